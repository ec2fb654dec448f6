"""Plans against fixed formations: the same simulator and the same joint estimate, over paired seeds.

    python benchmarks/planning.py [--seeds 40]           a straight 7.2 m at depth tracks, equal images in all
    python benchmarks/planning.py --images 8             the same from rendered images, for whose noise plans are made
    python benchmarks/planning.py --on L                 with walls: L, U, pillars, rooms, slalom, offset
    python benchmarks/planning.py --robots 4             a larger team
    python benchmarks/planning.py --safety 1000 --on L   how near robots come to each other and to walls
    python benchmarks/planning.py --length 21.5          a longer way
    python benchmarks/planning.py --promises             what the plans promise, without simulating them
    python benchmarks/planning.py --keep f.jsonl --for 280  a part, to which later ones with more seeds add theirs
    python benchmarks/planning.py --fps 30 --seconds 1.67  as many images, and less time to drive

The mover drives its way at 0.2 m/s, robots hide what is behind them, and stop where their leaps slip to (1 cm and
1 cm for each metre, 1 deg). Mounts are wrong by 1 deg and 5 mm, the span by 0.1 mm, the floor by 0.1 deg (one sigma).
b0 is the paper's formation with its patrol, b1 the same with the best l and theta of Fig. 4, b2 the best fixed gait
with its patrol; b3 is greedy by information, b4 by the common view, b5 by chance; `gait` is the best gait with designed
drives, `horizon` the receding horizon, `from b0` the same from the paper's start, `short` the shortest gait that
promises what b0 does (planning_baselines.py).
"""

import argparse
import hashlib
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from monte_carlo import over_seeds, solved, truth_of
from planning_baselines import MOUNT_SIGMA_DEG, NAMES, Scene, missions, mounted
from scipy.stats import beta

from coloc_graph.errors import ColocError, InputError
from coloc_graph.evaluation import align
from coloc_graph.pipeline.batch import Solution, SolveOptions, solve
from coloc_graph.planning.drive import SETTLE
from coloc_graph.planning.mission import Mission
from coloc_graph.planning.plan import Plan
from coloc_graph.planning.route import route
from coloc_graph.planning.slip import stop_sigma
from coloc_graph.run import atomic_run, open_run
from coloc_graph.simulation import Imperfections, World, build_world, record, reference_team
from coloc_graph.simulation.floor_plans import FLOOR_PLANS, FloorPlan
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import MILD_LENS, stated_team
from coloc_graph.simulation.world import Depth, stream

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
#: Noise of a marker centre in rendered images [px], which plans for images are made for: `coloc solve` learns 0.039 to
#: 0.046 from images of three gaits, 10 images a second, floor of 0.1 deg, of which slopes are a part (0.030 to 0.038
#: on a floor that is flat); the 0.3 px of a team are not used there, as each detection has a covariance of its own.
IMAGE_NOISE_PX = 0.045
LENGTH = 7.2  # m
BOOTSTRAPS = 2000
RADIUS = 0.17  # of a Create [m]


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run.

    Errors of the observers' last poses [m], [deg], the sigma of the positions that the estimator states [m], the number
    of void stances and of all, and why it `failed`.
    """

    end: tuple[float, ...] = ()
    heading: tuple[float, ...] = ()
    stated: float = math.nan
    void: int = 0
    stances: int = 0
    failed: str = ""


def outcome(
    seed: int,
    plan: Plan,
    fps: float,
    wrong: Imperfections,
    depth: Depth,
    names: tuple[str, ...],
    floor_plan: FloorPlan | None,
) -> Outcome:
    """Simulate a seed that follows a plan, solve it and compare with its truth."""
    try:
        scenario = planned(plan, stream(seed, "formation"), floor_plan)
        team = reference_team(MILD_LENS if depth == "images" else (), names=names)
        world = build_world(scenario, seed=seed, fps=fps, imperfections=wrong, depth=depth, team=team)
        solution = solved(world, SolveOptions("joint"))[0] if depth == "tracks" else from_images(world)
    except ColocError as error:
        return Outcome(failed=str(error), stances=len(plan.stances))
    true = align(solution.estimate.trajectories, truth_of(world), "A", on_floor=True)
    end, heading, variance = [], [], []
    for robot in plan.observers:
        T, q = solution.estimate.trajectories[robot].T_world_body[-1], true[robot][-1]
        covariances = solution.estimate.trajectories[robot].covariances
        assert covariances is not None
        variance.append(np.trace(covariances[-1][3:5, 3:5]))
        end.append(float(np.linalg.norm(T[:2, 3] - q[:2, 3])))
        off = math.atan2(T[1, 0], T[0, 0]) - math.atan2(q[1, 0], q[0, 0])
        heading.append(abs(math.degrees(math.remainder(off, math.tau))))
    stated = math.sqrt(np.mean(variance))
    used = {one.homography.stance for one in solution.measurements if solution.reason(one) is None}
    return Outcome(tuple(end), tuple(heading), stated, len(plan.stances) - len(used), len(plan.stances))


def from_images(world: World) -> Solution:
    """A world rendered and solved."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with atomic_run(path, world.team, image_format="raw") as writer:
            record(world, writer, "images")
        return solve(open_run(path), SolveOptions("joint"))


def rms(outcomes: Sequence[Outcome], what: str) -> float:
    """RMS over runs and observers."""
    return math.sqrt(np.mean([np.square(getattr(one, what)).mean() for one in outcomes if not one.failed]))


def ratio(outcomes: Sequence[Outcome], base: Sequence[Outcome], what: str) -> tuple[float, float, float]:
    """RMS as a share of the base's over paired seeds, with its bootstrap interval (95 %)."""
    pairs = [
        (np.square(getattr(a, what)).mean(), np.square(getattr(b, what)).mean())
        for a, b in zip(outcomes, base, strict=True)
        if not (a.failed or b.failed)
    ]
    return bootstrapped(np.array(pairs))


def bootstrapped(squares: np.ndarray) -> tuple[float, float, float]:
    """Root of the ratio of the sums of two columns (n, 2), with its bootstrap interval (95 %)."""
    drawn = np.random.default_rng(0).integers(len(squares), size=(BOOTSTRAPS, len(squares)))
    sums = squares[drawn].sum(axis=1)
    low, high = np.percentile(np.sqrt(sums[:, 0] / sums[:, 1]), [2.5, 97.5])
    return float(np.sqrt(squares[:, 0].sum() / squares[:, 1].sum())), float(low), float(high)


def promised_ratio(outcomes: Sequence[Outcome], sigma: float) -> tuple[float, float, float]:
    """Promised sigma of the end as a share of the RMS, with its bootstrap interval (95 %)."""
    return bootstrapped(np.array([(sigma**2, np.square(one.end).mean()) for one in outcomes if not one.failed]))


def stated_ratio(outcomes: Sequence[Outcome]) -> tuple[float, float, float]:
    """RMS of the end's sigmas that the estimator states as a share of the RMS, with its bootstrap interval (95 %)."""
    return bootstrapped(np.array([(one.stated**2, np.square(one.end).mean()) for one in outcomes if not one.failed]))


def share_interval(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact (Clopper-Pearson) interval of a share `count` of `total`."""
    low, high = (1 - confidence) / 2, (1 + confidence) / 2
    return (
        float(beta.ppf(low, count, total - count + 1)) if count else 0.0,
        float(beta.ppf(high, count + 1, total - count)) if count < total else 1.0,
    )


class Kept:
    """Outcomes of plans and seeds, kept in a file (JSON lines) if there is one."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._found: dict[tuple[str, int], Outcome] = {}
        if path is not None and path.exists():
            for row in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
                key = row.pop("plan"), row.pop("seed")
                self._found[key] = Outcome(**{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()})

    def of(self, plan: Plan, seed: int) -> Outcome | None:
        """Outcome of a seed, if it is there."""
        return self._found.get((digest(plan), seed))

    def add(self, plan: Plan, seed: int, one: Outcome) -> None:
        """Keep an outcome."""
        self._found[digest(plan), seed] = one
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"plan": digest(plan), "seed": seed, **asdict(one)}) + "\n")


def digest(plan: Plan) -> str:
    """Hash of a plan, whose numbers count to 1e-6."""
    rows = [
        [stance.mover, stance.duration, *stance.anchors, *(list(stance.standing.items())), *stance.waypoints]
        for stance in plan.stances
    ]
    rounded = json.loads(json.dumps(rows), parse_float=lambda text: round(float(text), 6))
    return hashlib.sha256(json.dumps(rounded).encode()).hexdigest()[:16]


def safety(mission: Mission, draws: int, floor_plan: FloorPlan | None) -> str:
    """Least distances, over draws of where robots stop, of middles of robots and from walls; in one line.

    Leaps, drives, and the mover's way from one drive to the next, at places every 2 cm, against the walls' rectangles,
    not the map of the planner.
    """
    rng = np.random.default_rng(0)
    drawn = [_least(mission.plan, rng, floor_plan) for _ in range(draws)]
    to_robot, to_wall = np.min([one[:2] for one in drawn], axis=0)
    collisions = sum(one[0] < 2 * RADIUS or one[1] < RADIUS for one in drawn)
    stopped = sum(one[2] for one in drawn)
    return (
        f"{collisions} of {draws} missions with a collision, {stopped} that could not go on; least distance of two "
        f"middles {to_robot:.3f} m, of a middle from a wall {to_wall:.3f} m (robots have a radius of {RADIUS} m)"
    )


def _least(plan: Plan, rng: np.random.Generator, floor_plan: FloorPlan | None) -> tuple[float, float, bool]:
    """Least distances of two middles and of one from walls in one drawn mission [m]; True if one finds no way."""
    free = None if floor_plan is None else floor_plan.floor_map().clear
    stood: dict[str, np.ndarray] = {}
    to_robot, to_wall, last = math.inf, math.inf, plan.stances[0].waypoints[0]
    for stance in plan.stances:
        places = {}
        for name, pose in stance.standing.items():
            if name in stance.anchors:
                places[name] = stood[name]
                continue
            leapt = math.dist(pose[:2], stood[name]) if name in stood else 0.0
            places[name] = np.array(pose[:2]) + rng.standard_normal(2) * float(stop_sigma(leapt))
        ways = [(dense(stance.waypoints), list(places.values()))]
        try:
            for name, place in places.items():
                others = [one for other, one in places.items() if other != name]
                start = stood.get(name, place)
                leap = dense([start, *route(start, place, others, free)] if name in stood else [place, place])
                ways.append((leap, others))
            if stood:  # it drives to there while the observers still stand where they did
                before = list(stood.values())
                ways.append((dense([last, *route(last, stance.waypoints[0], before, free)]), before))
        except InputError:
            return to_robot, to_wall, True
        for way, others in ways:
            to_robot = min(to_robot, *(float(np.hypot(*(way - other).T).min()) for other in others))
            to_wall = min(to_wall, math.inf if floor_plan is None else float(floor_plan.distance(way).min()))
        last, stood = stance.waypoints[-1], places
    return to_robot, to_wall, False


def dense(points: Sequence[Sequence[float]]) -> np.ndarray:
    """Places every 2 cm of a polyline."""
    at = np.asarray(points, float)
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(at, axis=0).T))])
    along = np.linspace(0.0, far[-1], max(int(far[-1] / 0.02), 1) + 1)
    return np.column_stack([np.interp(along, far, column) for column in at.T])


def outcomes(
    made: dict[str, Mission],
    seeds: Sequence[int],
    kept: Kept,
    work: Callable[[int, Plan], Outcome],
    until: float,
    processes: int,
) -> dict[str, list[Outcome]]:
    """Outcomes of all plans for the seeds for which there is time until `until`, seed by seed."""
    found: dict[str, list[Outcome]] = {name: [] for name in made}
    batch = 2 * processes
    for start in range(0, len(seeds), batch):
        some = seeds[start : start + batch]
        for mission in made.values():
            missing = [seed for seed in some if kept.of(mission.plan, seed) is None]
            if missing and time.monotonic() > until:
                return found
            if missing:
                for seed, one in zip(missing, over(missing, mission.plan, work, processes), strict=True):
                    kept.add(mission.plan, seed, one)
        for name, mission in made.items():
            found[name] += [one for seed in some if (one := kept.of(mission.plan, seed)) is not None]
    return found


def over(seeds: Sequence[int], plan: Plan, work: Callable[[int, Plan], Outcome], processes: int) -> list[Outcome]:
    """Outcomes of a plan for seeds, on several processes if so many are asked for."""
    one = partial(work, plan=plan)
    return [one(seed) for seed in seeds] if processes == 1 else over_seeds(one, seeds, processes)


def table(made: dict[str, Mission], found: dict[str, list[Outcome]], fps: float) -> dict[str, object]:
    """Print a row for each plan, with the ratios to the first one and to the best fixed gait, b2."""
    rows: dict[str, object] = {}
    first = next(iter(found))
    bases = [first, *(["b2"] if "b2" in found and first != "b2" else [])]
    for name, runs in found.items():
        if not runs:
            print(f"{name:8} no seeds yet: there was no time for one", flush=True)
            continue
        mission = made[name]
        promised, stated = promised_ratio(runs, mission.end_sigma), stated_ratio(runs)
        void, attempts = sum(one.void for one in runs), sum(one.stances for one in runs)
        ratios = {
            base: {what: ratio(runs, found[base], what) for what in ("end", "heading")}
            for base in bases
            if base != name
        }
        row = {
            "seeds": len(runs),
            "stances": len(mission.plan.stances),
            "images": round(mission.capture_time * fps),
            "mission_s": mission.duration,
            "end_mm": 1e3 * rms(runs, "end"),
            "promised_mm": 1e3 * mission.end_sigma,
            "stated_mm": 1e3 * math.sqrt(np.mean([one.stated**2 for one in runs if not one.failed])),
            "promised_over_realised": promised,
            "stated_over_realised": stated,
            "heading_deg": rms(runs, "heading"),
            "promised_heading_deg": math.degrees(mission.heading_sigma),
            "ratios": ratios,
            "void": void / attempts,
            "void_interval": share_interval(void, attempts),
            "failed": [one.failed for one in runs if one.failed],
        }
        rows[name] = row
        print(
            f"{name:8} {len(runs):3} seeds {row['stances']:3} stances {row['images']:5} images "
            f"{mission.duration:4.0f} s"
            f"  end {row['end_mm']:5.1f} mm (promised {row['promised_mm']:5.1f}, stated {row['stated_mm']:5.1f}, "
            f"over realised: promised {interval(promised)}, stated {interval(stated)})  "
            f"heading {row['heading_deg']:.3f} deg ({row['promised_heading_deg']:.3f})  "
            f"void {void} of {attempts} (at most {100 * row['void_interval'][1]:.2f} %)"
            + "".join(
                f"  of {base}: end {interval(one['end'])}, heading {interval(one['heading'])}"
                for base, one in ratios.items()
            )
            + (f"  failed {len(row['failed'])}: {row['failed'][0]}" if row["failed"] else ""),
            flush=True,
        )
    return rows


def promised(mission: Mission) -> str:
    """Promise of a mission, in one line."""
    heading, stances = math.degrees(mission.heading_sigma), mounted(mission)
    standing = sum(SETTLE for time in mission.leap_times if time)
    return (
        f"{len(mission.plan.stances):3} stances {mission.capture_time:5.0f} s of images {mission.duration:5.0f} s  "
        f"({standing:.0f} s settling)  end {1e3 * mission.end_sigma:5.1f} mm  heading {heading:.3f} deg  "
        + (f"mounts to {MOUNT_SIGMA_DEG:g} deg " + (f"in {stances} stances" if stances else "never"))
    )


def interval(found: tuple[float, float, float]) -> str:
    """A ratio with its interval."""
    return f"{found[0]:.2f} ({found[1]:.2f}-{found[2]:.2f})"


def main() -> int:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--images", type=int, metavar="SEEDS")
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of a stance of b0")
    parser.add_argument("--noise", type=float, default=0.3, help="of marker centres at depth tracks [px]")
    parser.add_argument("--length", type=float, default=LENGTH, help="length of the way [m]")
    parser.add_argument("--on", choices=FLOOR_PLANS, help="floor with walls")
    parser.add_argument("--safety", type=int, default=0, metavar="DRAWS")
    parser.add_argument("--robots", type=int, choices=range(3, 7), default=3, help="of the team; the last drives")
    parser.add_argument("--only", nargs="*", default=[], choices=NAMES, metavar="PLAN", help=", ".join(NAMES))
    parser.add_argument("--promises", action="store_true", help="print what plans promise, and simulate none")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="outcomes of earlier parts, to which this one adds")
    parser.add_argument("--for", dest="seconds_left", type=float, default=math.inf, help="begin no more after this [s]")
    parser.add_argument("--processes", type=int, default=2)
    args = parser.parse_args()
    until = time.monotonic() + args.seconds_left
    depth, seeds = ("images", args.images) if args.images else ("tracks", args.seeds)
    floor_plan = None if args.on is None else FLOOR_PLANS[args.on]
    names = tuple("ABCDEF"[: args.robots])
    wrong = replace(WRONG, noise_px=args.noise)
    expected = replace(wrong, noise_px=IMAGE_NOISE_PX) if args.images else wrong
    team = stated_team(reference_team(names=names), expected)
    made = missions(Scene.of(team, args.fps, args.seconds, args.length, floor_plan), args.only)
    found: dict[str, object]
    if args.promises:
        found = {name: promised(mission) for name, mission in made.items()}
        for name, text in found.items():
            print(f"{name:8} {text}", flush=True)
    elif args.safety:
        found = {name: safety(mission, args.safety, floor_plan) for name, mission in made.items()}
        for name, text in found.items():
            print(f"{name:8} {text}", flush=True)
    else:
        work = partial(outcome, fps=args.fps, wrong=wrong, depth=depth, names=names, floor_plan=floor_plan)
        every = range(args.first, args.first + seeds)
        runs = outcomes(made, every, Kept(args.keep), work, until, args.processes)
        found = table(made, runs, args.fps)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
