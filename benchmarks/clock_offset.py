"""Clocks 20 ms apart: how well the offset is found, and what it costs the relative pose, over seeds.

Each row is a way the mover drives, seen as tracks. The same worlds are measured with clocks that agree
("synchronised"), with the offset estimated, and with clocks that are said to agree though they do not. Motion
that repeats itself in time (a line, an arc at constant speed) must be told to be unobservable.

    python benchmarks/clock_offset.py [--seeds 40] [--json]
"""

import argparse
import json
import sys
from dataclasses import replace
from functools import partial

import gtsam
import msgspec
import numpy as np
from monte_carlo import MemoryRun, anees_interval, over_seeds

from coloc_graph.frontend import ClockOffset, FrontendOptions, PairMeasurement, measure_pair, share_clock_offsets
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.simulation import Imperfections, World, build_world, reference_team, scenario
from coloc_graph.simulation.paths import SPEED, Path
from coloc_graph.simulation.rig import MILD_LENS
from coloc_graph.simulation.world import stream

OFFSET = 0.020
STANCES = 5

#: Ways to drive: images a second, pixel noise [px], and points a stance.
MOTIONS: dict[str, tuple[str, float, float, int]] = {
    "stop and go, 30 fps, 0.1 px": ("stop", 30.0, 0.1, 600),
    "stop and go, 30 fps, 0.3 px": ("stop", 30.0, 0.3, 600),
    "stop and go, 100 fps, 0.3 px": ("stop", 100.0, 0.3, 2000),
    "stop and go, 10 fps, 0.1 px, half a frame apart": ("stop apart", 10.0, 0.1, 200),
    "corner to corner, 30 fps, 0.3 px": ("drive", 30.0, 0.3, 600),
    "bursts of 3 captures, 0.3 px": ("bursts", 0.0, 0.3, 100),
    "straight at constant speed, 30 fps, 0.3 px": ("line", 30.0, 0.3, 600),
    "arc at constant speed, 30 fps, 0.3 px": ("arc", 30.0, 0.3, 600),
    "arc at constant speed, 100 fps, 0.1 px": ("arc", 100.0, 0.1, 2000),
}


def world_of(motion: str, fps: float, noise: float, points: int, offset: float, seed: int) -> World:
    """A hallway of `STANCES` stances, its mover driving as the motion says."""
    what = scenario("hallway", stances=STANCES, rng=stream(seed, "formation"))
    imperfections = Imperfections(clock_offset=offset, noise_px=noise)
    if motion == "bursts":
        return build_world(what, seed=seed, points=points, imperfections=imperfections, burst=3)
    # at depth images for its drive: what is measured are tracks, which have no bias
    world = build_world(
        what,
        depth="images",
        seed=seed,
        points=points,
        fps=fps,
        imperfections=imperfections,
        team=reference_team(MILD_LENS),
        stopping=motion.startswith("stop"),
    )
    if motion == "stop apart":
        captures = tuple(
            tuple(
                one if one.robot == "A" else replace(one, times=one.times + 0.5 / fps, stamps=one.stamps + 0.5 / fps)
                for one in both
            )
            for both in world.captures
        )
        world = replace(world, captures=captures)
    if motion in ("line", "arc"):
        world = replace(world, paths=world.paths | {what.mover: _steady(world, motion, seed)})
    return world


def _steady(world: World, motion: str, seed: int) -> Path:
    """The mover's path in all stances: one line, or one arc, at constant speed."""
    rng = np.random.default_rng((seed, 99))
    times, knots = [], []
    for k in range(len(world.stances)):
        x, y = world.scenario.middle(k)
        begin, end = world.captures[k][0].times[[0, -1]] + (-0.5, 0.5)
        t = np.arange(begin, end, 0.01)
        s = t - (begin + end) / 2
        if motion == "line":
            speed, heading = 1.0 / (end - begin), rng.uniform(-0.5, 0.5)
            path = [x + 1.2 + speed * s * np.cos(heading), y + speed * s * np.sin(heading), 0 * s + heading]
        else:
            turn = SPEED / 0.3 * s + rng.uniform(-np.pi, np.pi)
            path = [x + 1.2 + 0.3 * np.cos(turn), y + 0.3 * np.sin(turn), turn + np.pi / 2]
        times.append(t)
        knots.append(np.stack(path, axis=1))
    old = world.paths[world.scenario.mover]
    return Path(np.concatenate(times), np.concatenate(knots), old.tilt_times, old.tilts)


def measured(world: World, clock_sigma: float) -> tuple[PairMeasurement, ...]:
    """All stances' measurements with one offset, the clocks said to agree to `clock_sigma` [s]."""
    run = MemoryRun(replace(world, team=msgspec.structs.replace(world.team, clock_sigma=clock_sigma)))
    every = [measure_pair(run, stance, *stance.observers, FrontendOptions()) for stance in run.stances]
    return share_clock_offsets(every, clock_sigma)[0]


def errors(world: World, measurements: tuple[PairMeasurement, ...]) -> list[tuple[float, float, float]]:
    """Error of each relative pose: translation [mm], rotation [mrad], NEES; NaN where there is no pose."""
    out = []
    for stance, one in zip(world.stances, measurements, strict=True):
        i, j = (world.paths[robot].pose_at([stance.start])[0] for robot in stance.observers)
        if one.relative_pose is None:
            out.append((np.nan, np.nan, np.nan))
            continue
        xi = gtsam.Pose3.Logmap(gtsam.Pose3(one.relative_pose.T_i_j).between(gtsam.Pose3(se3_inverse(i) @ j)))
        nees = xi @ np.linalg.solve(one.relative_pose.covariance, xi) / 6
        out.append((1e3 * np.linalg.norm(xi[3:]), 1e3 * np.linalg.norm(xi[:3]), nees))
    return out


def one_seed(seed: int, name: str) -> dict[str, object]:
    """One run of a motion."""
    motion, fps, noise, points = MOTIONS[name]
    late = world_of(motion, fps, noise, points, OFFSET, seed)
    together = world_of(motion, fps, noise, points, 0.0, seed)
    # without an offset only captures of one instant pair; half a frame apart there are none
    if motion == "stop apart":
        together = world_of("stop", fps, noise, points, 0.0, seed)
    found = measured(late, OFFSET)
    alone: list[ClockOffset | None] = [one.offset_evidence for one in found]
    sign = [1 if one.homography.robot_i == "A" else -1 for one in found]
    h = found[0].homography
    return {
        "offset_ms": 1e3 * (sign[0] * h.time_offset - OFFSET),
        "sigma_ms": 1e3 * h.time_offset_sigma,
        "told": bool(h.warning),
        "alone": [(1e3 * (s * e.value - OFFSET), 1e3 * e.sigma) for s, e in zip(sign, alone, strict=True) if e],
        "estimated": errors(late, found),
        "synchronised": errors(together, measured(together, 0.0)),
        "ignored": errors(late, measured(late, 0.0)),
    }


def _rms(values: object) -> float:
    return float(np.sqrt(np.nanmean(np.square(np.asarray(values, float)))))


def row_of(name: str, seeds: int) -> dict[str, float]:
    """The figures of one motion."""
    runs = over_seeds(partial(one_seed, name=name), range(seeds))
    off, sigma = (np.array([run[key] for run in runs]) for key in ("offset_ms", "sigma_ms"))
    alone = np.array([one for run in runs for one in run["alone"]]).reshape(-1, 2)
    row = {
        "offset_rms_ms": _rms(off),
        "offset_sigma_ms": float(sigma.mean()),
        "offset_nees": float((off**2 / sigma**2).mean()),
        "stance_offset_rms_ms": _rms(alone[:, 0]) if len(alone) else float("nan"),
        "stance_offset_nees": float(((alone[:, 0] / alone[:, 1]) ** 2).mean()) if len(alone) else float("nan"),
        "stances_that_observe": len(alone) / (seeds * STANCES),
        "told_unobservable": float(np.mean([bool(run["told"]) for run in runs])),
    }
    for way in ("synchronised", "estimated", "ignored"):
        every = np.array([run[way] for run in runs], float).reshape(-1, 3)
        with np.errstate(all="ignore"):
            row |= {
                f"{way}_mm": _rms(every[:, 0]) if np.isfinite(every).any() else float("nan"),
                f"{way}_nees": float(np.nanmean(every[:, 2])) if np.isfinite(every).any() else float("nan"),
                f"{way}_poses": float(np.isfinite(every[:, 0]).mean()),
            }
    return row


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--only", default="", help="only motions whose name contains this")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    table = {name: row_of(name, args.seeds) for name in MOTIONS if args.only in name}
    if args.json:
        print(json.dumps(table, indent=2))
        return 0
    print(f"clocks {1e3 * OFFSET:.0f} ms apart, {STANCES} stances of 10 s share the offset, {args.seeds} seeds")
    left = ("offset", 8), ("sigma", 7), ("NEES", 6), ("a stance", 10), ("NEES", 6), ("unobs.", 8)
    right = ("synchr.", 9), ("NEES", 6), ("found", 8), ("NEES", 6), ("ratio", 7), ("ignored", 9), ("NEES", 7)
    print(" " * 50 + "".join(f"{what:>{width}}" for what, width in (*left, *right, ("poses", 7))))
    for name, row in table.items():
        print(
            f"{name:50}{row['offset_rms_ms']:6.2f}ms{row['offset_sigma_ms']:7.2f}{row['offset_nees']:6.2f}"
            f"{row['stance_offset_rms_ms']:8.2f}ms{row['stance_offset_nees']:6.2f}"
            f"{100 * row['told_unobservable']:7.0f}%"
            f"{row['synchronised_mm']:7.2f}mm{row['synchronised_nees']:6.2f}{row['estimated_mm']:6.2f}mm"
            f"{row['estimated_nees']:6.2f}{row['estimated_mm'] / row['synchronised_mm']:7.2f}"
            f"{row['ignored_mm']:7.2f}mm{row['ignored_nees']:7.1f}{100 * row['ignored_poses']:6.0f}%"
        )
    low, high = anees_interval(args.seeds, 1)
    print(f"95 % of offset NEES of {args.seeds} seeds: {low:.2f} to {high:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
