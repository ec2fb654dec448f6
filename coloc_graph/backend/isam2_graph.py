"""The graph inside an estimator: ISAM2 with QR, insertion of links and removal of outliers."""

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.backend.calibration import ANCHOR_TILT_SIGMA, TILTS, is_calibration
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE, UNCHECKED, Agreement, agreement, innovation, keys_of
from coloc_graph.backend.factors import Factors, Method, calibrations_in, poses_in
from coloc_graph.backend.graph import Link, PoseGraph
from coloc_graph.backend.insertion import InsertionPlan, Tie
from coloc_graph.backend.optimize import fit_graph
from coloc_graph.backend.solver import RELINEARIZE_CALIBRATION, isam_parameters, joint_covariance, optimise, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.measurements import Sighting

Array = NDArray[np.float64]

MAX_CLEAR_CHI2 = float(chdtri(1, REJECTION_P_VALUE))  # chi2 of an insertion below which it holds no outlier
MAX_STEPS = 10  # relinearisations per insertion; a first stance with mounts a degree off takes 4
CONVERGED = 1e-4  # change of poses by a step below which they have converged [m, entries of a rotation]
MAX_CHI2_RATIO = 0.9  # of the worst chi2 after and before a step, below which another step is taken


class InsertedLink(NamedTuple):
    """A link and its factor in the graph."""

    link: Link
    factor: gtsam.NonlinearFactor


class Outcome(NamedTuple):
    """Result of an insertion: outliers, and the agreement of all inserted links with the graph before."""

    rejected: list[tuple[Link, Agreement]]
    agreement: Agreement


class Isam2Graph:
    """Poses that are `tied` to the reference, and calibration variables, kept optimised while links are inserted.

    Not transactional: after an exception drop it and use `rebuilt`.
    """

    def __init__(self, factors_of: Factors) -> None:
        self.factors_of = factors_of
        self.tied: set[int] = set()
        self._calibrated: dict[int, Array] = {}  # calibration variables at the last linearisation of everything
        self.isam = gtsam.ISAM2(isam_parameters(calibrates=factors_of.variables is not None))

    def pose(self, key: int) -> gtsam.Pose3:
        """Return T_world_body of a tied key."""
        return self.isam.calculateEstimatePose3(key)

    def covariance(self, key: int) -> Array:
        """Return the covariance (6, 6) of a tied key."""
        return np.asarray(self.isam.marginalCovariance(key))

    def errors(self, key: int) -> Array:
        """Return the estimate of a calibration variable: as stated while no factor is on it."""
        if key in self._calibrated:
            return np.asarray(self.isam.calculateEstimateVector(key))
        return self.factors_of.nominal(key)

    def residual(self, tie: Tie) -> float:
        """Return the RMS residual of a link between tied keys in units of its noise."""
        factor = self.factors_of.of_link(*tie)
        values = gtsam.Values()
        for key in map(int, factor.keys()):
            values.insert(key, self._known(key))
        return float(np.sqrt(2 * factor.error(values) / self.factors_of.rows(tie[0], factor)))

    def values(self) -> gtsam.Values:
        """Return the estimates of all variables."""
        return self.isam.calculateEstimate()

    def enter(self, plan: InsertionPlan) -> Outcome:
        """Insert poses and links, without outliers."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in plan.start.items():
            is_reference = not self.tied and not values.size()
            values.insert(key, pose)
            for factor in (self.factors_of.gauge(key),) if is_reference else self.factors_of.of_pose(key):
                factors.add(factor)
        made = [self.factors_of.of_link(*tie) for tie in (*plan.ties, *plan.near)]
        far = {id(tie): self.factors_of.of_link(*tie) for tie in plan.far}
        gates = {id(tie): self._gate(tie) for tie in plan.far}
        self._new_variables([*made, *far.values()], factors, values)
        first = factors.size() + len(plan.ties)
        for factor in made:
            factors.add(factor)
        # the increase of chi2 is at most that of the new factors before anything moves
        clear = not plan.near or 2 * factors.error(self._with_known(values, factors)) < MAX_CLEAR_CHI2
        if not self.tied and self._calibrated:
            # with mounts that are degrees off a first full step may diverge
            values, _ = optimise(factors, values)
        indices = self._into_isam(factors, values) if factors.size() else []
        inside = {index: InsertedLink(tie[0], self.isam.getFactorsUnsafe().at(index))
                  for index, tie in zip(indices[first:], plan.near, strict=True)}  # fmt: skip
        rejected = self._enter_far([(InsertedLink(tie[0], far[id(tie)]), gates[id(tie)]) for tie in plan.far], inside)
        if plan.far or not clear:
            rejected += self._take_out(inside)
        together = self._agreement([self.isam.getFactorsUnsafe().at(index) for index in (*indices[:first], *inside)])
        for key in plan.start:
            if not np.isfinite(self.isam.calculateEstimatePose3(key).translation()).all():
                raise EstimationError("a pose came out as not finite")
        self.tied |= plan.start.keys()
        self._anchor()
        return Outcome(rejected, together)

    def _anchor(self) -> None:
        """Linearise further spans at the estimate of a mount, once its tilts are known well enough."""
        variables = self.factors_of.variables
        if variables is None:
            return
        for key in self._calibrated:
            if variables.is_mount(key) and (
                key in variables.anchors or np.sqrt(self.covariance(key).diagonal()[TILTS].max()) < ANCHOR_TILT_SIGMA
            ):
                variables.anchors[key] = self.errors(key)

    def _new_variables(
        self, made: list[gtsam.NonlinearFactor], factors: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> None:
        """Add the calibration variables that factors are on and that the graph lacks, with their priors."""
        for key in sorted({key for factor in made for key in factor.keys()[2:]} - self._calibrated.keys()):
            self._calibrated[key] = self.factors_of.nominal(key)
            values.insert(key, self._calibrated[key])
            factors.add(self.factors_of.calibration_prior(key))

    def _into_isam(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, instead_of: Sequence[int] = ()
    ) -> list[int]:
        """Insert factors, `instead_of` others, optimise, and return their indices.

        Where mounts change, everything is linearised anew until they converge: poses shift with them, further than one
        step reaches.
        """
        indices = list(self.isam.update(factors, values, list(instead_of)).getNewFactorsIndices())
        for _ in range(MAX_STEPS):
            now = {key: self.errors(key) for key in self._calibrated}
            changes = (np.abs(now[key] - before).max() for key, before in self._calibrated.items())
            if all(change < RELINEARIZE_CALIBRATION for change in changes):
                break
            self._linearise()
            self._calibrated = now
        return indices

    def _linearise(self) -> None:
        """Linearise everything anew at its estimate, and take one step."""
        again = gtsam.ISAM2UpdateParams()
        again.force_relinearize = True
        self.isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)

    def _known(self, key: int) -> gtsam.Pose3 | Array:
        return self.errors(key) if is_calibration(key) else self.isam.calculateEstimatePose3(key)

    def _with_known(self, new: gtsam.Values, factors: gtsam.NonlinearFactorGraph) -> gtsam.Values:
        """Return the initial values of new variables, and the estimates of all others that factors are on."""
        values = gtsam.Values(new)
        for key in map(int, factors.keyVector()):
            if not values.exists(key):
                values.insert(key, self._known(key))
        return values

    def _gate(self, tie: Tie) -> gtsam.NonlinearFactor | None:
        """Return the between-factor by which a distant sighting is tested and led in; None of other links.

        A landmark that drift has displaced is far off in the image, or behind the camera: there its pixels give
        neither a distance nor a gradient.
        """
        link, i, j = tie
        if not isinstance(link, Sighting) or self.factors_of.variables is None:
            return None
        return self.factors_of.between(link, i, j, self.factors_of.expected(link, i, j, self.errors))

    def _enter_far(
        self, far: list[tuple[InsertedLink, gtsam.NonlinearFactor | None]], inside: dict[int, InsertedLink]
    ) -> list[tuple[Link, Agreement]]:
        """Insert links that agree with the graph, and add them to `inside`; return the others, which are rejected."""
        rejected: list[tuple[Link, Agreement]] = []
        passed: list[InsertedLink] = []
        factors, leading = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for one, gate in far:
            off = self._agreement([one.factor if gate is None else gate], inside=False)
            if off.p_value() < REJECTION_P_VALUE:
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
        """Insert factors that lead the poses to where others can be evaluated, optimise, and return their indices."""
        if not leading.size():
            return []
        indices = list(self.isam.update(leading, gtsam.Values()).getNewFactorsIndices())
        keys = keys_of([leading.at(n) for n in range(leading.size())])
        before = [self.isam.calculateEstimatePose3(key) for key in keys]
        for _ in range(MAX_STEPS):
            self._linearise()
            now = [self.isam.calculateEstimatePose3(key) for key in keys]
            if all(a.equals(b, CONVERGED) for a, b in zip(before, now, strict=True)):
                break
            before = now
        return indices

    def _take_out(self, inside: dict[int, InsertedLink]) -> list[tuple[Link, Agreement]]:
        """Remove outliers, the worst first."""
        rejected: list[tuple[Link, Agreement]] = []
        before = np.inf  # worst chi2 a step ago; it has converged where a step no longer lowers it
        while inside:
            among = {index: self._agreement([one.factor]) for index, one in inside.items()}
            worst = min(among, key=lambda index: among[index].p_value())
            if among[worst].p_value() >= REJECTION_P_VALUE:
                break
            if among[worst].chi2 < MAX_CHI2_RATIO * before:
                # an unconverged residual counts many times over where little else checks it
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
    """Return the ISAM2 graph of all that is tied to the reference, at its optimum, and the tied links."""
    if not spanning_tree(graph, graph.links):
        graph = graph.without(graph.measurements)  # nothing but the reference is tied yet
    fit = with_stack(len(graph.nodes), lambda: fit_graph(method, graph))
    live = Isam2Graph(fit.factors_of)
    with fit.batched:
        live.isam.update(fit.factors, fit.values)
    live.tied = set(poses_in(fit.values))
    live._calibrated = calibrations_in(fit.values)
    return live, fit.links
