"""Cost of the viewer: server time an update while scrubbing, opening, and a live update on the estimator's thread.

Times are by the clock and of the render thread alone; how fast the machine is at the moment is measured before and
after, and the update is also given as it would be on a core that takes `NOMINAL_MS` for that.

python benchmarks/viewer.py [--stances 1000 10000 100000] [--robots 3] [--json]
"""

import argparse
import json
import time

import numpy as np

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run import Stance
from coloc_graph.viewer import Edges, Scene, Viewer
from coloc_graph.viewer.scene import layer_of

UPDATES = 200
#: A million additions in a Python loop on a free core of about 3 GHz [ms].
NOMINAL_MS = 50.0


def leapfrog(robots: int, stances: int) -> Scene:
    """A scene of robots that leap on in turn, an edge and a stay-put constraint a stance, estimate and truth."""
    rng = np.random.default_rng(0)
    names = tuple(f"R{n}" for n in range(robots))
    k = np.arange(stances)
    made = tuple(
        Stance(n, 10.0 * n, 10.0 * n + 5, (names[0], names[1]), names[2:3], (names[n % 2],) if n else ())
        for n in range(stances)
    )
    root = rng.normal(0, 0.01, (stances, 6, 6))
    layers = []
    for name, noise in (("joint", 0.02), ("true", 0.0)):
        paths = {}
        for number, robot in enumerate(names):
            x = 0.4 * ((k + number % 2) // 2) + rng.normal(0, noise, stances)
            T = floor_pose(x, 0.6 * number + 3 * np.sin(x / 40), np.full(stances, 0.1))
            paths[robot] = Trajectory(robot, 10.0 * k, T, k, root @ root.mT)
        layers.append(layer_of(name, names, made, paths))
    edges = Edges(
        k, np.zeros(stances, int), np.ones(stances, int), np.abs(rng.normal(1, 0.3, stances)), ("",) * stances
    )
    stayed = np.stack([k[1:] % 2, k[1:]], axis=1)
    return Scene(names, made, tuple(layers), edges, stayed=stayed, title=f"{stances} stances")


def calibration() -> float:
    """Time a million additions in a Python loop on this thread [ms], the best of three."""
    found = []
    for _ in range(3):
        started, total = time.thread_time(), 0
        for n in range(1_000_000):
            total += n
        found.append(1e3 * (time.thread_time() - started))
    return min(found)


def measure(robots: int, stances: int) -> dict[str, float]:
    """Milliseconds to open, of an update while scrubbing (by the clock, of its thread), at rest, of `publish`."""
    scene = leapfrog(robots, stances)
    speeds = [calibration()]
    started = time.perf_counter()
    viewer = Viewer(scene, port=0)
    viewer.wait_idle()
    opened = time.perf_counter() - started
    rows = np.linspace(0, stances - 1, UPDATES).astype(int)
    moving, used = [], []
    for row in rows.tolist():
        before = viewer.frame
        viewer.go(row)
        while viewer.frame is before:
            time.sleep(0.002)
        time.sleep(0.05)  # as often as the client sends
        moving.append(viewer.frame_seconds)
        used.append(viewer.frame_cpu_seconds)
    viewer.wait_idle()
    rest = viewer.frame_seconds
    published = []
    for _ in range(100):
        started = time.perf_counter()
        viewer.publish(scene)
        published.append(time.perf_counter() - started)
    viewer.close()
    speeds.append(calibration())
    slow = float(np.mean(speeds)) / NOMINAL_MS
    return {
        "open_ms": 1e3 * opened,
        "update_ms_median": 1e3 * float(np.median(moving)),
        "update_cpu_ms_median": 1e3 * float(np.median(used)),
        "update_cpu_ms_nominal": 1e3 * float(np.median(used)) / slow,
        "calibration_ms": float(np.mean(speeds)),
        "update_ms_95": 1e3 * float(np.quantile(moving, 0.95)),
        "rest_ms": 1e3 * rest,
        "publish_ms_worst": 1e3 * max(published),
    }


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stances", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    table = {stances: measure(args.robots, stances) for stances in args.stances}
    if args.json:
        print(json.dumps(table, indent=2))
        return 0
    for stances, row in table.items():
        print(f"{stances:>7} stances x {args.robots} robots: " + ", ".join(f"{k} {v:.2f}" for k, v in row.items()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
