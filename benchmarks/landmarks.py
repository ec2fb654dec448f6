"""Drift against distance, with landmarks and without: a leap-frog of 100 m, four laps of a square course.

Mounts off by 0.5 deg and 3 mm, spans by 0.1 mm, the floor by 0.05 deg (one sigma each), 0.3 px, 100 points a stance;
the joint estimate. Two landmarks a lap, each two lights 0.4 m apart, seen from up to 3 m.

    python benchmarks/landmarks.py                      # a table and docs/images/landmarks.png
    python benchmarks/landmarks.py --seeds 4 --json
"""

import argparse
import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from monte_carlo import MemoryRun, over_seeds, truth_of
from msgspec.structs import replace as with_fields
from scipy.stats import t as student

from coloc_graph.evaluation import align, evaluate, nees_of
from coloc_graph.geometry.lie import floor_pose, se3_inverse, yaw
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.report.drawing import COLOURS, styled
from coloc_graph.run import Detections
from coloc_graph.simulation import Imperfections, World, build_world, scenario
from coloc_graph.simulation.scenarios import COURSE_GAIT
from coloc_graph.simulation.world import stream

FIELD = Imperfections(mount_sigma_deg=0.5, height_sigma=0.003, span_sigma=1e-4, floor_sigma_deg=0.05)
MODES = ("none", "unknown", "known")
TITLES = {"none": "without", "unknown": "seen again, places unknown", "known": "and on a map (5 mm, 0.5 deg)"}
#: Errors are gathered over so much of the way [m].
BIN = 2.5
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "landmarks.png"


@dataclass(frozen=True)
class Outcome:
    """Figures of one run.

    RMS position errors of the pair by distance [m], of the end, heading there [deg], NEES of the last standing pose and
    of all, of the landmarks, and their errors [m].
    """

    by_distance: list[float]
    end: float
    heading_deg: float
    nees_last: float
    anees: float
    nees_landmarks: list[float]
    landmark_errors: list[float]
    chi2_per_dof: float
    refused: int
    seconds: float


def blind(run: MemoryRun) -> MemoryRun:
    """The same run of a team that has no landmarks."""
    run.team = with_fields(run.team, landmarks=())
    for robot, detections in run._detections.items():
        run._detections[robot] = [_without(one) for one in detections]
    return run


def _without(one: Detections) -> Detections:
    kept = np.array([not marker.startswith("L") for marker in one.markers], bool)
    arrays = {name: getattr(one, name)[kept] for name in ("uv", "covariance", "flags", "peak", "area")}
    return replace(one, markers=tuple(m for m, keep in zip(one.markers, kept, strict=True) if keep), **arrays)


def of_seed(seed: int, mode: str, length: float, laps: int) -> Outcome:
    """One run, solved."""
    what = scenario("landmarks", length=length, laps=laps, rng=stream(seed, "formation"))
    world = build_world(what, seed=seed, points=100, imperfections=FIELD, known=mode == "known")
    run = MemoryRun(world) if mode != "none" else blind(MemoryRun(world))
    solution = solve(run, SolveOptions())
    estimate = solution.estimate
    true = align(estimate.trajectories, truth_of(world), "A", on_floor=True)
    accuracy = evaluate(estimate.trajectories, true, on_floor=True)
    squares: dict[int, list[float]] = {}
    for robot in ("A", "B"):
        trajectory = estimate.trajectories[robot]
        assert trajectory.stances is not None
        off = np.linalg.norm(trajectory.positions[:, :2] - true[robot][:, :2, 3], axis=1)
        for stance, error in zip(trajectory.stances.tolist(), off.tolist(), strict=True):
            squares.setdefault(int(stance * COURSE_GAIT.leap / BIN), []).append(error**2)
    last = nees_of(estimate.trajectories["A"], true["A"], [2, 3, 4])[-1]
    errors, nees = _of_landmarks(solution.estimate.landmarks, world)
    return Outcome(
        by_distance=[float(np.sqrt(np.mean(squares[n]))) for n in sorted(squares)],
        end=accuracy.end_position_error,
        heading_deg=accuracy.heading_error_deg,
        nees_last=float(last),
        anees=accuracy.anees or float("nan"),
        nees_landmarks=nees,
        landmark_errors=errors,
        chi2_per_dof=estimate.chi2 / estimate.dof,
        refused=len(estimate.rejected),
        seconds=solution.seconds_backend,
    )


def _of_landmarks(placed: dict, world: World) -> tuple[list[float], list[float]]:
    """Errors [m] and NEES per degree of freedom of landmarks, in the estimate's world."""
    x, y, _ = (T := world.paths["A"].pose_at([world.stances[0].start])[0])[:3, 3]
    T_estimate_world = se3_inverse(floor_pose(x, y, float(yaw(T))))
    errors, nees = [], []
    for name, one in placed.items():
        T_true = T_estimate_world @ world.T_world_landmark[name]
        errors.append(float(np.linalg.norm(T_true[:2, 3] - one.T_world_body.translation()[:2])))
        track = Trajectory(name, np.zeros(1), one.T_world_body.matrix()[None], None, one.covariance[None])
        nees += nees_of(track, T_true[None], [2, 3, 4]).tolist()
    return errors, nees


def mean_interval(values: list[float]) -> tuple[float, float, float]:
    """Mean and its 95 % interval."""
    mean, n = float(np.mean(values)), len(values)
    half = float(student.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    return mean, mean - half, mean + half


@styled
def figure(found: dict[str, list[Outcome]]) -> Figure:
    """Errors by distance: the mean over the seeds, with its 95 % interval."""
    drawn = Figure(figsize=(9, 4.2), layout="constrained")
    axes = drawn.add_subplot(xlabel="way of the team [m]", ylabel="position error [cm], mean over the runs")
    for mode, colour in zip(MODES, COLOURS, strict=False):
        table = 100 * np.array([one.by_distance for one in found[mode]])
        at = BIN * (np.arange(table.shape[1]) + 0.5)
        mean, low, high = np.array([mean_interval(column.tolist()) for column in table.T]).T
        axes.plot(at, mean, color=colour, linewidth=1.8, label=TITLES[mode],
                  linestyle="--" if mode == "known" else "-")  # fmt: skip
        axes.fill_between(at, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, BIN * table.shape[1])
    axes.legend(title=f"landmarks, {len(found['none'])} runs; bands: 95 % of the mean", loc="upper left")
    return drawn


def summarised(outcomes: list[Outcome]) -> dict[str, object]:
    """A mode over its seeds."""
    laps = np.array([one.by_distance for one in outcomes])
    quarters = [100 * float(part.mean()) for part in np.array_split(laps.mean(axis=0), 4)]
    landmarks = [error for one in outcomes for error in one.landmark_errors]
    return {
        "runs": len(outcomes),
        "error_by_quarter_cm": quarters,
        "end_cm": [100 * value for value in mean_interval([one.end for one in outcomes])],
        "heading_deg": mean_interval([one.heading_deg for one in outcomes]),
        "nees_last": mean_interval([one.nees_last for one in outcomes]),
        "anees": mean_interval([one.anees for one in outcomes]),
        "nees_landmarks": mean_interval([v for one in outcomes for v in one.nees_landmarks]) if landmarks else None,
        "landmarks_cm": 100 * float(np.sqrt(np.mean(np.square(landmarks)))) if landmarks else None,
        "chi2_per_dof": float(np.mean([one.chi2_per_dof for one in outcomes])),
        "refused": sum(one.refused for one in outcomes),
        "graph_s": float(np.mean([one.seconds for one in outcomes])),
    }


def main() -> None:
    """Run it, print it, draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--length", type=float, default=100.0)
    parser.add_argument("--laps", type=int, default=4)
    parser.add_argument("--picture", type=Path, default=PICTURE)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = {
        mode: over_seeds(partial(of_seed, mode=mode, length=options.length, laps=options.laps), range(options.seeds))
        for mode in MODES
    }
    print(json.dumps({mode: summarised(found[mode]) for mode in MODES}, indent=None if options.json else 2))
    figure(found).savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()
