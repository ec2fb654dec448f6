"""Inspection of one edge and one robot: the pair measured again, both decompositions, pictures, and reports."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend import PairMeasurement
from coloc_graph.frontend.homography.decomposition import choose_by_normal, decompose_svd
from coloc_graph.frontend.homography.fit import INLIER_GATE
from coloc_graph.frontend.homography.plane import on_plane
from coloc_graph.frontend.learnt_noise import measure_alone
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import floor_pose, so3_log
from coloc_graph.run import Run
from coloc_graph.team import Camera, Team
from coloc_graph.viewer import palette
from coloc_graph.viewer.frame import Lines
from coloc_graph.viewer.scene import Array, Layer, Scene

Image = NDArray[np.uint8]

IMAGE_TOLERANCE = 0.3  # s between an instant and its image, and between joined samples of a track, at most
GAP_FACTOR = 5.0  # times the median interval between samples of a track, above which they are not joined
PICTURE_SCALE = 2  # factor by which images are enlarged
MAX_POINTS = 60  # points drawn in a picture


@dataclass(frozen=True, eq=False)
class Solution:
    """Decomposition of a homography: rotation [deg], translation (3,) [m] of `T_cj_ci`, error of the normal [deg]."""

    rotation_deg: float
    translation: Array
    normal_error_deg: float
    chosen: bool


@dataclass(frozen=True, eq=False)
class Inspection:
    """One edge in detail: the measurement made again, both its decompositions, and a picture."""

    measured: PairMeasurement
    solutions: tuple[Solution, ...]
    picture: Image


def examine(scene: Scene, edge: int) -> Inspection:
    """Measure the pair of an edge again, decompose and draw it; raises `InputError` without a run."""
    run, row = scene.run, int(scene.edges.rows[edge])
    if run is None:
        raise InputError("there is no run to measure this pair in: open the run, or a result that lies beside it")
    stance = scene.stances[row]
    robot_i, robot_j = (scene.robots[int(n)] for n in (scene.edges.i[edge], scene.edges.j[edge]))
    measured = measure_alone(run, stance, robot_i, robot_j, scene.frontend)
    picture = _picture(run, scene.middle(row), (robot_i, robot_j), measured)
    return Inspection(measured, _solutions(run, measured), picture)


def _solutions(run: Run, measured: PairMeasurement) -> tuple[Solution, ...]:
    pose, H = measured.relative_pose, measured.homography.H_j_i
    if pose is None or pose.plane is None:
        return ()
    R, T, N = decompose_svd(H)
    taken = int(choose_by_normal(N, pose.plane.N)[0])
    errors = np.rad2deg(np.arccos(np.clip(N @ pose.plane.N, -1, 1)))
    turns = np.rad2deg(np.linalg.norm(so3_log(R), axis=1))
    return tuple(Solution(float(turns[n]), pose.plane.d * T[n], float(errors[n]), n == taken) for n in range(2))


def camera_image(run: Run, robot: str, time: float) -> Image | None:
    """Image of a robot's camera at an instant, RGB; None if there is none.

    Without images its detections of the stance are drawn, those of the instant bright.
    """
    camera = run.team[robot].camera_if_any
    if camera is None:
        return None
    if run.has_images(robot):
        image = min(
            run.images(robot, time - IMAGE_TOLERANCE, time + IMAGE_TOLERANCE),
            key=lambda one: abs(one.time - time),
            default=None,
        )
        if image is None:
            return None
        pixels = image.pixels
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB if pixels.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)
    if not run.has_detections(robot):
        return None
    of = next(
        (stance for stance in run.stances if stance.start - IMAGE_TOLERANCE <= time <= stance.end + IMAGE_TOLERANCE),
        None,
    )
    seen = [] if of is None else list(run.detections(robot, of.start, of.end))
    if not seen:
        return None
    canvas = np.full((camera.height, camera.width, 3), 26, np.uint8)
    latest = min(seen, key=lambda one: abs(one.time - time))
    for one in seen:
        for uv in one.uv[np.isfinite(one.uv).all(axis=1)]:
            cv2.circle(canvas, _pixel(uv), max(camera.width // 160, 1), (96, 102, 112), -1, cv2.LINE_AA)
    for uv in latest.uv[np.isfinite(latest.uv).all(axis=1)]:
        cv2.circle(canvas, _pixel(uv), max(camera.width // 64, 2), (255, 244, 190), -1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


def _picture(run: Run, time: float, robots: tuple[str, str], measured: PairMeasurement) -> Image:
    """Draw both images side by side with their tracks, and the points of i mapped by H onto j."""
    halves: list[Image] = []
    for number, robot in enumerate(robots):
        camera = run.team[robot].camera
        image = camera_image(run, robot, time)
        if image is None or not run.has_images(robot):
            image = np.full((camera.height, camera.width, 3), 26, np.uint8)
        large = cv2.resize(image, None, fx=PICTURE_SCALE, fy=PICTURE_SCALE, interpolation=cv2.INTER_AREA)
        half: Image = (large * 0.6).astype(np.uint8)  # so that what is drawn stands out
        if measured.tracks is not None:
            _draw_tracks(half, measured.tracks[number])
        halves.append(half)
    _draw_points(run, halves, robots, measured)
    for half, text in zip(halves, (f"{robots[0]} (i)", f"{robots[1]} (j)"), strict=True):
        cv2.putText(half, text, (12, 34), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2, cv2.LINE_AA)
    height = max(half.shape[0] for half in halves)
    padded = [cv2.copyMakeBorder(half, 0, height - len(half), 0, 0, cv2.BORDER_CONSTANT) for half in halves]
    return np.asarray(np.hstack([padded[0], np.full((height, 4, 3), 255, np.uint8), padded[1]]), np.uint8)


def _draw_tracks(half: Image, tracks: Sequence[Track]) -> None:
    for number, track in enumerate(tracks):
        colour = tuple(int(value) for value in palette.ROBOTS[(number + 4) % len(palette.ROBOTS)])
        points = np.round(8 * (PICTURE_SCALE * (track.uv + 0.5) - 0.5)).astype(np.int32)
        # a pause in a track is no line across the image
        for part in np.split(points, np.flatnonzero(np.diff(track.times) > max_gap(track.times)) + 1):
            cv2.polylines(half, [part], False, colour, 1, cv2.LINE_AA, 3)


def _draw_points(run: Run, halves: list[Image], robots: tuple[str, str], measured: PairMeasurement) -> None:
    """Draw some of the points in both images, and in j the points of i mapped by H."""
    found, h = measured.correspondences, measured.homography
    if found is None or not len(found):
        return
    some = np.unique(np.linspace(0, len(found) - 1, MAX_POINTS).round().astype(int))
    good = np.zeros(len(found), bool)
    if h.unusable is None:
        assert measured.fit is not None
        good = measured.fit.squared_residuals < INLIER_GATE
        some = np.union1d(some, np.flatnonzero(~good)[:MAX_POINTS])  # what does not fit is what one looks for
    for half, points in zip(halves, (found.uv_i, found.uv_j), strict=True):
        for uv, fits in zip(points[some], good[some], strict=True):
            cv2.circle(half, _pixel(PICTURE_SCALE * uv), 5, (255, 255, 255) if fits else (240, 120, 20), 1, cv2.LINE_AA)
    if h.unusable is None:
        warped = warp(h.H_j_i, run.team[robots[0]].camera.rays(found.uv_i[some]), run.team[robots[1]].camera)
        for uv in warped[np.isfinite(warped).all(axis=1)]:
            at = _pixel(PICTURE_SCALE * uv)
            cv2.drawMarker(halves[1], at, (86, 180, 233), cv2.MARKER_TILTED_CROSS, 9, 1, cv2.LINE_AA)


def max_gap(times: Array) -> float:
    """Longest interval between two samples of a track that are joined [s]."""
    return max(IMAGE_TOLERANCE, GAP_FACTOR * float(np.median(np.diff(times)))) if len(times) > 1 else IMAGE_TOLERANCE


def warp(H: Array, rays: Array, camera: Camera) -> Array:
    """Map rays (n, 3) of camera i by H to pixels (n, 2) of camera j; NaN behind it."""
    return camera.project(rays @ H.T * np.sign(np.linalg.det(H)))[0]


def _pixel(uv: Array) -> tuple[int, int]:
    return round(float(uv[0])), round(float(uv[1]))


def marker_trajectories(scene: Scene, row: int, measured: Sequence[PairMeasurement], dark: bool) -> tuple[Lines, Lines]:
    """Trajectories of the markers in a stance, on the marker plane: as observed, and as estimated.

    Observed: with the stated mount of each observer, in its colour. Estimated: with the calibrated mounts, the mean of
    both observers, in the mover's colour. Both from the estimated poses of the observers.
    """
    if scene.run is None or scene.team is None or not scene.layers:
        return _joined([]), _joined([])
    base, number = scene.layers[0], {robot: n for n, robot in enumerate(scene.robots)}
    colours = palette.robot_colours(len(scene.robots), dark)
    seen: dict[str, list[tuple[Array, Array]]] = {}
    estimated = []
    for one in measured:
        h = one.homography
        positions = {robot: base.xyz[number[robot], row] for robot in (h.robot_i, h.robot_j)}
        if (
            one.tracks is None
            or one.correspondences is None
            or not all(np.isfinite(p).all() for p in positions.values())
        ):
            continue
        T = {
            robot: floor_pose(positions[robot][0], positions[robot][1], base.yaw[number[robot], row])
            for robot in positions
        }
        for robot, tracks in zip((h.robot_i, h.robot_j), one.tracks, strict=True):
            if robot not in seen:
                seen[robot] = [
                    (track.times, _on_floor(scene, scene.team, row, robot, T[robot], track.uv)) for track in tracks
                ]
        team = scene.calibrated or scene.team
        movers = scene.stances[row].movers
        colour = colours[number[movers[0]]] if len(movers) == 1 else palette.ink(dark)
        found = one.correspondences
        both = [
            _on_floor(scene, team, row, robot, T[robot], uv)
            for robot, uv in ((h.robot_i, found.uv_i), (h.robot_j, found.uv_j))
        ]
        for marker in np.unique(found.markers):
            own = found.markers == marker
            estimated.append((found.times[own], (both[0][own] + both[1][own]) / 2, colour))
    return (
        _joined([(t, p, palette.faded(colours[number[r]], dark, 0.2)) for r, every in seen.items() for t, p in every]),
        _joined(estimated),
    )


def _on_floor(scene: Scene, team: Team, row: int, robot: str, T_world_body: Array, uv: Array) -> Array:
    """Pixels (n, 2) of a robot at rest as points (n, 3) [m] of the marker plane in the world; NaN above its horizon."""
    assert scene.run is not None
    one = team[robot]
    try:
        plane = stance_plane(_with_team(scene.run, team), scene.stances[row], robot)
    except DegenerateGeometry:
        return np.full((len(uv), 3), np.nan)
    T = T_world_body @ one.mount.T_body_camera
    points = on_plane(one.camera.rays(uv), plane)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _with_team(run: Run, team: Team) -> Run:
    return run if team is run.team else replace(run, team=team)


def _joined(parts: Sequence[tuple[Array, Array, palette.Colours]]) -> Lines:
    """Trajectories as segments between finite points that are consecutive in time."""
    points, colours = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3), np.uint8)]
    for times, positions, colour in parts:
        good = (
            (np.diff(times) <= max_gap(times))
            & np.isfinite(positions[:-1]).all(axis=1)
            & np.isfinite(positions[1:]).all(axis=1)
        )
        segments = np.stack([positions[:-1], positions[1:]], axis=1)[good]
        segments[..., 2] = 0.012  # on the floor, like the robots' trajectories
        points.append(segments)
        colours.append(np.broadcast_to(colour, segments.shape))
    return Lines(np.concatenate(points).astype(np.float32), np.concatenate(colours).astype(np.uint8))


def edge_report(scene: Scene, edge: int, found: Inspection | None) -> str:
    """Report on an edge as markdown; with `found`, including the pair measured again."""
    return "\n\n".join(_edge_lines(scene, edge, found))


def _edge_lines(scene: Scene, edge: int, found: Inspection | None) -> Iterator[str]:
    edges = scene.edges
    i, j = (scene.robots[int(n)] for n in (edges.i[edge], edges.j[edge]))
    yield f"### {i} - {j}, stance {scene.stances[int(edges.rows[edge])].index}"
    if edges.reason[edge]:
        yield f"**Rejected:** {edges.reason[edge]}"
    if np.isfinite(edges.sigmas[edge]):
        yield f"residual **{edges.sigmas[edge]:.2f} sigma** ({edges.of_what})"
    if found is None:
        return
    h, pose = found.measured.homography, found.measured.relative_pose
    rows = [("points", f"{h.points}"), ("inliers", f"{h.inliers}")]
    if h.unusable is None:
        rows += [
            ("point residual", f"{h.residual:.2f} sigma"),
            ("overlap in image i", f"{h.overlap_px:.0f} px"),
            (
                "clock offset, j - i",
                f"{1000 * h.time_offset:.2f} ± {1000 * h.time_offset_sigma:.2f} ms"
                if h.time_offset_sigma
                else "stated as equal",
            ),
        ]
    if pose is not None:
        rows.append(("distance", f"{np.linalg.norm(pose.T_i_j[:3, 3]):.4f} m"))
    yield _table(("pair measured again", ""), rows)
    if h.warning:
        yield f"_{h.warning}_"
    if h.unusable is None:
        yield "H, image i to image j, normalised\n\n" + _matrix(h.H_j_i)
    if found.solutions:
        yield _table(
            ("decomposition", "1", "2"),
            [
                ("error of normal", *(f"{one.normal_error_deg:.2f} deg" for one in found.solutions)),
                ("rotation", *(f"{one.rotation_deg:.2f} deg" for one in found.solutions)),
                (
                    "translation [m]",
                    *(", ".join(f"{value:.3f}" for value in one.translation) for one in found.solutions),
                ),
                ("", *("**chosen**" if one.chosen else "" for one in found.solutions)),
            ],
        )
    if h.unusable is None:
        yield "White: points, orange: outliers. Blue crosses in j: points of i mapped by H."


def robot_report(scene: Scene, number: int, row: int) -> str:
    """Report on a robot at a stance as markdown: pose, covariance, mount."""
    return "\n\n".join(_robot_lines(scene, number, row))


def _robot_lines(scene: Scene, number: int, row: int) -> Iterator[str]:
    robot = scene.robots[number]
    yield f"### Robot {robot}, stance {scene.stances[row].index if row >= 0 else '-'}"
    if row < 0 or not scene.layers or not scene.layers[0].there[number, row]:
        yield "It has no pose at this stance: it is disconnected from the reference."
        return
    for layer in (scene.layers[0], scene.other):
        if layer is not None and layer.there[number, row]:
            yield _table((layer.name, ""), _pose_rows(scene, layer, number, row))
    if scene.team is None or scene.team[robot].mount_if_any is None:
        return
    stated = scene.team[robot].mount
    found = scene.calibrated[robot].mount if scene.calibrated is not None else None
    yield _table(
        ("mount", "stated", *(("estimated",) if found else ())),
        [
            (
                name,
                *(
                    f"{getattr(one, key):.{digits}f} ± {getattr(one, sigma):.{digits}f}"
                    for one in (stated, found)
                    if one
                ),
            )
            for name, key, sigma, digits in (
                ("height [m]", "height", "height_sigma", 4),
                ("tilt [deg]", "tilt_deg", "tilt_sigma_deg", 3),
                ("roll [deg]", "roll_deg", "roll_sigma_deg", 3),
            )
        ],
    )


def _pose_rows(scene: Scene, base: Layer, number: int, row: int) -> list[tuple[str, str]]:
    x, y, z = base.xyz[number, row]
    xy, heading = base.covariance[number, row], base.yaw_sigma[number, row]
    rows = [("x, y", f"{x:.4f}, {y:.4f} m"), ("z", f"{1000 * z + 0.0:.1f} mm"),
            ("heading", f"{np.rad2deg(base.yaw[number, row]):.2f} deg")]  # fmt: skip
    if np.isfinite(xy).all():
        rows += [
            ("sigma x, y", f"{1000 * np.sqrt(xy[0, 0]):.2f}, {1000 * np.sqrt(xy[1, 1]):.2f} mm"),
            ("correlation x, y", f"{_correlation(xy):.2f}"),
            ("sigma heading", f"{np.rad2deg(heading):.3f} deg"),
        ]
    off = scene.errors(base)[number, row]
    if np.isfinite(off):
        rows.append(("error (truth known)", f"{1000 * off:.2f} mm"))
    return rows


def _correlation(C: Array) -> float:
    scale = float(np.sqrt(C[0, 0] * C[1, 1]))
    return float(C[0, 1]) / scale if scale > 0 else 0.0


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] + ["--:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _matrix(M: Array) -> str:
    rows = [[f"{value:.5f}" for value in row] for row in M]
    return "```\n" + "\n".join("  ".join(cell.rjust(9) for cell in row) for row in rows) + "\n```"
