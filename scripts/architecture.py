"""Draw ARCHITECTURE.md from the imports: rooms, layers, and the modules on the road of the data.

    python scripts/architecture.py           write ARCHITECTURE.md
    python scripts/architecture.py --check   exit with 1 if the file on disk differs

`tests/test_packaging.py` holds what is drawn: every room has a layer, imports point down, no circles.
"""

import argparse
import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "coloc_graph"
DRAWING = ROOT / "ARCHITECTURE.md"

#: Layers from the bottom, with what they are for. A room imports itself and rooms of the rows above it in this list,
#: never of its own row; the modules of the first row may import each other.
LAYERS: list[tuple[str, set[str]]] = [
    ("types and mathematics", {"_lazy", "_version", "errors", "geometry", "input_file", "machine", "measurements"}),
    ("robots", {"team"}),
    ("recorded data", {"run"}),
    ("image files", {"image_file"}),
    ("measuring, estimating, devices", {"frontend", "backend", "robot_io", "evaluation", "calibration"}),
    ("formats of others, plans", {"exchange", "planning"}),
    ("whole runs", {"simulation", "pipeline"}),
    ("reports and missions", {"report", "online"}),
    ("results on disk, simulated missions", {"missions", "results"}),
    ("experiments and viewer", {"experiments", "viewer"}),
    ("commands", {"cli"}),
    ("what users import", {"__init__"}),
]
EVERYWHERE = {
    "_lazy",
    "_version",
    "errors",
    "__init__",
}  # left out of the drawing: imported by all rooms, or imports all
RANK = {room: rank for rank, (_, rooms) in enumerate(LAYERS) for room in rooms}

#: The road of the data: a step, the modules that take it in order.
ROAD = [
    ("open a run or record one", ["run.reader", "run.writer", "robot_io.camera.open", "exchange.ros_import"]),
    ("detect markers in images", ["frontend.images.detection", "frontend.images.centroid"]),
    ("track them", ["frontend.tracks.tracking", "frontend.tracks.blink_codes"]),
    ("pair the tracks of two observers", ["frontend.pairing.association", "frontend.pairing.clock_offset"]),
    ("fit a homography", ["frontend.homography.fit", "frontend.homography.refinement"]),
    ("relative pose, eq. (2) or maximum likelihood",
     ["frontend.homography.eq2_pose", "frontend.homography.ml_pose", "measurements"]),
    ("build and solve the graph", ["backend.graph", "backend.batch", "backend.optimize", "backend.estimate"]),
    ("the whole of it, for a run", ["pipeline.batch", "pipeline.incremental"]),
    ("compare with truth", ["evaluation.pose_errors", "evaluation.nees"]),
    ("write a result, show it", ["results.writer", "report.html", "viewer.app"]),
]  # fmt: skip


def module_name(path: Path) -> str:
    """Dotted name of a file of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def room_of(module: str) -> str:
    """Room of a module: the first name below the package; `__init__` for the package itself."""
    return module.split(".")[1] if "." in module else "__init__"


@cache
def imported_names(path: Path) -> tuple[tuple[int, str], ...]:
    """All names that a file imports, also inside functions, as (line, dotted name)."""
    return tuple(_imported_names(path))


def _imported_names(path: Path) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(
                    f"{path}, line {node.lineno}: write the import absolute, a relative one hides its room"
                )
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


def module_imports() -> dict[str, set[str]]:
    """Modules of the package that each module imports."""
    graph: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        names = {name for _, name in imported_names(path)}
        owners = {name if name in MODULES else name.rpartition(".")[0] for name in names}
        graph[module] = {owner for owner in owners if owner in MODULES and owner != module}
    return graph


def room_imports(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Rooms that each room imports."""
    rooms: dict[str, set[str]] = defaultdict(set)
    for module, others in graph.items():
        rooms[room_of(module)] |= {room_of(other) for other in others} - {room_of(module)}
    return rooms


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Sets of nodes that reach each other; empty if the graph has no circle."""
    reached = {node: _reachable(graph, node) for node in graph}
    found: list[set[str]] = []
    for node in graph:
        circle = {other for other in reached[node] if node in reached.get(other, ())}
        if circle and circle not in found:
            found.append(circle)
    return found


def _reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    found, waiting = set(), list(graph[start])
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting += graph.get(node, ())
    return found


def _reduced(rooms: dict[str, set[str]]) -> dict[str, set[str]]:
    """The imports without those that follow from others: an arrow a -> c goes if a -> b -> c."""
    return {
        room: {one for one in others if not any(one in _reachable(rooms, other) for other in others - {one})}
        for room, others in rooms.items()
    }


def summary_of(module: str) -> str:
    """First line of a module's docstring."""
    docstring = ast.get_docstring(ast.parse(MODULES[module].read_text(encoding="utf-8")))
    return docstring.splitlines()[0] if docstring else ""


def drawing() -> str:
    """Text of ARCHITECTURE.md."""
    graph = module_imports()
    rooms = room_imports(graph)
    arrows = _reduced({room: others - EVERYWHERE for room, others in rooms.items() if room not in EVERYWHERE})
    lines = [*HEAD.splitlines(), "", "```mermaid", "flowchart TD"]
    for rank, (purpose, members) in reversed(list(enumerate(LAYERS))):
        lines.append(f'  subgraph layer{rank}["{purpose}"]')
        lines += [f"    {room}" for room in sorted(members - EVERYWHERE)]
        lines.append("  end")
    lines += [f"  {room} --> {other}" for room in sorted(arrows) for other in sorted(arrows[room])]
    lines += ["```", "", "| room | holds | imports |", "|---|---|---|"]
    for _, members in reversed(LAYERS):
        for room in sorted(members - EVERYWHERE):
            others = ", ".join(sorted(rooms.get(room, set()) - EVERYWHERE)) or "nothing of the package"
            lines.append(f"| `{room}` | {summary_of(f'coloc_graph.{room}')} | {others} |")
    lines += ["", *ROAD_HEAD.splitlines(), "", "| step | modules |", "|---|---|"]
    for step, modules in ROAD:
        paths = [MODULES[f"coloc_graph.{module}"].relative_to(ROOT).as_posix() for module in modules]
        links = ", ".join(f"[{path.removeprefix('coloc_graph/')}]({path})" for path in paths)
        lines.append(f"| {step} | {links} |")
    return "\n".join(lines) + "\n"


HEAD = """\
# Architecture

Written by `python scripts/architecture.py` from the imports; a test fails if it is out of date. Do not edit it by hand.

The code is one import package, `coloc_graph`. `frontend`, `backend` and `robot_io` at the root are links into it, for
reading. Imports point down: a room may import the rooms of lower layers, never those of its own layer or above, and no
modules import each other in a circle. `frontend` and `backend` do not know each other; what passes between them is
defined in `measurements`. `coloc_graph.solve` is the whole road in one call.

## Rooms

Arrows are imports; an arrow that follows from two others is left out, and so is `errors`, which all rooms import."""

ROAD_HEAD = """\
## The road of the data

From frames to an estimate, in the order in which it happens; [docs/conventions.md](docs/conventions.md) has frames and
units, [docs/run-format.md](docs/run-format.md) the file in which runs are kept."""


def main() -> int:
    """Write the drawing, or compare it."""
    parser = argparse.ArgumentParser(description="Draw ARCHITECTURE.md from the imports.")
    parser.add_argument("--check", action="store_true", help="compare instead of writing; exit with 1 if it differs")
    text = drawing()
    if parser.parse_args().check:
        return int(not DRAWING.exists() or DRAWING.read_text(encoding="utf-8") != text)
    DRAWING.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
