"""Times of the front end beside those of another checkout of this repository, in turns, as ratios of processor time.

    python benchmarks/beside.py CHECKOUT [--rounds 3] [--python CHECKOUT/.venv/bin/python]

- the lights of a single image of 320x240, found and measured: two, 26, and 35 that are 4.4 px apart;
- one LED followed through 200 images of 320x240, with centres and covariances, also beside the least program in OpenCV
  that finds it in the full frame (threshold, contours, moments), and beside cv2.SimpleBlobDetector;
- a stance of two cameras through `measure_pair`: from tracks (250 points), from raw images at 100 fps, and from JPEG at
  10 fps, with the time that reading alone takes.

Each round runs every figure in both checkouts, each in a process of its own, and the shortest times count.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve()


def shortest(work: Callable[[], object], repeats: int) -> float:
    """Return the shortest processor time of a call [ms], after one that does not count."""
    work()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return 1e3 * min(times)


def figures(root: Path) -> dict[str, float]:
    """Measure the checkout that is imported, with its own benchmarks and simulation [ms]."""
    sys.path.insert(0, str(root / "benchmarks"))
    import cv2
    import numpy as np
    from monte_carlo import MemoryRun, simulated

    from coloc_graph.frontend import (
        Detector,
        FrontendOptions,
        MarkerTracker,
        TrackerOptions,
        detect_leds,
        measure_pair,
    )
    from coloc_graph.run import Image, open_run
    from coloc_graph.simulation import Sensor, render, simulate, spots

    cv2.setNumThreads(1)
    rng, found = np.random.default_rng(0), {}

    def image(uv: np.ndarray, radius: float) -> np.ndarray:
        return render(spots(uv, radius, 220.0), size=(320, 240), background=15.0, sensor=Sensor(), rng=rng)

    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    single = {
        "two lights": image(np.array([[100.3, 80.2], [160.7, 90.4]]), 1.5),
        "26 lights": image([30.2, 40.4] + 38.3 * grid[:26], 1.2),
        "35 close lights": image([140.2, 110.4] + 4.4 * grid[grid[:, 0] < 6][:35], 0.8),
    }
    for name, pixels in single.items():
        found[name] = shortest(lambda pixels=pixels: detect_leds(pixels), 3 if "close" in name else 60)

    k = np.linspace(0, 1, 200)
    path = np.stack([320 * (0.12 + 0.76 * k), 240 * (0.5 + 0.25 * np.sin(6 * k))], axis=1)
    images = [Image("A", 0.01 * n, image(uv, 1.5)) for n, uv in enumerate(path)]

    def follow() -> None:
        tracker = MarkerTracker("A", Detector(), TrackerOptions(markers=1))
        for one in images:
            tracker.step(one)
        assert [len(track) for track in tracker.tracks()] == [200]

    def least_program() -> None:
        for one in images:
            bright = cv2.threshold(one.pixels, 50, 255, cv2.THRESH_BINARY)[1]
            for contour in cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
                cv2.moments(contour)

    peer = cv2.SimpleBlobDetector_create()
    found["LED followed, an image"] = shortest(follow, 10) / 200
    found["threshold, contours, moments"] = shortest(least_program, 10) / 200
    found["SimpleBlobDetector"] = shortest(lambda: [peer.detect(one.pixels) for one in images[:20]], 3) / 20

    def stance(run: object) -> Callable[[], object]:
        return lambda: measure_pair(run, run.stances[0], "A", "B", FrontendOptions())

    found["measure_pair, tracks"] = shortest(stance(MemoryRun(simulated("single-step", 0, points=250, l=0.8))), 15)
    with tempfile.TemporaryDirectory() as folder:
        for kind, fps, points in (("raw", 100.0, 1000), ("jpeg", 10.0, 300)):
            file = Path(folder) / f"{kind}.mcap"
            simulate("hallway", file, depth="images", fps=fps, points=points, stances=1, image_format=kind)
            run = open_run(file)
            window = run.stances[0].start, run.stances[0].end

            def read(run: object = run, window: tuple[float, float] = window) -> int:
                # in turns, as `measure_pair` does, since both robots' images share chunks of the file
                return 2 * sum(1 for _ in zip(run.images("A", *window), run.images("B", *window), strict=False))

            seconds = read() / 2 / fps
            found[f"{kind} at {fps:g} fps, a second"] = shortest(stance(run), 3) / seconds
            found[f"{kind}, reading alone"] = shortest(read, 3) / seconds
    return found


def main() -> None:
    """Measure both in turns and print times and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="folder of the other checkout")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--python", type=Path, help="its interpreter (default: CHECKOUT/.venv/bin/python)")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(figures(options.checkout)))
        return
    other = options.checkout.resolve()
    both = {HERE.parents[1]: Path(sys.executable), other: options.python or other / ".venv/bin/python"}
    best: dict[Path, dict[str, float]] = {root: {} for root in both}
    for _ in range(options.rounds):
        for root, python in both.items():
            environment = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"}
            command = [python, HERE, root, "--worker"]
            done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            for name, taken in json.loads(done.stdout).items():
                best[root][name] = min(best[root].get(name, taken), taken)
    ours, theirs = best.values()
    print(f"{'':32}{'here':>10}{'there':>10}{'ratio':>8}")
    for name, taken in ours.items():
        print(f"{name:32}{taken:7.3f} ms{theirs[name]:7.3f} ms{taken / theirs[name]:8.2f}")
    least = ours["threshold, contours, moments"]
    print(f"an LED followed, beside the least program in OpenCV: {ours['LED followed, an image'] / least:.2f} times")
    for kind in ("raw at 100 fps", "jpeg at 10 fps"):
        print(f"{kind}: {1e3 / ours[f'{kind}, a second']:.1f} times real time")


if __name__ == "__main__":
    main()
