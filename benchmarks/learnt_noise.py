"""Noise of marker centres as it is learnt, on real LEDs and on images of another renderer.

    python benchmarks/learnt_noise.py [--grid FOLDER] [--chain FOLDER] [--json]

The grid: real images of a flat grid of 7 x 5 LEDs by a fisheye camera (Kannala-Brandt), places of the LEDs free. The
noise is learnt from half of the images and judged on the other half, both ways: chi2 per degree of freedom, for each
image and for saturated and other spots apart. Once it is predicted before an image is seen; and once every other LED of
an image tells how much this image scatters, as the fit of a stance does, and the rest is judged. Centres of mass and
`cv2.SimpleBlobDetector` stand beside the detector.

The chain: three path-traced stances with truth, as they are and made worse. The noise is learnt from two stances by
their homographies, which know no truth, and the detector is judged against truth on the third: NEES per degree of
freedom, of all its detections, and of those that are points of a homography. The pose NEES is of the whole run.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from coloc_graph.frontend import detect_leds
from coloc_graph.frontend.homography.noise_components import NoiseEvidence, learn_components
from coloc_graph.frontend.homography.scatter import learn_spread, variance_factor
from coloc_graph.frontend.learnt_noise import NoiseBelief
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import Flag, Image, Motion, RunWriter, Stance, open_run
from coloc_graph.team import Camera, CentreNoise, Floor, Markers, Mount, Robot, Team

Array = NDArray[np.float64]

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
COLUMNS, ROWS = 7, 5
BOARD = np.array([[x, y, 0.0] for y in range(ROWS) for x in range(COLUMNS)])
WEAK_PRIOR = 0.2  # residuals in pixels per spacing that keep the grid's places from drifting (gauge)
SAME = 0.3  # px, within which a point of a homography is a detection
MATCH = 2.0  # px, within which a detection is of a marker


@dataclass(frozen=True, eq=False)
class Spots:
    """Centres of the grid's LEDs in n images, (n, 35, 2) [px], their covariances, and which are saturated (n, 35)."""

    uv: Array
    covariance: Array
    saturated: NDArray[np.bool_]

    def __getitem__(self, which: NDArray[np.int64]) -> "Spots":
        return Spots(self.uv[which], self.covariance[which], self.saturated[which])


def ours(image: NDArray[np.uint8]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Detect LEDs by the project's detector."""
    blobs = detect_leds(image)
    return blobs.uv, blobs.covariance, (blobs.flags & Flag.SATURATED) != 0


def centres_of_mass(image: NDArray[np.uint8]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Detect LEDs as centres of mass above a threshold."""
    _, _, stats, _ = cv2.connectedComponentsWithStats((image > 80).astype(np.uint8), connectivity=8)
    uv = []
    for x, y, w, h, _area in stats[1:]:
        light = np.maximum(image[y - 2 : y + h + 2, x - 2 : x + w + 2].astype(float) - np.median(image), 0)
        down, across = np.mgrid[y - 2 : y + h + 2, x - 2 : x + w + 2]
        uv.append([(light * across).sum() / light.sum(), (light * down).sum() / light.sum()])
    return np.array(uv), np.tile(1e-4 * np.eye(2), (len(uv), 1, 1)), np.zeros(len(uv), bool)


def simple_blobs(image: NDArray[np.uint8]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Detect LEDs by OpenCV's blob detector."""
    p = cv2.SimpleBlobDetector_Params()
    p.blobColor, p.minArea, p.maxArea = 255, 4, 400
    p.filterByCircularity = p.filterByConvexity = p.filterByInertia = False
    p.minThreshold, p.maxThreshold, p.thresholdStep, p.minDistBetweenBlobs = 40, 220, 10, 3
    uv = np.array([one.pt for one in cv2.SimpleBlobDetector_create(p).detect(image)])
    return uv, np.tile(1e-4 * np.eye(2), (len(uv), 1, 1)), np.zeros(len(uv), bool)


def grid_spots(folder: Path, detector: Callable[[NDArray[np.uint8]], tuple[Array, Array, NDArray[np.bool_]]]) -> Spots:
    """Detect the grid in all images that show it whole."""
    views = []
    for path in sorted(folder.glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found = detector(np.asarray(image, np.uint8))
        order = _order(found[0]) if len(found[0]) == len(BOARD) else None
        if order is None:
            print(f"{path.name}: {len(found[0])} spots are no grid of {len(BOARD)}", file=sys.stderr)
            continue
        views.append([column[order] for column in found])
    return Spots(*(np.array(column) for column in zip(*views, strict=True)))


def _order(uv: Array) -> NDArray[np.int64] | None:
    """Indices (35,) of spots in the grid's order, row by row; None if they are no grid."""
    hull = cv2.convexHull(uv.astype(np.float32)).reshape(-1, 2)
    box = cv2.boxPoints(cv2.minAreaRect(uv.astype(np.float32)))
    corners = np.array([hull[np.argmin(np.linalg.norm(hull - corner, axis=1))] for corner in box])
    ends = np.array([[0, 0], [COLUMNS - 1, 0], [COLUMNS - 1, ROWS - 1], [0, ROWS - 1]], np.float32)
    best: tuple[tuple[bool, bool, float], NDArray[np.int64]] | None = None
    for turn in range(8):
        four = np.roll(corners if turn < 4 else corners[::-1], turn, axis=0)
        H, _ = cv2.findHomography(four, ends)
        at = cv2.perspectiveTransform(uv.reshape(-1, 1, 2), H).reshape(-1, 2)
        place = np.rint(at).astype(int)
        index = place[:, 1] * COLUMNS + place[:, 0]
        if sorted(index.tolist()) != list(range(len(BOARD))) or place.min() < 0 or place[:, 0].max() >= COLUMNS:
            continue
        right = uv[place[:, 0] == COLUMNS - 1].mean(0) - uv[place[:, 0] == 0].mean(0)
        down = uv[place[:, 1] == ROWS - 1].mean(0) - uv[place[:, 1] == 0].mean(0)
        key = bool(right[0] * down[1] < right[1] * down[0]), bool(right[0] < 0), float(np.abs(at - place).max())
        if best is None or key < best[0]:
            best = key, np.argsort(index)
    return None if best is None else best[1]


def fit_grid(uv: Array) -> tuple[Array, Array]:
    """Fit lens, poses and places: residuals (n, 35, 2) [px], and an orthonormal basis of what the fit can explain."""
    n = len(uv)
    centre = np.array([480.0, 300.0])
    poses = []
    for view in uv:
        rays = (view - centre) / 300.0
        r = np.linalg.norm(rays, axis=1)
        rays = rays * (np.tan(np.minimum(r, 1.3)) / np.maximum(r, 1e-9))[:, None]
        _, turn, shift = cv2.solvePnP(BOARD, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        poses.append(np.concatenate([turn, shift]).ravel())

    def residuals(p: Array) -> Array:
        pose, places = p[8 : 8 + 6 * n].reshape(n, 6), BOARD + p[8 + 6 * n :].reshape(-1, 3)
        R = np.array([cv2.Rodrigues(one[:3])[0] for one in pose])
        x, y, z = np.moveaxis(places @ R.mT + pose[:, None, 3:], -1, 0)
        r = np.hypot(x, y)
        angle = np.arctan2(r, z)
        square = angle**2
        bent = angle * (1 + square * (p[4] + square * (p[5] + square * (p[6] + square * p[7]))))
        seen = np.stack([x * bent / r * p[0] + p[2], y * bent / r * p[1] + p[3]], axis=-1)
        return np.concatenate([(seen - uv).ravel(), WEAK_PRIOR * p[8 + 6 * n :]])

    start = np.concatenate([[300, 300, *centre, 0, 0, 0, 0], np.ravel(poses), np.zeros(3 * len(BOARD))])
    found = least_squares(residuals, start, loss="soft_l1", max_nfev=60, x_scale="jac")
    found = least_squares(residuals, found.x, max_nfev=60, x_scale="jac")
    J = found.jac[: uv.size]
    U, size, _ = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-12), full_matrices=False)
    return found.fun[: uv.size].reshape(uv.shape), U[:, size > 1e-7 * size[0]]


def grid_evidence(spots: Spots) -> NoiseEvidence:
    """Make the evidence of all images together."""
    r, basis = fit_grid(spots.uv)
    each = np.tile(np.eye(2), (r.size // 2, 1, 1))
    images = np.repeat(np.arange(len(spots.uv)), len(BOARD))
    saturated = spots.saturated.ravel()[:, None, None]
    parts = [spots.covariance.reshape(-1, 2, 2), ~saturated * each, saturated * each]
    return NoiseEvidence(
        r.reshape(-1, 2), basis.reshape(-1, 2, basis.shape[1]), np.array(parts), np.arange(3), 1.0, images
    )


def judge(evidence: NoiseEvidence, logs: Array) -> tuple[Array, Array]:
    """Return chi2 (n,) of each spot with the noise of some variances, and its degrees of freedom (n,)."""
    C = np.tensordot(np.exp(logs), evidence.parts, axes=1)
    inverse = np.linalg.inv(C)
    weighted = inverse @ evidence.design
    normal = np.linalg.inv(np.einsum("nap,naq->pq", evidence.design, weighted))
    h = normal @ np.einsum("nap,na->p", weighted, evidence.residual)
    left = evidence.residual - evidence.design @ h
    used = np.einsum("nap,pq,naq->n", weighted, normal, evidence.design)
    return np.einsum("na,nab,nb->n", left, inverse, left), 2 - used


def grid_figures(folder: Path) -> dict[str, object]:
    """All figures of the grid."""
    spots = grid_spots(folder, ours)
    n = len(spots.uv)
    halves = np.arange(0, n, 2), np.arange(1, n, 2)
    means, sigmas = CentreNoise().logs
    chi2, dof, stated, adapted = np.zeros((n, 35)), np.zeros((n, 35)), np.zeros(2), np.zeros((n, 35))
    learnt = []
    spreads = []
    evidence = [grid_evidence(spots[half]) for half in halves]
    for one, other, judged in ((0, 1, halves[1]), (1, 0, halves[0])):
        logs, covariance = learn_components([evidence[one]], np.array(means), np.diag(np.square(sigmas)))
        # expected variances, larger than the medians by what is uncertain of them
        expected = logs + covariance.diagonal() / 2
        own = [column.reshape(-1, 35).sum(axis=1) for column in judge(evidence[one], expected)]
        spread, factor = learn_spread(*own, max(sigmas) ** 2, CentreNoise().spread, CentreNoise().spread_factor)
        learnt.append(CentreNoise.of_logs(logs.tolist(), np.sqrt(covariance.diagonal()).tolist(), spread, factor))
        logs = expected
        found = judge(evidence[other], logs)
        chi2[judged], dof[judged] = (column.reshape(-1, 35) for column in found)
        spreads.append(spread * np.exp(np.log(factor) ** 2))
        for image in judged:
            for half in (0, 1):
                seen = slice(half, None, 2)
                rest = slice(1 - half, None, 2)
                scale = variance_factor(float(chi2[image, seen].sum()), float(dof[image, seen].sum()), spreads[-1])
                adapted[image, rest] = chi2[image, rest] / scale
        stated += [column.sum() for column in judge(evidence[other], np.array([0.0, -30.0, -30.0]))]
    saturated = spots.saturated
    scatter = {}
    for name, detector in (("ours", ours), ("centre of mass", centres_of_mass), ("SimpleBlobDetector", simple_blobs)):
        r, basis = fit_grid(grid_spots(folder, detector).uv)
        scatter[name] = float(np.sqrt((r**2).sum() / (r.size - basis.shape[1])))
    return {
        "images": n,
        "chi2_per_dof_stated": float(stated[0] / stated[1]),
        "chi2_per_dof": float(chi2.sum() / dof.sum()),
        "saturated": float(chi2[saturated].sum() / dof[saturated].sum()),
        "unsaturated": float(chi2[~saturated].sum() / dof[~saturated].sum()),
        "by_image": (chi2.sum(1) / dof.sum(1)).tolist(),
        "spread": spreads,
        "adapted": float(adapted.sum() / dof.sum()),
        "adapted_saturated": float(adapted[saturated].sum() / dof[saturated].sum()),
        "adapted_unsaturated": float(adapted[~saturated].sum() / dof[~saturated].sum()),
        "adapted_by_image": (adapted.sum(1) / dof.sum(1)).tolist(),
        "floor_px": [one.floor_px for one in learnt],
        "saturated_px": [one.saturated_px for one in learnt],
        "scatter_px": scatter,
    }


Pixels = NDArray[np.uint8]


def variants(noise: float) -> dict[str, tuple[Callable[[Pixels], Pixels], float]]:
    """Return how images are made worse, and their scale; `noise` is the images' own [grey levels]."""
    rng = np.random.default_rng(0)
    more = np.sqrt(8.0) * noise  # three times in all

    def bytes_(image: Array) -> Pixels:
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    return {
        "as it is": (lambda im: im, 1.0),
        "gamma 2.2": (lambda im: bytes_(255 * (im / 255.0) ** (1 / 2.2)), 1.0),
        "half resolution": (
            lambda im: np.asarray(cv2.resize(im, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8),
            0.5,
        ),
        "three times the noise": (lambda im: bytes_(im + rng.normal(0, more, im.shape)), 1.0),
        "binary": (lambda im: np.where(im > 100, 255, 0).astype(np.uint8), 1.0),
    }


def chain_figures(folder: Path) -> list[dict[str, object]]:
    """All figures of the chain, a row a variant."""
    truth = json.loads((folder / "truth.json").read_text())
    first = [_image(folder, 0, "A", i).astype(float) for i in range(6)]
    noise = float(np.median(np.abs(np.diff(first, axis=0)))) / 0.6745 / np.sqrt(2)
    rows = []
    for name, (change, scale) in variants(noise).items():
        images = {
            (k, robot): [change(_image(folder, k, robot, i)) for i in range(len(stance["frames"]))]
            for k, stance in enumerate(truth["stances"])
            for robot in stance["observers"]
        }
        rows.append({"images": name, **_variant(truth, images, scale)})
    return rows


def _image(folder: Path, stance: int, robot: str, number: int) -> Pixels:
    image = cv2.imread(str(folder / f"{stance:02d}" / robot / f"{number:04d}.png"), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, np.uint8)


def _variant(truth: dict[str, Any], images: dict[tuple[int, str], list[Pixels]], scale: float) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        _write(path, truth, images, scale)
        run = open_run(path)
        solution = solve(run, SolveOptions())
        assessed = assess(solution)
    accuracy = None if assessed is None else assessed[0]
    prior, team = NoiseBelief.of(run.team), run.team
    chi2, dof, stated, error, chi2_used, dof_used = 0.0, 0, 0.0, 0.0, 0.0, 0
    for k, stance in enumerate(truth["stances"]):
        others = [one for one in solution.measurements if one.homography.stance != k]
        used = prior.updated(others).used(team)
        found = next(one.correspondences for one in solution.measurements if one.homography.stance == k)
        assert found is not None
        points = dict(zip(stance["observers"], (found.uv_i, found.uv_j), strict=True))
        for robot in stance["observers"]:
            for frame, image in zip(stance["frames"], images[k, robot], strict=True):
                blobs = detect_leds(image)
                blobs = blobs[(blobs.flags & (Flag.CLIPPED | Flag.MERGED)) == 0]
                for uv in frame["uv"][robot] if len(blobs) else []:
                    off = blobs.uv - ((np.array(uv) + 0.5) * scale - 0.5)
                    nearest = int(np.argmin(np.linalg.norm(off, axis=1)))
                    if np.linalg.norm(off[nearest]) > MATCH:
                        continue
                    saturated = bool(blobs.flags[nearest] & Flag.SATURATED)
                    own = blobs.covariance[nearest][None]
                    C = used[robot].camera.centre_covariance(own, np.array([[1.0 - saturated, saturated]]))
                    e = off[nearest]
                    squared = float(e @ np.linalg.solve(C[0], e))
                    if np.linalg.norm(points[robot] - blobs.uv[nearest], axis=1).min() < SAME:
                        chi2_used, dof_used = chi2_used + squared, dof_used + 2
                    chi2 += squared
                    stated += float(e @ np.linalg.solve(own[0], e))
                    error += float(e @ e)
                    dof += 2
    return {
        "points": dof // 2,
        "rms_px": float(np.sqrt(error / dof)),
        "nees_stated": stated / dof,
        "nees_learnt": chi2 / dof,
        "pose_nees": None if accuracy is None else accuracy.anees,
        "pose_nees_by_robot": None if accuracy is None else [asdict(row.nees) for row in accuracy.robots if row.nees],
        "nees_used": chi2_used / dof_used,
        "used": solution.count.used,
        "chi2_per_dof": solution.estimate.chi2 / max(solution.estimate.dof, 1),
        "warnings": list(solution.warnings),
    }


def _write(path: Path, truth: dict[str, Any], images: dict[tuple[int, str], list[Pixels]], scale: float) -> None:
    """Write a run of the chain with its truth: the team as a user would state it."""
    height, width = next(iter(images.values()))[0].shape
    f, half = truth["K"][0][0] * scale, (scale - 1) / 2
    cx, cy = (truth["K"][n][2] * scale + half for n in (0, 1))
    camera = Camera(width=width, height=height, fx=f, fy=f, cx=cx, cy=cy, fps=10.0)
    mount = Mount(height=truth["nominal"]["height"], tilt_deg=truth["nominal"]["tilt_deg"], height_sigma=0.003,
                  tilt_sigma_deg=0.5, roll_sigma_deg=0.5)  # fmt: skip
    markers = Markers(height=truth["marker_height"], positions=((0.0, truth["span"] / 2), (0.0, -truth["span"] / 2)))
    robots = [Robot(name=name, camera_if_any=camera, mount_if_any=mount) for name in ("A", "B")]
    team = Team(reference="A", robots=(*robots, Robot(name="C", markers=markers)), floor=Floor())
    stands: dict[str, list[float]] = {}
    with RunWriter(path, team) as writer:
        for k, stance in enumerate(truth["stances"]):
            begin = 1000.0 + 30.0 * k
            times = [begin + frame["t"] for frame in stance["frames"]]
            before = truth["stances"][k - 1]["observers"] if k else []
            names, poses = truth["robots"][k : k + 2], truth["poses"][k : k + 2]
            anchors = tuple(name for name, pose in zip(names, poses, strict=True) if stands.get(name) == pose)
            assert anchors or not before
            stands = dict(zip(names, poses, strict=True))
            writer.write(Motion("C", times[0], True))
            for robot in stance["observers"]:
                for time, image in zip(times, images[k, robot], strict=True):
                    writer.write(Image(robot, time, image))
                for time in (times[0], times[-1]):
                    x, y, yaw = stands[robot]
                    writer.write_truth(robot, time, floor_pose(x, y, yaw))
            writer.write(Motion("C", times[-1], False))
            writer.write(Stance(k, times[0], times[-1], tuple(stance["observers"]), ("C",), anchors))


def table(figures: dict[str, object]) -> str:
    """Figures for people."""
    lines = []
    grid = figures.get("grid")
    if isinstance(grid, dict):
        lines += [
            f"LED grid, {grid['images']} images, learnt on half, judged on the other: chi2/dof "
            f"{grid['chi2_per_dof']:.2f} (as stated {grid['chi2_per_dof_stated']:.1f}); "
            f"saturated {grid['saturated']:.2f}, others {grid['unsaturated']:.2f}",
            f"floors {', '.join(f'{one:.3f}' for one in grid['saturated_px'] + grid['floor_px'])} px",
            "by image: " + " ".join(f"{one:.2f}" for one in grid["by_image"]),
            f"with the scatter of every other LED of an image, the rest: chi2/dof {grid['adapted']:.2f}; saturated "
            f"{grid['adapted_saturated']:.2f}, others {grid['adapted_unsaturated']:.2f}; spread of log variance "
            + ", ".join(f"{one:.2f}" for one in grid["spread"]),
            "by image: " + " ".join(f"{one:.2f}" for one in grid["adapted_by_image"]),
            "scatter about lens and grid: " + ", ".join(f"{k} {v:.4f} px" for k, v in grid["scatter_px"].items()),
            "",
        ]
    chain = figures.get("chain")
    if isinstance(chain, list):
        head = "RMS px", "stated", "learnt", "used", "pose NEES"
        lines.append(f"{'path-traced chain, NEES':24}" + "".join(f"{one:>10}" for one in head) + "  by robot (95 %)")
        for row in chain:
            pose = "-" if row["pose_nees"] is None else f"{row['pose_nees']:.2f}"
            lines.append(
                f"{row['images']:24}{row['rms_px']:10.4f}{row['nees_stated']:10.2f}{row['nees_learnt']:10.2f}"
                f"{row['nees_used']:10.2f}{pose:>10}  "
                + ", ".join(
                    f"{n['mean']:.2f} ({n['low']:.2f}-{n['high']:.2f})" for n in row["pose_nees_by_robot"] or []
                )
            )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 2 where no data are there, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--grid", type=Path, default=SHARED / "uvdar_led_grid", help="folder with the grid's images")
    parser.add_argument("--chain", type=Path, default=SHARED / "rendered_chain", help="folder with truth.json")
    parser.add_argument("--json", action="store_true", help="print figures as JSON instead of a table")
    options = parser.parse_args(arguments)
    figures: dict[str, object] = {}
    if any(options.grid.glob("*.png")):
        figures["grid"] = grid_figures(options.grid)
    if (options.chain / "truth.json").is_file():
        figures["chain"] = chain_figures(options.chain)
    if not figures:
        print(f"{options.grid} and {options.chain} hold no data; give --grid or --chain", file=sys.stderr)
        return 2
    print(json.dumps(figures, indent=2) if options.json else table(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
