"""The most likely poses, landmarks and errors of a whole drive together: `optimise_drive`."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.planar.estimate import DriveEstimate, Errors
from coloc_graph.backend.planar.factors import DriveFactors, landmark_key, pose_key
from coloc_graph.backend.planar.filter import Filtered, Models, filter_forward
from coloc_graph.backend.planar.gauss_newton import gauss_newton
from coloc_graph.backend.planar.summary import DOUBTED, Found, measured_off, steps_off, summed_up
from coloc_graph.backend.solver import joint_covariance, with_stack
from coloc_graph.errors import EstimationError
from coloc_graph.keyframes import Drive
from coloc_graph.team import Team

Array = NDArray[np.float64]

#: Of so many measurements and steps of each robot it is looked how much of their residual the fit has taken away.
SAMPLED = 30
#: Where the fit has left less than this of residuals, they say nothing of noise.
LEAST_LEFT = 0.3
#: Noise is not taken for less, or more, than so many times what is stated.
NOISE_RANGE = (0.2, 5.0)


def optimise_drive(team: Team, drive: Drive, *, calibrate_noise: bool = True) -> DriveEstimate:
    """The most likely of all, given all steps and measurements, from where a filter sees it.

    Noise is what the team states, times what makes it that of the residuals (`calibrate_noise`), by robot and kind.
    Raises `EstimationError` where no robot can be placed, or the search leads nowhere.
    """
    return with_stack(sum(map(len, drive.times)), lambda: _optimised(team, drive, calibrate_noise))


@dataclass(frozen=True, eq=False)
class _Graph:
    """A graph over the robots that have a place; `first_step` of each robot's and `measured` say which factor is
    which: the latter are the last, in their order."""

    factors: gtsam.NonlinearFactorGraph
    first_step: dict[int, int]
    measured: NDArray[np.int64]

    def of_measured(self, n: int) -> gtsam.NonlinearFactor:
        """The factor of the n-th of the measured."""
        return self.factors.at(self.factors.size() - len(self.measured) + n)


def _optimised(team: Team, drive: Drive, calibrate_noise: bool) -> DriveEstimate:
    filtered = filter_forward(team, drive)
    models = Models(team, drive)
    robots = sorted(filtered.placed_at)
    if not robots:
        raise EstimationError(
            "no robot's measurements say where it is: let one see two landmarks of known positions several times"
        )
    factors = DriveFactors(drive, models)
    values = _start(filtered, factors, robots)
    graph = _graph(factors, values, robots)
    values, iterations = gauss_newton(graph.factors, values)
    absorbed = None
    if calibrate_noise:
        found = _found(factors, values)
        marginals = gtsam.Marginals(graph.factors, values)
        noise, absorbed = _noise(factors, graph, found, values, marginals)
        factors = DriveFactors(drive, models, noise)
        graph = _graph(factors, values, robots)
        values, more = gauss_newton(graph.factors, values)
        iterations += more
    found = _found(factors, values, gtsam.Marginals(graph.factors, values))
    taken = np.zeros(len(drive.measured), bool)
    taken[graph.measured] = True
    return summed_up(factors, found, taken, iterations, absorbed)


def _start(filtered: Filtered, factors: DriveFactors, robots: Sequence[int]) -> gtsam.Values:
    """Where the search starts: as the filter has it."""
    values = gtsam.Values()
    whole = filtered.whole(factors.drive, factors.models)
    for robot in robots:
        for k, pose in enumerate(whole[robot].tolist()):
            values.insert(pose_key(robot, k), gtsam.Pose2(*pose))
        for key, errors in (
            (factors.wheels_variable(robot), filtered.wheels),
            (factors.ranging_variable(robot), filtered.ranging),
        ):
            if key is not None:
                values.insert(key, errors[robot])
    for landmark, position in enumerate(filtered.landmarks):
        if np.isfinite(position[0]) and not factors.is_exact(landmark):
            values.insert(landmark_key(landmark), position)
    return values


def _graph(factors: DriveFactors, values: gtsam.Values, robots: Sequence[int]) -> _Graph:
    drive, m = factors.drive, factors.drive.measured
    graph = gtsam.NonlinearFactorGraph()
    if not factors.models.map_known:
        key = pose_key(robots[0], 0)
        graph.add(factors.gauge(key, values.atPose2(key)))
    landmarks = [n for n in range(len(drive.landmarks)) if values.exists(landmark_key(n))]
    for factor in factors.priors(robots, landmarks):
        graph.add(factor)
    first_step = {}
    for robot in robots:
        first_step[robot] = graph.size()
        for k in range(len(drive.times[robot]) - 1):
            graph.add(factors.step(robot, k))
    there = np.zeros(len(drive.robots) + len(drive.landmarks), bool)
    there[list(robots)] = True
    there[[len(drive.robots) + n for n in range(len(drive.landmarks)) if n in landmarks or factors.is_exact(n)]] = True
    measured = np.flatnonzero(there[m.robot] & there[m.target])
    for index in measured.tolist():
        graph.add(factors.measured(index))
    return _Graph(graph, first_step, measured)


def _found(factors: DriveFactors, values: gtsam.Values, marginals: gtsam.Marginals | None = None) -> Found:
    """What values hold, with covariances where their marginals are given."""
    drive, models = factors.drive, factors.models

    def covariance(key: int, size: int) -> Array:
        return np.full((size, size), np.nan) if marginals is None else np.asarray(marginals.marginalCovariance(key))

    def errors_of(key: int) -> tuple[Array, Array]:
        errors = values.atVector(key)
        return errors, covariance(key, len(errors))

    poses, covariances, errors = [], [], []
    for robot, times in enumerate(drive.times):
        at, C = np.full((len(times), 3), np.nan), np.full((len(times), 3, 3), np.nan)
        there = len(times) > 0 and values.exists(pose_key(robot, 0))
        if there:
            for k in range(len(times)):
                pose = values.atPose2(pose_key(robot, k))
                at[k] = pose.x(), pose.y(), pose.theta()
                C[k] = covariance(pose_key(robot, k), 3)
        poses.append(at)
        covariances.append(C)
        errors.append(factors.errors_in(robot, errors_of) if there else Errors(None, None))
    landmarks = {}
    for number in range(len(drive.landmarks)):
        key = landmark_key(number)
        if values.exists(key):
            landmarks[number] = (np.asarray(values.atPoint2(key)), covariance(key, 2))
        elif factors.is_exact(number):
            landmarks[number] = (models.map[number], np.eye(2) * models.map_sigmas[number] ** 2)
    return Found(poses, covariances, landmarks, errors)


def _noise(
    factors: DriveFactors, graph: _Graph, found: Found, values: gtsam.Values, marginals: gtsam.Marginals
) -> tuple[Array, float]:
    """What standard deviations are to be multiplied with, (robots, 3): of ranges, bearings, steps.

    Of a sum of squared residuals the fit has taken away a part: that of the sampled ones. And how many degrees of
    freedom the fit has left more than shares say: of a measurement with a share s, of which it has taken h, it has left
    s (1 - h), and not s - h, since errors that last are not fitted as new ones would be.
    """
    absorbed = 0.0
    drive, m = factors.drive, factors.drive.measured
    off = measured_off(factors, found)[graph.measured]
    good = np.abs(off).max(axis=1, initial=0.0) < DOUBTED
    noise = factors.noise.copy()
    rng = np.random.default_rng(0)
    for robot, first in graph.first_step.items():
        own = np.flatnonzero((m.robot[graph.measured] == robot) & good)
        if len(own):
            share = m.share[graph.measured[own]]
            some = rng.choice(own, min(SAMPLED, len(own)), replace=False)
            taken = np.mean([_taken(graph.of_measured(int(n)), values, marginals) for n in some], axis=0)
            mean = (share * off[own] ** 2).sum(axis=0) / share.sum(axis=0)
            noise[robot, :2] *= np.sqrt(mean / np.maximum(1 - taken, LEAST_LEFT))
            absorbed += float(((1 - share) * taken).sum())
        steps = len(drive.times[robot]) - 1
        if steps > 0:
            some = rng.choice(steps, min(SAMPLED, steps), replace=False)
            of_steps = [_taken(graph.factors.at(first + int(k)), values, marginals) for k in some]
            left = 1 - float(np.mean(of_steps))
            if left > LEAST_LEFT:
                noise[robot, 2] *= float(np.sqrt((steps_off(factors, found, robot) ** 2).mean() / left))
    return np.clip(noise, *NOISE_RANGE), absorbed


def _taken(factor: gtsam.NonlinearFactor, values: gtsam.Values, marginals: gtsam.Marginals) -> Array:
    """How much of a factor's squared residual the fit has taken away, by row, in units of its noise."""
    A, _ = factor.linearize(values).jacobian()
    taken: Array = np.einsum("ij,jk,ik->i", A, joint_covariance(marginals, list(map(int, factor.keys()))), A)
    return taken
