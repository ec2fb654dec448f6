"""Track one robot's two markers in a batch, however far they move from image to image.

Two equal lights of one rigid body are found in each image by their known span on the marker plane, without a motion
model. Their order then follows from the heading of the line through both: one image gives it modulo half a turn, and
neighbouring images resolve the rest if the robot turns by clearly less than a quarter between them; otherwise the path
is cut in two. `pairing.rigid_alignment` joins the pieces by what another camera saw at the same instants.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.frontend.tracks.tracking import UNRELIABLE
from coloc_graph.geometry.lie import across
from coloc_graph.measurements import Plane
from coloc_graph.run import Detections, Flag
from coloc_graph.team import Camera

Array = NDArray[np.float64]

SPAN_TOLERANCE = 0.35  # share of the span; a tilt that is wrong by 1 deg makes 0.15 at 2 m
CLEARLY_MORE = 1.05  # ratio of the likelihoods of two planes above which the second is preferred
SPAN_SCALE = 0.1  # share of the span, standard deviation by which rival pairs of lights are compared
MAX_LIGHTS = 12  # lights of an image that are considered, brightest first
CELL = 2.0  # px, side of the cells in which lights at rest are counted
STATIC_SHARE = 0.5  # minimum share of the images in which a light at rest is seen in one cell
MAX_GAP = 4.0  # median image intervals over which a heading is extrapolated
MIN_HEADING_SIGMA = 0.05  # rad, lower bound of the heading's prediction error
LINK_LOG_RATIO = 12.0  # minimum log likelihood ratio of a heading against its opposite
MAX_JUMP = 8.0  # median steps of the body between two images beyond which the path is cut


@dataclass(frozen=True, eq=False)
class RigidPath:
    """Two lights of one body in one camera, image by image.

    Attributes
    ----------
    robot
        Robot that carries the camera.
    times
        Times of the samples, (n,) [s].
    uv, covariance, peak
        Both lights, (n, 2, 2) [px], their covariances, (n, 2, 2, 2) [px^2], and brightness, (n, 2) [grey levels].
    saturated
        True for lights whose core is at the sensor's limit, (n, 2).
    places
        Both lights on the marker plane, (n, 2, 2) [m].
    piece
        Number of the piece of each sample, (n,), within which the order of the two lights is consistent.
    lights
        Number of moving lights in each image, seen together or not, (images,).
    """

    robot: str
    times: Array
    uv: Array
    covariance: Array
    peak: Array
    saturated: NDArray[np.bool_]
    places: Array
    piece: NDArray[np.int64]
    lights: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)

    @property
    def step(self) -> float:
        """Median distance that a light moves from one image to the next [px]."""
        if len(self) < 2:
            return float("nan")
        straight = np.linalg.norm(self.uv[1:] - self.uv[:-1], axis=2).mean(axis=1)
        crossed = np.linalg.norm(self.uv[1:] - self.uv[:-1, ::-1], axis=2).mean(axis=1)
        return float(np.median(np.minimum(straight, crossed)))

    @property
    def apart(self) -> float:
        """Median distance between the two lights in the image [px]."""
        return float(np.median(np.linalg.norm(self.uv[:, 0] - self.uv[:, 1], axis=1))) if len(self) else float("nan")

    @property
    def pieces(self) -> int:
        """Number of pieces, 0 of an empty path."""
        return int(self.piece[-1]) + 1 if len(self) else 0

    def swapped(self, which: NDArray[np.bool_], piece: NDArray[np.int64]) -> "RigidPath":
        """Return the path with its lights exchanged at samples of a mask (n,), and other pieces (n,)."""
        order = np.where(which[:, None], [1, 0], [0, 1])
        rows = np.arange(len(self))[:, None]
        return replace(
            self,
            uv=self.uv[rows, order],
            covariance=self.covariance[rows, order],
            peak=self.peak[rows, order],
            saturated=self.saturated[rows, order],
            places=self.places[rows, order],
            piece=piece,
        )

    def without(self, samples: NDArray[np.int64]) -> "RigidPath":
        """Return the path without samples of given indices (k,)."""
        keep = np.ones(len(self), bool)
        keep[samples] = False
        return replace(
            self,
            times=self.times[keep],
            uv=self.uv[keep],
            covariance=self.covariance[keep],
            peak=self.peak[keep],
            saturated=self.saturated[keep],
            places=self.places[keep],
            piece=self.piece[keep],
        )

    def tracks(self, mover: str) -> list[Track]:
        """Two tracks for each piece, all of one body."""
        made = []
        for piece in np.unique(self.piece).tolist():
            own = self.piece == piece
            for light in range(2):
                columns = self.uv, self.covariance, self.peak
                uv, covariance, peak = (one[own, light] for one in columns)
                track = Track(self.robot, "", self.times[own], uv, covariance, peak, body=0, mover=mover)
                made.append(replace(track, saturated=self.saturated[own, light]))
        return made


def rigid_path(
    robot: str, seen: Sequence[Detections], camera: Camera, planes: Sequence[Plane], span: float
) -> RigidPath:
    """Find the path of a body with two lights in all images of one camera.

    Parameters
    ----------
    robot
        Name of the robot whose camera it is.
    seen
        Detections of whole images, in order of time.
    camera, planes
        The camera, and possible marker planes in its frame, the most probable first.
    span
        Distance between the two markers [m].

    Returns
    -------
    RigidPath
        The path, empty if no image shows two lights at that distance.
    """
    images = [_moving(one, still) for still in [_static_cells(seen)] for one in seen]
    lights = np.array([len(one.uv) for one in images], np.int64)
    rows = _rows(images, camera, planes, span)
    chosen = _likeliest(rows, span)
    own = [(images[row[0]], row[1][n], row[2][n]) for row, n in zip(rows, chosen, strict=True)]
    path = RigidPath(
        robot,
        np.array([one.time for one, _, _ in own]),
        np.array([one.uv[pair] for one, pair, _ in own]).reshape(-1, 2, 2),
        np.array([one.covariance[pair] for one, pair, _ in own]).reshape(-1, 2, 2, 2),
        np.array([one.peak[pair] for one, pair, _ in own]).reshape(-1, 2),
        np.array([(one.flags[pair] & Flag.SATURATED) != 0 for one, pair, _ in own]).reshape(-1, 2),
        np.array([places for _, _, places in own]).reshape(-1, 2, 2),
        np.zeros(len(own), np.int64),
        lights,
    )
    return path.swapped(*_ordered(path)) if len(path) else path


#: Image, pairs of lights (m, 2), their places (m, 2, 2) [m], costs (m,).
_Row = tuple[int, NDArray[np.int64], Array, Array]


def _rows(images: Sequence[Detections], camera: Camera, planes: Sequence[Plane], span: float) -> list[_Row]:
    """Pairs of lights that are a span apart on the plane that explains most images, image by image."""
    counts = [len(one.uv) for one in images]
    of_count = {count: np.triu_indices(count, 1) for count in set(counts)}
    sizes = [len(of_count[count][0]) for count in counts]
    shown = np.flatnonzero(sizes)  # images with two lights or more
    if not len(shown):
        return []
    first = np.cumsum([0, *counts])
    a, b = (np.concatenate([first[n] + of_count[counts[n]][side] for n in shown]) for side in range(2))
    starts = np.cumsum([0, *(sizes[n] for n in shown)])
    rays = camera.rays(np.concatenate([one.uv for one in images]))
    each = [_on_plane_a_span_apart(rays, plane, a, b, span) for plane in planes]
    fits = [float(np.maximum.reduceat(np.exp(-costs), starts[:-1]).sum()) for _, costs in each]
    best = int(np.argmax(fits))
    places, costs = each[best] if fits[best] > CLEARLY_MORE * fits[0] else each[0]
    rows: list[_Row] = []
    for number, start, end in zip(shown.tolist(), starts[:-1], starts[1:], strict=True):
        good = start + np.flatnonzero(np.isfinite(costs[start:end]))
        if len(good):
            pairs = np.stack([a[good], b[good]], axis=1)
            rows.append((number, pairs - first[number], places[pairs], costs[good]))
    return rows


def _on_plane_a_span_apart(
    rays: Array, plane: Plane, a: NDArray[np.int64], b: NDArray[np.int64], span: float
) -> tuple[Array, Array]:
    """Metric coordinates (n, 2) of rays on a plane, and costs (m,) of pairs of them, infinite if no span apart."""
    axes = across(plane.N)
    if np.cross(*axes) @ plane.N < 0:
        axes = axes[::-1]  # the same way round in every camera
    places = on_plane(rays, plane) @ axes.T
    off = np.linalg.norm(places[a] - places[b], axis=1) / span - 1
    near = np.abs(off) < SPAN_TOLERANCE  # not of NaN, above the horizon
    return places, np.where(near, 0.5 * np.square(off / SPAN_SCALE), np.inf)


def _static_cells(seen: Sequence[Detections]) -> NDArray[np.int64]:
    """Cells (m, 2) of the image in which a light at rest is seen."""
    every = [np.unique(np.floor(one.uv / CELL).astype(np.int64), axis=0) for one in seen if len(one.uv)]
    if not every:
        return np.zeros((0, 2), np.int64)
    cells, counts = np.unique(np.concatenate(every), axis=0, return_counts=True)
    return cells[counts > max(STATIC_SHARE * len(seen), 3)]


def _moving(seen: Detections, static: NDArray[np.int64]) -> Detections:
    """Select detections that may be of the body: reliable, not of lights at rest, the brightest."""
    keep = (seen.flags & UNRELIABLE) == 0
    if len(static) and len(seen.uv):
        cells = np.floor(seen.uv / CELL).astype(np.int64)
        keep &= np.abs(cells[:, None] - static[None]).max(axis=2).min(axis=1) > 1
    which = np.flatnonzero(keep)
    which = np.sort(which[np.argsort(-seen.peak[which], kind="stable")[:MAX_LIGHTS]])
    columns = (getattr(seen, name)[which] for name in ("flags", "peak", "area"))
    markers = tuple(seen.markers[n] for n in which)
    return Detections(seen.robot, seen.time, seen.uv[which], seen.covariance[which], markers, *columns)


def _likeliest(rows: Sequence[_Row], span: float) -> list[int]:
    """Index of one pair of lights in each image, the smoothest sequence, by dynamic programming."""
    if not rows:
        return []
    middles = [row[2].mean(axis=1) for row in rows]
    sure = [m[0] for m in middles if len(m) == 1]
    steps = np.linalg.norm(np.diff(np.array(sure).reshape(-1, 2), axis=0), axis=1)
    scale = max(2 * float(np.median(steps)), 0.05 * span) if len(steps) else span
    total, back = rows[0][3], []
    for before, middle, row in zip(middles, middles[1:], rows[1:], strict=False):
        moved = np.linalg.norm(middle[:, None] - before[None], axis=2) / scale
        cost = total[None] + np.minimum(0.5 * np.square(moved), 20.0)
        best = cost.argmin(axis=1)
        back.append(best)
        total = cost[np.arange(len(best)), best] + row[3]
    chosen = [int(total.argmin())]
    for best in reversed(back):
        chosen.append(int(best[chosen[-1]]))
    return chosen[::-1]


def _ordered(path: RigidPath) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Mask (n,) of samples whose lights must be exchanged for a consistent order, and the piece (n,) of each sample.

    The heading's prediction error (constant rate, or no turn, whichever predicts better) is known modulo half a turn.
    Its robust scale over the stance tells how certain the choice of the nearer half is.
    """
    n = len(path)
    if n < 2:
        return np.zeros(n, bool), np.zeros(n, np.int64)
    arm = path.places[:, 1] - path.places[:, 0]
    heading = np.arctan2(arm[:, 1], arm[:, 0])
    turn = _half(np.diff(heading))  # modulo half a turn
    dt = np.diff(path.times)
    usual = float(np.median(dt))
    rate = turn / dt
    # errors of a constant rate, forward and backward in time; of the first and the last link only one of both
    ahead, behind = np.full(n - 1, np.nan), np.full(n - 1, np.nan)
    near = dt <= MAX_GAP * usual
    both = near[1:] & near[:-1]
    ahead[1:] = np.where(both, _half(turn[1:] - rate[:-1] * dt[1:]), np.nan)
    behind[:-1] = np.where(both, _half(turn[:-1] - rate[1:] * dt[:-1]), np.nan)
    constant, none = _scale(ahead), _scale(turn[near])
    if constant < none:
        error = np.fmax(np.abs(ahead), np.abs(behind))
        predicted = np.where(np.isfinite(ahead), np.concatenate([[0.0], rate[:-1]]) * dt, np.append(rate[1:], 0.0) * dt)
        sigma = constant
    else:
        error, predicted, sigma = np.abs(turn), np.zeros(n - 1), none
    error = np.where(np.isfinite(error), error, np.pi / 2)
    sigma = np.maximum(sigma, MIN_HEADING_SIGMA) * np.maximum(dt / usual, 1.0)
    ratio = (np.pi**2 - 2 * np.pi * error) / (2 * sigma**2)
    middle = path.places.mean(axis=1)
    jump = np.linalg.norm(np.diff(middle, axis=0), axis=1) / np.maximum(dt / usual, 1.0)
    sure = near & (ratio > LINK_LOG_RATIO) & (jump <= MAX_JUMP * max(float(np.median(jump)), 1e-3))
    # the true turn is the one nearest to the prediction; an odd number of half turns exchanges the lights
    true = predicted + _half(np.diff(heading) - predicted)
    odd = np.rint((true - np.diff(heading)) / np.pi).astype(np.int64) % 2 == 1
    exchanged = np.concatenate([[False], np.cumsum(odd) % 2 == 1])
    return exchanged, np.concatenate([[0], np.cumsum(~sure)])


def _half(angle: Array) -> Array:
    """Angles [rad] modulo half a turn, in [-pi/2, pi/2)."""
    return np.asarray((angle + np.pi / 2) % np.pi - np.pi / 2)


def _scale(error: Array) -> float:
    """Robust standard deviation of errors that may hold NaN, no less than their tails say; infinite of fewer than 3."""
    finite = np.abs(error[np.isfinite(error)])
    if len(finite) < 3:
        return float("inf")
    middle, tail = np.quantile(finite, [0.5, 0.9])
    return float(max(middle / 0.6745, tail / 1.645))
