"""Pose graphs in the g2o format, out and in.

VERTEX_SE3:QUAT and EDGE_SE3:QUAT with the information's upper triangle, translation first; read are also VERTEX_SE2
and EDGE_SE2. Ids are plain integers; numbers read back to the bit. g2o has no word for a stay-put constraint:
stances that share a pose share a vertex, and a comment says so, which `read_g2o` understands. Landmarks, and the map,
are vertices like any other, named in comments. Nor has g2o a word for a floor: its priors are left out. What a planar
measurement does not know has the information `UNKNOWN`.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Estimate, StayPut
from coloc_graph.backend.factors import GAUGE_SIGMA, link_covariance
from coloc_graph.backend.landmarks import MAP
from coloc_graph.errors import InputError
from coloc_graph.geometry.lie import quaternion
from coloc_graph.measurements import Node

Array = NDArray[np.float64]

#: The information of what a measurement does not know, on paper: a deviation of 1 km, or of 1000 rad.
UNKNOWN = 1e-6
_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
_IS = re.compile(r"# (\d+) is (.+)")
_STAY_PUT = re.compile(r"# STAY_PUT (\S+) (\d+) (\d+)")


def write_g2o(estimate: Estimate, path: Path) -> None:
    """Write what was estimated, and what was measured between it and not refused."""
    graph = estimate.graph
    poses: dict[int, Array] = {}
    names: dict[int, list[str]] = {}
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        for stance, T in zip(trajectory.stances.tolist(), trajectory.T_world_body, strict=True):
            key = graph.key(robot, stance)
            poses.setdefault(key, T)
            names.setdefault(key, []).append(f"{robot}@{stance}")
    still = estimate.landmarks if estimate.map is None else {**estimate.landmarks, MAP: estimate.map}
    for name, placed in still.items():
        key = graph.places.still()[name]
        poses[key], names[key] = placed.T_world_body.matrix(), ["the map" if name == MAP else f"landmark {name}"]
    ids = {key: number for number, key in enumerate(poses)}

    lines = []
    for key, pose in poses.items():
        lines.append(f"# {ids[key]} is {' = '.join(names[key])}")
        lines.append(f"VERTEX_SE3:QUAT {ids[key]} {_pose(pose)}")
    lines.append(f"FIX {ids[graph.reference_key]}")
    lines += [
        f"# STAY_PUT {stay.robot} {stay.before} {stay.after}"
        for stay in graph.stay_puts
        if graph.key(stay.robot, stay.after) in ids
    ]
    for link in graph.without(one.measurement for one in estimate.refused).links:
        i, j = map(graph.places.key, link.ends)
        if i in ids and j in ids:
            upper = " ".join(repr(float(x)) for x in _information(link_covariance(link))[np.triu_indices(6)])
            lines.append(f"EDGE_SE3:QUAT {ids[i]} {ids[j]} {_pose(link.T_i_j)} {upper}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _information(C: Array) -> Array:
    """g2o's (6, 6), translation first, of a covariance (6, 6), or (3, 3) of heading, x, y."""
    information = UNKNOWN * np.eye(6)
    known = slice(0, 6) if len(C) == 6 else slice(2, 5)
    information[known, known] = np.linalg.inv(C)
    return information[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]


def _pose(T: Array) -> str:
    w, x, y, z = quaternion(T[:3, :3])
    return " ".join(repr(float(number)) for number in (*T[:3, 3], x, y, z, w))


@dataclass(frozen=True, eq=False)
class G2oGraph:
    """A pose graph read from a file: factors and values with the file's ids as keys, `Pose2` or `Pose3`.

    The `fixed` vertices (the lowest id where the file fixes none) hold the world by a prior, the first factors.
    `names` are the robots and stances that our own files give to vertices, and `stay_puts` their constraints: all of
    `names[id]` are one place. `landmarks` are the names of the vertices that are landmarks.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    fixed: tuple[int, ...]
    names: dict[int, tuple[Node, ...]]
    stay_puts: tuple[StayPut, ...]
    landmarks: dict[int, str] = field(default_factory=dict)


def read_g2o(path: str | Path) -> G2oGraph:
    """The pose graph in a g2o file; `InputError` naming the line where it is none, an id is there twice or missing."""
    return _Reader(Path(path)).read()


class _Reader:
    """One pass over the lines."""

    def __init__(self, path: Path) -> None:
        self.path, self.line = path, 0
        self.edges, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.ends: list[tuple[int, int, int]] = []
        self.planar: dict[int, bool] = {}
        self.fixed: list[tuple[int, int]] = []
        self.names: dict[int, tuple[Node, ...]] = {}
        self.stay_puts: list[StayPut] = []
        self.landmarks: dict[int, str] = {}
        self.tags: dict[str, tuple[int | None, Callable[[list[float]], None]]] = {
            "VERTEX_SE2": (4, self._vertex2),
            "VERTEX_SE3:QUAT": (8, self._vertex3),
            "EDGE_SE2": (11, self._edge2),
            "EDGE_SE3:QUAT": (30, self._edge3),
            "FIX": (None, self._fix),
        }

    def read(self) -> G2oGraph:
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{self.path}: cannot be read ({error}); give a pose graph in the g2o format") from error
        for self.line, line in enumerate(text.splitlines(), start=1):
            if line.startswith("#"):
                self._comment(line)
            elif line.strip():
                self._record(line.split())
        return self._graph()

    def _error(self, what: str, line: int | None = None) -> InputError:
        return InputError(f"{self.path}, line {self.line if line is None else line}: {what}")

    def _record(self, words: list[str]) -> None:
        tag, *rest = words
        if tag not in self.tags:
            raise self._error(f"`{tag}` is not read; a graph of poses has {', '.join(self.tags)}")
        count, take = self.tags[tag]
        try:
            numbers = [float(word) for word in rest]
        except ValueError:
            raise self._error(f"`{tag}` holds what is no number") from None
        if (len(numbers) != count if count else not numbers) or not np.isfinite(numbers).all():
            raise self._error(f"`{tag}` has {len(numbers)} numbers; {count or 'at least 1'}, all finite, are expected")
        take(numbers)

    def _comment(self, line: str) -> None:
        if found := _IS.fullmatch(line.strip()):
            if found[2].startswith("landmark "):
                self.landmarks[int(found[1])] = found[2].removeprefix("landmark ")
            named = [name.rpartition("@") for name in found[2].split(" = ")]
            if all(robot and stance.isdecimal() for robot, _, stance in named):
                self.names[int(found[1])] = tuple((robot, int(stance)) for robot, _, stance in named)
        elif found := _STAY_PUT.fullmatch(line.strip()):
            self.stay_puts.append(StayPut(found[1], int(found[2]), int(found[3])))

    def _id(self, number: float) -> int:
        if number != int(number) or not 0 <= number < 2**53:
            raise self._error(f"{number:g} is no id; ids are whole numbers, not negative")
        return int(number)

    def _insert(self, number: float, pose: gtsam.Pose2 | gtsam.Pose3) -> None:
        key = self._id(number)
        if key in self.planar:
            raise self._error(f"vertex {key} is there twice; give each an id of its own")
        self.values.insert(key, pose)
        self.planar[key] = isinstance(pose, gtsam.Pose2)

    def _vertex2(self, n: list[float]) -> None:
        self._insert(n[0], gtsam.Pose2(*n[1:]))

    def _vertex3(self, n: list[float]) -> None:
        self._insert(n[0], self._pose3(n[1:]))

    def _pose3(self, n: list[float]) -> gtsam.Pose3:
        x, y, z, *q = n
        length = float(np.linalg.norm(q))
        if abs(length - 1) > 1e-3:
            raise self._error("the quaternion is not of unit length; write qx qy qz qw")
        qx, qy, qz, qw = (part / length for part in q)
        return gtsam.Pose3(gtsam.Rot3(qw, qx, qy, qz), np.array([x, y, z]))

    def _edge2(self, n: list[float]) -> None:
        i, j = self._id(n[0]), self._id(n[1])
        self.ends.append((i, j, self.line))
        noise = gtsam.noiseModel.Gaussian.Information(self._information_of(n[5:], 3))
        self.edges.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*n[2:5]), noise))

    def _edge3(self, n: list[float]) -> None:
        i, j = self._id(n[0]), self._id(n[1])
        self.ends.append((i, j, self.line))
        information = self._information_of(n[9:], 6)[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]
        noise = gtsam.noiseModel.Gaussian.Information(information)
        self.edges.add(gtsam.BetweenFactorPose3(i, j, self._pose3(n[2:9]), noise))

    def _information_of(self, upper: list[float], size: int) -> Array:
        information = np.zeros((size, size))
        information[np.triu_indices(size)] = upper
        information = information + np.triu(information, 1).T
        if np.linalg.eigvalsh(information)[0] <= 0:
            raise self._error("the information matrix is not positive definite")
        return information

    def _fix(self, n: list[float]) -> None:
        self.fixed += [(self._id(number), self.line) for number in n]

    def _graph(self) -> G2oGraph:
        if not self.planar:
            raise InputError(f"{self.path}: holds no vertex; give a pose graph in the g2o format")
        for *ends, line in [*self.ends, *self.fixed]:
            for key in ends:
                if key not in self.planar:
                    raise self._error(f"vertex {key} is not there; give it a VERTEX line", line)
        if len(set(self.planar.values())) > 1 or any(
            self.planar[i] != (self.edges.at(at).dim() == 3) for at, (i, _, _) in enumerate(self.ends)
        ):
            raise InputError(f"{self.path}: mixes SE2 and SE3; give a graph of one of them")
        fixed = tuple(dict.fromkeys(key for key, _ in self.fixed)) or (min(self.planar),)
        factors = gtsam.NonlinearFactorGraph()
        for key in fixed:
            if self.planar[key]:
                noise = gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_SIGMA)
                factors.add(gtsam.PriorFactorPose2(key, self.values.atPose2(key), noise))
            else:
                noise = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
                factors.add(gtsam.PriorFactorPose3(key, self.values.atPose3(key), noise))
        factors.push_back(self.edges)
        return G2oGraph(factors, self.values, fixed, self.names, tuple(self.stay_puts), self.landmarks)
