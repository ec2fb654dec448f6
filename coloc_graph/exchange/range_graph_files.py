"""Files of factor graphs by their endings, and pose graphs of g2o as `RangeGraph`."""

import string
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import gtsam

from coloc_graph.errors import InputError
from coloc_graph.exchange import jrl, pyfg
from coloc_graph.exchange.g2o import G2oGraph, read_g2o
from coloc_graph.exchange.range_graph import LANDMARK, RangeGraph, RelativeValue
from coloc_graph.measurements import Node

WRITERS: dict[str, Callable[[RangeGraph, Path], None]] = {"pyfg": pyfg.write_pyfg, "jrl": jrl.write_jrl}
SUFFIXES = (".pyfg", ".jrl", ".g2o")
#: PyFactorGraph knows capital letters only.
_LETTERS = [letter for letter in string.ascii_uppercase + string.ascii_lowercase if letter != LANDMARK]


def read_range_graph(path: str | Path) -> RangeGraph:
    """Read a factor graph by the ending of its file: .pyfg, .jrl or .g2o.

    Raises
    ------
    InputError
        The ending is none of these, or the file is damaged.
    """
    path = Path(path)
    match path.suffix.lower():
        case pyfg.SUFFIX:
            return pyfg.read_pyfg(path)
        case jrl.SUFFIX:
            return jrl.read_jrl(path)
        case ".g2o":
            return of_pose_graph(read_g2o(path), {})[0]
    raise InputError(f"{path} is no factor graph: give a file that ends in {', '.join(SUFFIXES)}")


def of_pose_graph(graph: G2oGraph, times: Mapping[Node, float]) -> tuple[RangeGraph, dict[str, str]]:
    """Return a pose graph with names of a letter and a number for its vertices.

    Parameters
    ----------
    graph : G2oGraph
        Pose graph of a file.
    times : mapping of (robot, stance) to float
        Times of poses [s], where they are known.

    Returns
    -------
    (RangeGraph, dict of str to str)
        The graph, its poses being initial values, and the letter of each robot, of the landmarks "landmarks".
    """
    letters: dict[str, str] = {}
    names: dict[int, str] = {}
    counts: dict[str, int] = {}
    known: dict[str, float] = {}
    for key in graph.values.keys():  # noqa: SIM118
        nodes = graph.names.get(key)
        robot = nodes[0][0] if nodes else "landmarks" if key in graph.landmarks else _symbol(key)
        letter = letters.get(robot) or _free(robot, letters)
        letters[robot] = letter
        names[key] = f"{letter}{counts.get(letter, 0)}"
        counts[letter] = counts.get(letter, 0) + 1
        if nodes and nodes[0] in times:
            known[names[key]] = times[nodes[0]]
    value: Any = graph.values.atPose2 if graph.planar else graph.values.atPose3
    relatives = []
    for number, (i, j) in enumerate(graph.ends):
        factor: Any = graph.edges.at(number)
        time = max(known.get(names[i], 0.0), known.get(names[j], 0.0))
        covariance = factor.noiseModel().covariance()
        relatives.append(RelativeValue(time, names[i], names[j], factor.measured(), (covariance + covariance.T) / 2))
    initial = {name: value(key) for key, name in names.items()}
    if known:  # what has no time of its own, as landmarks
        known = {name: known.get(name, min(known.values())) for name in names.values()}
        relatives = [one if one.time else _at(one, min(known.values())) for one in relatives]
    return RangeGraph(graph.planar, known, {}, initial, relatives=tuple(relatives)), letters


def letters_of(robots: Iterable[str]) -> dict[str, str]:
    """Return a letter for each robot: its own first one as a capital where that is free, else the first that is."""
    letters: dict[str, str] = {}
    for robot in robots:
        letters[robot] = _free(robot, letters)
    return letters


def _at(one: RelativeValue, time: float) -> RelativeValue:
    return RelativeValue(time, one.first, one.second, one.value, one.covariance)


def _symbol(key: int) -> str:
    letter = chr(gtsam.symbolChr(key))
    return letter if letter.isascii() and letter.isalpha() else "vertices"


def _free(robot: str, letters: Mapping[str, str]) -> str:
    taken = set(letters.values())
    found = next((one for one in (robot[:1].upper(), *_LETTERS) if one in _LETTERS and one not in taken), None)
    if found is None:
        raise InputError(f"the formats name robots by one letter, and there are more than {len(_LETTERS)}: export g2o")
    return found
