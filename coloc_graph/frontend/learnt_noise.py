"""Learn the noise of each camera's marker centres from the run (`NoiseBelief`).

The team's values (`Camera.centre_noise`, or the defaults) are the prior. All fits of a run update it at once, or stance
by stance.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from coloc_graph.frontend.homography.noise_components import NoiseEvidence, learn_components, scatter_of
from coloc_graph.frontend.homography.refinement import linearise, projection
from coloc_graph.frontend.homography.scatter import learn_spread
from coloc_graph.frontend.pairing.correspondence import separated
from coloc_graph.frontend.stance import FrontendOptions, PairMeasurement, measure_pair
from coloc_graph.frontend.stance_tracks import StanceTracks
from coloc_graph.run import Recorded, Stance
from coloc_graph.run.recorded import Restated
from coloc_graph.team import CentreNoise, Team
from coloc_graph.team.centre_noise import COMPONENTS

Array = NDArray[np.float64]

BIAS_PX = 0.002  # median of the shared error where a team states nothing
SAME_NOISE = 0.01  # relative difference of standard deviations of centres that changes no measurement
PARTS = (("stated sigma times", "scale", ""), ("white floor", "floor", "px"), ("of saturated spots", "saturated", "px"))


@dataclass(frozen=True)
class NoiseRow:
    """Component of a camera's noise, stated and learnt, each with its factor of uncertainty."""

    robot: str
    what: str
    unit: str
    stated: float
    stated_factor: float
    learnt: float
    learnt_factor: float


@dataclass(frozen=True, eq=False)
class NoiseBelief:
    """Belief on the noise of robots' cameras.

    Attributes
    ----------
    robots
        Names of the r robots with a camera.
    mean, covariance
        Logarithms of the variance components, `COMPONENTS` for each robot, (k,), and their covariance, (k, k).
    points
        Numbers of marker centres that they are learnt from, (r,).
    typical
        Mean stated variance of the centres [px^2] and share of saturated ones, (r, 2).
    bias_px, bias_factor
        Medians of the errors that all centres of a marker share in a stance [px], and the factors within which they
        are known, (r,).
    spread, spread_factor
        Median of the standard deviation of the logarithms of stances' variances, and the factor within which it is
        known.
    """

    robots: tuple[str, ...]
    mean: Array
    covariance: Array
    points: NDArray[np.int64]
    typical: Array
    bias_px: Array
    bias_factor: Array
    spread: float
    spread_factor: float

    @classmethod
    def of(cls, team: Team) -> "NoiseBelief":
        """Return the prior that a team states for all robots with a camera."""
        robots = tuple(robot.name for robot in team.robots if robot.camera_if_any is not None)
        stated = [team[name].camera.centre_noise or CentreNoise() for name in robots]
        logs = [one.logs for one in stated]
        means, sigmas = ([value for one in logs for value in one[which]] for which in (0, 1))
        spreads = np.log([(one.spread, one.spread_factor) for one in stated or [CentreNoise()]])
        cameras = [team[name].camera for name in robots]
        return cls(
            robots,
            np.array(means),
            np.diag(np.square(sigmas)),
            np.zeros(len(robots), np.int64),
            np.zeros((len(robots), 2)),
            np.array([one.bias_px or BIAS_PX for one in cameras]),
            np.array([one.bias_factor for one in cameras]),
            *np.exp(spreads.mean(axis=0)).tolist(),
        )

    def updated(self, measured: Sequence[PairMeasurement]) -> "NoiseBelief":
        """Return the belief updated by measurements."""
        made = [found for found in map(self._evidence, measured) if found is not None]
        if not made:
            return self
        every = [evidence for evidence, _ in made]
        mean, covariance = learn_components(every, self.mean, self.covariance)
        chi2, dof, level = scatter_of(every, np.exp(mean + covariance.diagonal() / 2), self.covariance)
        spread = learn_spread(chi2, dof, level, self.spread, self.spread_factor)
        points, typical = np.array(self.points), np.array(self.typical)
        sums = points[:, None] * typical
        for robot, number, mean_of_points in (seen for _, both in made for seen in both):
            points[robot] += number
            sums[robot] += number * mean_of_points
        typical = sums / np.maximum(points, 1)[:, None]
        changed = replace(self, mean=mean, covariance=covariance, points=points, typical=typical)
        return replace(changed, spread=spread[0], spread_factor=spread[1])

    def with_bias(self, size: float, factor: float) -> "NoiseBelief":
        """Return the belief with shared errors of `size` times those of before, known within a factor."""
        return replace(self, bias_px=size * self.bias_px, bias_factor=np.full(len(self.robots), factor))

    def _evidence(self, measured: PairMeasurement) -> tuple[NoiseEvidence, list[tuple[int, int, Array]]] | None:
        """Evidence of a fit, and for either camera its index, number of points, and their typical values."""
        fit, found, cameras = measured.fit, measured.correspondences, measured.cameras
        if fit is None or found is None or cameras is None:
            return None
        kept = np.flatnonzero(fit.inliers)
        pairs = found.pairs[kept]
        at = linearise(fit.H, pairs.x_i, pairs)
        robots = [self.robots.index(name) for name in (measured.homography.robot_i, measured.homography.robot_j)]
        sides = (pairs.x_i, pairs.covariance_i, found.loads_i), (pairs.x_j, pairs.covariance_j, found.loads_j)
        parts: list[Array] = []
        seen = []
        for robot, camera, (x, C, loads) in zip(robots, cameras, sides, strict=True):
            stated, per_px = separated(C, x, loads[kept], camera)
            own = [stated, *(load[:, None, None] * per_px for load in loads[kept].T)]
            parts += own if parts else [at.by_z @ part @ at.by_z.mT for part in own]
            variance = np.trace(np.linalg.solve(per_px, stated), axis1=1, axis2=2).mean() / 2
            seen.append((robot, len(kept), np.array([variance, loads[kept, 1].mean()])))
        components = np.array([len(COMPONENTS) * robot + n for robot in robots for n in range(len(COMPONENTS))])
        weight = measured.homography.share / fit.persistence
        rows = projection(fit.H, pairs.x_i)[2]
        return NoiseEvidence(at.residual_j, rows, np.array(parts), components, weight), seen

    def _of(self, robot: str) -> tuple[Array, Array]:
        own = slice(begin := len(COMPONENTS) * self.robots.index(robot), begin + len(COMPONENTS))
        return self.mean[own], self.covariance[own, own]

    def noise(self, robot: str) -> CentreNoise:
        """Return the noise of a camera: medians, each with its factor of uncertainty."""
        mean, covariance = self._of(robot)
        sigmas = np.sqrt(covariance.diagonal()).tolist()
        return CentreNoise.of_logs(mean.tolist(), sigmas, self.spread, self.spread_factor)

    def sigma(self, robot: str) -> tuple[float, float]:
        """Return the standard deviation of a typical centre [px] and its factor of uncertainty."""
        mean, _ = self._of(robot)
        stated, saturated = self.typical[self.robots.index(robot)]
        parts = np.exp(mean) * (stated, 1 - saturated, saturated)
        return math.sqrt(parts.sum()), math.exp(math.sqrt(self._log_variance(robot)) / 2)

    def _log_variance(self, robot: str, saturated: float | None = None) -> float:
        """Variance of the logarithm of the variance of a typical centre, or of a typical one with a saturated share."""
        mean, covariance = self._of(robot)
        stated, usual = self.typical[self.robots.index(robot)]
        share = usual if saturated is None else saturated
        parts = np.exp(mean) * (stated, 1 - share, share)
        relative = parts / parts.sum()
        return float(relative @ covariance @ relative)

    def differs_from(self, other: "NoiseBelief") -> bool:
        """Return whether measurements differ by the two: the typical centre does by more than `SAME_NOISE`."""
        now, before = (
            [one.sigma(name) for name in self.robots] for one in (self, replace(other, typical=self.typical))
        )
        logs = np.log([[sigma * factor ** math.log(factor) for sigma, factor in one] for one in (now, before)])
        return bool((np.abs(logs[0] - logs[1])[self.points > 0] > SAME_NOISE).any())

    def rows(self, team: Team) -> list[NoiseRow]:
        """Return the learnt components beside the stated ones."""
        rows = []
        for robot, points, (variance, saturated) in zip(self.robots, self.points, self.typical, strict=True):
            if not points:
                continue
            stated, learnt = team[robot].camera.centre_noise or CentreNoise(), self.noise(robot)
            rows.append(NoiseRow(robot, "typical centre", "px", math.sqrt(variance), 1.0, *self.sigma(robot)))
            there = (True, saturated < 1, saturated > 0)
            for what, name, unit in (part for part, seen in zip(PARTS, there, strict=True) if seen):
                ends = f"_{unit}" * bool(unit), "_factor"
                values = (getattr(one, f"{name}{end}") for one in (stated, learnt) for end in ends)
                rows.append(NoiseRow(robot, what, unit, *values))
            number = self.robots.index(robot)
            before = NoiseBelief.of(team)
            values = (one[number] for one in (before.bias_px, before.bias_factor, self.bias_px, self.bias_factor))
            rows.append(NoiseRow(robot, "shared in a stance", "px", *map(float, values)))
            differ = stated.spread, stated.spread_factor, self.spread, self.spread_factor
            rows.append(NoiseRow(robot, "log variance by stance", "", *differ))
        return rows

    def used(self, team: Team) -> Team:
        """Return a team whose cameras have the expected variances, which are larger than the medians if uncertain.

        The variance of a centre is often known better than its components, which cannot be separated: the scale is
        widened by the uncertainty of the typical centre, and each floor by that of a typical centre of its kind.
        """
        noises = {}
        for name in self.robots:
            mean, covariance = self._of(name)
            # half the variance of the logarithm of the variance
            widening = covariance.diagonal() / 2
            if self.points[self.robots.index(name)]:
                widening = np.array([self._log_variance(name, saturated) for saturated in (None, 0.0, 1.0)]) / 2
            spread = self.spread * math.exp(math.log(self.spread_factor) ** 2)  # root of the expected square
            noises[name] = CentreNoise.of_logs((mean + widening).tolist(), [0.0] * len(COMPONENTS), spread, 1.0)
        expected = self.bias_px * np.exp(np.log(self.bias_factor) ** 2)  # root of the expected square
        return _with_noise(team, noises, dict(zip(self.robots, expected, strict=True)))

    def learnt(self, team: Team) -> Team:
        """Return a team that states the learnt noise of its cameras."""
        noises = {
            name: structs.replace(self.noise(name), typical_px=self.sigma(name)[0])
            for name, n in zip(self.robots, self.points, strict=True)
            if n
        }
        bias = dict(zip(self.robots, self.bias_px, strict=True))
        return _with_noise(team, noises, bias, dict(zip(self.robots, self.bias_factor, strict=True)))


def _with_noise(
    team: Team,
    noises: Mapping[str, CentreNoise],
    bias_px: Mapping[str, float],
    bias_factor: Mapping[str, float] | None = None,
) -> Team:
    """Return a team with other noise of some robots' cameras."""
    robots = []
    for robot in team.robots:
        if robot.name in noises:
            camera, factor = robot.camera, (bias_factor or {}).get(robot.name, robot.camera.bias_factor)
            noise = {"centre_noise": noises[robot.name], "bias_px": float(bias_px[robot.name])}
            robot = structs.replace(robot, camera_if_any=structs.replace(camera, **noise, bias_factor=float(factor)))
        robots.append(robot)
    return structs.replace(team, robots=tuple(robots))


def measured_again(measured: Iterable[PairMeasurement], team: Team) -> tuple[PairMeasurement, ...]:
    """Measure pairs again from the same points, with the noise of a team's cameras."""
    return tuple(
        one
        if one.with_team is None
        else replace(
            one.with_team(team),
            offset_evidence=one.offset_evidence,
            standing=one.standing,
            landmarks=one.landmarks,
        )
        for one in measured
    )


def measure_alone(
    run: Recorded,
    stance: Stance,
    robot_i: str,
    robot_j: str,
    options: FrontendOptions | None = None,
    tracks: StanceTracks | None = None,
) -> PairMeasurement:
    """Measure a pair of one stance as a run of this stance alone would: with the team's prior of the noise, updated.

    Parameters
    ----------
    run, stance
        Run and stance.
    robot_i, robot_j
        Names of the observers.
    options
        Options of the front end.
    tracks
        Tracks of the stance, if they exist already.

    Returns
    -------
    PairMeasurement
        The measurement.
    """
    prior = NoiseBelief.of(run.team)
    noisy = Restated(run, prior.used(run.team))
    first = measure_pair(noisy, stance, robot_i, robot_j, options or FrontendOptions(), tracks)
    return measured_again([first], prior.updated([first]).used(run.team))[0]
