"""One frame of a scene as arrays, computed before any handle is touched."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from coloc_graph.viewer import palette
from coloc_graph.viewer.motion import pose_at
from coloc_graph.viewer.palette import Colours
from coloc_graph.viewer.plans import planned_lines
from coloc_graph.viewer.prepared import (
    Z_ODOMETRY,
    Z_SIGHTING,
    Float32,
    about_z,
    covariance_shapes,
    edges_of,
    ellipse_axes,
    links_of,
)
from coloc_graph.viewer.scene import TRUE, Array, Edges, Index, Landmarks, Layer, Links, Mask, Scene

MAX_POSES_MOVING = 1_800  # poses drawn while time moves
MAX_POSES_AT_REST = 9_000  # poses drawn at rest
Z_ELLIPSE = 0.004  # m over the floor
Z_RING = 0.006  # m over the floor
Z_WEDGE = 0.008  # m over the floor
Z_TRAJECTORY = 0.010  # m over the floor
DASH = 0.06  # m, length of a dash and of a gap
MAX_DASHES = 4_000  # dashes of one set of lines; of more they are drawn through
WEDGE_REACH = 0.3  # m, length of a heading wedge
ROBOT_REACH = 0.2  # m, radius in which a click meets a robot


@dataclass(frozen=True)
class ViewState:
    """State of the controls: `aside` [m] offsets another result to the side; `rests` is false while time moves."""

    time: float = 0.0
    shown: frozenset[str] = frozenset()
    ellipses: bool = True
    wedges: bool = True
    edges: bool = True
    stays: bool = True
    sightings: bool = False
    odometry: bool = False
    plans: bool = True
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
    """All that is drawn at one time.

    `row` is that of the stance; `poses` (r, 4) are x, y, z [m], heading [rad] of the robots, NaN if there is none, and
    `roles` their roles. `edge_ids` (m,) number the edges drawn at `edge_points` (m, 2, 3) [m]; `note` is a sentence on
    stances that are not drawn. The other fields are named like the controls that show them.
    """

    row: int
    poses: Array
    roles: tuple[str, ...]
    trajectories: dict[str, Lines]
    edges: Lines
    edges_now: Lines
    rejected: Lines
    picked: Lines
    sightings: Lines
    odometry: Lines
    planned: Lines
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
    """Compute the frame of a scene for a state of the controls."""
    row, dark = scene.row_at(state.time), state.dark
    colours = palette.robot_colours(len(scene.robots), dark)
    shown = [layer for layer in scene.layers if layer.name in state.shown]
    most = (MAX_POSES_AT_REST if state.rests else MAX_POSES_MOVING) // max(len(scene.robots) * (len(shown) + 1), 1)
    rows = thinned_rows(row, most)
    base = scene.layers[0] if scene.layers else None
    poses = np.full((len(scene.robots), 4), np.nan)
    parts = _Parts()
    if base is not None and row >= 0:
        poses = np.concatenate([pose_at(scene, base, n, np.array([state.time])) for n in range(len(scene.robots))])
        for depth, layer in enumerate(scene.layers):
            if layer in shown:
                parts.trajectories[layer.name] = _trajectory(scene, layer, rows, colours, state, depth)
        # the covariances of the poses are drawn even if their trajectory is not
        drawn = [(base, scene.edges, 0)]
        if scene.other is not None and scene.other in shown:
            drawn.append((scene.other, scene.other_edges, len(scene.edges)))
        for layer, edges, first in drawn:
            if state.ellipses or state.wedges:
                parts.add_covariances(layer, rows, colours, state)
            if state.edges:
                parts.add_edges(layer, edges, first, row, most, state)
        if state.ellipses and len(scene.landmarks):
            parts.ellipses.append(_landmark_ellipses(scene.landmarks, state))
        if state.stays:
            parts.rings = _rings(scene, base, row, most, colours)
        if state.sightings:
            parts.lines["sightings"] = [_linked(base, scene.sightings, Z_SIGHTING, palette.SIGHTING, row, most, dark)]
            if len(scene.landmarks):
                parts.lines["sightings"].append(_landmark_sightings(base, scene.landmarks, row, most, dark))
        if state.odometry:
            parts.lines["odometry"] = [_linked(base, scene.odometry, Z_ODOMETRY, palette.ODOMETRY, row, most, dark)]
    if state.plans and scene.plans:
        parts.lines["planned"] = [Lines(*planned_lines(scene, row, colours, state.k_sigma, dark))]
    count = row + 1
    note = "" if len(rows) >= count else (
        f"{len(rows):,} of {count:,} stances are drawn, the last {most // 2:,} among them"
        + ("" if state.rests else "; more when time rests")
    )  # fmt: skip
    return Frame(
        row=row,
        poses=poses,
        roles=tuple(scene.roles(row, robot) for robot in scene.robots),
        trajectories=parts.trajectories,
        **{name: joined(lines) for name, lines in parts.lines.items()},
        ellipses=_batch(parts.ellipses) if state.ellipses else NO_BATCH,
        wedges=_batch(parts.wedges) if state.wedges else NO_BATCH,
        rings=parts.rings,
        edge_ids=np.concatenate([np.zeros(0, np.int64), *parts.edge_ids]),
        edge_points=np.concatenate([np.zeros((0, 2, 3), np.float32), *parts.edge_points]),
        note=note,
    )


def thinned_rows(row: int, most: int) -> Index:
    """At most `most` of the rows 0 to `row`, ascending: the last half complete, those before it evenly spaced."""
    if row + 1 <= most:
        return np.arange(row + 1)
    recent = max(most // 2, 1)
    count = max(most - recent, 1)
    early = np.arange(count) * (row - recent) // max(count - 1, 1)
    rows = np.concatenate([early, np.arange(row - recent + 1, row + 1)])
    return np.asarray(rows[np.append(True, np.diff(rows) > 0)])


def _trajectory(scene: Scene, layer: Layer, rows: Index, colours: Colours, state: ViewState, depth: int) -> Lines:
    xyz, there = layer.xyz[:, rows], layer.there[:, rows]
    before = np.maximum.accumulate(np.where(there, np.arange(len(rows)), -1), axis=1)[:, :-1]
    number, at = np.nonzero(there[:, 1:] & (before >= 0))
    a, b = xyz[number, before[number, at]], xyz[number, at + 1]
    moved = (a != b).any(axis=1)
    number, segments = number[moved], np.stack([a[moved], b[moved]], axis=1)
    if depth == 0 and len(rows) and state.time > (start := scene.middle(int(rows[-1]))):  # and the part up to now
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
    raised[..., 2] = Z_TRAJECTORY + 0.001 * depth
    if layer.aside:
        raised[..., 1] += state.aside
    return Lines(raised, np.repeat(tint[:, None], 2, axis=1))


def dashed(segments: Array | Float32) -> tuple[Array | Float32, Index]:
    """Cut segments (n, 2, 3) into dashes, and number the segment of each; too many are left whole."""
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    count = np.maximum(np.ceil(length / (2 * DASH)).astype(int), 1)
    if not len(segments) or count.sum() > MAX_DASHES:
        return segments, np.arange(len(segments))
    which = np.repeat(np.arange(len(segments)), count)
    step = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    low = step / count[which]
    high = low + 0.55 / count[which]
    a, b = segments[which, 0], segments[which, 1] - segments[which, 0]
    return np.stack([a + low[:, None] * b, a + high[:, None] * b], axis=1), which


class _Parts:
    """Parts of a frame, of one result or of two."""

    def __init__(self) -> None:
        self.trajectories: dict[str, Lines] = {}
        self.lines: dict[str, list[Lines]] = {
            name: [] for name in ("edges", "edges_now", "rejected", "picked", "sightings", "odometry", "planned")
        }
        self.ellipses: list[Batch] = []
        self.wedges: list[Batch] = []
        self.rings = NO_BATCH
        self.edge_ids: list[Index] = []
        self.edge_points: list[Float32] = []

    def add_covariances(self, layer: Layer, rows: Index, colours: Colours, state: ViewState) -> None:
        """Add ellipses of x, y and wedges of the heading at all poses of a layer."""
        drawn = covariance_shapes(layer)
        number, at = np.nonzero(drawn.known[:, rows])
        at = rows[at]
        positions = layer.xyz[number, at].astype(np.float32)
        positions[:, 1] += state.aside if layer.aside else 0.0
        axes = np.ones((2, len(at), 3), np.float32)
        axes[0, :, :2] = np.maximum(state.k_sigma * drawn.axes[number, at], 1e-5)
        half = np.tan(np.minimum(state.k_sigma * layer.yaw_sigma[number, at], 1.2))
        axes[1, :, 0], axes[1, :, 1] = WEDGE_REACH, WEDGE_REACH * np.maximum(half, 0.01)
        colour = palette.faded(colours, state.dark, 0.5 if layer.aside else 0.0)[number]
        self.ellipses.append(Batch(drawn.position_wxyz[number, at], _raised(positions, Z_ELLIPSE), axes[0], colour))
        self.wedges.append(Batch(drawn.heading_wxyz[number, at], _raised(positions, Z_WEDGE), axes[1], colour))

    def add_edges(self, layer: Layer, edges: Edges, first: int, row: int, most: int, state: ViewState) -> None:
        """Add edges up to a row: those of its stance, earlier ones, rejected ones as dashes, and the picked one."""
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
        self._add("rejected", ends, grey, ~used, dashes=True)
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
    """Links up to a row, thinned like the poses."""
    ids = thinned_rows(int(np.searchsorted(links.rows_j, row, side="right")) - 1, most)
    ends = links_of(layer, links, z)[ids]
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return Lines(ends, np.broadcast_to(palette.seen_on(colour, dark), (len(ends), 2, 3)))


def _landmark_sightings(layer: Layer, landmarks: Landmarks, row: int, most: int, dark: bool) -> Lines:
    """Sightings of landmarks up to a row, thinned like the poses."""
    links = landmarks.sightings
    ids = thinned_rows(int(np.searchsorted(links.rows_j, row, side="right")) - 1, most)
    ends = np.zeros((len(ids), 2, 3), np.float32)
    ends[:, 0, :2] = layer.xyz[links.i[ids], links.rows_i[ids], :2]
    ends[:, 1, :2] = landmarks.xy[links.j[ids]]
    ends[..., 2] = Z_SIGHTING
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    return Lines(ends, np.broadcast_to(palette.seen_on(palette.SIGHTING, dark), (len(ends), 2, 3)))


def _landmark_ellipses(landmarks: Landmarks, state: ViewState) -> Batch:
    """Ellipses of the landmarks' positions."""
    axes, direction = ellipse_axes(landmarks.covariance)
    scales = np.ones((len(landmarks), 3), np.float32)
    scales[:, :2] = np.maximum(state.k_sigma * axes, 1e-5)
    positions = np.zeros((len(landmarks), 3), np.float32)
    positions[:, :2], positions[:, 2] = landmarks.xy, Z_ELLIPSE
    colours = np.broadcast_to(palette.LANDMARK, (len(landmarks), 3))
    return Batch(about_z(direction), positions, scales, colours)


def _rings(scene: Scene, layer: Layer, row: int, most: int, colours: Colours) -> Batch:
    """Rings at the poses that a robot kept from one stance to the next, up to a row."""
    count = int(np.searchsorted(scene.stayed[:, 1], row, side="right"))
    number, at = scene.stayed[thinned_rows(count - 1, most)].T
    there = layer.there[number, at]
    number, at = number[there], at[there]
    wxyz = np.zeros((len(number), 4), np.float32)
    wxyz[:, 0] = 1.0
    positions = layer.xyz[number, at].astype(np.float32)
    return Batch(wxyz, _raised(positions, Z_RING), np.ones((len(number), 3), np.float32), colours[number])


def joined(parts: Sequence[Lines]) -> Lines:
    """Concatenate lines."""
    return parts[0] if len(parts) == 1 else Lines(*map(np.concatenate, zip(NO_LINES, *parts, strict=True)))


def _batch(parts: Sequence[Batch]) -> Batch:
    return parts[0] if len(parts) == 1 else Batch(*map(np.concatenate, zip(NO_BATCH, *parts, strict=True)))


def _raised(positions: Float32, z: float) -> Float32:
    out = positions.copy()
    out[:, 2] = z
    return out


def pick(
    frame: Frame, origin: Sequence[float], direction: Sequence[float], most_deg: float = 1.5, size: float = 1.0
) -> tuple[str, int] | None:
    """Find the robot or edge that a ray from the camera meets: ("robot", number), ("edge", its number) or None.

    An edge is met within `most_deg` at the camera, a robot within its body, drawn `size` times as large as it is.
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
    """Number of the segment (n, 2, 3) nearest to a ray with unit direction, by the angle at its origin, or None."""
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
