"""Factor graphs of poses, landmarks and ranges, as the field's benchmark formats hold them: `pyfg` and `jrl`.

Variables have names of a letter and a number, `A12`: the letter of a robot and the number of its pose; `L3` is a
landmark. Poses are `gtsam.Pose2` or `gtsam.Pose3`, positions arrays of shape (2,) or (3,).
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError

Array = NDArray[np.float64]

NAME = re.compile(r"([A-Za-z])(\d{1,15})")
LANDMARK = "L"  # letter of landmarks


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior of a pose or a position, with its covariance in GTSAM's tangent."""

    time: float
    name: str
    value: Any
    covariance: Array


@dataclass(frozen=True, eq=False)
class RelativeValue:
    """Pose of `second` in the pose `first`, or position of the landmark `second` in it.

    Parameters
    ----------
    time : float
        Time [s].
    first, second : str
        Names of the variables.
    value : gtsam.Pose2, gtsam.Pose3 or (2,) or (3,) float
        Relative pose or position [m].
    covariance : (n, n) float
        In GTSAM's tangent: of Pose2 x, y, heading; of Pose3 rotation first; of a position x, y, z in the first pose.
    """

    time: float
    first: str
    second: str
    value: Any
    covariance: Array


@dataclass(frozen=True, eq=False)
class RangeValue:
    """Distance [m] between the origins of a pose and of another pose or a landmark, at a time [s]."""

    time: float
    first: str
    second: str
    distance: float
    variance: float


@dataclass(frozen=True, eq=False)
class BearingRangeValue:
    """Bearing and range of `second` in the pose `first`.

    Parameters
    ----------
    time : float
        Time [s].
    first, second : str
        Names of the variables.
    bearing : float or (3,) float
        Angle [rad] in the plane, or a unit vector.
    distance : float
        Range [m].
    covariance : (2, 2) or (3, 3) float
        Bearing first, in GTSAM's tangent (of a unit vector that of `gtsam.Unit3`).
    """

    time: float
    first: str
    second: str
    bearing: Any
    distance: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class RangeGraph:
    """Factor graph of a benchmark file.

    Parameters
    ----------
    planar : bool
        True if poses are `Pose2`.
    times : mapping of str to float
        Time of each pose [s]; poses without a time are missing.
    truth : mapping of str to pose or position
        True values, those of the file's vertices; an estimator must not read them.
    initial : mapping of str to pose or position
        Initial values that the file states; of PyFG none.
    priors, relatives, ranges, bearings : tuple
        Measurements.
    outliers : frozenset of int
        Places in `measurements` that the file knows to be outliers.
    """

    planar: bool
    times: Mapping[str, float] = field(default_factory=dict)
    truth: Mapping[str, Any] = field(default_factory=dict)
    initial: Mapping[str, Any] = field(default_factory=dict)
    priors: tuple[Prior, ...] = ()
    relatives: tuple[RelativeValue, ...] = ()
    ranges: tuple[RangeValue, ...] = ()
    bearings: tuple[BearingRangeValue, ...] = ()
    outliers: frozenset[int] = frozenset()

    @property
    def measurements(self) -> tuple[Prior | RelativeValue | RangeValue | BearingRangeValue, ...]:
        """All measurements, by kind."""
        return (*self.priors, *self.relatives, *self.ranges, *self.bearings)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all variables: those with values first, then those that are only measured."""
        found = dict.fromkeys((*self.truth, *self.initial, *self.times))
        for one in self.measurements:
            found |= dict.fromkeys(ends_of(one))
        return tuple(found)


def ends_of(one: Prior | RelativeValue | RangeValue | BearingRangeValue) -> tuple[str, ...]:
    """Return the names of the variables that a measurement relates."""
    return (one.name,) if isinstance(one, Prior) else (one.first, one.second)


def is_pose(value: Any) -> bool:
    """True of a pose, False of a position."""
    return isinstance(value, gtsam.Pose2 | gtsam.Pose3)


def is_landmark(name: str) -> bool:
    """Return whether a name is that of a landmark."""
    return name.startswith(LANDMARK)


def key_of(name: str) -> int:
    """Return the GTSAM key of a variable: its letter and its number, as GTSAM's `symbol`.

    Raises
    ------
    InputError
        The name is not a letter and a number.
    """
    found = NAME.fullmatch(name)
    if found is None:
        raise InputError(f"`{name}` is not the name of a variable: give a letter and a number, as A12")
    return int(gtsam.symbol(found[1], int(found[2])))


def as_bearing(one: RelativeValue) -> BearingRangeValue:
    """Return a landmark's relative position as bearing and range, its covariance propagated to first order.

    Raises
    ------
    InputError
        The landmark is at the pose, where there is no bearing.
    """
    p = np.asarray(one.value, float)
    distance = float(np.linalg.norm(p))
    if distance == 0:
        raise InputError(f"{one.second} is measured at no distance from {one.first}, so that it has no bearing")
    along = p / distance
    if len(p) == 2:
        bearing: Any = float(np.arctan2(p[1], p[0]))
        across = np.array([[-along[1], along[0]]])
    else:
        bearing = along
        across = np.asarray(gtsam.Unit3(*along).basis()).T
    J = np.vstack([across / distance, along])
    return BearingRangeValue(one.time, one.first, one.second, bearing, distance, J @ one.covariance @ J.T)


def factors_of(graph: RangeGraph) -> gtsam.NonlinearFactorGraph:
    """Return the measurements as GTSAM's own factors, by the keys of `key_of`, in the order of `measurements`."""
    factors = gtsam.NonlinearFactorGraph()
    for factor in _factors(graph):
        factors.add(factor)
    return factors


def values_of(values: Mapping[str, Any]) -> gtsam.Values:
    """Return poses and positions as GTSAM's values."""
    found = gtsam.Values()
    for name, value in values.items():
        found.insert(key_of(name), value)
    return found


def _factors(graph: RangeGraph) -> Iterator[gtsam.NonlinearFactor]:
    planar, noise = graph.planar, gtsam.noiseModel.Gaussian.Covariance
    kinds: dict[str, Any] = _PLANAR if planar else _SOLID
    for prior in graph.priors:
        kind = kinds["pose prior" if is_pose(prior.value) else "point prior"]
        yield kind(key_of(prior.name), prior.value, noise(prior.covariance))
    seen = []
    for step in graph.relatives:
        if is_pose(step.value):
            ends = key_of(step.first), key_of(step.second)
            yield kinds["between"](*ends, step.value, noise(step.covariance))
        else:
            seen.append(as_bearing(step))
    for one in graph.ranges:
        kind = kinds["range of point" if is_landmark(one.second) else "range of pose"]
        yield kind(key_of(one.first), key_of(one.second), one.distance, noise(np.array([[one.variance]])))
    for both in (*seen, *graph.bearings):
        kind = kinds["bearing of point" if is_landmark(both.second) else "bearing of pose"]
        bearing = gtsam.Rot2(both.bearing) if planar else gtsam.Unit3(*both.bearing)
        yield kind(key_of(both.first), key_of(both.second), bearing, both.distance, noise(both.covariance))


_PLANAR = {
    "pose prior": gtsam.PriorFactorPose2,
    "point prior": gtsam.PriorFactorPoint2,
    "between": gtsam.BetweenFactorPose2,
    "range of pose": gtsam.RangeFactorPose2,
    "range of point": gtsam.RangeFactor2D,
    "bearing of pose": gtsam.BearingRangeFactorPose2,
    "bearing of point": gtsam.BearingRangeFactor2D,
}
_SOLID = {
    "pose prior": gtsam.PriorFactorPose3,
    "point prior": gtsam.PriorFactorPoint3,
    "between": gtsam.BetweenFactorPose3,
    "range of pose": gtsam.RangeFactorPose3,
    "range of point": gtsam.RangeFactor3D,
    "bearing of pose": gtsam.BearingRangeFactorPose3,
    "bearing of point": gtsam.BearingRangeFactor3D,
}
