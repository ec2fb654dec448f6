"""Find the samples of two cameras that show the same marker at the same instant.

Samples are paired by time (5 ms, paper section V). Named tracks are paired by name, unnamed ones by their motion
(`association`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.refinement import PointPairs
from coloc_graph.frontend.pairing.association import (
    HIDDEN,
    HIDDEN_ALONE,
    MIN_POSTERIOR,
    MIN_SHARE_ALONE,
    Unassociated,
    associate,
)
from coloc_graph.frontend.tracks.interpolation import MAX_GAP
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.team import Camera

Array = NDArray[np.float64]

PAIRING_WINDOW = 5e-3  # s, time difference up to which two samples are of one instant
STILL = 8.0  # px, diagonal of the bounding box of a light at rest
BORDER = 6.0  # px from the border of the image, within which a marker may be missed
CLOCK_GRAIN = 1e-6  # s, more than the rounding of UTC seconds in float64


class UnpairedTracks(DegenerateGeometry):
    """No association of two cameras' tracks is certain; `what` is the reason without the remedy."""

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(f"{what}: {remedy}")
        self.what = what


@dataclass(frozen=True, eq=False)
class Correspondences:
    """The same markers at the same instants in cameras i and j.

    Attributes
    ----------
    uv_i, uv_j
        Pixels, (n, 2).
    times
        Times by camera i's clock, (n,) [s].
    markers
        Index of camera i's track, (n,).
    pairs
        Normalised coordinates with covariances.
    loads_i, loads_j
        Parts of the white floors, of other and of saturated spots, in each point (`team.CentreNoise`), (n, 2); less
        than 1 for interpolated points.
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
    """Pair the samples of two ascending series that are nearest to each other in time.

    Parameters
    ----------
    times_i, times_j
        Ascending times [s].
    window
        Largest time difference [s].

    Returns
    -------
    numpy.ndarray
        Indices of paired samples, (n, 2).
    """
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
    """Apply `pair_by_time` to many pairs of series at once: index of the pair (m,), and indices (m, 2) in it."""
    # lay the pairs one behind the other, too far apart for samples of different pairs to be near each other
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


#: Predicate of a homography and the tracks of camera i that it pairs: False if other knowledge contradicts them.
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
    """Find the correspondences between the tracks of two cameras whose clocks agree.

    Parameters
    ----------
    tracks_i, tracks_j
        Tracks of both cameras.
    camera_i, camera_j
        The cameras.
    alone
        True if one robot moves only, so that both cameras see the same one at any time.
    plausible
        Predicate that associations of unnamed tracks must satisfy.

    Returns
    -------
    Correspondences
        The same markers at the same instants.

    Raises
    ------
    DegenerateGeometry
        There are none, or the association is ambiguous.
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
    """Find the correspondences between the tracks of two cameras whose clocks differ by an uncertain offset.

    The nearest samples are paired and extrapolated to the same instant.

    Parameters
    ----------
    tracks_i, tracks_j, camera_i, camera_j, alone, plausible
        As in `correspond`.
    offset, sigma
        Clock offset and its standard deviation [s], which enlarges camera j's covariances by the markers' velocity.

    Returns
    -------
    tuple
        Pairs of track indices, and the correspondences.

    Raises
    ------
    DegenerateGeometry
        There are none, or the association is ambiguous.
    """
    clock = offset, sigma
    candidates = Candidates(tracks_i, tracks_j, camera_i, camera_j, clock, alone=alone, plausible=plausible)
    return _chosen(candidates, tracks_i, tracks_j)


def _chosen(
    candidates: "Candidates", tracks_i: Sequence[Track], tracks_j: Sequence[Track]
) -> tuple[list[tuple[int, int]], Correspondences]:
    if not candidates.indices:
        raise UnpairedTracks(*_reason_for_none(tracks_i, tracks_j, candidates.window))
    if all(track.marker for track in (*tracks_i, *tracks_j)):
        return list(candidates.indices), candidates.join(list(candidates.indices))
    found = associate(candidates)
    pair = f"{tracks_i[0].robot} and {tracks_j[0].robot}"
    if isinstance(found, Unassociated):
        raise UnpairedTracks(f"no pairing of the tracks of {pair} fits one homography ({found.what})", found.remedy)
    if found.posterior < MIN_POSTERIOR:
        raise UnpairedTracks(
            f"the association of the tracks of {pair} is ambiguous: {len(found.rivals) + 1} pairings each fit a "
            f"homography, and the most probable one has a probability of only {100 * found.posterior:.1f} %",
            "let the moving robots turn and drive apart, or name the markers",
        )
    return list(found.chosen), candidates.join(found.chosen)


def _reason_for_none(tracks_i: Sequence[Track], tracks_j: Sequence[Track], window: float) -> tuple[str, str]:
    if not tracks_i or not tracks_j:
        seeing = next((track.robot for track in (*tracks_i, *tracks_j)), None)
        who = "neither saw one" if seeing is None else f"only {seeing} saw one"
        return (
            f"the observers never see a marker at the same instant: {who}",
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
    """All pairs of tracks that may be one marker: they share instants, and names if both have one.

    `clock` is the clock offset and its standard deviation [s], None for clocks that agree.
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
        self.hidden, self.least = (HIDDEN_ALONE, MIN_SHARE_ALONE) if alone else (HIDDEN, 0.0)
        self.bodies = [track.body for track in tracks_i], [track.body for track in tracks_j]
        self._x_i = [normalised(track, camera_i) for track in self._i]
        self._x_j = [normalised(track, camera_j) for track in self._j]
        # where a lens cannot be inverted there is no ray, and one NaN would invalidate the whole stance
        finite_i, finite_j = [_finite(x) for x in self._x_i], [_finite(x) for x in self._x_j]
        self.indices: dict[tuple[int, int], NDArray[np.int64]] = {}
        self._clock = clock
        offset, window = (0.0, PAIRING_WINDOW) if clock is None else (clock[0], MAX_GAP / 2)
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
        """All samples that the chosen pairs share."""
        return self.join(chosen).pairs

    def visible(self, H_j_i: Array) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Masks of each track's samples, of i and of j, that the other camera would see."""
        camera_i, camera_j = self._cameras
        if self._alone:
            return _while_seen(self._i, self._j), _while_seen(self._j, self._i)
        return (
            [_in_view(camera_j, H_j_i, x) for x, _ in self._x_i],
            [_in_view(camera_i, np.asarray(np.linalg.inv(H_j_i), float), x) for x, _ in self._x_j],
        )

    def plausible(self, H_j_i: Array, chosen: Sequence[tuple[int, int]]) -> bool:
        """Return whether a homography and its pairs agree with everything else that is known."""
        return self._plausible is None or self._plausible(H_j_i, [self._i[a] for a, _ in chosen])

    def covered(self, chosen: Sequence[tuple[int, int]]) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
        """Masks of each track's samples, of i and of j, between the first and last that a chosen pair shares."""
        in_i, in_j = ([np.zeros(len(track), bool) for track in tracks] for tracks in (self._i, self._j))
        for a, b in chosen:
            m, n = self.indices[a, b].T
            in_i[a][m.min() : m.max() + 1] = True
            in_j[b][n.min() : n.max() + 1] = True
        return in_i, in_j

    def claimed(self, residuals: dict[tuple[int, int], float]) -> list[tuple[int, int]]:
        """Select pairs, smallest residual first, that share no sample with one selected before."""
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
        """Correspondences of the chosen pairs."""
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
        """Extrapolate samples n (k,) of track b to the instants of samples m (k,) of track a."""
        x, covariance = self._x_j[b][0][n], self._x_j[b][1][n]
        if self._clock is None:
            return x, covariance
        offset, sigma = self._clock
        slope = self._slopes[b][n]
        ahead = self._i[a].times[m] + offset - self._j[b].times[n]
        return x + slope * ahead[:, None], covariance + sigma**2 * slope[:, :, None] * slope[:, None, :]


def _while_seen(tracks: Sequence[Track], others: Sequence[Track]) -> list[NDArray[np.bool_]]:
    """Masks of each track's samples during which any of the other tracks lasts."""
    return [
        np.any([(track.times >= one.times[0]) & (track.times <= one.times[-1]) for one in others], axis=0)
        for track in tracks
    ]


def _in_view(camera: Camera, H: Array, x: Array) -> NDArray[np.bool_]:
    """Mask of points x (n, 2) of another camera that H maps into a camera's image, and not to its border."""
    uv, inside = camera.project(np.column_stack([x, np.ones(len(x))]) @ H.T)
    with np.errstate(invalid="ignore"):
        return np.asarray(
            inside & (uv > BORDER).all(axis=1) & (uv < (camera.width - BORDER, camera.height - BORDER)).all(axis=1)
        )


@lru_cache(maxsize=1000)  # a camera's tracks are in as many pairs as it has partners
def normalised(track: Track, camera: Camera) -> tuple[Array, Array]:
    """Normalised coordinates of a track (n, 2), with covariances (n, 2, 2) that contain the camera's `centre_noise`."""
    x = camera.normalise(track.uv)
    J = camera.per_pixel(x)
    return x, J @ camera.centre_covariance(track.covariance, track.loads) @ J.mT


def _speed(times: Array, x: Array) -> Array:
    """Approximate velocities (n, 2) of a track at its samples [1/s]; 0 at isolated samples."""
    if len(times) < 2:
        return np.zeros_like(x)
    step = np.diff(times)
    joined = (step > 1e-4) & (step < MAX_GAP)
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
