"""Draw pose graphs as Graphviz dot: one box for each pose variable, with visible stay-put constraints."""

from collections import defaultdict

from coloc_graph.backend import PoseGraph, StayPut
from coloc_graph.backend.landmarks import OnMap
from coloc_graph.measurements import Node, Odometry, Range, RelativePose

#: Colours that colour-blind readers tell apart (Okabe and Ito).
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def to_dot(graph: PoseGraph) -> str:
    """Format a graph in the dot language; draw it with `dot -Tsvg`, or `neato` for large graphs.

    A box is one variable, labelled with all stances that share it; a double border marks a robot that stayed put
    exactly. Dashed edges are stay-put constraints with a slip, dotted ones odometry, thin ones sightings, dashed
    grey ones ranges. Landmarks are hexagons, and so is the map, with dashed edges to the landmarks on it.
    """
    places: dict[int, list[Node]] = defaultdict(list)
    for node in graph.nodes:
        places[graph.pose_keys.key(node)].append(node)
    linked = [[graph.pose_keys.key(node) for node in link.ends] for link in graph.links]
    ends = {key for keys in linked for key in keys}
    still = {key: name for name, key in graph.pose_keys.static().items() if key in ends}
    ids = {key: f"n{number}" for number, key in enumerate([*places, *still])}
    lines = ["graph poses {", "  node [shape=box, style=rounded, fontname=Helvetica];", "  edge [fontname=Helvetica];"]
    for key, nodes in places.items():
        label = " = ".join(f"{robot}@{stance}" for robot, stance in nodes)
        colour = _COLOURS[graph.robots.index(nodes[0][0]) % len(_COLOURS)]
        borders = 2 if len(nodes) > 1 else 1
        world = ", penwidth=3" if key == graph.reference_key else ""
        lines.append(f'  {ids[key]} [label="{label}", color="{colour}", peripheries={borders}{world}];')
    for key, name in still.items():
        lines.append(f'  {ids[key]} [label="{name.removeprefix("/")}", shape=hexagon, style=solid, color="#555555"];')
    for link, keys in zip(graph.links, linked, strict=True):
        i, j = (ids[key] for key in keys)
        if isinstance(link, RelativePose):
            style = f'label="H {link.stance}"'
        elif isinstance(link, StayPut):
            style = 'label="stay put", style=dashed'
        elif isinstance(link, OnMap):
            style = "style=dashed"
        elif isinstance(link, Range):
            style = 'style=dashed, color="#999999"'
        else:
            style = "style=dotted" if isinstance(link, Odometry) else "penwidth=0.5"
        lines.append(f"  {i} -- {j} [{style}];")
    return "\n".join([*lines, "}"]) + "\n"
