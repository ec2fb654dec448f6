"""The graph inside an estimator: ISAM2 with QR, insertion of links and removal of outliers."""

from collections.abc import Collection, Iterable, Sequence
from math import isfinite, sqrt
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.backend.batched_factors import BatchedFactor, BatchedFactors
from coloc_graph.backend.calibration import ANCHOR_TILT_SIGMA, PLANE, TILTS, is_calibration, size_of
from coloc_graph.backend.chi2_test import REJECTION_P_VALUE, UNCHECKED, Agreement, agreement, innovation, keys_of
from coloc_graph.backend.factors import Factors, calibrations_in
from coloc_graph.backend.fixed_lag import marginal_factor
from coloc_graph.backend.graph import Link
from coloc_graph.backend.insertion import InsertionPlan, Tie
from coloc_graph.backend.solver import RELINEARIZE_CALIBRATION, covariance_root, isam_parameters, optimise
from coloc_graph.backend.tie_test import TieTest
from coloc_graph.errors import EstimationError

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
    """Result: outliers, and the agreement of all links inserted; where ties are outliers, nothing is inserted."""

    rejected: list[tuple[Link, Agreement]]
    agreement: Agreement
    inserted: bool = True


class Isam2Graph:
    """Poses that are `tied` to the reference, and calibration variables, kept optimised while links are inserted.

    Not transactional: after an exception drop it and make it anew.
    """

    def __init__(self, factors_of: Factors) -> None:
        self.factors_of = factors_of
        self.tied: set[int] = set()
        #: Poses that were marginalised: T_world_body and covariance (6, 6) at that time.
        self.marginalised: dict[int, tuple[gtsam.Pose3, Array]] = {}
        self._poses: dict[int, gtsam.Pose3] = {}  # estimates that were asked for since the last step
        self._estimates = gtsam.Values()  # likewise, of variables that factors are on
        self._covariances: dict[int, Array] = {}  # likewise, of poses
        self._calibrated: dict[int, Array] = {}  # calibration variables at the last linearisation of everything
        self._former: dict[int, Array] = {}  # planes of marginalised stances, at their estimates
        self._batched: dict[int, BatchedFactor] = {}  # factors of numpy models, by index
        self._latest = _batch([])  # factors of the last insertion
        self._made: dict[int, tuple[Link, gtsam.NonlinearFactor]] = {}  # their links and factors, by a link's identity
        self.isam = self._new_isam()
        #: Factors and values with which it began, after poses were marginalised.
        self.begun = gtsam.NonlinearFactorGraph(), gtsam.Values()

    @classmethod
    def again(
        cls, factors_of: Factors, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, tied: Collection[int]
    ) -> "Isam2Graph":
        """Return the graph that began with some factors and values, as after `marginalise`."""
        graph = cls(factors_of)
        graph.begin_with(factors, values)
        graph.tied = set(tied)
        return graph

    def forget(self) -> None:
        """Drop the poses that were marginalised."""
        self.tied -= self.marginalised.keys()
        self.marginalised, self._former = {}, {}

    def _new_isam(self) -> gtsam.ISAM2:
        return gtsam.ISAM2(isam_parameters(calibrates=self.factors_of.variables is not None))

    def pose(self, key: int) -> gtsam.Pose3:
        """Return T_world_body of a tied key."""
        if key in self.marginalised:
            return self.marginalised[key][0]
        if key not in self._poses:
            self._poses[key] = self.isam.calculateEstimatePose3(key)
        return self._poses[key]

    def covariance(self, key: int) -> Array:
        """Return the covariance (6, 6) of a tied key."""
        if key in self.marginalised:
            return self.marginalised[key][1]
        if key not in self._covariances:
            root = covariance_root(self.isam, [key])
            self._covariances[key] = root @ root.T
        return self._covariances[key].copy()

    def errors(self, key: int) -> Array:
        """Return the estimate of a calibration variable: as stated while no factor is on it."""
        if key in self._calibrated:
            return np.asarray(self.isam.calculateEstimateVector(key))
        return self._former.get(key, self.factors_of.nominal(key))

    def residuals(self, ties: Iterable[Tie]) -> list[float]:
        """Return the RMS residual of each of some links between tied keys, in units of its noise."""
        links, factors = [tie[0] for tie in ties], [self._factor(tie) for tie in ties]
        with self._latest:
            known = self._known_of(factors)
            errors = [factor.error(known) for factor in factors]
        rows = map(self.factors_of.rows, links, factors)
        return [sqrt(2 * error / count) for error, count in zip(errors, rows, strict=True)]

    def _factor(self, tie: Tie) -> gtsam.NonlinearFactor:
        """Return the factor of a link: that of the last insertion, or a new one."""
        link, factor = self._made.get(id(tie[0]), (None, None))
        return self.factors_of.of_link(*tie) if factor is None or link is not tie[0] else factor

    def values(self) -> gtsam.Values:
        """Return the estimates of all variables."""
        values = self.isam.calculateEstimate()
        for key, (pose, _) in self.marginalised.items():
            values.insert(key, pose)
        return values

    def enter(self, plan: InsertionPlan) -> Outcome:
        """Insert poses and links, without outliers."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in plan.start.items():
            values.insert(key, pose)
            for factor in self._priors(key, plan):
                factors.add(factor)
        made = [self.factors_of.of_link(*tie) for tie in (*plan.ties, *plan.near)]
        if wrong := self._tie_test(plan).outliers(plan, made):
            return Outcome(wrong, UNCHECKED, inserted=False)
        far = {id(tie): self.factors_of.of_link(*tie) for tie in plan.far}
        links = (*plan.ties, *plan.near, *plan.far)
        self._made = {id(tie[0]): (tie[0], one) for tie, one in zip(links, (*made, *far.values()), strict=True)}
        self._latest = _batch(made + list(far.values()))
        with self._latest:
            return self._enter(plan, factors, values, made, far)

    def _priors(self, key: int, plan: InsertionPlan) -> tuple[gtsam.NonlinearFactor, ...]:
        """Return the priors of a new variable."""
        if not self.tied and key == next(iter(plan.start)):
            return (self.factors_of.gauge(key),)
        return self.factors_of.of_new(key, is_point=key in plan.points)

    def _tie_test(self, plan: InsertionPlan) -> TieTest:
        return TieTest(
            lambda key: key in self.tied or key in self._calibrated,
            None if self.tied else next(iter(plan.start), None),
            lambda key: plan.start[key] if key in plan.start else self._known(key),
            lambda keys: covariance_root(self.isam, keys),
            lambda key: self._priors(key, plan),
        )

    def _enter(
        self,
        plan: InsertionPlan,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        made: list[gtsam.NonlinearFactor],
        far: dict[int, gtsam.NonlinearFactor],
    ) -> Outcome:
        """Insert the factors of a plan: those of its poses, its ties and near links, and its distant links."""
        gates = {id(tie): self.factors_of.leading(*tie, self.errors) for tie in plan.far}
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
        inside = {
            index: InsertedLink(tie[0], factor)
            for index, factor, tie in zip(indices[first:], made[len(plan.ties) :], plan.near, strict=True)
        }
        rejected = self._enter_far([(InsertedLink(tie[0], far[id(tie)]), gates[id(tie)]) for tie in plan.far], inside)
        together = self._together(indices[:first], inside, plan)
        # no single link is further off than all of them together
        if (plan.far or not clear) and not (together.dof and together.chi2 < MAX_CLEAR_CHI2):
            rejected += self._take_out(inside)
            together = self._together(indices[:first], inside, plan)
        for key in plan.start:
            if not isfinite(self.pose(key).translation().sum()):
                raise EstimationError("a pose came out as not finite")
        self.tied |= plan.start.keys()
        self._anchor()
        return Outcome(rejected, together)

    def _together(self, first: Iterable[int], inside: Iterable[int], plan: InsertionPlan) -> Agreement:
        """Test all factors that a plan has put in, its `first` ones and its tested links, against the graph before."""
        factors = self.isam.getFactorsUnsafe()
        inserted = [factors.at(index) for index in (*first, *inside)]
        # what only determines new poses cannot be contradicted
        checked = sum(factor.dim() for factor in inserted) > 6 * len(plan.start)
        return self._agreement(inserted) if checked else UNCHECKED

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
        indices = self._update(factors, values, instead_of)
        for _ in range(MAX_STEPS):
            now = {key: self.errors(key) for key in self._calibrated}
            changes = (np.abs(now[key] - before).max() for key, before in self._calibrated.items())
            if all(change < RELINEARIZE_CALIBRATION for change in changes):
                break
            self._linearise()
            self._calibrated = now
        return indices

    def _update(
        self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, instead_of: Sequence[int] = ()
    ) -> list[int]:
        """Insert factors, `instead_of` others, take one step, and return their indices."""
        self._moved()
        indices = list(self.isam.update(factors, values, list(instead_of)).getNewFactorsIndices())
        for index in instead_of:
            self._batched.pop(index, None)
        if self.factors_of.variables is not None:
            made = map(factors.at, range(len(indices)))
            self._batched |= {n: one for n, one in zip(indices, made, strict=True) if isinstance(one, BatchedFactor)}
        return indices

    def _moved(self) -> None:
        """Drop the estimates that were asked for, before a step."""
        self._poses, self._estimates, self._covariances = {}, gtsam.Values(), {}

    def _linearise(self) -> None:
        """Linearise everything anew at its estimate, and take one step."""
        again = gtsam.ISAM2UpdateParams()
        again.force_relinearize = True
        self._moved()
        with _batch(self._batched.values()):
            self.isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), again)

    def marginalise(self, keep: Collection[int]) -> None:
        """Marginalise all poses but those to `keep`, with the planes that were stated for their stances.

        Their estimates stay as they are now; what their measurements say of the others remains, linearised.
        """
        inside = self.isam.getFactorsUnsafe()
        factors = {n: inside.at(n) for n in range(inside.size()) if inside.exists(n)}
        gone = self.tied - self.marginalised.keys() - set(keep)
        planes = {key for key in self._calibrated if gtsam.mrsymbolChr(key) == PLANE}
        for factor in factors.values():
            keys = set(map(int, factor.keys()))
            if not keys & gone and len(keys) > 1:
                planes -= keys
        values = self.isam.calculateEstimate()
        self.marginalised |= {key: (values.atPose3(key), self.covariance(key)) for key in gone}
        self._former |= {key: self.errors(key) for key in planes}
        past, left = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for factor in factors.values():
            (past if (gone | planes).intersection(factor.keys()) else left).add(factor)
        oldest_first = [key for key in keys_of(past.at(n) for n in range(past.size())) if key in gone]
        with _batch(self._batched.values()):
            summary = marginal_factor(past.linearize(values), values, (*oldest_first, *sorted(planes)))
            if summary is not None:
                left.add(summary)
            for key in gone | planes:
                values.erase(key)
            self.begin_with(left, values)

    def begin_with(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Hold these factors and variables, and nothing else."""
        self.isam, self._batched, self.begun = self._new_isam(), {}, (factors, values)
        self._update(factors, values)
        self._calibrated = calibrations_in(values)

    def _known(self, key: int) -> gtsam.Pose3 | Array:
        return self.errors(key) if is_calibration(key) else self.pose(key)

    def _with_known(self, new: gtsam.Values, factors: gtsam.NonlinearFactorGraph) -> gtsam.Values:
        """Return the initial values of new variables, and the estimates of all others that factors are on."""
        values = gtsam.Values(self._estimates)
        values.insert(new)
        for key in map(int, factors.keyVector()):
            if not values.exists(key):
                values.insert(key, self._known(key))
        return values

    def _enter_far(
        self, far: list[tuple[InsertedLink, gtsam.NonlinearFactor | None]], inside: dict[int, InsertedLink]
    ) -> list[tuple[Link, Agreement]]:
        """Insert links that agree with the graph, and add them to `inside`; return the others, which are rejected."""
        rejected: list[tuple[Link, Agreement]] = []
        passed: list[InsertedLink] = []
        factors, leading = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        tested = [one.factor if gate is None else gate for one, gate in far]
        for (one, gate), factor in zip(far, tested, strict=True):
            off = self._agreement([factor], inside=False)
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
        indices = self._update(leading, gtsam.Values())
        keys = keys_of([leading.at(n) for n in range(leading.size())])
        before = [self.pose(key) for key in keys]
        for _ in range(MAX_STEPS):
            self._linearise()
            now = [self.pose(key) for key in keys]
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
            self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [worst])
            before = np.inf
        return rejected

    def _agreement(self, factors: list[gtsam.NonlinearFactor], *, inside: bool = True) -> Agreement:
        if not factors:
            return UNCHECKED
        keys = keys_of(factors)
        root = covariance_root(self.isam, keys)
        begin = 0
        for key in keys:
            end = begin + size_of(key)
            if not is_calibration(key):
                self._covariances[key] = root[begin:end] @ root[begin:end].T
            begin = end
        return (agreement if inside else innovation)(factors, self._known_of(factors), root)

    def _known_of(self, factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.Values:
        """Return the estimates of all variables that factors are on, and those of the latest batch, among others."""
        values = self._estimates
        batch = (key for key in self._latest.keys if self.isam.valueExists(key))
        for key in (*keys_of(factors), *batch):
            if not values.exists(key):
                values.insert(key, self._known(key))
        return values


def _batch(factors: Iterable[gtsam.NonlinearFactor]) -> BatchedFactors:
    """Return the context in which those of numpy models among factors are evaluated together."""
    return BatchedFactors([one.evaluator for one in factors if isinstance(one, BatchedFactor)])
