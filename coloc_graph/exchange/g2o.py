"""Pose graphs in the g2o format, read: those of other people and ours.

Ids are integers of 64 bits, as GTSAM's symbols are. Comments, in lines of their own or behind a record, blank lines,
Windows line ends and a byte order mark are accepted.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import StayPut
from coloc_graph.backend.factors import GAUGE_SIGMA
from coloc_graph.errors import InputError
from coloc_graph.input_file import quoted, read_text
from coloc_graph.measurements import Node

Array = NDArray[np.float64]

#: Order of ours, rotation first, in g2o's, translation first.
TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
#: Largest id, and number that is read.
MAX_ID = 2**64 - 1
MAX_NUMBER = 1e100
#: Least eigenvalue of an information matrix of unit diagonal that is positive definite.
LEAST_EIGENVALUE = 1e-12
#: Least eigenvalue that projection leaves, relative to the largest.
LEAST_PROJECTED = 1e-9
_IS = re.compile(r"# (\d{1,20}) is (.+)")
_STAY_PUT = re.compile(r"# STAY_PUT (\S+) (\d{1,9}) (\d{1,9})")
_ID = re.compile(r"[0-9]{1,20}")


@dataclass(frozen=True, eq=False)
class G2oGraph:
    """Pose graph of a file: factors and values with the file's ids as keys, `Pose2` or `Pose3`.

    Attributes
    ----------
    factors, values
        The graph. The `fixed` vertices (the lowest id where the file fixes none) hold the world by a prior, the first
        factors.
    fixed
        Ids of the vertices that do not move.
    names
        Robots and stances that our own files give to vertices; all of `names[id]` are one pose.
    stay_puts
        Stay-put constraints of our own files.
    landmarks
        Names of the vertices that are landmarks.
    projected
        Number of edges whose information matrix was not positive definite and was projected (see `read_g2o`).
    left_out
        Number of edges without any information, which were left out.
    """

    factors: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    fixed: tuple[int, ...]
    names: dict[int, tuple[Node, ...]]
    stay_puts: tuple[StayPut, ...]
    landmarks: dict[int, str] = field(default_factory=dict)
    projected: int = 0
    left_out: int = 0

    @property
    def planar(self) -> bool:
        """True if the poses are `Pose2`."""
        return self.factors.size() > 0 and self.factors.at(0).dim() == 3


def read_g2o(path: str | Path, *, lenient: bool = False) -> G2oGraph:
    """Read the pose graph in a g2o file.

    Parameters
    ----------
    path
        File.
    lenient
        Whether information matrices that are not positive definite are projected onto the nearest that is (negative
        and zero eigenvalues become `LEAST_PROJECTED` of the largest); an edge with no positive eigenvalue is left out.

    Raises
    ------
    InputError
        If it is no pose graph; it names the line. If, without `lenient`, information matrices are not positive
        definite; it says how many and names the first.
    """
    return _Reader(Path(path), lenient).read()


class _Reader:
    """One pass over the lines."""

    def __init__(self, path: Path, lenient: bool) -> None:
        self.path, self.lenient, self.line = path, lenient, 0
        self.edges, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.ends: list[tuple[int, int, int, bool]] = []
        self.planar: dict[int, bool] = {}
        self.fixed: list[tuple[int, int]] = []
        self.names: dict[int, tuple[Node, ...]] = {}
        self.stay_puts: list[StayPut] = []
        self.landmarks: dict[int, str] = {}
        self.indefinite: list[int] = []
        self.left_out = 0
        # ids, numbers after them, and who takes both
        self.tags: dict[str, tuple[int, int, Callable[[list[int], list[float]], None]]] = {
            "VERTEX_SE2": (1, 3, self._vertex2),
            "VERTEX_SE3:QUAT": (1, 7, self._vertex3),
            "EDGE_SE2": (2, 9, self._edge2),
            "EDGE_SE3:QUAT": (2, 28, self._edge3),
        }

    def read(self) -> G2oGraph:
        text = read_text(self.path, "give a pose graph in the g2o format")
        for self.line, line in enumerate(text.split("\n"), start=1):
            content = line.strip()
            if content.startswith("#"):
                self._comment(content)
            elif words := content.split("#", 1)[0].split():
                self._record(words)
        return self._graph()

    def _error(self, what: str, line: int | None = None) -> InputError:
        return InputError(f"{self.path}, line {self.line if line is None else line}: {what}")

    def _record(self, words: list[str]) -> None:
        tag, *rest = words
        if tag == "FIX":
            if not rest:
                raise self._error("`FIX` has no id; give the vertices that do not move")
            self.fixed += [(self._id(word), self.line) for word in rest]
            return
        if tag not in self.tags:
            raise self._error(f"{quoted(tag)} is not read; a graph of poses has {', '.join((*self.tags, 'FIX'))}")
        ids, count, take = self.tags[tag]
        try:
            numbers = [float(word) for word in rest]
        except ValueError:
            raise self._error(f"`{tag}` holds what is no number") from None
        if len(numbers) != ids + count or not all(abs(number) < MAX_NUMBER for number in numbers[ids:]):
            raise self._error(f"`{tag}` has {len(numbers)} numbers; {ids + count}, all finite, are expected")
        take([self._id(word) for word in rest[:ids]], numbers[ids:])

    def _comment(self, line: str) -> None:
        if found := _IS.fullmatch(line):
            number = int(found[1])
            if found[2].startswith("landmark "):
                self.landmarks[number] = found[2].removeprefix("landmark ")
            named = [name.rpartition("@") for name in found[2].split(" = ")]
            if all(robot and stance.isdecimal() and len(stance) < 10 for robot, _, stance in named):
                self.names[number] = tuple((robot, int(stance)) for robot, _, stance in named)
        elif found := _STAY_PUT.fullmatch(line):
            self.stay_puts.append(StayPut(found[1], int(found[2]), int(found[3])))

    def _id(self, word: str) -> int:
        if not _ID.fullmatch(word) or int(word) > MAX_ID:
            raise self._error(f"{quoted(word)} is no id; ids are whole numbers from 0 to {MAX_ID}")
        return int(word)

    def _insert(self, key: int, pose: gtsam.Pose2 | gtsam.Pose3) -> None:
        if key in self.planar:
            raise self._error(f"vertex {key} is there twice; give each an id of its own")
        self.values.insert(key, pose)
        self.planar[key] = isinstance(pose, gtsam.Pose2)

    def _vertex2(self, ids: list[int], n: list[float]) -> None:
        self._insert(ids[0], gtsam.Pose2(*n))

    def _vertex3(self, ids: list[int], n: list[float]) -> None:
        self._insert(ids[0], self._pose3(n))

    def _pose3(self, n: list[float]) -> gtsam.Pose3:
        x, y, z, *q = n
        length = float(np.linalg.norm(q)) if max(map(abs, q)) < 2 else 0.0
        if abs(length - 1) > 1e-3:
            raise self._error("the quaternion is not of unit length; write qx qy qz qw")
        qx, qy, qz, qw = (part / length for part in q)
        return gtsam.Pose3(gtsam.Rot3(qw, qx, qy, qz), np.array([x, y, z]))

    def _edge2(self, ids: list[int], n: list[float]) -> None:
        i, j = self._ends(ids, planar=True)
        if (noise := self._noise_of(n[3:], [0, 1, 2])) is not None:
            self.edges.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*n[:3]), noise))

    def _edge3(self, ids: list[int], n: list[float]) -> None:
        i, j = self._ends(ids, planar=False)
        measured = self._pose3(n[:7])
        if (noise := self._noise_of(n[7:], TRANSLATION_FIRST)) is not None:
            self.edges.add(gtsam.BetweenFactorPose3(i, j, measured, noise))

    def _ends(self, ids: list[int], *, planar: bool) -> list[int]:
        if ids[0] == ids[1]:
            raise self._error(f"the edge is from vertex {ids[0]} to itself; remove it")
        self.ends.append((ids[0], ids[1], self.line, planar))
        return ids

    def _noise_of(self, upper: list[float], order: list[int]) -> gtsam.noiseModel.Base | None:
        """Noise of an information matrix, its upper triangle row by row; None for an edge that is left out."""
        size = len(order)
        information = np.zeros((size, size))
        information[np.triu_indices(size)] = upper
        information = (information + np.triu(information, 1).T)[np.ix_(order, order)]
        scale = np.sqrt(np.abs(np.diag(information)))
        unit = information / np.outer(scale, scale) if (np.diag(information) > 0).all() else -np.eye(size)
        if np.isfinite(unit).all() and np.linalg.eigvalsh(unit)[0] > LEAST_EIGENVALUE:
            return gtsam.noiseModel.Gaussian.Information(information)
        self.indefinite.append(self.line)
        values, vectors = np.linalg.eigh(information)
        if not values[-1] > 0:
            self.left_out += 1
            return None
        root = np.sqrt(np.maximum(values, LEAST_PROJECTED * values[-1]))[:, None] * vectors.T
        return gtsam.noiseModel.Gaussian.SqrtInformation(root)

    def _graph(self) -> G2oGraph:
        if not self.planar:
            raise InputError(f"{self.path}: holds no vertex; give a pose graph in the g2o format")
        for *ends, line in [*((i, j, line) for i, j, line, _ in self.ends), *self.fixed]:
            for key in ends:
                if key not in self.planar:
                    raise self._error(f"vertex {key} is not there; give it a VERTEX line", line)
        if len({*self.planar.values(), *(planar for *_, planar in self.ends)}) > 1:
            raise InputError(f"{self.path}: mixes SE2 and SE3; give a graph of one of them")
        if self.indefinite and not self.lenient:
            count, first = len(self.indefinite), self.indefinite[0]
            raise self._error(
                f"the information matrix is not positive definite, as in {count} of {len(self.ends)} edges; correct "
                f"{'it' if count == 1 else 'them'}, or read the graph with --lenient, which projects "
                f"{'it' if count == 1 else 'them'}",
                first,
            )
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
        return G2oGraph(
            factors=factors,
            values=self.values,
            fixed=fixed,
            names=self.names,
            stay_puts=tuple(self.stay_puts),
            landmarks=self.landmarks,
            projected=len(self.indefinite) - self.left_out,
            left_out=self.left_out,
        )
