"""The front end: how exact its centres are, and how fast it is beside named peers. Ratios, side by side.

    python benchmarks/frontend.py [--repeats 7] [--json]

- one LED at 200 grey levels over noise of 3: RMSE and bias of its centre, stated over observed variance;
- finding and measuring the lights of a single image: two, 26, and 35 that are 4.4 px apart;
- tracking one marker, frames a second, beside cv2.SimpleBlobDetector on the full frame: only following it, as
  that does, and with the measurement of its sub-pixel centres and their covariances;
- a recorded run of two cameras at 100 fps, raw images, through the front end: times real time;
- one homography of 250 points (robust, maximum likelihood, information) beside cv2.findHomography(USAC_MAGSAC);
- eq. (2) of many homographies in one call beside a loop over findHomography and decomposeHomographyMat.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from monte_carlo import MemoryRun, simulated

from coloc_graph.frontend import (
    Detector,
    FrontendOptions,
    MarkerTracker,
    PointPairs,
    Threshold,
    TrackerOptions,
    decompose_with_normal,
    detect_leds,
    fit_homography,
    measure_pair,
)  # fmt: skip
from coloc_graph.frontend.homography.refinement import least_squares
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.run import Image, open_run
from coloc_graph.simulation import Sensor, render, simulate, spots


def seconds(work: Callable[[], object], repeats: int) -> float:
    """The median time of a call."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def in_turn(a: Callable[[], object], b: Callable[[], object], repeats: int) -> tuple[float, float, float]:
    """Median times of a and b, and the median of their ratio a / b, taken in turn."""
    a(), b()
    pairs = [(seconds(a, 1), seconds(b, 1)) for _ in range(repeats)]
    times = np.median(pairs, axis=0)
    return float(times[0]), float(times[1]), float(np.median([x / y for x, y in pairs]))


def centres(n: int = 1000) -> dict[str, float]:
    """Errors of the centre of an LED with a peak of 200 grey levels over noise of 3."""
    rng = np.random.default_rng(0)
    sensor = Sensor(read_noise=3.0, shot_gain=0.0)
    errors, variances, peaks = [], [], []
    for uv in 30 + rng.uniform(-0.5, 0.5, (n, 2)):
        image = render(spots(uv, 1.5, 290.0), size=(61, 61), background=10.0, sensor=sensor, rng=rng)
        blob = detect_leds(image, threshold=Threshold(shot_gain=sensor.shot_gain))
        errors.append(blob.uv[0] - uv)
        variances.append(np.diag(blob.covariance[0]))
        peaks.append(blob.peak[0])
    observed = np.var(errors, axis=0)
    return {
        "peak": float(np.mean(peaks)),
        "rmse_px": float(np.sqrt(np.square(errors).mean())),
        "bias_px": float(np.abs(np.mean(errors, axis=0)).max()),
        "stated_over_observed_variance": float((np.mean(variances, axis=0) / observed).mean()),
    }


def single_images(repeats: int) -> dict[str, float]:
    """Milliseconds of finding and measuring the lights of one image."""
    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    places = {
        "two_ms": (np.array([[100.3, 80.2], [160.7, 90.4]]), 1.5),
        "many_ms": ([30.2, 40.4] + 38.3 * grid[:26], 1.2),
        "close_ms": ([140.2, 110.4] + 4.4 * grid[grid[:, 0] < 6][:35], 0.8),
    }
    found = {}
    for name, (uv, radius) in places.items():
        image = render(spots(uv, radius, 220.0), background=15.0, sensor=Sensor(), rng=np.random.default_rng(0))
        found[name] = 1e3 * seconds(partial(detect_leds, image), 10 * repeats)
    return found


def tracking(repeats: int, width: int = 320, height: int = 240) -> dict[str, float]:
    """Frames a second of tracking one marker, and of SimpleBlobDetector on the full frame."""
    rng = np.random.default_rng(0)
    k = np.linspace(0, 1, 200)
    path = np.stack([width * (0.12 + 0.76 * k), height * (0.5 + 0.25 * np.sin(6 * k))], axis=1)
    images = [
        Image(
            "A",
            0.01 * k,
            render(spots(uv, 1.5, 220.0), size=(width, height), background=15.0, sensor=Sensor(), rng=rng),
        )
        for k, uv in enumerate(path)
    ]
    parameters = cv2.SimpleBlobDetector_Params()
    parameters.filterByColor, parameters.blobColor = True, 255
    parameters.filterByArea, parameters.minArea, parameters.maxArea = True, 2.0, 600.0
    parameters.filterByCircularity = parameters.filterByInertia = parameters.filterByConvexity = False
    parameters.minThreshold, parameters.maxThreshold = 35.0, 255.0
    peer = cv2.SimpleBlobDetector_create(parameters)

    def follow() -> MarkerTracker:
        tracker = MarkerTracker("A", Detector(), TrackerOptions(markers=1))
        for image in images:
            tracker.step(image)
        return tracker

    def ours() -> None:
        tracks = follow().tracks()
        assert len(tracks) == 1
        assert len(tracks[0]) == len(images)

    def theirs() -> None:
        for image in images:
            peer.detect(image.pixels)

    a, b, ratio = in_turn(theirs, ours, repeats)
    _, followed, following = in_turn(theirs, follow, repeats)
    return {
        "ours_fps": len(images) / b,
        "following_fps": len(images) / followed,
        "simple_blob_fps": len(images) / a,
        "ratio": ratio,
        "following_ratio": following,
    }


def real_time(repeats: int) -> dict[str, float]:
    """Time the front end on a recorded stance of two cameras, raw images, as a multiple of 100 fps."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        simulate("hallway", path, depth="images", fps=100.0, points=1000, stances=1, image_format="raw")
        run = open_run(path)
        stance = run.stances[0]
        frames = sum(1 for _ in run.images("A", stance.start, stance.end))
        taken = seconds(lambda: measure_pair(run, stance, "A", "B", FrontendOptions()), repeats)
    return {"frames_a_camera": frames, "seconds": taken, "times_real_time": frames / 100.0 / taken}


def homography(repeats: int) -> dict[str, float]:
    """Times of one measurement of 250 points."""
    run = MemoryRun(simulated("single-step", 0, points=250, l=0.8, theta_deg=30.0))
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions()).correspondences
    ours, theirs, ratio = in_turn(
        lambda: fit_homography(found.pairs),
        lambda: cv2.findHomography(found.uv_i, found.uv_j, cv2.USAC_MAGSAC),
        40 * repeats,
    )
    return {"ours_ms": 1e3 * ours, "magsac_ms": 1e3 * theirs, "ratio": ratio}


def batched(repeats: int, m: int = 500) -> dict[str, float]:
    """Times of eq. (2) on m draws of 50 points."""
    run = MemoryRun(simulated("single-step", 0, points=250, l=0.8, theta_deg=30.0))
    found = measure_pair(run, run.stances[0], "A", "B", FrontendOptions()).correspondences
    camera, plane = run.team["A"].camera, stance_plane(run, run.stances[0], "A")
    rng = np.random.default_rng(0)
    draws = np.array([rng.choice(250, 50, replace=False) for _ in range(m)])
    p = found.pairs
    noise = np.broadcast_to(p.covariance_i[0], (m, 50, 2, 2))

    def ours() -> None:
        pairs = PointPairs(p.x_i[draws], p.x_j[draws], noise, noise)
        decompose_with_normal(least_squares(pairs), plane.N, plane.d)

    def theirs() -> None:
        for draw in draws:
            H, _ = cv2.findHomography(found.uv_i[draw], found.uv_j[draw], 0)
            _, _, _, normals = cv2.decomposeHomographyMat(H, camera.K)
            max(normals, key=lambda normal: float(normal.ravel() @ plane.N))

    a, b, ratio = in_turn(theirs, ours, repeats)
    return {"ours_ms": 1e3 * b, "opencv_loop_ms": 1e3 * a, "ratio": ratio}


def main() -> int:
    """Print the figures beside what is asked of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    figures = {
        "centres": centres(),
        "single_images": single_images(args.repeats),
        "tracking": tracking(args.repeats),
        "tracking_vga": tracking(args.repeats, 640, 480),
        "real_time": real_time(args.repeats),
        "homography": homography(args.repeats),
        "batched_eq2": batched(args.repeats),
    }
    if args.json:
        print(json.dumps(figures, indent=2))
        return 0
    c, s, t, v, r, h, b = figures.values()
    print(
        f"LED centre, peak {c['peak']:.0f} over noise 3: RMSE {c['rmse_px']:.3f} px (at most 0.05), bias "
        f"{c['bias_px']:.4f} px (0.02), stated / observed variance {c['stated_over_observed_variance']:.2f}"
    )
    print(
        f"lights of a single image: two {s['two_ms']:.2f} ms, 26 {s['many_ms']:.2f} ms, 35 that are 4.4 px apart "
        f"{s['close_ms']:.1f} ms"
    )
    print(
        f"tracking one marker at 320x240: followed {t['following_fps']:.0f} frames/s, with sub-pixel centres and "
        f"covariances {t['ours_fps']:.0f}; SimpleBlobDetector {t['simple_blob_fps']:.0f}: "
        f"{t['following_ratio']:.1f} and {t['ratio']:.1f} times (at least 10)"
    )
    print(f"  the same at 640x480: {v['following_ratio']:.1f} and {v['ratio']:.1f} times")
    print(
        f"two cameras at 100 fps, raw, {r['frames_a_camera']} frames each: {r['times_real_time']:.1f} times real "
        "time (at least 10)"
    )
    print(
        f"one homography of 250 points: {h['ours_ms']:.2f} ms, MAGSAC++ alone {h['magsac_ms']:.2f} ms: "
        f"{h['ratio']:.1f} times (at most 3)"
    )
    print(
        f"eq. (2) of 500 draws of 50 points: {b['ours_ms']:.0f} ms in one call, {b['opencv_loop_ms']:.0f} ms in a "
        f"loop over OpenCV: {b['ratio']:.1f} times faster (at least 5)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
