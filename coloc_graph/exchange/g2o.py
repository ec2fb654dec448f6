"""Pose graphs in the g2o format, read: those of other people and ours.

Ids are integers of 64 bits, as GTSAM's symbols are. Comments, in lines of their own or behind a record, blank lines,
Windows line ends and a byte order mark are accepted. A file without any vertex begins at its edges, compounded.

Source: g2o's file format, https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import StayPut
from coloc_graph.backend.factors import GAUGE_SIGMA
from coloc_graph.errors import InputError
from coloc_graph.exchange.g2o_records import Block, G2oText, bad_line, parse_g2o
from coloc_graph.input_file import read_text
from coloc_graph.measurements import Node

Array = NDArray[np.float64]

TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]  # our order, rotation first, in g2o's
MAX_NORM_ERROR = 1e-3  # of a quaternion, which is then normalised
MIN_EIGENVALUE = 1e-12  # of an information matrix of unit diagonal that is positive definite
MIN_PROJECTED = 1e-9  # least eigenvalue that projection leaves, relative to the largest
_IS = re.compile(r"# (\d{1,20}) is (.+)")
_STAY_PUT = re.compile(r"# STAY_PUT (\S+) (\d{1,9}) (\d{1,9})")


@dataclass(frozen=True, eq=False)
class G2oGraph:
    """Pose graph of a file: factors and values with the file's ids as keys, `Pose2` or `Pose3`.

    Attributes
    ----------
    factors, values
        The graph. The `fixed` vertices (the lowest id where the file fixes none) hold the world by a prior, the first
        factors.
    edges
        Factors of the edges alone.
    ends
        Ids of the vertices of each edge.
    planar
        True if the poses are `Pose2`.
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
    edges: gtsam.NonlinearFactorGraph
    ends: tuple[tuple[int, int], ...]
    planar: bool
    fixed: tuple[int, ...]
    names: dict[int, tuple[Node, ...]]
    stay_puts: tuple[StayPut, ...]
    landmarks: dict[int, str] = field(default_factory=dict)
    projected: int = 0
    left_out: int = 0


def read_g2o(path: str | Path, *, lenient: bool = False) -> G2oGraph:
    """Read the pose graph in a g2o file.

    Parameters
    ----------
    path
        File.
    lenient
        Whether information matrices that are not positive definite are projected onto the nearest that is (negative
        and zero eigenvalues become `MIN_PROJECTED` of the largest); an edge with no positive eigenvalue is left out.

    Raises
    ------
    InputError
        If it is no pose graph; it names the line. If, without `lenient`, information matrices are not positive
        definite; it says how many and names the first.
    """
    path = Path(path)
    text = parse_g2o(path, read_text(path, "give a pose graph in the g2o format"))
    planar = _is_planar(path, text)
    kind = "SE2" if planar else "SE3:QUAT"
    vertices, edges = text.blocks[f"VERTEX_{kind}"], text.blocks[f"EDGE_{kind}"]
    _require_ends(path, text, vertices, edges)
    measured = _poses(path, edges, planar=planar)
    if vertices.ids:
        initial = dict(zip((key for (key,) in vertices.ids), _poses(path, vertices, planar=planar), strict=True))
    else:
        initial = _compounded(edges.ids, measured)
    values = gtsam.Values()
    for key, pose in initial.items():
        values.insert(key, pose)
    roots, indefinite = _information_roots(edges.numbers[:, 3:] if planar else edges.numbers[:, 7:])
    if len(indefinite) and not lenient:
        count, them = len(indefinite), "it" if len(indefinite) == 1 else "them"
        raise bad_line(
            path,
            edges.lines[indefinite[0]],
            f"the information matrix is not positive definite, as in {count} of {len(edges.ids)} edges; correct {them},"
            f" or read the graph with --lenient, which projects {them}",
        )
    fixed = tuple(dict.fromkeys(key for key, _ in text.fixed)) or (min(initial),)
    between = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    factors, links, ends = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph(), []
    for key in fixed:
        if planar:
            held = gtsam.noiseModel.Isotropic.Sigma(3, GAUGE_SIGMA)
            factors.add(gtsam.PriorFactorPose2(key, values.atPose2(key), held))
        else:
            held = gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)
            factors.add(gtsam.PriorFactorPose3(key, values.atPose3(key), held))
    noises: dict[bytes, gtsam.noiseModel.Base] = {}  # most files have few
    for (i, j), pose, root in zip(edges.ids, measured, roots, strict=True):
        if root is not None:
            if (noise := noises.get(which := root.tobytes())) is None:
                noise = noises[which] = gtsam.noiseModel.Gaussian.SqrtInformation(root)
            links.add(between(i, j, pose, noise))
            ends.append((i, j))
    factors.push_back(links)
    left_out = len(edges.ids) - len(ends)
    names, stay_puts, landmarks = _own_comments(text.comments)
    return G2oGraph(
        factors=factors,
        values=values,
        edges=links,
        ends=tuple(ends),
        planar=planar,
        fixed=fixed,
        names=names,
        stay_puts=stay_puts,
        landmarks=landmarks,
        projected=len(indefinite) - left_out,
        left_out=left_out,
    )


def _is_planar(path: Path, text: G2oText) -> bool:
    """Return whether a file is a graph in 2D; raise where it is of both kinds or of none."""
    planar = [bool(text.blocks[f"{one}_SE2"].ids) for one in ("VERTEX", "EDGE")]
    solid = [bool(text.blocks[f"{one}_SE3:QUAT"].ids) for one in ("VERTEX", "EDGE")]
    if not any(planar) and not any(solid):
        raise InputError(f"{path}: holds no vertex and no edge; give a pose graph in the g2o format")
    if any(planar) and any(solid):
        raise InputError(f"{path}: mixes SE2 and SE3; give a graph of one of them")
    return any(planar)


def _require_ends(path: Path, text: G2oText, vertices: Block, edges: Block) -> None:
    """Raise unless ids of vertices are unique and edges join two of them."""
    keys: set[int] = set()
    for (key,), line in zip(vertices.ids, vertices.lines, strict=True):
        if key in keys:
            raise bad_line(path, line, f"vertex {key} is there twice; give each an id of its own")
        keys.add(key)
    keys |= set() if keys else {key for ids in edges.ids for key in ids}
    for ids, line in (*zip(edges.ids, edges.lines, strict=True), *(((key,), line) for key, line in text.fixed)):
        for key in ids:
            if key not in keys:
                raise bad_line(path, line, f"vertex {key} is not there; give it a VERTEX line")
        if len(ids) == 2 and ids[0] == ids[1]:
            raise bad_line(path, line, f"the edge is from vertex {ids[0]} to itself; remove it")


def _compounded(ends: list[tuple[int, ...]], measured: list[Any]) -> dict[int, Any]:
    """Poses of a file without vertices: edges compounded from the lowest id of each connected part, breadth first."""
    steps: dict[int, list[tuple[int, Any]]] = {}
    for (i, j), pose in zip(ends, measured, strict=True):
        steps.setdefault(i, []).append((j, pose))
        steps.setdefault(j, []).append((i, pose.inverse()))
    found: dict[int, Any] = {}
    for root in sorted(steps):
        queue = [] if root in found else [root]
        found.setdefault(root, type(measured[0])())
        for at in queue:
            for to, pose in steps[at]:
                if to not in found:
                    found[to] = found[at].compose(pose)
                    queue.append(to)
    return found


def _poses(path: Path, block: Block, *, planar: bool) -> list[Any]:
    """Poses of vertices or edges, `Pose2` or `Pose3`."""
    if planar:
        return [gtsam.Pose2(*row) for row in block.numbers[:, :3].tolist()]
    q = block.numbers[:, 3:7]
    length = np.linalg.norm(q, axis=1)
    wrong = np.abs(length - 1) > MAX_NORM_ERROR
    if wrong.any():
        line = block.lines[int(np.argmax(wrong))]
        raise bad_line(path, line, "the quaternion is not of unit length; write qx qy qz qw")
    turns = (q / length[:, None])[:, [3, 0, 1, 2]].tolist()
    places = block.numbers[:, :3].copy()
    return [gtsam.Pose3(gtsam.Rot3(*turn), place) for turn, place in zip(turns, places, strict=True)]


def _information_roots(upper: Array) -> tuple[list[Array | None], NDArray[np.intp]]:
    """Roots R of information matrices R^T R, and the indices of those that are not positive definite.

    Parameters
    ----------
    upper
        Upper triangles of information matrices row by row, (n, 6) in 2D or (n, 21) in 3D, g2o's order.

    Returns
    -------
    roots
        Upper triangular (3, 3) or (6, 6), GTSAM's order; of an indefinite matrix that of its projection, None where no
        eigenvalue is positive.
    indefinite
        Indices of the matrices that are not positive definite.
    """
    size = 3 if upper.shape[1] == 6 else 6
    order = [0, 1, 2] if size == 3 else TRANSLATION_FIRST
    information = np.zeros((len(upper), size, size))
    information[(slice(None), *np.triu_indices(size))] = upper
    information += np.triu(information, 1).transpose(0, 2, 1)
    information = information[:, order][:, :, order]
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    scale = np.sqrt(np.where((diagonal > 0).all(axis=1, keepdims=True), diagonal, np.nan))
    unit = information / (scale[:, :, None] * scale[:, None, :])
    sound = np.isfinite(unit).all(axis=(1, 2))
    unit[~sound] = np.eye(size)
    try:  # a tenth of the time of eigenvalues
        np.linalg.cholesky(unit - MIN_EIGENVALUE * np.eye(size))
    except np.linalg.LinAlgError:
        sound &= np.linalg.eigvalsh(unit)[:, 0] > MIN_EIGENVALUE
    factors = np.linalg.cholesky(np.where(sound[:, None, None], information, np.eye(size))).transpose(0, 2, 1)
    roots: list[Array | None] = list(factors)
    indefinite = np.flatnonzero(~sound)
    for index in indefinite:
        values, vectors = np.linalg.eigh(information[index])
        root = np.sqrt(np.maximum(values, MIN_PROJECTED * values[-1]))[:, None] * vectors.T if values[-1] > 0 else None
        roots[index] = root
    return roots, indefinite


def _own_comments(
    comments: list[str],
) -> tuple[dict[int, tuple[Node, ...]], tuple[StayPut, ...], dict[int, str]]:
    """Names of vertices, stay-put constraints and names of landmarks in the comments of our own files."""
    names: dict[int, tuple[Node, ...]] = {}
    stay_puts: list[StayPut] = []
    landmarks: dict[int, str] = {}
    for line in comments:
        if found := _IS.fullmatch(line):
            number = int(found[1])
            if found[2].startswith("landmark "):
                landmarks[number] = found[2].removeprefix("landmark ")
            named = [name.rpartition("@") for name in found[2].split(" = ")]
            if all(robot and stance.isdecimal() and len(stance) < 10 for robot, _, stance in named):
                names[number] = tuple((robot, int(stance)) for robot, _, stance in named)
        elif found := _STAY_PUT.fullmatch(line):
            stay_puts.append(StayPut(found[1], int(found[2]), int(found[3])))
    return names, tuple(stay_puts), landmarks
