"""Who moved is inferred where nothing states it; what wheels say of a bump is told."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from coloc_graph.backend import Bump
from coloc_graph.backend.graph import StayPut
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.pipeline.batch import solve
from coloc_graph.pipeline.moves import described_bumps
from coloc_graph.run import OdometrySample, RunWriter, open_run
from coloc_graph.simulation import simulate


def without_moves(path, scenario, tmp_path, **options):
    """A simulated run of which only tracks are left, as an import of tracks without moves makes it."""
    made = tmp_path / "made.mcap"
    simulate(scenario, made, seed=3, **options)
    run, standing, stances = open_run(made), set(), []
    for stance in run.stances:
        stances.append(replace(stance, anchors=tuple(one for one in stance.observers if one in standing)))
        standing = (standing | set(stance.observers)) - set(stance.movers)
    with RunWriter(path, run.team, flush_every=None) as writer:
        records = [*stances, *(one for name in run.team.names for one in run.detections(name))]
        for one in sorted(records, key=lambda one: getattr(one, "time", getattr(one, "start", 0.0))):
            writer.write(one)
    return open_run(path), run


def test_of_three_observers_the_one_that_moved_is_inferred_and_the_others_stay_anchors(tmp_path):
    run, right = without_moves(tmp_path / "run.mcap", "team", tmp_path, robots=4, stances=4, points=200)
    solution = solve(run)
    moved = {(r, a.index) for b, a in zip(right.stances, right.stances[1:], strict=False)
             for r in run.stances[a.index].anchors if r not in a.anchors and r in b.observers}  # fmt: skip
    said = [one for one in solution.warnings if "--moves" in one]
    assert len(said) == bool(moved)
    assert all(f"{robot} moved before stance {stance}" in said[0] for robot, stance in moved)
    assert not solution.estimate.bumped and not solution.estimate.rejected


def test_of_two_observers_neither_is_an_anchor_and_the_sentence_says_what_to_give(tmp_path):
    run, _ = without_moves(tmp_path / "run.mcap", "hallway", tmp_path, stances=3, points=100)
    solution = solve(run)
    (said,) = [one for one in solution.warnings if "--moves" in one]
    assert "A or B moved before stance 1" in said and "not known" in said
    assert not any("bumped" in one or "rejected" in one for one in solution.warnings)
    assert all(0 in one.stances.tolist() and 2 not in one.stances.tolist()
               for one in solution.estimate.trajectories.values())  # fmt: skip


@pytest.mark.parametrize(
    ("way", "told"), [(0.3, "by its wheels it drove 30 cm"), (0.0, "odometry never changes"), (None, "did not turn")]
)
def test_what_wheels_say_of_a_bump_is_told(tmp_path, way, told):
    simulate("hallway", tmp_path / "run.mcap", stances=2, points=20, seed=1)
    run = open_run(tmp_path / "run.mcap")
    begin, end = run.stances[0].end, run.stances[1].start

    class Driven:
        def odometry(self, robot):
            for time in np.linspace(begin - 5, end + 5, 50).tolist():
                part = np.clip((time - begin) / (end - begin), 0, 1) * (way or 0.0)
                part += 0.0 if way is not None else 0.2 * (time < begin - 2)
                yield OdometrySample(robot, time, np.array([part, 0.0, 0.0]), np.eye(3) * 1e-8)

    bump = Bump(StayPut("A", 0, 1), gtsam.Pose3(floor_pose(0.3, 0.0, 0.0)), 50.0)
    (said,) = described_bumps(Driven(), {one.index: one for one in run.stances}, [bump])
    assert told in said
