"""Odometry that cannot be right: jumps, drivers that hang, covariances that say nothing; mended, and told.

A recording whose odometry is right is passed on as it is.
"""

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import wrap
from coloc_graph.run import OdometrySample, Stance
from coloc_graph.run.odometry_breaks import find_breaks, join_breaks

Array = NDArray[np.float64]

ALONG = 0.02  # standard deviation of odometry whose covariances are not believed, after one metre [m]
TURNED = 0.02  # the same after turning by one radian [rad]
VEER = 0.01  # its heading after one metre [rad]
MIN_SIGMA = 1e-4  # and of each increment at least [m, rad]
ABSURD_SIGMA = 10.0  # standard deviation of one increment that says nothing [m, rad]
HUNG_SIGMA = 1.0  # standard deviation of a way on which the odometry hung [m, rad]
MIN_HUNG = 5  # samples of a stance that do not change where its driver hangs
BREAKS_NAMED = 3  # jumps of one robot that are told one by one


@dataclass(frozen=True, eq=False)
class Samples:
    """Odometry of a robot: `times` (n,), `poses` (n, 3) and `covariances` (n, 3, 3) of increments."""

    robot: str
    times: Array
    poses: Array
    covariances: Array

    @classmethod
    def of(cls, robot: str, samples: Iterable[OdometrySample]) -> "Samples":
        """Stack samples, holding none: 100,000 objects in a list cost the garbage collector a second."""
        stacked = array("d")
        for one in samples:
            stacked.append(one.time)
            stacked.frombytes(np.asarray(one.pose, float).tobytes())
            stacked.frombytes(np.asarray(one.covariance, float).tobytes())
        rows = np.array(stacked).reshape(-1, 13)
        return cls(robot, rows[:, 0], rows[:, 1:4], rows[:, 4:].reshape(-1, 3, 3))

    def between(self, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Yield the samples from `start` to `end` [UTC s]."""
        first = 0 if start is None else int(np.searchsorted(self.times, start))
        until = len(self.times) if end is None else int(np.searchsorted(self.times, end, side="right"))
        for n, time in enumerate(self.times[first:until].tolist(), start=first):
            yield OdometrySample(self.robot, time, self.poses[n], self.covariances[n])


class CheckedRun:
    """A recording with checked odometry; all else is as it is recorded. `warnings` tell what was mended."""

    def __init__(self, run: Any) -> None:
        self._run = run
        self._odometry: dict[str, Samples] = {}
        said: list[str] = []
        for robot in run.team.names:
            self._odometry[robot], sentences = checked(Samples.of(robot, run.odometry(robot)), run.stances)
            said += sentences
        self.warnings = (*run.warnings, *said)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Odometry, as `Recorded`."""
        return self._odometry[robot].between(start, end)


def checked(samples: Samples, stances: Sequence[Stance]) -> tuple[Samples, list[str]]:
    """Mend one robot's odometry.

    Parameters
    ----------
    samples : Samples
        All of it, in the order of time.
    stances : sequence of Stance
        Those in which it is a mover tell whether its odometry hangs.

    Returns
    -------
    Samples, list of str
        The odometry, and a sentence on each fault; none where nothing is wrong.
    """
    robot, times, poses = samples.robot, samples.times, samples.poses
    if len(times) < 2:
        return samples, []
    covariances = samples.covariances.copy()
    breaks = find_breaks(times, poses)
    said = [
        f"the odometry of {robot} {one}; the jump is cut out, and what it may hide is in the uncertainty"
        for one in breaks[:BREAKS_NAMED]
    ]
    if len(breaks) > BREAKS_NAMED:
        said.append(f"the odometry of {robot} jumped {len(breaks) - BREAKS_NAMED} more times")
    mended = join_breaks(poses, breaks)
    moved = np.diff(mended, axis=0, prepend=mended[:1])
    wrong = _says_nothing(covariances) & (np.abs(moved).max(axis=1) > 0)
    if wrong.any():
        said.append(
            f"the odometry of {robot} states {_fault(covariances[wrong])} in {wrong.sum()} of {len(wrong)} samples: "
            f"it is taken to err by {100 * ALONG:.0f} cm after one metre; state the covariance of each increment"
        )
        covariances[wrong] = _usual(moved[wrong])
    for one in breaks:
        covariances[one.index] = np.diag(np.square(one.sigmas))
    for stance in stances:
        inside = np.flatnonzero((times >= stance.start) & (times <= stance.end))
        if robot in stance.movers and len(inside) >= MIN_HUNG and not np.ptp(poses[inside], axis=0).any():
            covariances[inside[-1]] = np.diag([HUNG_SIGMA**2] * 3)
            said.append(
                f"the odometry of {robot} does not change in stance {stance.index}, in which it moves: it is not used "
                "there; check its driver"
            )
    return Samples(robot, times, mended, covariances) if said else samples, said


def _says_nothing(covariances: Array) -> NDArray[np.bool_]:
    """True of covariances (n, 3, 3) that are zero, no covariances, or so large that they say nothing."""
    finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)), bool)
    variances = np.diagonal(np.where(finite[:, None, None], covariances, -1.0), axis1=1, axis2=2)
    least = np.linalg.eigvalsh(np.where(finite[:, None, None], covariances, 0.0))[:, 0]
    none = ~variances.any(axis=1) | (variances < 0).any(axis=1) | (least < -1e-9 * variances.max(axis=1))
    return np.asarray(none | (variances > ABSURD_SIGMA**2).any(axis=1))


def _fault(covariances: Array) -> str:
    if not covariances.any():
        return "a covariance of zero"
    return "a covariance that is none, or that says nothing,"


def _usual(moved: Array) -> Array:
    """Covariances (n, 3, 3) of increments (n, 3) of ordinary wheels."""
    way, turn = np.hypot(moved[:, 0], moved[:, 1]), np.abs(wrap(moved[:, 2]))
    xy = ALONG**2 * way + MIN_SIGMA**2
    yaw = TURNED**2 * turn + VEER**2 * way + MIN_SIGMA**2
    return np.asarray(np.stack([xy, xy, yaw], axis=1)[:, :, None] * np.eye(3))
