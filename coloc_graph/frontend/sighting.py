"""Sight a robot: its position and heading, with a covariance, from its two markers in the image of a camera at rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from coloc_graph.frontend.homography.eq2_pose import turned_normal
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.homography.plane_view import view_of_plane
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.frontend.pairing.clock_offset import ClockOffset
from coloc_graph.frontend.pairing.correspondence import pair_by_time
from coloc_graph.frontend.tracks.marker_pairs import longest_pair, named_pair, tracks_of
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import across, floor_pose, so3_exp
from coloc_graph.geometry.se2 import wrap
from coloc_graph.measurements import Plane, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Markers, Robot

Array = NDArray[np.float64]

SPAN_TOLERANCE = 0.35  # relative error of the distance between a robot's two markers
SPEED_WINDOW = 0.3  # samples within this of a sighting tell how the markers moved [s]
MIN_DRIVEN = 0.1  # m that a robot must drive for its odometry to tell its unnamed markers apart
_NO_ERRORS = np.zeros((1, 6))


@dataclass(frozen=True)
class Marked:
    """Markers of a robot or of a landmark."""

    name: str
    markers: Markers | None


def sight(
    stance: Stance,
    observer: Robot,
    seen: Robot | Marked,
    tracks: Sequence[Track],
    plane: Plane,
    wheels: WheelTrack | None = None,
    at: float | None = None,
    clock: ClockOffset | None = None,
) -> Sighting | None:
    """Sight a body with two markers.

    Parameters
    ----------
    stance, observer
        Stance, and the robot that observes.
    seen
        Body that is seen.
    tracks
        Tracks in the observer's camera.
    plane
        Marker plane, computed from the observer's mount.
    wheels
        Wheel odometry of the body, which tells markers without names apart.
    at
        Time of the sighting [UTC s]; by default the instant at which the markers are seen best.
    clock
        Observer's clock minus the reference robot's. The time of the sighting is corrected by it, and what the body
        moves within its standard deviation is in the covariance.

    Returns
    -------
    Sighting or None
        T_observer_seen with its covariance (3, 3) of heading, x, y; None if two markers are never seen at once, or
        cannot be told apart.
    """
    markers = seen.markers
    if markers is None or len(markers.positions) < 2 or not plane.d_from_mount or not plane.normal_from_mount:
        return None
    pair = _marker_tracks(seen, tracks, observer, plane, wheels, alone=stance.movers == (seen.name,))
    if pair is None:
        return None
    shared = pair_by_time(pair[0].times, pair[1].times)
    uv = np.stack([pair[0].uv[shared[:, 0]], pair[1].uv[shared[:, 1]]], axis=1)
    times = pair[0].times[shared[:, 0]]
    places = _on_floor(observer, plane, uv)
    length = np.linalg.norm(np.diff(markers.p_body[:2, :2], axis=0))
    rays = observer.camera.rays(uv.reshape(-1, 2))
    likely = np.zeros(len(uv), bool)
    for one in plausible_planes(plane, observer.mount):
        p = on_plane(rays, one).reshape(-1, 2, 3)
        with np.errstate(invalid="ignore"):
            likely |= np.abs(np.linalg.norm(p[:, 1] - p[:, 0], axis=1) / length - 1) < SPAN_TOLERANCE
    good = np.flatnonzero(likely & np.isfinite(places).all(axis=(1, 2)))
    if not len(good):
        return None
    # the nearest is seen best: the error of a point on the floor grows with the square of the distance
    cost = np.linalg.norm(places[good], axis=2).max(axis=1) if at is None else np.abs(times[good] - at)
    best = int(good[np.argmin(cost)])
    stated, loads = (
        np.stack([getattr(track, name)[row] for track, row in zip(pair, shared[best], strict=True)])
        for name in ("covariance", "loads")
    )
    noise = block_diag(*observer.camera.centre_covariance(stated, loads))
    clock = clock or ClockOffset(0.0, 0.0)
    if clock.sigma:
        noise += _late(times, uv, best, clock.sigma)
    pose, covariance = _pose(observer, markers, plane, uv[best], noise)
    T_observer_seen = floor_pose(pose[1], pose[2], pose[0])
    view = view_of_plane(observer.camera, plane.N)
    x = view.normalise(uv[best])
    J = block_diag(*view.per_pixel(x))
    return Sighting(
        stance=stance.index,
        observer=observer.name,
        seen=seen.name,
        time=float(times[best]) - clock.value,
        T_observer_seen=T_observer_seen,
        covariance=covariance,
        x_markers=x,
        x_covariance=J @ (noise + observer.camera.bias_px**2 * np.eye(4)) @ J.T,
        R_camera_view=view.R_camera_view if view is not observer.camera else None,
    )


def _late(times: Array, uv: Array, best: int, sigma: float) -> Array:
    """Covariance (4, 4) of two markers' pixels (n, 2, 2) at the sample `best`, as its time is known to `sigma` [s]."""
    near = np.flatnonzero(np.abs(times - times[best]) < max(SPEED_WINDOW, sigma))
    rows = slice(max(min(int(near[0]), best - 2), 0), max(int(near[-1]), best + 2) + 1)
    t = times[rows] - times[best]
    terms = np.stack([np.ones_like(t), t, t**2 / 2], axis=1)
    _, speed, acceleration = np.linalg.lstsq(terms, uv[rows].reshape(-1, 4), rcond=1e-9)[0]
    moved = np.stack([sigma * speed, np.sqrt(3 / 4) * sigma**2 * acceleration])  # second moments of both terms
    return np.asarray(moved.T @ moved)


def at_rest(track: Track, time: float) -> Track:
    """Average the samples of a marker at rest into one sample at a time [UTC s]."""
    n = len(track)
    return replace(
        track,
        times=np.array([time]),
        uv=track.uv.mean(axis=0, keepdims=True),
        covariance=track.covariance.mean(axis=0, keepdims=True) / n,
        peak=track.peak.mean(keepdims=True),
        saturated=None if track.saturated is None else np.array([track.saturated.any()]),
    )


def _marker_tracks(
    seen: Robot | Marked,
    tracks: Sequence[Track],
    observer: Robot,
    plane: Plane,
    wheels: WheelTrack | None,
    *,
    alone: bool,
) -> tuple[Track, Track] | None:
    """Tracks of the first and the second marker of a body, None if they are not identified."""
    named = named_pair(tracks, seen.name, alone=alone)
    if named is not None:
        return tracks[named[0]], tracks[named[1]]
    if any(track.marker for track in tracks):
        tracks = [tracks[n] for n in tracks_of(tracks, seen.name, alone=alone)]
        if len(tracks) != 2:
            return None
    if len(tracks) < 2 or wheels is None or not len(wheels):
        return None
    if len(tracks) > 2:
        assert seen.markers is not None
        planes = plausible_planes(plane, observer.mount)
        couple = longest_pair(tracks, observer.camera, planes, seen.markers.span or 0.0)
        if couple is None:
            return None
        tracks = [tracks[n] for n in couple]
    ahead = _drives_ahead(seen, tracks[0], tracks[1], observer, plane, wheels)
    if ahead is None:
        return None
    return (tracks[0], tracks[1]) if ahead else (tracks[1], tracks[0])


def _drives_ahead(
    seen: Robot | Marked, first: Track, second: Track, observer: Robot, plane: Plane, wheels: WheelTrack
) -> bool | None:
    """Return whether two tracks, taken as a robot's markers in order, give it the heading of its odometry.

    The observed path is aligned to the odometry's, which gives the rotation between the two frames. None if the
    odometry does not decide.
    """
    assert seen.markers is not None
    shared = pair_by_time(first.times, second.times)
    if len(shared) < 2:
        return None
    uv = np.stack([first.uv[shared[:, 0]], second.uv[shared[:, 1]]], axis=1)
    places = _on_floor(observer, plane, uv)
    finite = np.isfinite(places).all(axis=(1, 2))
    if finite.sum() < 2:
        return None
    middle, driven = places[finite].mean(axis=1), wheels.pose_at(first.times[shared[finite, 0]])
    a, b = middle - middle.mean(axis=0), driven[:, :2] - driven[:, :2].mean(axis=0)
    if np.linalg.norm(np.ptp(b, axis=0)) < MIN_DRIVEN:
        return None
    turn = np.arctan2((b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]).sum(), (a * b).sum())
    arm, model = places[finite, 1] - places[finite, 0], np.diff(seen.markers.p_body[:2, :2], axis=0)[0]
    heading = np.arctan2(arm[:, 1], arm[:, 0]) - np.arctan2(model[1], model[0])
    agreement = float(np.cos(heading - driven[:, 2] - turn).mean())
    return None if abs(agreement) < 0.5 else agreement > 0


def _on_floor(observer: Robot, plane: Plane, uv: Array, errors: Array = _NO_ERRORS) -> Array:
    """Project pixels (n, m, 2) to the marker plane: (n, m, 2) [m] in the observer's body frame.

    `errors` (n, 6) or (1, 6) are errors of the normal about two axes across it [rad], of d [m], and of the mount's
    height [m], tilt and roll [rad].
    """
    n, m, _ = uv.shape
    T_body_camera = observer.mount.off_by(errors[:, 3:])
    N = turned_normal(plane, observer.mount, T_body_camera)
    sides = across(plane.N)
    N = (so3_exp(errors[:, :2] @ sides) @ N[..., None])[..., 0]
    d = plane.d + errors[:, 2] + errors[:, 3]
    rays = observer.camera.rays(uv.reshape(-1, 2)).reshape(n, m, 3)
    along = (rays @ N[..., None])[..., 0]
    p_camera = rays * (d[:, None] / np.where(along > 1e-6, along, np.nan))[..., None]
    p_body = p_camera @ T_body_camera[:, :3, :3].mT + T_body_camera[:, None, :3, 3]
    return np.asarray(p_body[..., :2])


def _pose(observer: Robot, markers: Markers, plane: Plane, uv: Array, noise: Array) -> tuple[Array, Array]:
    """Heading, x, y (3,) of a body with its first two markers at pixels (2, 2), and their covariance (3, 3).

    `noise` (4, 4) is the covariance of these pixels. The line through both gives the heading, their midpoint the
    position.
    """
    root = np.zeros((10, 10))
    root[:4, :4] = np.linalg.cholesky(noise + observer.camera.bias_px**2 * np.eye(4))
    mount = observer.mount
    root[4:, 4:] = np.diag(
        [
            plane.normal_sigma,
            plane.normal_sigma,
            plane.d_sigma,
            mount.height_sigma,
            *np.deg2rad([mount.tilt_sigma_deg, mount.roll_sigma_deg]),
        ]
    )
    step = 0.1
    errors = np.concatenate([np.zeros((1, 10)), step * root.T, -step * root.T])
    places = _on_floor(observer, plane, uv + errors[:, :4].reshape(-1, 2, 2), errors[:, 4:])
    model = markers.p_body[:2, :2]
    arm, of_model = places[:, 1] - places[:, 0], model[1] - model[0]
    heading = np.arctan2(arm[:, 1], arm[:, 0]) - np.arctan2(of_model[1], of_model[0])
    c, s = np.cos(heading), np.sin(heading)
    mx, my = model.mean(axis=0)
    xy = places.mean(axis=1) - np.stack([c * mx - s * my, s * mx + c * my], axis=1)
    # differences in the tangent of the first pose: heading, then x and y in its own axes
    turned = wrap(heading - heading[0])
    off = xy - xy[0]
    xi = np.stack([turned, c[0] * off[:, 0] + s[0] * off[:, 1], -s[0] * off[:, 0] + c[0] * off[:, 1]], axis=1)
    columns = (xi[1:11] - xi[11:]) / (2 * step)
    return np.array([heading[0], *xy[0]]), columns.T @ columns
