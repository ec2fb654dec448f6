"""Checkpoint of an estimator as JSON: its inputs, from which it can be rebuilt. No pickle."""

import base64
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.estimate import Rejection
from coloc_graph.backend.validation import require_valid
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.input_file import read_bytes
from coloc_graph.measurements import Odometry, Range, RelativePose, Sighting
from coloc_graph.run import Stance
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.team import Floor, Landmark, Robot, Slip

FORMAT = "coloc-graph-checkpoint-7"

#: Measurements; `Any`, since msgspec cannot decode a union of dataclasses: a file has each under its `KINDS`.
Measurements = tuple[Any, ...]
KINDS: dict[str, type] = {
    "relative_pose": RelativePose,
    "sighting": Sighting,
    "odometry": Odometry,
    "range": Range,
}


@dataclass(frozen=True, eq=False)
class WaitingStance:
    """A stance that arrived before its predecessor `after`, and waits for it."""

    stance: Stance
    measurements: Measurements
    after: int


@dataclass(frozen=True, eq=False)
class Base:
    """Stances and measurements that were optimised in batch.

    `rejected` are the reasons of outliers, by the index of the measurement.
    """

    stances: tuple[Stance, ...] = ()
    measurements: Measurements = ()
    rejected: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Entry:
    """Input of one call: a stance, or None where measurements came late, and its measurements."""

    stance: Stance | None
    measurements: Measurements


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of an estimator: its `base`, the `journal` of later inputs in order, and `waiting` stances."""

    reference: str
    robots: tuple[str, ...]
    floor: Floor | None
    slips: dict[str, Slip]
    robot_models: dict[str, Robot]
    landmarks: dict[str, Landmark]
    lag: int
    base: Base
    journal: tuple[Entry, ...]
    waiting: tuple[WaitingStance, ...]

    def mapped(self, convert: Callable[[Measurements], Measurements]) -> "Checkpoint":
        """Return the checkpoint with all measurements converted."""
        base = replace(self.base, measurements=convert(self.base.measurements))
        journal = tuple(replace(one, measurements=convert(one.measurements)) for one in self.journal)
        waiting = tuple(replace(one, measurements=convert(one.measurements)) for one in self.waiting)
        return replace(self, base=base, journal=journal, waiting=waiting)


class _Format(msgspec.Struct):
    format: str


class _File(_Format):
    checkpoint: Checkpoint


def base_of(stances: tuple[Stance, ...], measurements: Measurements, rejected: Mapping[int, Rejection]) -> Base:
    """Return the base of stances and measurements; `rejected` are the outliers, by the identity of the measurement."""
    numbers = {id(one): number for number, one in enumerate(measurements)}
    return Base(stances, measurements, {numbers[key]: one.reason for key, one in rejected.items()})


def write(saved: Checkpoint, path: Path) -> None:
    """Write a checkpoint atomically; numbers read back bit for bit.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    file = _File(FORMAT, saved.mapped(lambda found: tuple({_kind(one): one} for one in found)))
    try:
        write_atomically(path, msgspec.json.encode(file, enc_hook=_array), synchronise=True)
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
        saved = msgspec.json.decode(content, type=_File, dec_hook=_numbers).checkpoint
        saved = saved.mapped(lambda found: tuple(map(_measurement, found)))
        parts: tuple[Base | Entry | WaitingStance, ...] = (saved.base, *saved.journal, *saved.waiting)
        for part in parts:
            require_valid(part.measurements, saved.floor)
        if not all(0 <= number < len(saved.base.measurements) for number in saved.base.rejected):
            raise ValueError("a measurement that is not there is rejected")
    except (msgspec.DecodeError, ValueError, TypeError, OverflowError, RecursionError, EstimationError) as error:
        raise InputError(f"{path}: is not a checkpoint, or a damaged one ({error}); solve the run again") from error
    return saved


def _kind(measured: object) -> str:
    return next(kind for kind, of in KINDS.items() if isinstance(measured, of))


def _measurement(stored: object) -> Any:
    """Decode a measurement, stored as a mapping of its kind to its fields."""
    ((kind, fields),) = stored.items() if isinstance(stored, dict) and len(stored) == 1 else (("", stored),)
    if kind not in KINDS:
        raise ValueError(f"there is no kind of measurement `{kind}`")
    return msgspec.convert(fields, KINDS[kind], dec_hook=_numbers)


def _array(array: object) -> dict[str, Any]:
    """Encode an array of float64: little-endian, in the order of C."""
    assert isinstance(array, np.ndarray)
    return {"shape": array.shape, "data": np.ascontiguousarray(array, "<f8").tobytes()}


def _numbers(_: type, stored: Any) -> NDArray[np.float64]:
    """Decode an array; `ValueError` where it is none, or not finite."""
    if not isinstance(stored, dict) or stored.keys() != {"shape", "data"}:
        raise ValueError("an array is not a shape with data")
    numbers = np.frombuffer(base64.b64decode(stored["data"]), "<f8").reshape(stored["shape"]).astype(np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError("an array holds a number that is not finite")
    return numbers
