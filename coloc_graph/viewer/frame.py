"""One picture of a scene, as arrays: what the handles are given, computed before they are touched."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from coloc_graph.viewer import palette
from coloc_graph.viewer.motion import pose_at
from coloc_graph.viewer.palette import Colours
from coloc_graph.viewer.prepared import (
    Z_ODOMETRY,
    Z_SIGHTING,
    Float32,
    about_z,
    doubts_of,
    edges_of,
    ellipse_axes,
    links_of,
)
from coloc_graph.viewer.scene import TRUE, Array, Edges, Index, Landmarks, Layer, Links, Mask, Scene

#: So many poses are drawn at most: while time moves, and once it rests.
MOVING = 1_800
RESTING = 9_000
#: Heights [m] over the floor: ellipses, rings, wedges, trajectories.
Z_ELLIPSE = 0.004
Z_RING = 0.006
Z_WEDGE = 0.008
Z_WAY = 0.010
#: Dashes and gaps of what is refused, and of what is chained, are so long [m]; so many at most.
DASH = 0.06
MOST_DASHES = 4_000
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
    sightings: bool = False
    odometry: bool = False
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
    sightings: Lines
    odometry: Lines
    ellipses: Batch
    wedges: Batch
    rings: Batch
    edge_ids: Index
    edge_points: Float32
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
    parts = _Parts()
    if base is not None and row >= 0:
        poses = np.concatenate([pose_at(scene, base, n, np.array([state.time])) for n in range(len(scene.robots))])
        for depth, layer in enumerate(scene.layers):
            if layer in shown:
                parts.ways[layer.name] = _way(scene, layer, rows, colours, state, depth)
        # the poses that the robots stand at are doubted whether or not their way is shown
        drawn = [(base, scene.edges, 0)]
        if scene.other is not None and scene.other in shown:
            drawn.append((scene.other, scene.other_edges, len(scene.edges)))
        for layer, edges, first in drawn:
            if state.ellipses or state.wedges:
                parts.doubt(layer, rows, colours, state)
            if state.edges:
                parts.tie(layer, edges, first, row, most, state)
        if state.ellipses and len(scene.landmarks):
            parts.ellipses.append(_doubts_of_landmarks(scene.landmarks, state))
        if state.stays:
            parts.rings = _rings(scene, base, row, most, colours)
        if state.sightings:
            parts.lines["sightings"] = [_linked(base, scene.sightings, Z_SIGHTING, palette.SIGHTING, row, most, dark)]
            if len(scene.landmarks):
                parts.lines["sightings"].append(_of_landmarks(base, scene.landmarks, row, most, dark))
        if state.odometry:
            parts.lines["odometry"] = [_linked(base, scene.odometry, Z_ODOMETRY, palette.ODOMETRY, row, most, dark)]
    count = row + 1
    note = "" if len(rows) >= count else (
        f"{len(rows):,} of {count:,} stances are drawn, the last {most // 2:,} among them"
        + ("" if state.rests else "; more when time rests")
    )  # fmt: skip
    return Frame(
        row=row,
        poses=poses,
        roles=tuple(scene.roles(row, robot) for robot in scene.robots),
        ways=parts.ways,
        **{name: joined(lines) for name, lines in parts.lines.items()},
        ellipses=_batch(parts.ellipses) if state.ellipses else NO_BATCH,
        wedges=_batch(parts.wedges) if state.wedges else NO_BATCH,
        rings=parts.rings,
        edge_ids=np.concatenate([np.zeros(0, np.int64), *parts.edge_ids]),
        edge_points=np.concatenate([np.zeros((0, 2, 3), np.float32), *parts.edge_points]),
        note=note,
    )


def thinned_rows(row: int, most: int) -> Index:
    """Of the rows 0 to `row` at most so many, ascending: the last half of them each, those before evenly."""
    if row + 1 <= most:
        return np.arange(row + 1)
    recent = max(most // 2, 1)
    count = max(most - recent, 1)
    early = np.arange(count) * (row - recent) // max(count - 1, 1)
    rows = np.concatenate([early, np.arange(row - recent + 1, row + 1)])
    return np.asarray(rows[np.append(True, np.diff(rows) > 0)])


def _way(scene: Scene, layer: Layer, rows: Index, colours: Colours, state: ViewState, depth: int) -> Lines:
    xyz, there = layer.xyz[:, rows], layer.there[:, rows]
    before = np.maximum.accumulate(np.where(there, np.arange(len(rows)), -1), axis=1)[:, :-1]
    number, at = np.nonzero(there[:, 1:] & (before >= 0))
    a, b = xyz[number, before[number, at]], xyz[number, at + 1]
    moved = (a != b).any(axis=1)
    number, segments = number[moved], np.stack([a[moved], b[moved]], axis=1)
    if depth == 0 and len(rows) and state.time > (start := scene.middle(int(rows[-1]))):  # and the way it is on now
        steps = np.linspace(start, state.time, 24)
        for one in range(len(scene.robots)):
            now = pose_at(scene, layer, one, steps)[:, :3]
            if np.isfinite(now).all():
                segments = np.concatenate([segments, np.stack([now[:-1], now[1:]], axis=1)])
                number = np.append(number, np.full(len(now) - 1, one))
    if layer.name == TRUE:
        tints = np.broadcast_to(palette.ink(state.dark), colours.shape)
    else:
        tints = palette.faded(colours, state.dark, 0.25 if layer.aside else 0.45 if depth else 0.0)
    points: Array | Float32 = segments
    tint = tints[number]
    if layer.name == "chained" or (layer.aside and not state.aside):
        points, which = dashed(segments)
        tint = tint[which]
    raised = points.astype(np.float32)
    raised[..., 2] = Z_WAY + 0.001 * depth
    if layer.aside:
        raised[..., 1] += state.aside
    return Lines(raised, np.repeat(tint[:, None], 2, axis=1))


def dashed(segments: Array | Float32) -> tuple[Array | Float32, Index]:
    """Segments (n, 2, 3) cut into dashes, and of which each is one; as they are where that would be too many."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    count = np.maximum(np.ceil(length / (2 * DASH)).astype(int), 1)
    if not len(segments) or count.sum() > MOST_DASHES:
        return segments, np.arange(len(segments))
    which = np.repeat(np.arange(len(segments)), count)
    step = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    low = step / count[which]
    high = low + 0.55 / count[which]
    a, b = segments[which, 0], segments[which, 1] - segments[which, 0]
    return np.stack([a + low[:, None] * b, a + high[:, None] * b], axis=1), which


class _Parts:
    """A frame while it is put together, of one result or of two."""

    def __init__(self) -> None:
        self.ways: dict[str, Lines] = {}
        self.lines: dict[str, list[Lines]] = {
            name: [] for name in ("edges", "edges_now", "refused", "picked", "sightings", "odometry")
        }
        self.ellipses: list[Batch] = []
        self.wedges: list[Batch] = []
        self.rings = NO_BATCH
        self.edge_ids: list[Index] = []
        self.edge_points: list[Float32] = []

    def doubt(self, layer: Layer, rows: Index, colours: Colours, state: ViewState) -> None:
        """Ellipses of x, y and wedges of the heading at all places of a layer."""
        drawn = doubts_of(layer)
        number, at = np.nonzero(drawn.known[:, rows])
        at = rows[at]
        places = layer.xyz[number, at].astype(np.float32)
        places[:, 1] += state.aside if layer.aside else 0.0
        axes = np.ones((2, len(at), 3), np.float32)
        axes[0, :, :2] = np.maximum(state.k_sigma * drawn.axes[number, at], 1e-5)
        half = np.tan(np.minimum(state.k_sigma * layer.yaw_sigma[number, at], 1.2))
        axes[1, :, 0], axes[1, :, 1] = WEDGE_REACH, WEDGE_REACH * np.maximum(half, 0.01)
        colour = palette.faded(colours, state.dark, 0.5 if layer.aside else 0.0)[number]
        self.ellipses.append(Batch(drawn.of_place[number, at], _raised(places, Z_ELLIPSE), axes[0], colour))
        self.wedges.append(Batch(drawn.of_heading[number, at], _raised(places, Z_WEDGE), axes[1], colour))

    def tie(self, layer: Layer, edges: Edges, first: int, row: int, most: int, state: ViewState) -> None:
        """Edges so far, those of this stance, the refused ones dashed, and the one that is picked."""
        drawn = edges_of(layer, edges, state.dark)
        ids = thinned_rows(int(np.searchsorted(edges.rows, row, side="right")) - 1, most)
        ids = ids[drawn.there[ids]]
        ends = drawn.ends[ids]
        ends[..., 1] += state.aside if layer.aside else 0.0
        used = edges.used[ids]
        now = np.arange(len(ids)) >= np.searchsorted(edges.rows[ids], row)  # they are in the order of the stances
        self._add("edges", ends, drawn.past[ids], used & ~now, dashes=layer.aside and not state.aside)
        self._add("edges_now", ends, drawn.now[ids], used & now, dashes=layer.aside and not state.aside)
        grey = np.broadcast_to(palette.grey(state.dark), (len(ids), 3))
        self._add("refused", ends, grey, ~used, dashes=True)
        picked = ids == (-1 if state.picked is None else state.picked - first)
        self._add("picked", ends, np.broadcast_to(palette.PICKED, (len(ids), 3)), picked)
        self.edge_ids.append(ids + first)
        self.edge_points.append(ends)

    def _add(self, name: str, ends: Float32, colours: Colours, which: Mask, *, dashes: bool = False) -> None:
        if not which.any():
            return
        points: Array | Float32 = ends[which]
        tints = colours[which]
        if dashes:
            points, of = dashed(points)
            tints = tints[of]
        self.lines[name].append(Lines(np.asarray(points, np.float32), np.repeat(tints[:, None], 2, axis=1)))


def _linked(layer: Layer, links: Links, z: float, colour: Colours, row: int, most: int, dark: bool) -> Lines:
    """Links so far, thinned as all else."""
    ids = thinned_rows(int(np.searchsorted(links.rows_j, row, side="right")) - 1, most)
    ends = links_of(layer, links, z)[ids]
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return Lines(ends, np.broadcast_to(palette.seen_on(colour, dark), (len(ends), 2, 3)))


def _of_landmarks(layer: Layer, landmarks: Landmarks, row: int, most: int, dark: bool) -> Lines:
    """Who sighted which landmark so far, thinned as all else."""
    links = landmarks.sightings
    ids = thinned_rows(int(np.searchsorted(links.rows_j, row, side="right")) - 1, most)
    ends = np.zeros((len(ids), 2, 3), np.float32)
    ends[:, 0, :2] = layer.xyz[links.i[ids], links.rows_i[ids], :2]
    ends[:, 1, :2] = landmarks.xy[links.j[ids]]
    ends[..., 2] = Z_SIGHTING
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return Lines(ends, np.broadcast_to(palette.seen_on(palette.SIGHTING, dark), (len(ends), 2, 3)))


def _doubts_of_landmarks(landmarks: Landmarks, state: ViewState) -> Batch:
    """The ellipses of their places."""
    axes, direction = ellipse_axes(landmarks.covariance)
    scales = np.ones((len(landmarks), 3), np.float32)
    scales[:, :2] = np.maximum(state.k_sigma * axes, 1e-5)
    places = np.zeros((len(landmarks), 3), np.float32)
    places[:, :2], places[:, 2] = landmarks.xy, Z_ELLIPSE
    colours = np.broadcast_to(palette.LANDMARK, (len(landmarks), 3))
    return Batch(about_z(direction), places, scales, colours)


def _rings(scene: Scene, layer: Layer, row: int, most: int, colours: Colours) -> Batch:
    """A ring wherever a robot stayed put from one stance to the next, so far."""
    count = int(np.searchsorted(scene.stayed[:, 1], row, side="right"))
    number, at = scene.stayed[thinned_rows(count - 1, most)].T
    there = layer.there[number, at]
    number, at = number[there], at[there]
    wxyz = np.zeros((len(number), 4), np.float32)
    wxyz[:, 0] = 1.0
    places = layer.xyz[number, at].astype(np.float32)
    return Batch(wxyz, _raised(places, Z_RING), np.ones((len(number), 3), np.float32), colours[number])


def joined(parts: Sequence[Lines]) -> Lines:
    """Lines of several in one."""
    return parts[0] if len(parts) == 1 else Lines(*map(np.concatenate, zip(NO_LINES, *parts, strict=True)))


def _batch(parts: Sequence[Batch]) -> Batch:
    return parts[0] if len(parts) == 1 else Batch(*map(np.concatenate, zip(NO_BATCH, *parts, strict=True)))


def _raised(places: Float32, z: float) -> Float32:
    out = places.copy()
    out[:, 2] = z
    return out


def pick(
    frame: Frame, origin: Sequence[float], direction: Sequence[float], most_deg: float = 1.5, size: float = 1.0
) -> tuple[str, int] | None:
    """What a ray from the eye meets: ("robot", number) or ("edge", its number in the scene); None for nothing.

    An edge is met within so many degrees at the eye, a robot within its body, `size` times as large as it is.
    """
    o, d = np.asarray(origin, float), np.asarray(direction, float)
    d = d / np.linalg.norm(d)
    centres = frame.poses[:, :3] + (0.0, 0.0, 0.2 * size)
    along = (centres - o) @ d
    off = np.linalg.norm(centres - o - along[:, None] * d, axis=1)
    hit = np.flatnonzero((along > 0) & (off < ROBOT_REACH * size))  # NaN, of who is nowhere, is not
    if len(hit):
        return "robot", int(hit[np.argmin(along[hit])])
    nearest = nearest_segment(frame.edge_points, o, d, most_deg)
    return None if nearest is None else ("edge", int(frame.edge_ids[nearest]))


def nearest_segment(segments: Array | Float32, origin: Array, direction: Array, most_deg: float) -> int | None:
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
