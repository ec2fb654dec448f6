"""Calibrate cameras and mounts by images of a board: consistency of the sigmas, and comparison with OpenCV alone.

    python benchmarks/calibration.py [--data FOLDER] [--splits N] [--sets N] [--json]

With FOLDER (left*.jpg and right*.jpg, a board of 9x6 inner corners, squares of 24.23 mm): reprojection RMS on the same
corners against `cv2.calibrateCamera`, and against OpenCV's usual corners (`cornerSubPix` in a window of 11 px). The
images are split into halves again and again; the difference of the two halves' parameters over the sigmas that the
halves state is 1 (RMS) where these are true.

Then simulated boards: cameras whose corners share errors, with the same ratio against the truth, and mounts from boards
on the floor, with NEES and chi2 per degree of freedom.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from coloc_graph.calibration import View, Views, calibrate_camera, calibrate_mount, find_boards, image_paths, make_board
from coloc_graph.calibration.camera import CameraCalibration
from coloc_graph.calibration.corners import read_image
from coloc_graph.simulation.boards import floor_poses, held_poses, seen_corners
from coloc_graph.team import Camera, Floor, Mount

Array = NDArray[np.float64]

BOARD = make_board("9x6", 0.02423)
LENS = 4  # coefficients, so that all compare the same
DEFAULT_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data" / "stereo_board"
CAMERA = Camera(width=640, height=480, fx=480.0, fy=482.0, cx=322.0, cy=236.0, distortion=(-0.12, 0.05, 5e-4, -8e-4))
#: How well a camera that takes part in a mount's calibration is known: fx, fy, cx, cy [px], k1, k2, p1, p2.
KNOWN = np.diag(np.array([0.8, 0.8, 1.0, 1.0, 0.003, 0.006, 5e-4, 5e-4]) ** 2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 2 where `--data` holds no such images, 1 where a target is missed, else 0."""
    parser = argparse.ArgumentParser(description="calibration of cameras and mounts against OpenCV and the truth")
    parser.add_argument("--data", type=Path, default=DEFAULT_DATA, help="folder with left*.jpg and right*.jpg")
    parser.add_argument("--splits", type=int, default=60, help="into halves (60)")
    parser.add_argument("--sets", type=int, default=400, help="simulated mounts (400); a tenth of that are cameras")
    parser.add_argument("--json", action="store_true", help="print figures as JSON instead of a table")
    options = parser.parse_args(arguments)
    figures: dict[str, Any] = {"opencv": cv2.__version__, "real": {}}
    for side in ("left", "right"):
        paths = [path for path in image_paths([options.data]) if path.name.startswith(side)] if _there(options) else []
        if paths:
            figures["real"][side] = real(paths, options.splits)
    figures["cameras"] = cameras(max(options.sets // 10, 5))
    figures["mounts"] = [mounts(options.sets, images, floor) for images, floor in ((1, 0.0), (5, 0.0), (10, 0.1))]
    print(json.dumps(figures, indent=2) if options.json else table(figures))
    if not figures["real"]:
        print(f"{options.data}: no left*.jpg; give the folder of the board's images with --data", file=sys.stderr)
        return 2
    met = all(one["rms"] <= one["opencv_rms_same_corners"] * (1 + 1e-9) for one in figures["real"].values())
    return 0 if met else 1


def _there(options: argparse.Namespace) -> bool:
    return options.data.is_dir() and any(options.data.glob("*.jpg"))


def real(paths: list[Path], splits: int) -> dict[str, Any]:
    """RMS against OpenCV on the same corners and on its usual ones; halves against what they state."""
    seen, _ = find_boards(paths, BOARD)
    ours = calibrate_camera(seen, BOARD, LENS)
    opencv = opencv_rms(seen)
    usual = [opencv_rms(opencv_corners(paths, window)) for window in (5, 11)]
    ratios, independent = halves(seen, splits)
    return {
        "images": len(paths),
        "rms": ours.bundle.rms,
        "opencv_rms_same_corners": opencv[1],
        "opencv_rms_same_corners_as_it_states": opencv[0],
        "opencv_rms_window_5": usual[0][1],
        "opencv_rms_window_11": usual[1][1],
        "parameters": list(ours.names),
        "values": ours.bundle.intrinsics.tolist(),
        "sigmas": ours.sigmas.tolist(),
        "opencv_sigmas": opencv[2].tolist(),
        "halves_over_sigmas": ratios.tolist(),
        "halves_over_opencv_sigmas": independent.tolist(),
    }


def opencv_rms(seen: Views) -> tuple[float, float, Array]:
    """OpenCV's calibration: the RMS it states, that of its parameters in double precision [px], and its sigmas."""
    points: list[Any] = [view.points.astype(np.float32) for view in seen.views]
    corners: list[Any] = [view.uv.astype(np.float32)[:, None] for view in seen.views]
    guess: Any = None
    stated, K, lens, rotations, translations, sigmas, *_ = cv2.calibrateCameraExtended(
        points, corners, (seen.width, seen.height), guess, guess, flags=cv2.CALIB_FIX_K3
    )
    off = [
        view.uv - cv2.projectPoints(view.points, r, t, K, lens)[0][:, 0]
        for view, r, t in zip(seen.views, rotations, translations, strict=True)
    ]
    squares = np.concatenate(off) ** 2
    return float(stated), float(np.sqrt(squares.sum() / len(squares))), np.asarray(sigmas).ravel()[: 4 + LENS]


def opencv_corners(paths: list[Path], window: int) -> Views:
    """The board's corners as OpenCV's examples find them."""
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    views = []
    for path in paths:
        image = read_image(path)
        found, corners = cv2.findChessboardCorners(image, BOARD.grid)
        if found:
            corners = cv2.cornerSubPix(image, corners, (window, window), (-1, -1), until)
            views.append(View(str(path), BOARD.points, np.asarray(corners, float).reshape(-1, 2)))
    height, width = image.shape
    return Views(width, height, tuple(views))


def halves(seen: Views, splits: int) -> tuple[Array, Array]:
    """RMS over splits (p,) of the halves' difference over the sigmas they state, ours and of independent corners."""
    rng = np.random.default_rng(0)
    ours, independent = [], []
    for _ in range(splits):
        order = rng.permutation(len(seen.views))
        a, b = (_of(seen, part) for part in np.array_split(order, 2))
        apart = a.bundle.intrinsics - b.bundle.intrinsics
        ours.append(apart / np.hypot(a.sigmas, b.sigmas))
        independent.append(apart / np.sqrt(np.diag(a.independent_covariance + b.independent_covariance)))
    return _rms(ours), _rms(independent)


def _of(seen: Views, which: NDArray[np.int64]) -> CameraCalibration:
    return calibrate_camera(Views(seen.width, seen.height, tuple(seen.views[i] for i in which)), BOARD, LENS)


def _rms(values: list[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def cameras(sets: int) -> list[dict[str, Any]]:
    """Errors of the parameters over their sigmas, RMS over simulated sets of 20 images: ours and OpenCV's."""
    out = []
    for name, bend in (("corners alone", 0.0), ("a board bent by 0.2 mm in each image", 2e-4)):
        rng = np.random.default_rng(1)
        truth = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.distortion])
        ours, independent = [], []
        for _ in range(sets):
            seen = seen_corners(rng, CAMERA, BOARD, held_poses(rng, CAMERA, BOARD, 20), 0.1, bend)
            found = calibrate_camera(seen, BOARD, LENS)
            off = found.bundle.intrinsics - truth
            ours.append(off / found.sigmas)
            independent.append(off / np.sqrt(np.diag(found.independent_covariance)))
        out.append({
            "what": name,
            "sets": sets,
            "errors_over_sigmas": _rms(ours).tolist(),
            "errors_over_independent_sigmas": _rms(independent).tolist(),
        })  # fmt: skip
    return out


def mounts(sets: int, images: int, floor_deg: float) -> dict[str, Any]:
    """NEES and chi2 per degree of freedom over simulated mounts, with a camera that is known as `KNOWN` says."""
    rng = np.random.default_rng(2)
    nees, chi2, dof, rejected = [], 0.0, 0, 0
    floor = Floor(tilt_sigma_deg=floor_deg, height_sigma=0.005 * floor_deg) if floor_deg else None
    for _ in range(sets):
        mount = Mount(height=rng.uniform(0.35, 0.45), tilt_deg=rng.uniform(15, 30), roll_deg=rng.normal(scale=2.0))
        off = rng.multivariate_normal(np.zeros(8), KNOWN)
        stated = replace(
            CAMERA,
            fx=CAMERA.fx + off[0],
            fy=CAMERA.fy + off[1],
            cx=CAMERA.cx + off[2],
            cy=CAMERA.cy + off[3],
            distortion=tuple((np.array(CAMERA.distortion) + off[4:]).tolist()),
        )
        seen = seen_corners(rng, CAMERA, BOARD, floor_poses(rng, CAMERA, mount, BOARD, images, floor), 0.1)
        found = calibrate_mount(
            seen.views, stated, Mount(height=0.4), BOARD.square, floor=floor, intrinsics_covariance=KNOWN
        )
        error = np.array([
            found.mount.height - mount.height,
            *np.deg2rad([found.mount.tilt_deg - mount.tilt_deg, found.mount.roll_deg - mount.roll_deg]),
        ])  # fmt: skip
        nees.append(error @ np.linalg.solve(found.covariance, error) / 3)
        chi2, dof, rejected = chi2 + found.chi2, dof + found.dof, rejected + len(found.rejected)
    return {
        "sets": sets,
        "images": images,
        "floor_deg": floor_deg,
        "nees": float(np.mean(nees)),
        "nees_95": float(1.96 * np.std(nees) / np.sqrt(sets)),
        "chi2_per_dof": chi2 / dof if dof else None,
        "rejected": rejected,
    }


def table(figures: dict[str, Any]) -> str:
    """The figures for people."""
    lines = [f"OpenCV {figures['opencv']}"]
    for side, one in figures["real"].items():
        lines += [
            "",
            f"{side}: {one['images']} images, {LENS} lens coefficients, reprojection RMS [px]",
            f"  ours {one['rms']:.6f}; OpenCV on the same corners {one['opencv_rms_same_corners']:.6f} (it states "
            f"{one['opencv_rms_same_corners_as_it_states']:.6f}, the board in single precision)",
            f"  OpenCV on its own corners: window of 5 px {one['opencv_rms_window_5']:.4f}, of 11 px "
            f"{one['opencv_rms_window_11']:.4f}",
            f"  {'':34}" + "".join(f"{name:>9}" for name in one["parameters"]),
        ]
        for name, key in (
            ("value", "values"),
            ("sigma", "sigmas"),
            ("OpenCV's sigma", "opencv_sigmas"),
            ("halves' difference / sigma", "halves_over_sigmas"),
            ("... / sigma as OpenCV has it", "halves_over_opencv_sigmas"),
        ):
            digits = [2] * 8 if "/" in name else [2] * 4 + [4] * 4
            lines.append(f"  {name:34}" + "".join(f"{x:9.{d}f}" for x, d in zip(one[key], digits, strict=True)))
    lines += ["", "simulated cameras, 20 images: error / sigma, RMS (1 is true)"]
    for one in figures["cameras"]:
        for name, key in (("ours", "errors_over_sigmas"), ("as OpenCV", "errors_over_independent_sigmas")):
            lines.append(
                f"  {one['what'] + ', ' + name:48}" + "".join(f"{x:7.2f}" for x in one[key]) + f"  ({one['sets']} sets)"
            )
    lines += ["", "simulated mounts, the camera known to about 1 px"]
    for one in figures["mounts"]:
        agreement = "" if one["chi2_per_dof"] is None else f", chi2/dof {one['chi2_per_dof']:.3f}"
        lines.append(
            f"  {one['images']} images, floor {one['floor_deg']} deg: NEES {one['nees']:.3f} +- {one['nees_95']:.3f}"
            f"{agreement}, {one['rejected']} images rejected of {one['images'] * one['sets']}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
