"""One picture of a scene, as arrays: what the handles are given, computed before they are touched."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.viewer import palette
from coloc_graph.viewer.motion import pose_at
from coloc_graph.viewer.palette import Colours
from coloc_graph.viewer.scene import Array, Index, Layer, Scene

Float32 = NDArray[np.float32]

#: So many poses are drawn at most: while time moves, and once it rests.
MOVING, RESTING = 2_400, 20_000
#: Heights [m] over the floor: ellipses, rings, wedges, trajectories, edges.
Z_ELLIPSE, Z_RING, Z_WEDGE, Z_WAY, Z_EDGE = 0.004, 0.006, 0.008, 0.010, 0.13
#: Dashes and gaps of what is refused, and of what is chained, are so long [m]; so many at most.
DASH, MOST_DASHES = 0.06, 4_000
WEDGE_REACH = 0.3
ROBOT_REACH = 0.2


@dataclass(frozen=True)
class ViewState:
    """What the GUI asks for. `aside` [m] is how far another result is moved to the side, `rests` whether time does."""

    time: float = 0.0
    shown: frozenset[str] = frozenset()
    ellipses: bool = True
    wedges: bool = True
    edges: bool = True
    stays: bool = True
    k_sigma: float = 3.0
    picked: int | None = None
    aside: float = 0.0
    dark: bool = False
    rests: bool = True


class Lines(NamedTuple):
    """Segments (n, 2, 3) [m] with colours (n, 2, 3), sRGB."""

    points: Float32
    colours: Colours


class Batch(NamedTuple):
    """Copies of a mesh: wxyz (n, 4), positions (n, 3), scales (n, 3), colours (n, 3), sRGB."""

    wxyz: Float32
    positions: Float32
    scales: Float32
    colours: Colours


@dataclass(frozen=True, eq=False)
class Frame:
    """Everything at one moment. `poses` (r, 4) are x, y, z, heading of the robots, NaN where a robot is nowhere.

    `edge_ids` (m,) number the edges that are drawn, `edge_points` (m, 2, 3) are where; `note` says what was left out.
    """

    row: int
    poses: Array
    roles: tuple[str, ...]
    ways: dict[str, Lines]
    edges: Lines
    edges_now: Lines
    refused: Lines
    picked: Lines
    ellipses: Batch
    wedges: Batch
    rings: Batch
    edge_ids: Index
    edge_points: Array
    note: str = field(default="")


NO_LINES = Lines(np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8))
NO_BATCH = Batch(
    np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
)


def frame_of(scene: Scene, state: ViewState) -> Frame:
    """The picture of a scene in a state."""
    row, dark = scene.row_at(state.time), state.dark
    colours = palette.robot_colours(len(scene.robots), dark)
    shown = [layer for layer in scene.layers if layer.name in state.shown]
    most = (RESTING if state.rests else MOVING) // max(len(scene.robots) * (len(shown) + 1), 1)
    rows = thinned_rows(row, most)
    base = scene.layers[0] if scene.layers else None
    poses = np.full((len(scene.robots), 4), np.nan)
    ways, ellipses, wedges, rings, edge_parts = {}, NO_BATCH, NO_BATCH, NO_BATCH, _no_edges()
    if base is not None and row >= 0:
        poses = np.concatenate([pose_at(scene, base, n, np.array([state.time])) for n in range(len(scene.robots))])
        for depth, layer in enumerate(scene.layers):
            if layer in shown:
                ways[layer.name] = _way(scene, layer, rows, colours, state, depth)
        if state.ellipses or state.wedges:
            ellipses, wedges = _doubts(base, rows, colours, state)
        if state.stays:
            rings = _rings(scene, base, row, most, colours, dark)
        if state.edges:
            edge_parts = _edges(scene, base, row, most, state)
    count = row + 1
    note = "" if len(rows) >= count else (
        f"{len(rows):,} of {count:,} stances are drawn, the last {most // 2:,} among them"
        + ("" if state.rests else "; more when time rests")
    )  # fmt: skip
    return Frame(
        row, poses, tuple(scene.roles(row, robot) for robot in scene.robots), ways, *edge_parts[:4],
        ellipses if state.ellipses else NO_BATCH, wedges if state.wedges else NO_BATCH, rings, *edge_parts[4:], note,
    )  # fmt: skip


def thinned_rows(row: int, most: int) -> Index:
    """Of the rows 0 to `row` at most so many, ascending: the last half of them each, those before evenly."""
    if row + 1 <= most:
        return np.arange(row + 1)
    recent = max(most // 2, 1)
    early = np.linspace(0, row - recent, max(most - recent, 1)).round().astype(np.int64)
    rows = np.concatenate([early, np.arange(row - recent + 1, row + 1)])
    return np.asarray(rows[np.append(True, np.diff(rows) > 0)])


def _way(scene: Scene, layer: Layer, rows: Index, colours: Colours, state: ViewState, depth: int) -> Lines:
    parts: list[Lines] = []
    is_base = depth == 0
    for number in range(len(scene.robots)):
        points = layer.xyz[number, rows]
        points = points[np.isfinite(points[:, 0])]
        if is_base and len(points):  # and the way it is on now
            start = scene.middle(int(rows[-1]))
            if state.time > start:
                steps = np.linspace(start, state.time, 24)
                points = np.concatenate([points, pose_at(scene, layer, number, steps)[:, :3]])
        if len(points) < 2:
            continue
        segments = np.stack([points[:-1], points[1:]], axis=1)
        segments = segments[np.abs(segments[:, 1] - segments[:, 0]).max(axis=1) > 1e-6]
        colour = colours[number]
        if layer.name == "true":
            colour = palette.ink(state.dark)
        elif layer.aside:
            colour = palette.faded(colour, state.dark, 0.25)
        elif not is_base:
            colour = palette.faded(colour, state.dark, 0.45)
        if layer.name == "chained" or (layer.aside and not state.aside):
            segments = dashed(segments)
        parts.append(Lines(_f32(segments), np.broadcast_to(colour, (len(segments), 2, 3))))
    if not parts:
        return NO_LINES
    points = np.concatenate([one.points for one in parts]).astype(np.float32)
    points[..., 2] = Z_WAY + 0.001 * depth
    if layer.aside:
        points[..., 1] += state.aside
    return Lines(points, np.concatenate([one.colours for one in parts]))


def dashed(segments: Array) -> Array:
    """Segments (n, 2, 3) cut into dashes, as they are where that would be too many."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    count = np.maximum(np.ceil(length / (2 * DASH)).astype(int), 1)
    if not len(segments) or count.sum() > MOST_DASHES:
        return segments
    which = np.repeat(np.arange(len(segments)), count)
    step = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    low = step / count[which]
    high = low + 0.55 / count[which]
    a, b = segments[which, 0], segments[which, 1] - segments[which, 0]
    return np.stack([a + low[:, None] * b, a + high[:, None] * b], axis=1)


def _doubts(layer: Layer, rows: Index, colours: Colours, state: ViewState) -> tuple[Batch, Batch]:
    """Ellipses of x, y and wedges of the heading at all places."""
    number, at = np.nonzero(layer.arrived[:, rows])
    at = rows[at]
    covariance, sigma = layer.covariance[number, at], layer.yaw_sigma[number, at]
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(sigma)
    number, at, covariance, sigma = number[known], at[known], covariance[known], sigma[known]
    if not len(number):
        return NO_BATCH, NO_BATCH
    places, angle = layer.xyz[number, at], layer.yaw[number, at]
    axes, direction = ellipse_axes(covariance)
    axes = np.maximum(state.k_sigma * axes, 1e-5)
    flat = np.ones((len(axes), 1))
    half = np.tan(np.minimum(state.k_sigma * sigma, 1.2))[:, None]
    colour = colours[number]
    ellipses = Batch(about_z(direction), _raised(places, Z_ELLIPSE), _f32(np.concatenate([axes, flat], 1)), colour)
    scale = np.concatenate([WEDGE_REACH * flat, WEDGE_REACH * np.maximum(half, 0.01), flat], axis=1)
    return ellipses, Batch(about_z(angle), _raised(places, Z_WEDGE), _f32(scale), colour)


def ellipse_axes(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (n, 2) [m], the longer first, and the longer one's direction (n,) [rad] of covariances (n, 2, 2)."""
    a, b, c = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    middle, spread = (a + b) / 2, np.hypot((a - b) / 2, c)
    axes = np.sqrt(np.stack([middle + spread, middle - spread], axis=1).clip(min=0))
    return axes, np.arctan2(c, (a - b) / 2) / 2


def _rings(scene: Scene, layer: Layer, row: int, most: int, colours: Colours, dark: bool) -> Batch:
    """A ring wherever a robot stayed put from one stance to the next, so far."""
    stayed = scene.stayed[: np.searchsorted(scene.stayed[:, 1], row, side="right")]
    stayed = stayed[thinned_rows(len(stayed) - 1, most)] if len(stayed) else stayed
    number, at = stayed.T
    there = layer.there[number, at]
    number, at = number[there], at[there]
    if not len(number):
        return NO_BATCH
    wxyz = about_z(np.zeros(len(number)))
    return Batch(wxyz, _raised(layer.xyz[number, at], Z_RING), np.ones((len(number), 3), np.float32), colours[number])


def _no_edges() -> tuple[Lines, Lines, Lines, Lines, Index, Array]:
    return NO_LINES, NO_LINES, NO_LINES, NO_LINES, np.zeros(0, np.int64), np.zeros((0, 2, 3))


def _edges(
    scene: Scene, layer: Layer, row: int, most: int, state: ViewState
) -> tuple[Lines, Lines, Lines, Lines, Index, Array]:
    """Edges so far, those of this stance, the refused ones dashed, and the one that is picked."""
    edges = scene.edges
    count = int(np.searchsorted(edges.rows, row, side="right"))
    if not count:
        return _no_edges()
    ids = thinned_rows(count - 1, most)
    ends = np.stack([layer.xyz[edges.i[ids], edges.rows[ids]], layer.xyz[edges.j[ids], edges.rows[ids]]], axis=1)
    there = np.isfinite(ends).all(axis=(1, 2))
    ids, ends = ids[there], ends[there]
    ends[..., 2] = Z_EDGE
    used, now = edges.used[ids], edges.rows[ids] == row
    colours = palette.of_residuals(edges.sigmas[ids], state.dark)
    past = palette.faded(colours, state.dark, 0.25)
    refused = dashed(ends[~used])
    picked = ids == (-1 if state.picked is None else state.picked)
    return (
        _lines(ends[used & ~now], past[used & ~now]),
        _lines(ends[used & now], colours[used & now]),
        _lines(refused, np.broadcast_to(palette.grey(state.dark), (len(refused), 3))),
        _lines(ends[picked], np.broadcast_to(palette.PICKED, (int(picked.sum()), 3))),
        ids,
        ends,
    )


def _lines(points: Array, colours: Colours) -> Lines:
    return Lines(points.astype(np.float32), np.repeat(colours[:, None], 2, axis=1))


def _raised(places: Array, z: float) -> Float32:
    out = places.astype(np.float32)
    out[:, 2] = z
    return out


def _f32(values: Array) -> Float32:
    return np.asarray(values, np.float32)


def about_z(angle: Array) -> Float32:
    """Quaternions (n, 4), w first, of turns (n,) [rad] about z."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1).astype(np.float32)


def pick(
    frame: Frame, origin: Sequence[float], direction: Sequence[float], most_deg: float = 1.5
) -> tuple[str, int] | None:
    """What a ray from the eye meets: ("robot", number) or ("edge", its number in the scene); None for nothing.

    An edge is met within so many degrees at the eye, a robot within its body.
    """
    o, d = np.asarray(origin, float), np.asarray(direction, float)
    d = d / np.linalg.norm(d)
    centres = frame.poses[:, :3] + (0.0, 0.0, 0.2)
    along = (centres - o) @ d
    off = np.linalg.norm(centres - o - along[:, None] * d, axis=1)
    hit = np.flatnonzero((along > 0) & (off < ROBOT_REACH))  # NaN, of who is nowhere, is not
    if len(hit):
        return "robot", int(hit[np.argmin(along[hit])])
    nearest = nearest_segment(frame.edge_points, o, d, most_deg)
    return None if nearest is None else ("edge", int(frame.edge_ids[nearest]))


def nearest_segment(segments: Array, origin: Array, direction: Array, most_deg: float) -> int | None:
    """The segment (of n, 2, 3) that a ray with unit direction passes closest to, by the angle at its origin."""
    if not len(segments):
        return None
    a = segments[:, 0] - origin
    u = segments[:, 1] - segments[:, 0]
    b, c, e, f = u @ direction, (u * u).sum(axis=1), a @ direction, (u * a).sum(axis=1)
    s = np.clip((b * e - f) / np.maximum(c - b * b, 1e-12), 0, 1)
    p = a + s[:, None] * u
    along = np.maximum(p @ direction, 1e-6)
    angle = np.arctan2(np.linalg.norm(p - along[:, None] * direction, axis=1), along)
    best = int(np.argmin(angle))
    return best if angle[best] < np.deg2rad(most_deg) else None
