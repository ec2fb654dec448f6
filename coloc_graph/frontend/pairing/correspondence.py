"""Which samples of two cameras show the same marker at the same instant.

Samples are paired by time (5 ms, paper section V). Tracks whose marker has a name pair by name. Tracks without
one pair by what they do (`association`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.refinement import PointPairs
from coloc_graph.frontend.pairing.association import HIDDEN, HIDDEN_ALONE, LEAST_ALONE, SURE, associate
from coloc_graph.frontend.tracks.interpolation import LONGEST_GAP
from coloc_graph.frontend.tracks.tracking import Track
from coloc_graph.team import Camera

Array = NDArray[np.float64]

#: Time difference up to which two samples count as one instant [s].
PAIRING_WINDOW = 5e-3

#: A light whose track stays in a box of this diagonal stands still [px].
STILL = 8.0
#: A marker nearer to the border than this may not be seen [px].
BORDER = 6.0
#: More than a float64 of UTC seconds is rounded by: a gap of the window itself is within it [s].
CLOCK_GRAIN = 1e-6


class UnpairedTracks(DegenerateGeometry):
    """No tracks of two cameras are certainly the same markers: `what` is so, and what may help."""

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(f"{what}: {remedy}")
        self.what = what


@dataclass(frozen=True, eq=False)
class Correspondences:
    """The same markers at the same instants in cameras i and j: `uv_*` (n, 2) [px], `times` (n,) of camera i.

    `pairs` are the same in normalised coordinates with covariances. `markers` names which track of camera i
    each belongs to (n,). `loads_*` (n, 2) are the parts of the white floor's and of saturation's variance that each
    point has (`team.CentreNoise`); of interpolated points they are less than 1.
    """

    uv_i: Array
    uv_j: Array
    times: Array
    markers: NDArray[np.int64]
    pairs: PointPairs
    loads_i: Array
    loads_j: Array

    def __len__(self) -> int:
        return len(self.times)


def pair_by_time(times_i: Array, times_j: Array, window: float = PAIRING_WINDOW) -> NDArray[np.int64]:
    """Indices (n, 2) of the samples nearest to each other in two ascending series, at most `window` [s] apart."""
    if not len(times_i) or not len(times_j):
        return np.empty((0, 2), np.int64)
    after = np.searchsorted(times_j, times_i)
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(times_j) - 1)
    gap_before, gap_after = times_i - times_j[before], times_j[after] - times_i
    np.abs(gap_before, out=gap_before), np.abs(gap_after, out=gap_after)
    nearest, gap = np.where(gap_before <= gap_after, before, after), np.minimum(gap_before, gap_after)
    kept = np.flatnonzero(gap <= window + CLOCK_GRAIN)
    near = nearest[kept]
    if (near[1:] == near[:-1]).any():  # each sample of j goes to the closest of i
        order = np.lexsort((gap[kept], near))
        first = np.ones(len(order), bool)
        first[1:] = near[order][1:] != near[order][:-1]
        kept = kept[np.sort(order[first])]
    pairs = np.empty((len(kept), 2), np.int64)
    pairs[:, 0], pairs[:, 1] = kept, nearest[kept]
    return pairs


def pair_each_by_time(
    series: Sequence[tuple[Array, Array]], window: float = PAIRING_WINDOW
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`pair_by_time` of many pairs of series at once: which of them (m,), and the indices (m, 2) in it.

    Laid one behind the other, so far apart that no sample is near one of another pair.
    """
    lengths = np.array([(len(a), len(b)) for a, b in series]).reshape(-1, 2)
    if not lengths.all(axis=1).any():
        return np.empty(0, np.int64), np.empty((0, 2), np.int64)
    begin = min(a[0] for a, _ in series if len(a))
    sides = [np.concatenate(side) - begin for side in zip(*series, strict=True)]
    apart = 2 * max(float(np.abs(side).max()) for side in sides if len(side)) + 10 * window + 1.0
    numbers = np.arange(len(series))
    first = np.cumsum(lengths, axis=0) - lengths
    laid = [side + apart * np.repeat(numbers, count) for side, count in zip(sides, lengths.T, strict=True)]
    pairs = pair_by_time(laid[0], laid[1], window)
    which = np.repeat(numbers, lengths[:, 0])[pairs[:, 0]]
    return which, pairs - first[which]


#: Whether a homography, and the tracks of camera i that it pairs, can be right, by what else is known.
Plausible = Callable[[Array, Sequence[Track]], bool]


def correspond(
    tracks_i: Sequence[Track],
    tracks_j: Sequence[Track],
    camera_i: Camera,
    camera_j: Camera,
    *,
    alone: bool = False,
    plausible: Plausible | None = None,
) -> Correspondences:
    """The correspondences between two cameras' tracks; raises `DegenerateGeometry` where there are none.

    Where one robot moves `alone`, what both cameras see at the same time is that. What is not `plausible` is no pairing
    of tracks without names.
    """
    candidates = Candidates(tracks_i, tracks_j, camera_i, camera_j, alone=alone, plausible=plausible)
    return _chosen(candidates, tracks_i, tracks_j)[1]


def correspond_roughly(
    tracks_i: Sequence[Track],
    tracks_j: Sequence[Track],
    camera_i: Camera,
    camera_j: Camera,
    offset: float,
    sigma: float,
    *,
    alone: bool = False,
    plausible: Plausible | None = None,
) -> tuple[list[tuple[int, int]], Correspondences]:
    """The same for clocks that differ by `offset`, known to `sigma` [s]: which tracks (a, b) are one marker's.

    Nearest samples are paired and moved to the same instant; what the sigma makes of a marker's speed is in
    camera j's covariances. Raises `DegenerateGeometry` as `correspond` does.
    """
    clock = offset, sigma
    candidates = Candidates(tracks_i, tracks_j, camera_i, camera_j, clock, alone=alone, plausible=plausible)
    return _chosen(candidates, tracks_i, tracks_j)


def _chosen(
    candidates: "Candidates", tracks_i: Sequence[Track], tracks_j: Sequence[Track]
) -> tuple[list[tuple[int, int]], Correspondences]:
    if not candidates.indices:
        raise UnpairedTracks(*_why_none(tracks_i, tracks_j, candidates.window))
    if all(track.marker for track in (*tracks_i, *tracks_j)):
        return list(candidates.indices), candidates.join(list(candidates.indices))
    found = associate(candidates)
    pair = f"{tracks_i[0].robot} and {tracks_j[0].robot}"
    if found is None:
        raise UnpairedTracks(
            f"no pairing of the tracks of {pair} is explained by one homography",
            "let the moving robot turn and drive further, look for reflections, and calibrate the lenses",
        )
    if found.posterior < SURE:
        raise UnpairedTracks(
            f"which tracks of {pair} are the same markers is ambiguous: {len(found.rivals) + 1} pairings are explained "
            f"by one homography each, and the likeliest is right with a chance of {100 * found.posterior:.1f} % only",
            "let the moving robots turn and drive apart, or give markers names",
        )
    return list(found.chosen), candidates.join(found.chosen)


def _why_none(tracks_i: Sequence[Track], tracks_j: Sequence[Track], window: float) -> tuple[str, str]:
    if not tracks_i or not tracks_j:
        seeing = next((track.robot for track in (*tracks_i, *tracks_j)), None)
        who = "both saw none" if seeing is None else f"{seeing} alone saw one"
        return (
            f"the observers never see a marker at the same instant, since {who}",
            "bring the mover into both fields of view, and check the cameras",
        )
    i, j = tracks_i[0].robot, tracks_j[0].robot
    names_i, names_j = ({track.marker for track in tracks} for tracks in (tracks_i, tracks_j))
    if all(names_i | names_j) and not names_i & names_j:
        return (
            f"no marker name is shared: {i} saw {_listed(names_i)} and {j} saw {_listed(names_j)}",
            "give the same marker the same name in every camera",
        )
    return (
        f"{i} and {j} never see a marker at the same instant (within {1e3 * window:.0f} ms)",
        "bring the mover into both fields of view, and check the clocks",
    )


def _listed(names: set[str]) -> str:
    shown = ", ".join(f"`{name}`" for name in sorted(names)[:3])
    return shown + (f" and {len(names) - 3} more" if len(names) > 3 else "")


class Candidates:
    """All pairs of tracks that may be one marker: they share instants, and their names, where they have some.

    `clock` is the clocks' offset and its sigma [s], None for clocks that agree.
    """

    def __init__(
        self,
        tracks_i: Sequence[Track],
        tracks_j: Sequence[Track],
        camera_i: Camera,
        camera_j: Camera,
        clock: tuple[float, float] | None = None,
        *,
        alone: bool = False,
        plausible: Plausible | None = None,
    ) -> None:
        self._i, self._j = list(tracks_i), list(tracks_j)
        self._cameras = camera_i, camera_j
        self._alone, self._plausible = alone, plausible
        self.hidden, self.least = (HIDDEN_ALONE, LEAST_ALONE) if alone else (HIDDEN, 0.0)
        self.bodies = [track.body for track in tracks_i], [track.body for track in tracks_j]
        self._x_i = [normalised(track, camera_i) for track in self._i]
        self._x_j = [normalised(track, camera_j) for track in self._j]
        # where a lens cannot be inverted there is no ray, and one NaN would spoil the whole stance
        finite_i, finite_j = [_finite(x) for x in self._x_i], [_finite(x) for x in self._x_j]
        self.indices: dict[tuple[int, int], NDArray[np.int64]] = {}
        self._clock = clock
        offset, window = (0.0, PAIRING_WINDOW) if clock is None else (clock[0], LONGEST_GAP / 2)
        self.window = window
        self._slopes = [np.empty((0, 2))] * len(self._j)
        if clock is not None:
            self._slopes = [_speed(track.times, x[0]) for track, x in zip(self._j, self._x_j, strict=True)]
        alike = [
            (a, b)
            for a, track_i in enumerate(self._i)
            for b, track_j in enumerate(self._j)
            if not (track_i.marker and track_j.marker and track_i.marker != track_j.marker)
            and not (track_i.mover and track_j.mover and track_i.mover != track_j.mover)
        ]
        which, every = pair_each_by_time([(self._i[a].times, self._j[b].times - offset) for a, b in alike], window)
        ends = np.searchsorted(which, np.arange(len(alike) + 1))
        for (a, b), begin, end in zip(alike, ends[:-1], ends[1:], strict=True):
            shared = every[begin:end]
            shared = shared[finite_i[a][shared[:, 0]] & finite_j[b][shared[:, 1]]]
            if len(shared):
                self.indices[a, b] = shared

    def points(self, chosen: Sequence[tuple[int, int]]) -> PointPairs:
        """All samples that some pairs of tracks share."""
        return self.join(chosen).pairs

    def visible(self, H_j_i: Array) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Of each sample of each track of i whether j would have seen it, and of those of j whether i would."""
        camera_i, camera_j = self._cameras
        if self._alone:
            return _while_seen(self._i, self._j), _while_seen(self._j, self._i)
        return (
            [_in_view(camera_j, H_j_i, x) for x, _ in self._x_i],
            [_in_view(camera_i, np.asarray(np.linalg.inv(H_j_i), float), x) for x, _ in self._x_j],
        )

    def plausible(self, H_j_i: Array, chosen: Sequence[tuple[int, int]]) -> bool:
        """Whether a homography, and what it pairs, can be right by what else is known."""
        return self._plausible is None or self._plausible(H_j_i, [self._i[a] for a, _ in chosen])

    def covered(self, chosen: Sequence[tuple[int, int]]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Of each sample of each track of i, and of j, whether it lies between those that a chosen pair shares."""
        in_i, in_j = ([np.zeros(len(track), bool) for track in tracks] for tracks in (self._i, self._j))
        for a, b in chosen:
            m, n = self.indices[a, b].T
            in_i[a][m.min() : m.max() + 1] = True
            in_j[b][n.min() : n.max() + 1] = True
        return in_i, in_j

    def claimed(self, residuals: dict[tuple[int, int], float]) -> list[tuple[int, int]]:
        """Of some pairs of tracks those that do not claim a sample that one with a smaller residual has."""
        free_i = [np.ones(len(track), bool) for track in self._i]
        free_j = [np.ones(len(track), bool) for track in self._j]
        chosen: list[tuple[int, int]] = []
        for a, b in sorted(residuals, key=lambda ab: residuals[ab]):
            m, n = self.indices[a, b].T
            if free_i[a][m].all() and free_j[b][n].all():
                chosen.append((a, b))
                free_i[a][m] = free_j[b][n] = False
        return sorted(chosen)

    def join(self, chosen: Sequence[tuple[int, int]]) -> Correspondences:
        """What some pairs of tracks share."""
        parts = [(a, b, *self.indices[a, b].T) for a, b in chosen]
        uv_i = np.concatenate([self._i[a].uv[m] for a, _, m, _ in parts])
        uv_j = np.concatenate([self._j[b].uv[n] for _, b, _, n in parts])
        seen_j = [self._at_j(a, b, m, n) for a, b, m, n in parts]
        return Correspondences(
            uv_i=uv_i,
            uv_j=uv_j,
            times=np.concatenate([self._i[a].times[m] for a, _, m, _ in parts]),
            markers=np.concatenate([np.full(len(m), a) for a, _, m, _ in parts]),
            pairs=PointPairs(
                np.concatenate([self._x_i[a][0][m] for a, _, m, _ in parts]),
                np.concatenate([x for x, _ in seen_j]),
                np.concatenate([self._x_i[a][1][m] for a, _, m, _ in parts]),
                np.concatenate([covariance for _, covariance in seen_j]),
            ),
            loads_i=np.concatenate([self._i[a].loads[m] for a, _, m, _ in parts]),
            loads_j=np.concatenate([self._j[b].loads[n] for _, b, _, n in parts]),
        )

    def _at_j(self, a: int, b: int, m: NDArray[np.int64], n: NDArray[np.int64]) -> tuple[Array, Array]:
        """Samples n (k,) of track b, where they are at the instants of samples m (k,) of track a."""
        x, covariance = self._x_j[b][0][n], self._x_j[b][1][n]
        if self._clock is None:
            return x, covariance
        offset, sigma = self._clock
        slope = self._slopes[b][n]
        ahead = self._i[a].times[m] + offset - self._j[b].times[n]
        return x + slope * ahead[:, None], covariance + sigma**2 * slope[:, :, None] * slope[:, None, :]


def _while_seen(tracks: Sequence[Track], others: Sequence[Track]) -> list[NDArray[np.bool_]]:
    """Of each sample of some tracks whether any of the others goes on at the time."""
    return [
        np.any([(track.times >= one.times[0]) & (track.times <= one.times[-1]) for one in others], axis=0)
        for track in tracks
    ]


def _in_view(camera: Camera, H: Array, x: Array) -> NDArray[np.bool_]:
    """Which points x (n, 2) of another camera come to lie within a camera's image, and not at its border, by H."""
    uv, inside = camera.project(np.column_stack([x, np.ones(len(x))]) @ H.T)
    with np.errstate(invalid="ignore"):
        return np.asarray(
            inside & (uv > BORDER).all(axis=1) & (uv < (camera.width - BORDER, camera.height - BORDER)).all(axis=1)
        )


@lru_cache(maxsize=1000)  # a camera's tracks are in as many pairs as it has partners
def normalised(track: Track, camera: Camera) -> tuple[Array, Array]:
    """A track in normalised coordinates (n, 2), with covariances (n, 2, 2) that hold the camera's `centre_noise`."""
    x = camera.normalise(track.uv)
    J = camera.per_pixel(x)
    return x, J @ camera.centre_covariance(track.covariance, track.loads) @ J.mT


def _speed(times: Array, x: Array) -> Array:
    """Roughly how fast a track (n, 2) moves at its samples [1/s]; 0 where a sample stands alone."""
    if len(times) < 2:
        return np.zeros_like(x)
    step = np.diff(times)
    joined = (step > 1e-4) & (step < LONGEST_GAP)
    between = np.where(joined[:, None], np.diff(x, axis=0) / np.where(joined, step, 1.0)[:, None], 0.0)
    count = np.maximum(np.append(joined, 0) + np.append(0, joined), 1)
    return np.asarray((np.vstack([between, np.zeros(2)]) + np.vstack([np.zeros(2), between])) / count[:, None])


def _finite(normalised_track: tuple[Array, Array]) -> NDArray[np.bool_]:
    x, covariance = normalised_track
    return np.asarray(np.isfinite(x).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))


def separated(C: Array, x: Array, loads: Array, camera: Camera) -> tuple[Array, Array]:
    """Covariances (n, 2, 2) of points as detections stated them, and those of one pixel; C has the `centre_noise`."""
    J = camera.per_pixel(x)
    per_px = J @ J.mT
    if camera.centre_noise is None:
        return C, per_px
    scale, *added = camera.centre_noise.variances
    return (C - (loads @ added)[:, None, None] * per_px) / scale, per_px


def with_noise(found: Correspondences, before: tuple[Camera, Camera], after: tuple[Camera, Camera]) -> Correspondences:
    """Return the correspondences with the centre noise that their cameras have `after`, instead of that `before`."""
    pairs = found.pairs
    sides = (pairs.covariance_i, pairs.x_i, found.loads_i), (pairs.covariance_j, pairs.x_j, found.loads_j)
    made = []
    for (C, x, loads), old, new in zip(sides, before, after, strict=True):
        stated, per_px = separated(C, x, loads, old)
        scale, *added = new.centre_noise.variances if new.centre_noise else (1.0, 0.0, 0.0)
        made.append(scale * stated + (loads @ added)[:, None, None] * per_px)
    return replace(found, pairs=PointPairs(pairs.x_i, pairs.x_j, *made))
