"""An estimator on disk, as JSON: what it was given, from which it can be rebuilt. No pickle."""

import os
from dataclasses import dataclass
from pathlib import Path

import gtsam
import msgspec
import numpy as np

from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.measurements import Measurement, Odometry, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Floor, Slip

FORMAT = "coloc-graph-checkpoint-1"


@dataclass(frozen=True, eq=False)
class Early:
    """A stance that came before the one it follows, which is `after`."""

    stance: Stance
    measurements: tuple[Measurement, ...]
    after: int


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What an estimator is made of; `refused` are reasons by the number of the measurement, `early` are the
    stances that wait."""

    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    stances: tuple[Stance, ...]
    measurements: tuple[Measurement, ...]
    refused: dict[int, str]
    early: tuple[Early, ...]


class _Measured(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One measurement of any kind: poses are 4x4 matrices."""

    kind: str
    ends: tuple[tuple[str, int], tuple[str, int]]
    T_i_j: list[list[float]]
    covariance: list[list[float]]
    time: float = 0.0
    T_ci_cj: list[list[float]] = []
    solution: int = 0
    normal_error: float = 0.0


class _Early(msgspec.Struct, forbid_unknown_fields=True):
    stance: Stance
    measurements: list[_Measured]
    after: int


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    stances: list[Stance]
    measurements: list[_Measured]
    refused: dict[int, str]
    early: list[_Early]


def write(saved: Checkpoint, path: Path) -> None:
    """Write a checkpoint whole or not at all; `InputError` where it cannot be written. Numbers read back to the bit."""
    file = _File(
        format=FORMAT,
        reference=saved.reference,
        robots=saved.robots,
        floor=saved.floor,
        slips=saved.slips,
        stances=list(saved.stances),
        measurements=[_of(one) for one in saved.measurements],
        refused=saved.refused,
        early=[_Early(one.stance, [_of(m) for m in one.measurements], one.after) for one in saved.early],
    )
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as stream:
            stream.write(msgspec.json.encode(file))
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be written ({error.strerror}); give another path") from error


def read(path: Path) -> Checkpoint:
    """The checkpoint in a file; `InputError` where it is none."""
    try:
        file = msgspec.json.decode(path.read_bytes(), type=_File)
        if file.format != FORMAT:
            raise InputError(f"{path}: is not a checkpoint of this version ({FORMAT}); solve the run again")
        saved = Checkpoint(
            reference=file.reference,
            robots=file.robots,
            floor=file.floor,
            slips=file.slips,
            stances=tuple(file.stances),
            measurements=tuple(_to(one) for one in file.measurements),
            refused=file.refused,
            early=tuple(Early(one.stance, tuple(map(_to, one.measurements)), one.after) for one in file.early),
        )
        for taken in (saved.measurements, *(one.measurements for one in saved.early)):
            require_valid(taken, saved.floor)
        if not all(0 <= number < len(saved.measurements) for number in saved.refused):
            raise ValueError("a measurement that is not there is refused")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give the path of a checkpoint") from error
    except (msgspec.DecodeError, ValueError, EstimationError) as error:
        raise InputError(f"{path}: is not a checkpoint, or a damaged one ({error}); solve the run again") from error
    return saved


def _of(measured: Measurement) -> _Measured:
    kind = {RelativePose: "relative_pose", Sighting: "sighting", Odometry: "odometry"}[type(measured)]
    out = _Measured(kind, measured.ends, measured.T_i_j.matrix().tolist(), np.asarray(measured.covariance).tolist())
    if isinstance(measured, Sighting):
        out.time = measured.time
    elif isinstance(measured, RelativePose):
        out.T_ci_cj, out.solution = measured.T_ci_cj.matrix().tolist(), measured.solution
        out.normal_error = measured.normal_error
    return out


def _to(one: _Measured) -> Measurement:
    (robot_i, before), (robot_j, after) = one.ends
    T_i_j, covariance = _pose(one.T_i_j), np.array(one.covariance, float)
    if one.kind == "odometry":
        return Odometry(robot_i, before, after, T_i_j, covariance)
    if one.kind == "sighting":
        return Sighting(before, robot_i, robot_j, one.time, T_i_j, covariance)
    if one.kind == "relative_pose":
        T_ci_cj = _pose(one.T_ci_cj)
        return RelativePose(before, robot_i, robot_j, T_i_j, covariance, T_ci_cj, one.solution, one.normal_error)
    raise ValueError(f"there is no kind of measurement `{one.kind}`")


def _pose(rows: list[list[float]]) -> gtsam.Pose3:
    T = np.array(rows, float)
    if T.shape != (4, 4):
        raise ValueError(f"a pose has the shape {T.shape}")
    return gtsam.Pose3(T)
