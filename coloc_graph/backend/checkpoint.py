"""Checkpoint of an estimator as JSON: its inputs, from which it can be rebuilt. No pickle."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.input_file import read_bytes
from coloc_graph.measurements import (
    HomographyMeasurement,
    MarkerSpan,
    Measurement,
    Odometry,
    Plane,
    RelativePose,
    Sighting,
)
from coloc_graph.run import Stance
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.team import Floor, Landmark, Robot, Slip

S = TypeVar("S", bound=msgspec.Struct)

FORMAT = "coloc-graph-checkpoint-4"


@dataclass(frozen=True, eq=False)
class WaitingStance:
    """A stance that arrived before its predecessor `after`, and waits for it."""

    stance: Stance
    measurements: tuple[Measurement, ...]
    after: int


@dataclass(frozen=True, eq=False)
class Base:
    """Stances and measurements that were optimised in batch.

    `rejected` are the reasons of outliers, by the index of the measurement.
    """

    stances: tuple[Stance, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    rejected: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Entry:
    """Input of one call: a stance, or None where measurements came late, and its measurements."""

    stance: Stance | None
    measurements: tuple[Measurement, ...]


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of an estimator: its `base`, the `journal` of inputs since in their order, and `waiting` stances."""

    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    robot_models: dict[str, Robot]
    landmarks: dict[str, Landmark]
    base: Base
    journal: tuple[Entry, ...]
    waiting: tuple[WaitingStance, ...]


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    """An array of float64, little-endian, in the order of C."""

    shape: tuple[int, ...]
    data: bytes


class _Plane(msgspec.Struct, forbid_unknown_fields=True):
    """`measurements.Plane`."""

    N: _Array
    d: float
    normal_sigma: float
    d_sigma: float
    normal_from_mount: bool
    d_from_mount: bool


class _Span(msgspec.Struct, forbid_unknown_fields=True):
    """`measurements.MarkerSpan`."""

    mover: str
    x_i: _Array
    covariance: _Array
    by_h: _Array
    shared: _Array


class _Homography(msgspec.Struct, forbid_unknown_fields=True):
    """`measurements.HomographyMeasurement`, of a stance and a pair that the relative pose names."""

    H_j_i: _Array
    information: _Array
    points: int
    inliers: int
    chi2: float
    dof: int
    overlap_px: float
    time_offset: float
    time_offset_sigma: float
    by_time_offset: _Array | None
    warning: str | None
    share: float = 1.0


class _Measured(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One measurement of any kind: poses are 4x4 matrices."""

    kind: str
    ends: tuple[tuple[str, int], tuple[str, int]]
    T_i_j: list[list[float]]
    covariance: list[list[float]]
    time: float = 0.0
    T_ci_cj: list[list[float]] | None = None
    solution: int | None = None
    normal_error: float | None = None
    homography: _Homography | None = None
    plane: _Plane | None = None
    movers: tuple[str, ...] = ()
    spans: list[_Span] = []
    x_markers: _Array | None = None
    x_covariance: _Array | None = None


class _WaitingStance(msgspec.Struct, forbid_unknown_fields=True):
    stance: Stance
    measurements: list[_Measured]
    after: int


class _Base(msgspec.Struct, forbid_unknown_fields=True):
    stances: list[Stance]
    measurements: list[_Measured]
    rejected: dict[int, str]


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    stance: Stance | None
    measurements: list[_Measured]


class _Format(msgspec.Struct):
    format: str


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    robot_models: dict[str, Robot]
    landmarks: dict[str, Landmark]
    base: _Base
    journal: list[_Entry]
    waiting: list[_WaitingStance]


def write(saved: Checkpoint, path: Path) -> None:
    """Write a checkpoint atomically; numbers read back bit for bit.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    file = _File(
        format=FORMAT,
        reference=saved.reference,
        robots=saved.robots,
        floor=saved.floor,
        slips=saved.slips,
        robot_models=saved.robot_models,
        landmarks=saved.landmarks,
        base=_Base(list(saved.base.stances), _of_all(saved.base.measurements), dict(saved.base.rejected)),
        journal=[_Entry(one.stance, _of_all(one.measurements)) for one in saved.journal],
        waiting=[_WaitingStance(one.stance, _of_all(one.measurements), one.after) for one in saved.waiting],
    )
    try:
        write_atomically(path, msgspec.json.encode(file), synchronise=True)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be written ({error.strerror}); give another path") from error


def read(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises
    ------
    InputError
        The file is missing, damaged, or of another version.
    """
    try:
        content = read_bytes(path, "give the path of a checkpoint")
        if msgspec.json.decode(content, type=_Format).format != FORMAT:
            raise InputError(f"{path}: is not a checkpoint of this version ({FORMAT}); solve the run again")
        file = msgspec.json.decode(content, type=_File)
        saved = Checkpoint(
            reference=file.reference,
            robots=file.robots,
            floor=file.floor,
            slips=file.slips,
            robot_models=file.robot_models,
            landmarks=file.landmarks,
            base=Base(tuple(file.base.stances), _to_all(file.base.measurements), file.base.rejected),
            journal=tuple(Entry(one.stance, _to_all(one.measurements)) for one in file.journal),
            waiting=tuple(WaitingStance(one.stance, _to_all(one.measurements), one.after) for one in file.waiting),
        )
        later = (*(one.measurements for one in saved.journal), *(one.measurements for one in saved.waiting))
        for measurements in (saved.base.measurements, *later):
            require_valid(measurements, saved.floor)
        if not all(0 <= number < len(saved.base.measurements) for number in saved.base.rejected):
            raise ValueError("a measurement that is not there is rejected")
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError, EstimationError) as error:
        raise InputError(f"{path}: is not a checkpoint, or a damaged one ({error}); solve the run again") from error
    return saved


def _of(measured: Measurement) -> _Measured:
    kind = {RelativePose: "relative_pose", Sighting: "sighting", Odometry: "odometry"}[type(measured)]
    out = _Measured(kind, measured.ends, measured.T_i_j.tolist(), np.asarray(measured.covariance).tolist())
    if isinstance(measured, Sighting):
        out.time = measured.time
        out.x_markers, out.x_covariance = _array(measured.x_markers), _array(measured.x_covariance)
    elif isinstance(measured, RelativePose):
        out.T_ci_cj = None if measured.T_ci_cj is None else measured.T_ci_cj.tolist()
        out.solution, out.normal_error, out.movers = measured.solution, measured.normal_error, measured.movers
        out.homography = None if measured.homography is None else _fields(measured.homography, _Homography)
        out.plane = None if measured.plane is None else _fields(measured.plane, _Plane)
        out.spans = [_fields(one, _Span) for one in measured.spans]
    return out


def _of_all(measurements: Iterable[Measurement]) -> list[_Measured]:
    return [_of(one) for one in measurements]


def _to_all(measurements: Iterable[_Measured]) -> tuple[Measurement, ...]:
    return tuple(_to(one) for one in measurements)


def _fields(one: Any, kind: type[S]) -> S:
    """Return the struct with those fields that it has, arrays as bytes."""
    values = {name: getattr(one, name) for name in kind.__struct_fields__}
    return kind(**{name: _array(value) if isinstance(value, np.ndarray) else value for name, value in values.items()})


def _values(one: msgspec.Struct) -> dict[str, Any]:
    """Return the fields of a struct, bytes as arrays."""
    values = {name: getattr(one, name) for name in one.__struct_fields__}
    return {name: _numbers(value) if isinstance(value, _Array) else value for name, value in values.items()}


def _array(array: NDArray[np.float64] | None) -> _Array | None:
    return None if array is None else _Array(array.shape, np.ascontiguousarray(array, "<f8").tobytes())


def _numbers(array: _Array | None) -> NDArray[np.float64] | None:
    if array is None:
        return None
    numbers = np.frombuffer(array.data, "<f8").reshape(array.shape).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError("an array holds what is not a number")
    return numbers


def _to(one: _Measured) -> Measurement:
    (robot_i, before), (robot_j, after) = one.ends
    T_i_j, covariance = _pose(one.T_i_j), np.array(one.covariance, float)
    if one.kind == "odometry":
        return Odometry(robot_i, before, after, T_i_j, covariance)
    if one.kind == "sighting":
        seen = _numbers(one.x_markers), _numbers(one.x_covariance)
        return Sighting(before, robot_i, robot_j, one.time, T_i_j, covariance, *seen)
    if one.kind == "relative_pose":
        return RelativePose(
            stance=before,
            robot_i=robot_i,
            robot_j=robot_j,
            T_i_j=T_i_j,
            covariance=covariance,
            T_ci_cj=None if one.T_ci_cj is None else _pose(one.T_ci_cj),
            solution=one.solution,
            normal_error=one.normal_error,
            homography=_homography(one, before, robot_i, robot_j),
            plane=None if one.plane is None else Plane(**_values(one.plane)),
            spans=tuple(MarkerSpan(**_values(span)) for span in one.spans),
            movers=one.movers,
        )
    raise ValueError(f"there is no kind of measurement `{one.kind}`")


def _homography(one: _Measured, stance: int, robot_i: str, robot_j: str) -> HomographyMeasurement | None:
    if one.homography is None:
        return None
    return HomographyMeasurement(stance, robot_i, robot_j, **_values(one.homography))


def _pose(rows: list[list[float]]) -> NDArray[np.float64]:
    T = np.array(rows, float)
    if T.shape != (4, 4):
        raise ValueError(f"a pose has the shape {T.shape}")
    return T
