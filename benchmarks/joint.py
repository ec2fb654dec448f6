"""The joint estimate over seeds: accuracy and honesty with mounts, markers and floor that are not as stated.

    python benchmarks/joint.py [--seeds 50] [--json]      hallway at depth tracks, 250 and 1000 points a stance
    python benchmarks/joint.py --images 10                 hallway from rendered images
    python benchmarks/joint.py --six-step 50               every segment of Table I
    python benchmarks/joint.py --far 50                    started from mounts 3 deg and 2 cm wrong
    python benchmarks/joint.py --budget 24 [--plot FILE]   what limits accuracy, one thing at a time
    python benchmarks/joint.py --speed                     40 stances in batch; an update at stance 40 and 1000

Mounts are wrong by 1 deg and 5 mm, the span is known to 0.1 mm, the floor uneven by 0.1 deg (one sigma each).
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
import timeit
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from monte_carlo import MemoryRun, anees_interval, over_seeds, rms_interval, simulated, solved, truth_of
from msgspec.structs import replace as with_fields

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from whole_graph import replay

from coloc_graph.evaluation import align
from coloc_graph.geometry.lie import se3_inverse, so3_log
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, World, simulate

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
METHODS = {
    "eq. (2), chained (the paper)": SolveOptions("chain"),
    "smoothed": SolveOptions("smooth"),
    "joint, without odometry": SolveOptions("joint", odometry=False),
    "joint (the default)": SolveOptions("joint"),
}


@dataclass(frozen=True)
class Figures:
    """Figures of one run.

    Length errors of A and B [%], the larger heading error at the end [deg], chi2 and dof, NEES of all poses together
    with its number of dimensions, and the number of outliers.
    """

    lengths: tuple[float, float]
    heading: float
    chi2: float
    dof: int
    anees: float
    refused: int


def one_run(seed: int, options: SolveOptions, points: int, imperfections: Imperfections, stances: int = 40) -> Figures:
    """The hallway of a seed, solved."""
    world = simulated("hallway", seed, points=points, stances=stances, imperfections=imperfections)
    return figures_of(world, options)


def figures_of(world: World, options: SolveOptions) -> Figures:
    """A world solved."""
    solution, accuracy = solved(world, options)
    rows = [row for row in accuracy.robots if row.robot != "C"]
    a, b = (100 * row.length_error / row.true_length for row in rows)
    estimate = solution.estimate
    heading = max(row.heading_error_deg for row in rows)
    return Figures(
        (a, b), heading, estimate.chi2, estimate.dof, accuracy.anees or 0.0, len(estimate.rejected)
    )  # fmt: skip


def summary(runs: list[Figures]) -> dict[str, object]:
    """RMS over runs with 95 % intervals; chi2/dof of all together; NEES as an average, with its standard error."""
    rms, low, high = rms_interval([e for run in runs for e in run.lengths])
    heading, *heading_95 = rms_interval([run.heading for run in runs])
    dof = sum(run.dof for run in runs)
    anees = np.array([run.anees for run in runs])
    return {
        "length_error_percent_rms": float(rms),
        "length_error_percent_95": [float(low), float(high)],
        "length_error_percent_mean": float(np.mean([e for run in runs for e in run.lengths])),
        "heading_deg_rms": float(heading),
        "heading_deg_95": [float(one) for one in heading_95],
        "chi2_per_dof": sum(run.chi2 for run in runs) / dof if dof else None,
        "anees": float(anees.mean()),
        "anees_standard_error": float(anees.std(ddof=1) / np.sqrt(len(anees))) if len(anees) > 1 else None,
        "refused": sum(run.refused for run in runs),
    }


def tracks(seeds: int) -> dict[str, dict[str, object]]:
    """The table of the hallway at depth tracks."""
    table = {}
    for points in (250, 1000):
        for name, options in METHODS.items():
            work = partial(one_run, options=options, points=points, imperfections=WRONG)
            table[f"{points} points, {name}"] = summary(over_seeds(work, range(seeds)))
            print_row(f"{points} points, {name}", table[f"{points} points, {name}"])
    return table


def last_pose(seed: int, points: int) -> float:
    """NEES of A's last pose alone, planar, 3 numbers: independent from seed to seed."""
    world = simulated("hallway", seed, points=points, stances=12, imperfections=WRONG)
    solution, _ = solved(world, SolveOptions("joint"))
    trajectory = solution.estimate.trajectories["A"]
    true = align(solution.estimate.trajectories, truth_of(world), "A", on_floor=True)["A"][-1]
    T = se3_inverse(trajectory.T_world_body[-1]) @ true
    xi = np.concatenate([so3_log(T[:3, :3])[2:], T[:2, 3]])
    C = trajectory.covariances[-1][2:5, 2:5]
    return float(xi @ np.linalg.solve(C, xi))


def honesty(seeds: int) -> dict[str, object]:
    """NEES of one pose a run, which is chi-square distributed if covariances are right."""
    nees = over_seeds(partial(last_pose, points=250), range(1000, 1000 + seeds))
    low, high = anees_interval(seeds, 3)
    found = {"anees": sum(nees) / (3 * seeds), "interval_95": [float(low), float(high)], "seeds": seeds}
    print(
        f"A's last pose of 12 stances, {seeds} seeds: NEES/3 {found['anees']:.3f}, 95 % interval {low:.3f}-{high:.3f}"
    )
    return found


def from_images(seed: int, imperfections: Imperfections) -> Figures:
    """The hallway of a seed, rendered and solved."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        simulate("hallway", path, depth="images", seed=seed, imperfections=imperfections)
        solution = solve(open_run(path))
        assessed = assess(solution)
    assert assessed is not None
    rows = [row for row in assessed[0].robots if row.robot != "C"]
    a, b = (100 * row.length_error / row.true_length for row in rows)
    estimate, heading = solution.estimate, max(row.heading_error_deg for row in rows)
    return Figures((a, b), heading, estimate.chi2, estimate.dof, assessed[0].anees or 0.0, len(estimate.rejected))


def images(seeds: int) -> dict[str, dict[str, object]]:
    """Rendered images, all effects on: with mounts as stated, and with mounts that are not."""
    table = {}
    for name, imperfections in (("mounts as stated", Imperfections()), ("mounts, span and floor wrong", WRONG)):
        runs = over_seeds(partial(from_images, imperfections=imperfections), range(seeds))
        table[name] = summary(runs)
        print_row(f"images, {name}", table[name])
    return table


def segments(seed: int, imperfections: Imperfections) -> dict[str, list[float]]:
    """Errors [cm] of the lengths of Table I by each method: of a, b, c, ... from where one robot stands to the next."""
    world = simulated("six-step", seed, points=100, imperfections=imperfections)
    errors = {}
    for name in ("eq. (2), chained (the paper)", "joint, without odometry"):
        solution, _ = solved(world, METHODS[name])
        places = {
            robot: {int(k): p for k, p in zip(t.stances, t.positions, strict=True)}
            for robot, t in solution.estimate.trajectories.items()
        }
        errors[name] = []
        for stance in solution.run.stances:
            i, j = stance.observers
            found = np.linalg.norm((places[i][stance.index] - places[j][stance.index])[:2])
            p, q = (world.paths[robot].planar_at([stance.start])[0, :2] for robot in (i, j))
            errors[name].append(float(100 * (found - np.linalg.norm(p - q))))
    return errors


def six_step(seeds: int) -> dict[str, dict[str, list[float]]]:
    """Table I: RMS and largest error of each segment."""
    table: dict[str, dict[str, list[float]]] = {}
    for what, imperfections in (("mounts as stated", Imperfections()), ("mounts, span and floor wrong", WRONG)):
        runs = over_seeds(partial(segments, imperfections=imperfections), range(seeds))
        for name in runs[0]:
            e = np.array([run[name] for run in runs])
            rms, largest = np.sqrt((e**2).mean(axis=0)), np.abs(e).max(axis=0)
            table[f"{what}, {name}"] = {"rms_cm": rms.tolist(), "largest_cm": largest.tolist()}
            print(f"six-step, {what}, {name}: RMS {np.round(rms, 2)} cm, largest {np.round(largest, 2)} cm")
    print("the paper's Table I: up to 0.52 cm")
    return table


def far_off(seed: int) -> Figures:
    """Mounts exactly 3 deg and 2 cm from what is stated, in directions of the seed."""
    exact = replace(WRONG, mount_sigma_deg=0.0, height_sigma=0.0)
    world = simulated("hallway", seed, points=250, imperfections=exact)
    rng = np.random.default_rng(seed)
    robots = []
    for robot in world.team.robots:
        m, (height, tilt, roll) = robot.mount, rng.choice([-1.0, 1.0], 3)
        wrong = with_fields(
            m, height=m.height + 0.02 * height, tilt_deg=m.tilt_deg + 3 * tilt, roll_deg=m.roll_deg + 3 * roll,
            height_sigma=0.02, tilt_sigma_deg=3.0, roll_sigma_deg=3.0,
        )  # fmt: skip
        robots.append(with_fields(robot, mount_if_any=wrong))
    return figures_of(replace(world, team=with_fields(world.team, robots=tuple(robots))), SolveOptions("joint"))


#: What is varied, from what is nearly perfect to what is poor: everything else is as in `BASE`.
BASE = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1, noise_px=0.3)
VARIED: dict[str, tuple[str, list[float]]] = {
    "pixel noise [px]": ("noise_px", [0.05, 0.3, 1.0]),
    "points a stance": ("points", [60, 250, 1000]),
    "span tolerance [mm]": ("span_sigma", [1e-5, 1e-4, 5e-4]),
    "mount tilt and roll [deg]": ("mount_sigma_deg", [0.0, 1.0, 2.0]),
    "mount height [mm]": ("height_sigma", [0.0, 5e-3, 2e-2]),
    "floor [deg]": ("floor_sigma_deg", [0.0, 0.1, 0.3]),
    "clock offset [ms]": ("clock_offset", [0.0, 2e-2]),
}


def one_budget(seed: int, name: str, value: float) -> tuple[float, float, float]:
    """Length errors and heading of one run with one thing changed."""
    points = 250
    imperfections = BASE
    if name == "points":
        points = int(value)
    else:
        imperfections = replace(BASE, **{name: value})
    run = one_run(seed, SolveOptions("joint"), points, imperfections)
    return (*run.lengths, run.heading)


def budget(seeds: int, plot: Path | None) -> dict[str, list[dict[str, float]]]:
    """Vary one source of error at a time."""
    table: dict[str, list[dict[str, float]]] = {}
    base: dict[str, float] | None = None
    for what, (name, values) in VARIED.items():
        table[what] = []
        for value in values:
            if base is not None and (getattr(BASE, name, None) == value or (name, value) == ("points", 250)):
                table[what].append({**base, "value": 1000 * value if "mm" in what or "ms" in what else value})
                continue
            runs = np.array(over_seeds(partial(one_budget, name=name, value=value), range(seeds)))
            rms, low, high = rms_interval(runs[:, :2].ravel().tolist())
            shown = 1000 * value if "mm" in what or "ms" in what else value
            row = {"value": shown, "percent": float(rms), "low": float(low), "high": float(high)}
            row["heading_deg"] = float(np.sqrt((runs[:, 2] ** 2).mean()))
            table[what].append(row)
            if getattr(BASE, name, None) == value or (name, value) == ("points", 250):
                base = row  # the same runs: once is enough
            print(
                f"{what:28}{shown:8g}  length {rms:.3f} % ({low:.3f}-{high:.3f})  heading {row['heading_deg']:.3f} deg",
                flush=True,
            )
    if plot is not None:
        draw(table, plot)
    return table


def draw(table: dict[str, list[dict[str, float]]], path: Path) -> None:
    """The budget as a row of small plots that share their axis."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(12, 5.2), sharey=True)
    base = {"pixel noise [px]": 0.3, "points a stance": 250, "span tolerance [mm]": 0.1, "floor [deg]": 0.1,
            "mount tilt and roll [deg]": 1.0, "mount height [mm]": 5.0, "clock offset [ms]": 0.0}  # fmt: skip
    top = max(row["high"] for rows in table.values() for row in rows)
    for axis, (what, rows) in zip(axes.flat, table.items(), strict=False):
        places = range(len(rows))
        percent, low, high = (np.array([row[key] for row in rows]) for key in ("percent", "low", "high"))
        axis.errorbar(places, percent, yerr=[percent - low, high - percent], color="#0072B2", marker="o", capsize=3)
        at = [n for n, row in enumerate(rows) if abs(row["value"] - base[what]) < 1e-9]
        axis.plot(at, percent[at], "o", markersize=11, markerfacecolor="none", color="#D55E00")
        axis.set_xticks(places, [f"{row['value']:g}" for row in rows])
        axis.set_xlabel(what)
        axis.set_xlim(-0.3, len(rows) - 0.7)
        axis.set_ylim(0, 1.05 * top)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("length error RMS [%]")
    axes.flat[-1].axis("off")
    figure.subplots_adjust(left=0.06, right=0.99, top=0.97, bottom=0.11, hspace=0.35, wspace=0.08)
    figure.text(0.79, 0.27, "ring: what all others are\nwhile one is varied\nbars: 95 % over the seeds", va="center")
    figure.savefig(path, dpi=120)


def speed() -> dict[str, float]:
    """Seconds to solve 40 stances from tracks; milliseconds of an update at stance 40 and about stance 1000."""
    run = MemoryRun(simulated("hallway", 0, points=250, stances=40, imperfections=WRONG))
    solve(run, SolveOptions("joint"))  # what is drawn when it is asked for is then there
    seconds = []
    for _ in range(5):
        started = time.perf_counter()
        solution = solve(run, SolveOptions("joint"))
        seconds.append(time.perf_counter() - started)
    figures = {"batch_40_s": min(seconds), "backend_40_s": solution.seconds_backend}
    _, updates = replay(solution.estimate.graph, "joint")
    figures["update_40_ms"] = 1000 * statistics.median(updates[30:])
    figures["inverse_us"] = inverse_us()
    print(figures, flush=True)
    long = simulated("hallway", 0, points=250, stances=1010, imperfections=WRONG)
    solution, _ = solved(long, SolveOptions("smooth"))
    estimate, updates = replay(solution.estimate.graph, "joint")
    figures["update_1000_ms"] = 1000 * statistics.median(updates[990:])
    figures["update_1000_mean_ms"] = 1000 * statistics.mean(updates[900:])
    figures["longest_update_ms"] = 1000 * max(updates)
    figures["refused_of_1010"] = len(estimate.rejected)
    print(figures)
    return figures


def inverse_us() -> float:
    """Microseconds of np.linalg.inv of a 3 by 3 matrix: how fast this machine is just now (5.8 when left alone)."""
    a = np.eye(3) + 0.1
    return min(timeit.repeat(lambda: np.linalg.inv(a), number=2000, repeat=9)) / 2000 * 1e6


def print_row(name: str, row: dict[str, object]) -> None:
    """One line of a table."""
    low, high = row["length_error_percent_95"]
    chi2 = "" if row["chi2_per_dof"] is None else f"  chi2/dof {row['chi2_per_dof']:.3f}"
    print(
        f"{name:52} length {row['length_error_percent_rms']:.3f} % ({low:.3f}-{high:.3f})  heading "
        f"{row['heading_deg_rms']:.3f} deg{chi2}  NEES {row['anees']:.2f}  refused {row['refused']}",
        flush=True,
    )


def main() -> int:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    for name in ("images", "six-step", "far", "budget", "honesty"):
        parser.add_argument(f"--{name}", type=int, metavar="SEEDS")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    asked: dict[str, Callable[[], object]] = {}
    if args.images:
        asked["images"] = partial(images, args.images)
    if args.six_step:
        asked["six-step"] = partial(six_step, args.six_step)
    if args.far:
        asked["far"] = lambda: far(args.far)
    if args.budget:
        asked["budget"] = partial(budget, args.budget, args.plot)
    if args.honesty:
        asked["honesty"] = partial(honesty, args.honesty)
    if args.speed:
        asked["speed"] = speed
    found = {name: work() for name, work in (asked or {"tracks": partial(tracks, args.seeds)}).items()}
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return 0


def far(seeds: int) -> dict[str, object]:
    """From mounts 3 deg and 2 cm wrong."""
    row = summary(over_seeds(far_off, range(seeds)))
    print_row("started 3 deg and 2 cm off", row)
    return row


if __name__ == "__main__":
    sys.exit(main())
