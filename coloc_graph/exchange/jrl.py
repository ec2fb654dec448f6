"""Read and write JSON Robot Log (.jrl), the format of multi-robot benchmarks.

Keys are GTSAM's symbols: the letter of a robot, and a number that counts poses from 0 and landmarks from 1e9. Noise is
a covariance, row by row, in GTSAM's order. A landmark's relative position, for which there is no record, is written as
bearing and range.

Source of the format: D. McGann, JSON Robot Log, https://github.com/DanMcGann/jrl; where its description and its parser
differ (robots as character codes, scalars in objects), both are read, and what the parser reads is written.
"""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.range_graph import (
    LANDMARK,
    BearingRangeValue,
    Prior,
    RangeGraph,
    RangeValue,
    RelativeValue,
    as_bearing,
    ends_of,
    is_landmark,
    is_pose,
    key_of,
)
from coloc_graph.geometry.lie import quaternion
from coloc_graph.input_file import quoted, read_text, shortened
from coloc_graph.run.atomic_file import write_atomically

Array = NDArray[np.float64]

SUFFIX = ".jrl"
FIRST_LANDMARK = 1_000_000_000  # least number of a landmark's key
MIN_NS = 1e15  # stamps from here on are nanoseconds, smaller ones are taken as they are: steps, or seconds
UNIT = "stamp_unit"  # entry of our own files whose stamps are nanoseconds and smaller than that
NS = "ns"
_REMEDY = "give a dataset in the JSON Robot Log format"
_SIZES = {"Pose2": 3, "Pose3": 6, "Point2": 2, "Point3": 3}
_MEASURED = ("Pose2", "Pose3", "2D", "3D")
_KINDS = {"Prior": tuple(_SIZES), "Between": tuple(_SIZES), "Range": _MEASURED, "BearingRange": _MEASURED}


def read_jrl(path: str | Path) -> RangeGraph:
    """Read a dataset in the JSON Robot Log format.

    Raises
    ------
    InputError
        It is none, or holds a kind of measurement that is not known.
    """
    path = Path(path)
    try:
        dataset = json.loads(read_text(path, _REMEDY))
    except (ValueError, RecursionError) as why:
        raise InputError(f"{path}: is damaged ({shortened(why)}); {_REMEDY}") from why
    reader = _Reader()
    where = "robots"
    try:
        entries = dataset["measurements"]
        marked = dataset.get("outlier_factors", {})
        least = 0.0 if dataset.get(UNIT) == NS else MIN_NS
        for robot, rows in entries.items():
            outliers = {tuple(one) for one in marked.get(robot, [])}
            for number, entry in enumerate(rows):
                stamp = float(entry["stamp"])
                for place, one in enumerate(entry.get("measurements", [])):
                    where = f"measurement {place} of entry {number} of robot {robot}"
                    reader.take(stamp * 1e-9 if stamp >= least else stamp, one, outlier=(number, place) in outliers)
        values = {}
        for kind in ("groundtruth", "initialization"):
            where = kind
            values[kind] = dict(reader.value(one) for rows in dataset.get(kind, {}).values() for one in rows)
        return reader.graph(values["groundtruth"], values["initialization"])
    except InputError as why:
        raise InputError(f"{path}, {where}: {why}") from why
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError) as why:
        reason = f"`{why.args[0]}` is missing" if isinstance(why, KeyError) else shortened(why)
        raise InputError(f"{path}, {where}: {reason}; {_REMEDY}") from why


class _Reader:
    """Collects the measurements of a dataset."""

    def __init__(self) -> None:
        self._found: dict[type, list[tuple[Any, bool]]] = defaultdict(list)
        self._times: dict[str, float] = {}
        self._planar: set[bool] = set()

    def take(self, time: float, one: dict[str, Any], *, outlier: bool) -> None:
        """Take one measurement."""
        tag = one["type"]
        kind, _, of = tag.partition("Factor")
        if of not in _KINDS.get(kind, ()):
            raise InputError(f"{quoted(tag)} is no measurement that is known; remove it")
        if kind == "Prior":
            name = _name(one["key"])
            taken: Any = Prior(time, name, self._typed(of, one["prior"]), _covariance(one, _SIZES[of]))
        else:
            first, second = _name(one["key1"]), _name(one["key2"])
            if first == second:
                raise InputError(f"the measurement is from {first} to itself; remove it")
            if kind == "Between":
                taken = RelativeValue(
                    time, first, second, self._typed(of, one["measurement"]), _covariance(one, _SIZES[of])
                )
            else:
                planar = "2" in of
                self._planar.add(planar)
                if (of in ("2D", "3D")) != is_landmark(second):
                    raise InputError(f"{tag} does not fit {second}; correct its key")
                if kind == "Range":
                    variance = float(_covariance(one, 1)[0, 0])
                    taken = RangeValue(time, first, second, _distance(one["measurement"]), variance)
                else:
                    measured = one["measurement"]
                    bearing = _bearing(measured["bearing"], planar=planar)
                    distance = _distance(measured["range"])
                    taken = BearingRangeValue(
                        time, first, second, bearing, distance, _covariance(one, 2 if planar else 3)
                    )
        for name in ends_of(taken):
            if not is_landmark(name):
                self._times.setdefault(name, time)
        if isinstance(taken, RelativeValue) and is_pose(taken.value):
            self._times[taken.second] = min(self._times[taken.second], time)
        self._found[type(taken)].append((taken, outlier))

    def value(self, one: dict[str, Any]) -> tuple[str, Any]:
        """Return the name and the value of a variable."""
        return _name(one["key"]), self._typed(one["type"], one)

    def _typed(self, kind: str, one: dict[str, Any]) -> Any:
        if kind not in _SIZES:
            raise InputError(f"{quoted(kind)} is no value that is known; give {', '.join(_SIZES)}")
        self._planar.add(kind.endswith("2"))
        if kind == "Pose2":
            return gtsam.Pose2(*_finite(one["x"], one["y"], one["theta"]))
        if kind == "Pose3":
            w, x, y, z = _finite(*one["rotation"])
            length = float(np.linalg.norm([w, x, y, z]))
            if abs(length - 1) > 1e-3:
                raise InputError("a quaternion is not of unit length; write w, x, y, z")
            turn = gtsam.Rot3(w / length, x / length, y / length, z / length)
            return gtsam.Pose3(turn, np.array(_finite(*one["translation"])))
        return np.array(_finite(*(one[axis] for axis in "xyz"[: _SIZES[kind]])))

    def graph(self, truth: dict[str, Any], initial: dict[str, Any]) -> RangeGraph:
        """Return all that was taken."""
        if len(self._planar) > 1:
            raise InputError("a graph of two dimensions is mixed with one of three; split them")
        kinds = (Prior, RelativeValue, RangeValue, BearingRangeValue)
        ordered = [one for kind in kinds for one in self._found[kind]]
        priors, relatives, ranges, bearings = (tuple(one for one, _ in self._found[kind]) for kind in kinds)
        return RangeGraph(
            planar=self._planar == {True},
            times=self._times,
            truth=truth,
            initial=initial,
            priors=priors,
            relatives=relatives,
            ranges=ranges,
            bearings=bearings,
            outliers=frozenset(place for place, (_, outlier) in enumerate(ordered) if outlier),
        )


def _name(key: int) -> str:
    if not isinstance(key, int) or not 0 <= key < 2**64:
        raise InputError(f"{quoted(key)} is no key of 64 bits")
    letter, number = chr(gtsam.symbolChr(key)), gtsam.symbolIndex(key)
    if not (letter.isascii() and letter.isalpha()):
        raise InputError(f"the key {key} is no symbol of a letter and a number")
    if number >= FIRST_LANDMARK:
        # one letter for landmarks, so that names tell them; those of a robot's own keep their letter in the number
        own = 0 if letter == LANDMARK else ord(letter) * 10**12
        return f"{LANDMARK}{number - FIRST_LANDMARK + own}"
    return f"{letter}{number}"


def _key(name: str) -> int:
    if not is_landmark(name):
        return key_of(name)
    letter, number = divmod(int(name[1:]), 10**12)
    return int(gtsam.symbol(chr(letter) if letter else LANDMARK, number + FIRST_LANDMARK))


def _finite(*numbers: Any) -> list[float]:
    found = [float(number) for number in numbers]
    if not np.isfinite(found).all():
        raise InputError("finite numbers are expected")
    return found


def _scalar(measured: Any) -> float:
    (value,) = _finite(measured["value"] if isinstance(measured, dict) else measured)
    return value


def _distance(measured: Any) -> float:
    if (value := _scalar(measured)) < 0:
        raise InputError(f"the range {value!r} is below 0; correct it")
    return value


def _bearing(measured: Any, *, planar: bool) -> Any:
    if planar:
        return _scalar(measured if not isinstance(measured, dict) else measured.get("theta", measured.get("value")))
    u = np.array(_finite(*([measured[axis] for axis in "ijk"] if isinstance(measured, dict) else measured)))
    if abs(np.linalg.norm(u) - 1) > 1e-3:
        raise InputError("a bearing is not of unit length; write its direction")
    return u / np.linalg.norm(u)


def _covariance(one: dict[str, Any], size: int) -> Array:
    numbers = _finite(*one["covariance"])
    if len(numbers) != size * size:
        raise InputError(f"the covariance has {len(numbers)} numbers, not {size * size}")
    C = np.reshape(numbers, (size, size))
    if not np.allclose(C, C.T, rtol=1e-6, atol=0) or not np.linalg.eigvalsh((C + C.T) / 2)[0] > 0:
        raise InputError("the covariance is not symmetric and positive definite")
    return np.asarray((C + C.T) / 2)


def write_jrl(graph: RangeGraph, path: str | Path, name: str = "") -> None:
    """Write a factor graph as a dataset in the JSON Robot Log format.

    Each measurement goes to the robot of its first variable; a landmark's values to each robot that measures it.

    Raises
    ------
    InputError
        A name has no GTSAM key.
    """
    path = Path(path)
    times = _all_times(graph)
    if any(time < 0 for time in times):
        raise InputError(f"{path}: JRL holds no times before 0: give UTC seconds")
    are_utc, are_steps = all(time >= MIN_NS * 1e-9 for time in graph.times.values()), all(map(_is_whole, times))
    in_ns = are_utc or not are_steps
    entries: dict[str, dict[int, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    marked: dict[str, list[tuple[int, int]]] = defaultdict(list)
    places = []
    sees: dict[str, set[str]] = defaultdict(set)
    for number, one in enumerate(graph.measurements):
        names = ends_of(one)
        for landmark in filter(is_landmark, names):
            sees[landmark] |= {other[0] for other in names if other != landmark} or {names[0][0]}
        stamp = round(one.time * 1e9) if in_ns else round(one.time)
        rows = entries[names[0][0]][stamp]
        rows.append(_measurement(one, planar=graph.planar))
        if number in graph.outliers:
            places.append((names[0][0], stamp, len(rows) - 1))
    for robot, stamp, place in places:
        marked[robot].append((sorted(entries[robot]).index(stamp), place))
    robots = sorted({one[0] for one in graph.names if not is_landmark(one)} | set(entries))
    dataset: dict[str, Any] = {
        "name": name or path.stem,
        "robots": [ord(robot) for robot in robots],
        "measurements": {
            robot: [{"stamp": stamp, "measurements": rows} for stamp, rows in sorted(entries[robot].items())]
            for robot in robots
        },
    }
    for kind, values in (("groundtruth", graph.truth), ("initialization", graph.initial)):
        if values:
            rows_of: dict[str, list[dict[str, Any]]] = {robot: [] for robot in robots}
            for variable, value in values.items():
                holders = sees[variable] or set(robots) if is_landmark(variable) else {variable[0]}
                for robot in sorted(holders & set(robots)):
                    rows_of[robot].append({"key": _key(variable), **_json(value)})
            dataset[kind] = rows_of
    if marked:
        dataset["outlier_factors"] = marked
    if in_ns and not are_utc:
        dataset[UNIT] = NS
    write_atomically(path, json.dumps(dataset) + "\n")


def _is_whole(time: float) -> bool:
    return time == round(time)


def _all_times(graph: RangeGraph) -> list[float]:
    return [*graph.times.values(), *(one.time for one in graph.measurements)]


def _measurement(one: Any, *, planar: bool) -> dict[str, Any]:
    if isinstance(one, Prior):
        prior = _json(one.value)
        kind, covariance = f"PriorFactor{prior['type']}", one.covariance.ravel().tolist()
        return {"type": kind, "key": _key(one.name), "prior": prior, "covariance": covariance}
    if isinstance(one, RelativeValue) and not is_pose(one.value):
        one = as_bearing(one)
    if isinstance(one, RelativeValue):
        measured = _json(one.value)
        kind, covariance = f"BetweenFactor{measured['type']}", one.covariance.ravel().tolist()
    else:
        of = ("2D" if planar else "3D") if is_landmark(one.second) else ("Pose2" if planar else "Pose3")
        distance = {"type": "Scalar", "value": one.distance}
        if isinstance(one, RangeValue):
            kind, measured, covariance = f"RangeFactor{of}", distance, [one.variance]
        else:
            bearing = (
                {"type": "Rot2", "theta": one.bearing}
                if planar
                else {"type": "Unit3", **dict(zip("ijk", map(float, one.bearing), strict=True))}
            )
            kind, covariance = f"BearingRangeFactor{of}", one.covariance.ravel().tolist()
            measured = {"type": "BearingRange", "bearing": bearing, "range": distance}
    ends = {"key1": _key(one.first), "key2": _key(one.second)}
    return {"type": kind, **ends, "measurement": measured, "covariance": covariance}


def _json(value: Any) -> dict[str, Any]:
    if isinstance(value, gtsam.Pose2):
        return {"type": "Pose2", "x": value.x(), "y": value.y(), "theta": value.theta()}
    if isinstance(value, gtsam.Pose3):
        turn = [float(one) for one in quaternion(value.rotation().matrix())]
        return {"type": "Pose3", "translation": value.translation().tolist(), "rotation": turn}
    return {"type": f"Point{len(value)}", **dict(zip("xyz", map(float, value), strict=False))}
