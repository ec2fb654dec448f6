"""Eq. (2) on real images: a chessboard before two cameras, against OpenCV's stereo calibration of the same images.

    python benchmarks/stereo_board.py [--data FOLDER] [--scale 0.4] [--json]

The corners of each of the 29 pairs come in as a user's own tracks (`import_tracks`), one stance a pair, with
the board's plane from PnP in the left camera. Each pair's homography gives one relative pose by eq. (2); the
true one is what `cv2.stereoCalibrate` finds from all pairs together. `cv2.decomposeHomographyMat` on the same
corners, its solution chosen by the same normal, stands beside it. The joint estimate is made with planes as PnP knows
them, and with planes that are stated twice and six times as loosely. `--scale` reduces the images first.

Frames: (R, T) = T_right_left takes coordinates in the left camera to the right one (optical: x right, y down,
z forward). Metres; errors in degrees and in percent of |T|.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend import Method
from coloc_graph.exchange.tracks import import_tracks
from coloc_graph.frontend import FrontendOptions, PairMeasurement
from coloc_graph.geometry.lie import se3, se3_inverse, so3_log
from coloc_graph.pipeline import batch as pipeline
from coloc_graph.run import Run, open_run
from coloc_graph.team import Camera, Mount, Robot, Team, write_team

Array = NDArray[np.float64]

BOARD = (9, 6)  # inner corners
SQUARE = 0.02423  # [m]
PAIRS = 29
CAMERAS = ("left", "right")
TARGET_DEG = 0.21  # medians of eq. (2), criterion transfer, over all pairs
TARGET_PERCENT = 1.8
LOOSE = (1.0, 2.0, 6.0)  # sigmas of stated planes, in those of PnP
JOINT_DEG = 0.05  # one pose from all pairs
JOINT_PERCENT = 0.5
FIRST_SIGMA = 0.25  # [px], until the corners have said their own
DEFAULT_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "stereo_board"


@dataclass(frozen=True, eq=False)
class Stereo:
    """OpenCV's calibration: both cameras, T_right_left (4, 4) [m], its RMS [px], the corners.

    `corners` are (pairs, 2 cameras, corners, 2) [px]; `planes` (pairs, 6) are N [unit] and d [m] in the left
    camera, by PnP, and for corners of 1 px how well: normal [deg], d [m]. `plane_rms` is what PnP leaves, an axis [px].
    """

    cameras: tuple[Camera, Camera]
    T_right_left: Array
    rms: float
    corners: Array
    planes: Array
    plane_rms: float


@dataclass(frozen=True)
class Row:
    """One line of the table: errors over `pairs` relative poses, rotation [deg] and translation [% of |T|]."""

    method: str
    pairs: int
    rotation_deg_median: float
    rotation_deg_p90: float
    translation_percent_median: float
    translation_percent_p90: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 2 where the data are not there, else 0."""
    parser = argparse.ArgumentParser(description="eq. (2) on a chessboard against OpenCV's stereo calibration")
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder with left*.jpg and right*.jpg")
    parser.add_argument("--scale", type=float, default=1.0, help="factor by which images are reduced (default: 1)")
    parser.add_argument("--json", action="store_true", help="print figures as JSON instead of a table")
    options = parser.parse_args(arguments)
    if not any(options.data.glob("left*.jpg")):
        what = "has no left*.jpg" if options.data.is_dir() else "there is no such folder"
        print(f"{options.data}: {what}; give the stereo_board folder with --data", file=sys.stderr)
        return 2
    figures = benchmark(calibrate(*find_corners(options.data, options.scale)))
    print(json.dumps(figures, indent=2) if options.json else table(figures))
    return 0


def find_corners(folder: Path, scale: float = 1.0) -> tuple[Array, tuple[int, int]]:
    """Corners (pairs, 2, 54, 2) [px] of the pairs in which both cameras see the whole board; width and height."""
    found = []
    size = (0, 0)
    for left in sorted(folder.glob("left*.jpg"), key=lambda path: int(path.stem.removeprefix("left"))):
        both = []
        for path in (left, left.with_name(left.name.replace("left", "right"))):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                break
            if scale != 1:
                image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            size = (image.shape[1], image.shape[0])
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
            seen, corners = cv2.findChessboardCorners(image, BOARD, flags=flags)
            if not seen:
                break
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
            both.append(cv2.cornerSubPix(image, corners, (4, 4), (-1, -1), criteria).reshape(-1, 2))
        if len(both) == 2:
            found.append(both)
    return np.array(found, np.float64), size


def calibrate(corners: Array, size: tuple[int, int]) -> Stereo:
    """OpenCV's calibration of each camera, then of the pair with the intrinsics held, and PnP of each board."""
    board = np.zeros((BOARD[0] * BOARD[1], 3), np.float32)
    board[:, :2] = np.mgrid[0 : BOARD[0], 0 : BOARD[1]].T.reshape(-1, 2) * SQUARE
    boards = [board] * len(corners)
    images = [[pair[side].astype(np.float32) for pair in corners] for side in (0, 1)]
    K_D = [cv2.calibrateCamera(boards, seen, size, None, None)[1:3] for seen in images]
    (K1, D1), (K2, D2) = K_D
    rms, _, _, _, _, R, T, *_ = cv2.stereoCalibrate(
        boards, images[0], images[1], K1, D1, K2, D2, size, flags=cv2.CALIB_FIX_INTRINSIC
    )
    planes, left = [], []
    for seen in images[0]:
        _, turn, shift = cv2.solvePnP(board, seen, K1, D1)
        left.append(cv2.projectPoints(board, turn, shift, K1, D1)[0].reshape(-1, 2) - seen)
        N = cv2.Rodrigues(turn)[0][:, 2]
        d = float(N @ shift.ravel())
        planes.append([*(N * np.sign(d)), abs(d), *_plane_sigmas(board, turn, shift, K1, D1)])
    cameras = [
        Camera(
            width=size[0],
            height=size[1],
            fx=float(K[0, 0]),
            fy=float(K[1, 1]),
            cx=float(K[0, 2]),
            cy=float(K[1, 2]),
            distortion=tuple(D.ravel()[:5].tolist()),
        )
        for K, D in K_D
    ]
    plane_rms = float(np.sqrt(np.mean(np.square(left))))
    return Stereo((cameras[0], cameras[1]), se3(R, T.ravel()), float(rms), corners, np.array(planes), plane_rms)


def _plane_sigmas(board: Array, turn: Array, shift: Array, K: Array, D: Array) -> tuple[float, float]:
    """Standard deviations of a board's normal [deg] and distance [m] by PnP, to first order, for corners of 1 px."""
    J = cv2.projectPoints(board, turn, shift, K, D)[1][:, :6]
    covariance = np.linalg.inv(J.T @ J)

    def plane(x: Array) -> Array:
        N = cv2.Rodrigues(x[:3])[0][:, 2]
        return np.append(N, N @ x[3:])

    at = np.concatenate([turn, shift]).ravel()
    by = np.array([(plane(at + 1e-6 * e) - plane(at - 1e-6 * e)) / 2e-6 for e in np.eye(6)]).T
    C = by @ covariance @ by.T
    return float(np.rad2deg(np.sqrt(np.trace(C[:3, :3]) / 2))), float(np.sqrt(C[3, 3]))


def benchmark(stereo: Stereo) -> dict[str, object]:
    """All figures, as `--json` prints them."""
    with tempfile.TemporaryDirectory() as folder:
        run = bring_in(stereo, FIRST_SIGMA, Path(folder))
        first = solve(run, "smooth", FrontendOptions())
        assert first.noise is not None
        sigma = float(np.mean([first.noise.sigma(name)[0] for name in CAMERAS]))
        run = bring_in(stereo, sigma, Path(folder))
        chained = solve(run, "chain", FrontendOptions(criterion="transfer", pose="eq2"))
        reprojected = solve(run, "chain", FrontendOptions(pose="eq2"))
        smoothed = solve(run, "smooth", FrontendOptions())
        joint, twice, loose = (
            solve(bring_in(stereo, sigma, Path(folder), factor * stereo.plane_rms), "joint", FrontendOptions())
            for factor in LOOSE
        )
    rows = [
        _row("eq. (2), criterion transfer (the paper's)", stereo, _poses(chained)),
        _row("eq. (2), criterion reprojection", stereo, _poses(reprojected)),
        _row("most likely pose", stereo, _poses(smoothed)),
        _row("cv2.decomposeHomographyMat", stereo, opencv_poses(stereo)),
        _row("smooth: one pose fused from all", stereo, fused_pose(smoothed)[None]),
        _row("joint, planes stated twice as loosely", stereo, fused_pose(twice)[None]),
        _row("joint, planes stated six times as loosely", stereo, fused_pose(loose)[None]),
        _row("joint: one pose and all planes", stereo, fused_pose(joint)[None]),
    ]
    estimate = smoothed.estimate
    return {
        "opencv": cv2.__version__,
        "pairs": len(stereo.corners),
        "stereo_calibration_rms_px": stereo.rms,
        "baseline_m": float(np.linalg.norm(stereo.T_right_left[:3, 3])),
        "corner_sigma_px": sigma,
        "chi2_per_dof_transfer": chi2_per_dof(chained.measurements),
        "chi2_per_dof_reprojection": chi2_per_dof(smoothed.measurements),
        "fused_chi2_per_dof": estimate.chi2 / estimate.dof,
        "joint_chi2_per_dof": joint.estimate.chi2 / joint.estimate.dof,
        "joint_sigmas": [_sigmas(stereo, one) for one in (joint, twice, loose)],
        "joint_target_met": rows[-1].rotation_deg_median <= JOINT_DEG
        and rows[-1].translation_percent_median <= JOINT_PERCENT,
        "rows": [asdict(row) for row in rows],
        "target_met": rows[0].pairs >= PAIRS
        and rows[0].rotation_deg_median <= TARGET_DEG
        and rows[0].translation_percent_median <= TARGET_PERCENT,
    }


def bring_in(stereo: Stereo, sigma: float, folder: Path, bias: float | None = None) -> Run:
    """The corners as a user would bring them: TEAM.toml and three CSVs in `folder`, one stance a pair.

    With a `bias` [px], what PnP leaves of the corners, planes have the tolerance that PnP has with it.
    """
    robots = [
        Robot(name=name, camera_if_any=camera, mount_if_any=Mount(height=0.0))
        for name, camera in zip(CAMERAS, stereo.cameras, strict=True)
    ]
    write_team(Team(reference=CAMERAS[0], robots=tuple(robots)), folder / "TEAM.toml")
    tracks, planes = (
        ["stance,time,robot,marker,u,v,sigma"],
        ["stance,robot,nx,ny,nz,d" + (",normal_sigma_deg,d_sigma" if bias is not None else "")],
    )
    for stance, (pair, plane) in enumerate(zip(stereo.corners.tolist(), stereo.planes.tolist(), strict=True)):
        *plane, turn, d = plane
        off = np.hypot(sigma, bias or 0.0)
        numbers = plane if bias is None else [*plane, float(off * turn), float(off * d)]
        planes.append(f"{stance},{CAMERAS[0]}," + ",".join(map(repr, numbers)))
        tracks += [
            f"{stance},{stance},{name},corner{index},{u!r},{v!r},{sigma!r}"
            for name, corners in zip(CAMERAS, pair, strict=True)
            for index, (u, v) in enumerate(corners)
        ]
    (folder / "TRACKS.csv").write_text("\n".join(tracks), encoding="utf-8")
    (folder / "PLANES.csv").write_text("\n".join(planes), encoding="utf-8")
    (folder / "MOVES.csv").write_text("stance,robot\n", encoding="utf-8")  # the cameras never moved
    import_tracks(
        folder / "TEAM.toml",
        folder / "TRACKS.csv",
        folder / "RUN.mcap",
        planes_path=folder / "PLANES.csv",
        moves_path=folder / "MOVES.csv",
    )
    return open_run(folder / "RUN.mcap")


def solve(run: Run, method: Method, options: FrontendOptions) -> pipeline.Solution:
    """The whole road, with one front end."""
    return pipeline.solve(run, pipeline.SolveOptions(method, options))


def chi2_per_dof(measurements: Sequence[PairMeasurement]) -> float:
    """Of the corners about all homographies, each corner in units of its sigma; 1 where the sigma is right."""
    used = [m.homography for m in measurements if m.homography.unusable is None]
    return float(sum(one.chi2 for one in used) / sum(one.dof for one in used))


def _poses(solution: pipeline.Solution) -> Array:
    """T_right_left (n, 4, 4) of each pair by eq. (2)."""
    found = [m.relative_pose.T_ci_cj for m in solution.measurements if m.relative_pose is not None]
    return se3_inverse(np.array(found))


def _sigmas(stereo: Stereo, solution: pipeline.Solution) -> float:
    """Distance of the pose of the right camera from the true one, in its own standard deviations: root of NEES."""
    left, right = (solution.run.team[name].mount.T_body_camera for name in CAMERAS)
    T_true = left @ se3_inverse(stereo.T_right_left) @ se3_inverse(right)
    off = se3_inverse(solution.estimate.pose(CAMERAS[1], 0).matrix()) @ T_true
    xi = np.concatenate([so3_log(off[:3, :3]), off[:3, 3]])
    return float(np.sqrt(xi @ np.linalg.solve(solution.estimate.covariance(CAMERAS[1], 0), xi) / 6))


def fused_pose(solution: pipeline.Solution) -> Array:
    """T_right_left (4, 4) of the pose graph: one pose from all pairs, since both cameras stayed put."""
    left, right = (solution.run.team[name].mount.T_body_camera for name in CAMERAS)
    T_left_right = se3_inverse(left) @ solution.estimate.pose(CAMERAS[1], 0).matrix() @ right
    return se3_inverse(T_left_right)


def opencv_poses(stereo: Stereo) -> Array:
    """T_right_left (n, 4, 4) by OpenCV: least-squares homography, the solution whose normal is the nearest."""
    poses = []
    for (left, right), (*normal, d) in zip(stereo.corners, stereo.planes[:, :4], strict=True):
        x_left, x_right = stereo.cameras[0].normalise(left), stereo.cameras[1].normalise(right)
        H, _ = cv2.findHomography(x_left, x_right, 0)
        _, Rs, Ts, Ns = cv2.decomposeHomographyMat(H, np.eye(3))
        nearest = int(np.argmax([np.ravel(N) @ np.array(normal) for N in Ns]))
        poses.append(se3(Rs[nearest], d * np.ravel(Ts[nearest])))
    return np.array(poses)


def _row(method: str, stereo: Stereo, T_right_left: Array) -> Row:
    true = stereo.T_right_left
    turned = so3_log(np.swapaxes(T_right_left[:, :3, :3], 1, 2) @ true[:3, :3])
    degrees = np.rad2deg(np.linalg.norm(turned, axis=1))
    percent = 100 * np.linalg.norm(T_right_left[:, :3, 3] - true[:3, 3], axis=1) / np.linalg.norm(true[:3, 3])
    return Row(
        method,
        len(T_right_left),
        *(float(value) for error in (degrees, percent) for value in (np.median(error), np.percentile(error, 90))),
    )


def table(figures: dict[str, object]) -> str:
    """The figures for people."""
    lines = [
        f"{figures['pairs']} pairs, OpenCV {figures['opencv']}, stereo calibration "
        f"{figures['stereo_calibration_rms_px']:.3f} px RMS, |T| {figures['baseline_m']:.4f} m",
        f"corner noise as measured: {figures['corner_sigma_px']:.3f} px an axis; with it chi2/dof is "
        f"{figures['chi2_per_dof_reprojection']:.2f} (reprojection), {figures['chi2_per_dof_transfer']:.2f} (transfer)",
        "",
        "T_right_left (takes left camera to right), error against cv2.stereoCalibrate",
        f"{'':44}{'rotation [deg]':>18}{'|dT|/|T| [%]':>18}",
        f"{'':38}{'pairs':>6}{'median':>9}{'p90':>9}{'median':>9}{'p90':>9}",
    ]
    rows = figures["rows"]
    assert isinstance(rows, list)
    for row in rows:
        numbers = [
            row[f"{what}_{which}"] for what in ("rotation_deg", "translation_percent") for which in ("median", "p90")
        ]
        lines.append(f"{row['method']:<42}{row['pairs']:>2}" + "".join(f"{number:9.3f}" for number in numbers))
    lines += [
        "",
        f"chi2/dof of smooth is {figures['fused_chi2_per_dof']:.1f} (noise alone, exact planes), of joint "
        f"{figures['joint_chi2_per_dof']:.2f} (with what lenses leave)",
        "joint's errors in its own standard deviations: " + ", ".join(f"{one:.2f}" for one in figures["joint_sigmas"]),  # type: ignore[attr-defined]
        f"target for joint, {JOINT_DEG} deg and {JOINT_PERCENT} %: "
        f"{'met' if figures['joint_target_met'] else 'NOT met'}",
        f"target for the first row, {PAIRS} pairs, medians {TARGET_DEG} deg and {TARGET_PERCENT} %: "
        f"{'met' if figures['target_met'] else 'NOT met'}",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
