"""The graph inside an estimator: ISAM2 with QR, what enters it, and what all others contradict taken out again."""

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.backend.calibration import ANCHORED, is_calibration
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.backend.chi2_test import LEAST_CHANCE, UNCHECKED, Agreement, agreement, innovation, keys_of
from coloc_graph.backend.factors import Factors, Method, calibrations_in, poses_in
from coloc_graph.backend.graph import Link, PoseGraph
from coloc_graph.backend.insertion import InsertionPlan, Tie
from coloc_graph.backend.optimize import fit_graph
from coloc_graph.backend.solver import RELINEARIZE_CALIBRATION, isam_parameters, joint_covariance, optimise, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Sighting

Array = NDArray[np.float64]

#: With less chi2 than this in all that enters, nothing of it is rejected, of however few degrees of freedom.
CLEAR = float(chdtri(1, LEAST_CHANCE))
#: So many steps at most lead to the optimum when something enters: a first stance with mounts a degree off takes 4.
MOST_STEPS = 10
#: Poses that a step moves by less than this are there [m, entries of a rotation].
THERE = 1e-4
#: A step that leaves more than this share of the worst chi2 has not brought it nearer.
NEARER = 0.9


class Entered(NamedTuple):
    """A link and the factor that it is."""

    link: Link
    factor: gtsam.NonlinearFactor


class Outcome(NamedTuple):
    """What was left out, and how all that went in agrees with what was there."""

    rejected: list[tuple[Link, Agreement]]
    agreement: Agreement


class Isam2Graph:
    """Poses that are `tied` to the reference, and calibration variables, kept optimised while links come in.

    Not transactional: after an exception it is to be thrown away, and `rebuilt`.
    """

    def __init__(self, factors_of: Factors) -> None:
        self.factors_of = factors_of
        self.tied: set[int] = set()
        self._calibrated: dict[int, Array] = {}  # calibration variables, where all was last linearised
        self.isam = gtsam.ISAM2(isam_parameters(calibrates=factors_of.variables is not None))

    def pose(self, key: int) -> gtsam.Pose3:
        """T_world_body of a tied key."""
        return self.isam.calculateEstimatePose3(key)

    def covariance(self, key: int) -> Array:
        """Its covariance (6, 6)."""
        return np.asarray(self.isam.marginalCovariance(key))

    def errors(self, key: int) -> Array:
        """What a calibration variable is thought to be: as stated, as long as nothing asks for it."""
        if key in self._calibrated:
            return np.asarray(self.isam.calculateEstimateVector(key))
        return self.factors_of.nominal(key)

    def residual(self, tie: Tie) -> float:
        """How far a link between tied keys is from what is known, RMS in units of its noise."""
        factor = self.factors_of.of_link(*tie)
        values = gtsam.Values()
        for key in map(int, factor.keys()):
            values.insert(key, self._known(key))
        return float(np.sqrt(2 * factor.error(values) / self.factors_of.rows(tie[0], factor)))

    def values(self) -> gtsam.Values:
        """Everything, where it is; to ask changes nothing."""
        return self.isam.calculateEstimate()

    def enter(self, entering: InsertionPlan) -> Outcome:
        """Put poses and links in, without what all others contradict."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in entering.start.items():
            is_reference = not self.tied and not values.size()
            values.insert(key, pose)
            for factor in (self.factors_of.gauge(key),) if is_reference else self.factors_of.of_pose(key):
                factors.add(factor)
        made = [self.factors_of.of_link(*tie) for tie in (*entering.ties, *entering.near)]
        far = {id(tie): self.factors_of.of_link(*tie) for tie in entering.far}
        gates = {id(tie): self._gate(tie) for tie in entering.far}
        self._new_variables([*made, *far.values()], factors, values)
        first = factors.size() + len(entering.ties)
        for factor in made:
            factors.add(factor)
        # what the error rises by is at most what the new factors have before anything moves to please them
        clear = not entering.near or 2 * factors.error(self._with_known(values, factors)) < CLEAR
        if not self.tied and self._calibrated:
            # mounts that are degrees off lead a first full step to where nothing leads on
            values, _ = optimise(factors, values)
        indices = self._into_isam(factors, values) if factors.size() else []
        inside = {index: Entered(tie[0], self.isam.getFactorsUnsafe().at(index))
                  for index, tie in zip(indices[first:], entering.near, strict=True)}  # fmt: skip
        rejected = self._enter_far([(Entered(tie[0], far[id(tie)]), gates[id(tie)]) for tie in entering.far], inside)
        if entering.far or not clear:
            rejected += self._take_out(inside)
        together = self._agreement([self.isam.getFactorsUnsafe().at(index) for index in (*indices[:first], *inside)])
        for key in entering.start:
            if not np.isfinite(self.isam.calculateEstimatePose3(key).translation()).all():
                raise EstimationError("a pose came out as not finite")
        self.tied |= entering.start.keys()
        self._anchor()
        return Outcome(rejected, together)

    def _anchor(self) -> None:
        """Once a mount's tilts are known well enough, spans that come in are taken apart for it as it is."""
        variables = self.factors_of.variables
        if variables is None:
            return
        for key in self._calibrated:
            if variables.is_mount(key) and (
                key in variables.anchors or np.sqrt(self.covariance(key).diagonal()[1:].max()) < ANCHORED
            ):
                variables.anchors[key] = self.errors(key)

    def _new_variables(
        self, made: list[gtsam.NonlinearFactor], factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> None:
        """The calibration variables that factors ask for and that are not in yet: added with their priors."""
        for key in sorted({key for factor in made for key in factor.keys()[2:]} - self._calibrated.keys()):
            self._calibrated[key] = self.factors_of.nominal(key)
            values.insert(key, self._calibrated[key])
            factors.add(self.factors_of.calibration_prior(key))

    def _into_isam(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, instead_of: Sequence[int] = ()
    ) -> list[int]:
        """Put factors in, `instead_of` others, and optimise; their indices.

        Where mounts turn out otherwise than thought, everything is linearised anew until they stay: poses shift with
        them, and that far one step does not lead to the optimum.
        """
        indices = list(self.isam.update(factors, values, list(instead_of)).getNewFactorsIndices())
        for _ in range(MOST_STEPS):
            now = {key: self.errors(key) for key in self._calibrated}
            changes = (np.abs(now[key] - before).max() for key, before in self._calibrated.items())
            if all(change < RELINEARIZE_CALIBRATION for change in changes):
                break
            self._linearise()
            self._calibrated = now
        return indices

    def _linearise(self) -> None:
        """Everything anew where it is, and one step from there."""
        again = gtsam.ISAM2UpdateParams()
        again.force_relinearize = True
        self.isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)

    def _known(self, key: int) -> gtsam.Pose3 | Array:
        return self.errors(key) if is_calibration(key) else self.isam.calculateEstimatePose3(key)

    def _with_known(self, new: gtsam.Values, factors: gtsam.NonlinearFactorGraph) -> gtsam.Values:
        """New variables where they start, and all others that factors are on where they are."""
        values = gtsam.Values(new)
        for key in map(int, factors.keyVector()):
            if not values.exists(key):
                values.insert(key, self._known(key))
        return values

    def _gate(self, tie: Tie) -> gtsam.NonlinearFactor | None:
        """By what a sighting that is far off is tested, and led in: what it says of two poses. None of all else, which
        is tested as it is.

        A landmark that drift has put elsewhere is far off in the image, or behind the camera: there pixels tell
        neither how far, nor the way there.
        """
        link, i, j = tie
        if not isinstance(link, Sighting) or self.factors_of.variables is None:
            return None
        return self.factors_of.between(link, i, j, self.factors_of.expected(link, i, j, self.errors))

    def _enter_far(
        self, far: list[tuple[Entered, gtsam.NonlinearFactor | None]], inside: dict[int, Entered]
    ) -> list[tuple[Link, Agreement]]:
        """Put in what does not contradict what is known, and note it as `inside`; what does is rejected."""
        rejected: list[tuple[Link, Agreement]] = []
        passed: list[Entered] = []
        factors, leading = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for one, gate in far:
            off = self._agreement([one.factor if gate is None else gate], inside=False)
            if off.chance() < LEAST_CHANCE:
                rejected.append((one.link, off))
            else:
                passed.append(one)
                factors.add(one.factor)
                if gate is not None:
                    leading.add(gate)
        if passed:
            led = self._led_in(leading)
            inside |= zip(self._into_isam(factors, gtsam.Values(), led), passed, strict=True)
        return rejected

    def _led_in(self, leading: gtsam.NonlinearFactorGraph) -> list[int]:
        """Put in factors that are to lead the poses to where others make sense, and go there; their indices."""
        if not leading.size():
            return []
        indices = list(self.isam.update(leading, gtsam.Values()).getNewFactorsIndices())
        keys = keys_of([leading.at(n) for n in range(leading.size())])
        before = [self.isam.calculateEstimatePose3(key) for key in keys]
        for _ in range(MOST_STEPS):
            self._linearise()
            now = [self.isam.calculateEstimatePose3(key) for key in keys]
            if all(a.equals(b, THERE) for a, b in zip(before, now, strict=True)):
                break
            before = now
        return indices

    def _take_out(self, inside: dict[int, Entered]) -> list[tuple[Link, Agreement]]:
        """Take out what all others contradict, the worst first."""
        rejected: list[tuple[Link, Agreement]] = []
        before = np.inf  # how far off the worst was a step ago; where no step brings it nearer, it is the optimum
        while inside:
            among = {index: self._agreement([one.factor]) for index, one in inside.items()}
            worst = min(among, key=lambda index: among[index].chance())
            if among[worst].chance() >= LEAST_CHANCE:
                break
            if among[worst].chi2 < NEARER * before:
                # what steps leave of a residual counts many times over where little else checks it
                before = among[worst].chi2
                self._linearise()
                continue
            rejected.append((inside.pop(worst).link, among[worst]))
            self.isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [worst])
            before = np.inf
        return rejected

    def _agreement(self, factors: list[gtsam.NonlinearFactor], *, inside: bool = True) -> Agreement:
        if not factors:
            return UNCHECKED
        values, keys = gtsam.Values(), keys_of(factors)
        for key in keys:
            values.insert(key, self._known(key))
        return (agreement if inside else innovation)(factors, values, joint_covariance(self.isam, keys))


def rebuilt(graph: PoseGraph, method: Method) -> tuple[Isam2Graph, tuple[Link, ...]]:
    """A live graph of everything in a graph that is tied to the reference, at its optimum, and the links that are."""
    if not spanning_tree(graph, graph.links):
        graph = graph.without(graph.measurements)  # nothing is tied yet but the reference
    fit = with_stack(len(graph.nodes), lambda: fit_graph(method, graph))
    live = Isam2Graph(fit.factors_of)
    with fit.at_once:
        live.isam.update(fit.factors, fit.values)
    live.tied = set(poses_in(fit.values))
    live._calibrated = calibrations_in(fit.values)
    return live, fit.links
