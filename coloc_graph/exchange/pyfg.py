"""Read and write PyFG text, the format of PyFactorGraph and of CORA's range-aided benchmarks.

A line is a record: VERTEX_SE2 or VERTEX_SE3:QUAT with time, name and true pose; VERTEX_XY or VERTEX_XYZ, a landmark;
the same with :PRIOR; EDGE_SE2 or EDGE_SE3:QUAT, a relative pose; EDGE_SE2_XY or EDGE_SE3_XYZ, a landmark's position in
a pose; EDGE_RANGE with distance and variance. Noise is the upper triangle of a covariance, translation first.

Source of the format: MarineRoboticsGroup, PyFactorGraph, https://github.com/MarineRoboticsGroup/PyFactorGraph
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.range_graph import (
    NAME,
    Prior,
    RangeGraph,
    RangeValue,
    RelativeValue,
    is_pose,
)
from coloc_graph.geometry.lie import quaternion
from coloc_graph.input_file import quoted, read_text
from coloc_graph.run.atomic_file import write_atomically

Array = NDArray[np.float64]

SUFFIX = ".pyfg"
_SWAPPED = [3, 4, 5, 0, 1, 2]  # translation first in rotation first, and back
MAX_NORM_ERROR = 1e-3  # of a quaternion, which is then normalised
_REMEDY = "give a factor graph in the PyFG format"

#: Numbers of names and of values of each record, True if it has a time, and size of its covariance.
_RECORDS = {
    "VERTEX_SE2": (1, 3, True, 0),
    "VERTEX_SE3:QUAT": (1, 7, True, 0),
    "VERTEX_XY": (1, 2, False, 0),
    "VERTEX_XYZ": (1, 3, False, 0),
    "VERTEX_SE2:PRIOR": (1, 3, True, 3),
    "VERTEX_SE3:QUAT:PRIOR": (1, 7, True, 6),
    "VERTEX_XY:PRIOR": (1, 2, True, 2),
    "VERTEX_XYZ:PRIOR": (1, 3, True, 3),
    "EDGE_SE2": (2, 3, True, 3),
    "EDGE_SE3:QUAT": (2, 7, True, 6),
    "EDGE_SE2_XY": (2, 2, True, 2),
    "EDGE_SE3_XYZ": (2, 3, True, 3),
    "EDGE_RANGE": (2, 1, True, 1),
}


def read_pyfg(path: str | Path) -> RangeGraph:
    """Read a factor graph in the PyFG format.

    Raises
    ------
    InputError
        It is none; the line is named.
    """
    path = Path(path)
    planar: bool | None = None
    times: dict[str, float] = {}
    truth: dict[str, Any] = {}
    found: dict[str, list[Any]] = {"prior": [], "relative": [], "range": []}
    for number, line in enumerate(read_text(path, _REMEDY).splitlines(), start=1):
        if not (words := line.split()) or words[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        tag = words[0]
        time, names, values, covariance = _record(where, words)
        if tag != "EDGE_RANGE":
            if planar not in (None, is_flat := "SE2" in tag or (tag.startswith("VERTEX_XY") and "XYZ" not in tag)):
                raise InputError(f"{where}: {tag} mixes a graph of two dimensions with one of three; split them")
            planar = is_flat
        if tag == "EDGE_RANGE":
            if not values[0] >= 0:
                raise InputError(f"{where}: the range {values[0]!r} is below 0; correct it")
            found["range"].append(RangeValue(time, names[0], names[1], values[0], float(covariance[0, 0])))
            continue
        value = _value(where, values) if "SE" in tag and not tag.endswith(("_XY", "_XYZ")) else np.array(values)
        if "EDGE" in tag:
            found["relative"].append(RelativeValue(time, names[0], names[1], value, covariance))
        elif tag.endswith("PRIOR"):
            found["prior"].append(Prior(time, names[0], value, covariance))
        else:
            if names[0] in truth:
                raise InputError(f"{where}: {names[0]} is there twice; give each vertex a name of its own")
            truth[names[0]] = value
            if "SE" in tag:
                times[names[0]] = time
    if not truth:
        raise InputError(f"{path}: holds no vertex; {_REMEDY}")
    graph = RangeGraph(
        planar=bool(planar),
        times=times,
        truth=truth,
        priors=tuple(found["prior"]),
        relatives=tuple(found["relative"]),
        ranges=tuple(found["range"]),
    )
    if unknown := [name for name in graph.names if name not in truth]:
        raise InputError(f"{path}: {unknown[0]} is measured but is no vertex; give it a VERTEX line")
    return graph


def _record(where: str, words: list[str]) -> tuple[float, list[str], list[float], Array]:
    """Time, names, values and covariance (GTSAM's order) of a line."""
    if (known := _RECORDS.get(words[0])) is None:
        raise InputError(f"{where}: {quoted(words[0])} is no record of the PyFG format; {_REMEDY}")
    count, size, timed, noise = known
    upper = noise * (noise + 1) // 2
    if len(words) != 1 + timed + count + size + upper:
        raise InputError(
            f"{where}: {words[0]} has {1 + timed + count + size + upper} entries, not {len(words)}; correct the line"
        )
    names = words[1 + timed : 1 + timed + count]
    for name in names:
        if NAME.fullmatch(name) is None:
            raise InputError(f"{where}: {quoted(name)} is no name of a letter and a number, as A12; rename it")
    if count == 2 and names[0] == names[1]:
        raise InputError(f"{where}: the measurement is from {names[0]} to itself; remove it")
    try:
        numbers = [float(word) for word in (words[1:2] if timed else []) + words[1 + timed + count :]]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{where}: finite numbers are expected; correct the line")
    time = numbers.pop(0) if timed else 0.0
    if (covariance := _covariance(noise, tuple(numbers[size:]))) is None:
        raise InputError(f"{where}: the covariance is not positive definite; correct it")
    return time, names, numbers[:size], covariance


@lru_cache(maxsize=1024)  # most files have few
def _covariance(size: int, upper: tuple[float, ...]) -> Array | None:
    """Return a covariance (GTSAM's order) of its upper triangle; None where it is not positive definite."""
    covariance = np.zeros((size, size))
    covariance[np.triu_indices(size)] = upper
    covariance += np.triu(covariance, 1).T
    if size and not np.linalg.eigvalsh(covariance)[0] > 0:
        return None
    return covariance[np.ix_(_SWAPPED, _SWAPPED)] if size == 6 else covariance


def _value(where: str, values: list[float]) -> gtsam.Pose2 | gtsam.Pose3:
    if len(values) == 3:
        return gtsam.Pose2(*values)
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1) > MAX_NORM_ERROR:
        raise InputError(f"{where}: the quaternion is not of unit length; write qx qy qz qw")
    x, y, z, w = (one / length for one in values[3:])
    return gtsam.Pose3(gtsam.Rot3(w, x, y, z), np.array(values[:3]))


def write_pyfg(graph: RangeGraph, path: str | Path) -> None:
    """Write a factor graph in the PyFG format; numbers are read back bit for bit.

    Vertices are the graph's true values; a graph without them is written with its initial values.

    Raises
    ------
    InputError
        The graph has bearings, which the format cannot hold, or variables without a value.
    """
    path = Path(path)
    if graph.bearings:
        raise InputError(
            f"{path}: PyFG holds no bearings, and the graph has {len(graph.bearings)}: write it as JRL (.jrl)"
        )
    values = {**graph.initial, **graph.truth}
    if missing := [name for name in graph.names if name not in values]:
        raise InputError(f"{path}: PyFG gives each variable a value, and {missing[0]} has none: write JRL (.jrl)")
    pose, point = ("SE2", "XY") if graph.planar else ("SE3:QUAT", "XYZ")
    lines = []
    for name, value in values.items():
        head = f"VERTEX_{pose} {graph.times.get(name, 0.0)!r}" if is_pose(value) else f"VERTEX_{point}"
        lines.append(f"{head} {name} {_numbers(value)}")
    for prior in graph.priors:
        kind = pose if is_pose(prior.value) else point
        noise = _noise(prior.covariance)
        lines.append(f"VERTEX_{kind}:PRIOR {prior.time!r} {prior.name} {_numbers(prior.value)} {noise}")
    for one in graph.relatives:
        kind = pose if is_pose(one.value) else f"{pose.removesuffix(':QUAT')}_{point}"
        numbers, noise = _numbers(one.value), _noise(one.covariance)
        lines.append(f"EDGE_{kind} {one.time!r} {one.first} {one.second} {numbers} {noise}")
    lines += [
        f"EDGE_RANGE {one.time!r} {one.first} {one.second} {one.distance!r} {one.variance!r}" for one in graph.ranges
    ]
    write_atomically(path, "\n".join(lines) + "\n")


def _numbers(value: Any) -> str:
    if isinstance(value, gtsam.Pose2):
        numbers = [value.x(), value.y(), value.theta()]
    elif isinstance(value, gtsam.Pose3):
        w, x, y, z = quaternion(value.rotation().matrix())
        numbers = [*value.translation(), x, y, z, w]
    else:
        numbers = list(value)
    return " ".join(repr(float(number)) for number in numbers)


def _noise(covariance: Array) -> str:
    C = covariance[np.ix_(_SWAPPED, _SWAPPED)] if len(covariance) == 6 else covariance
    return " ".join(repr(float(number)) for number in C[np.triu_indices(len(C))])
