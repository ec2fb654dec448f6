"""A mission that is continued: which stances enter again, with which data, and where the robots then stand."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from coloc_graph.online.journal import Attempt, Journal, read_attempts
from coloc_graph.online.record import Record, begun, continued
from coloc_graph.online.resume import restore
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.pipeline.incremental import IncrementalSolver
from coloc_graph.robot_io.link.messages import Sample, Wheels
from coloc_graph.run import open_run

MISSION = Path(__file__).parents[1] / "missions" / "recorded" / "continued-after-a-kill"


@pytest.fixture(scope="module")
def run():
    return open_run(MISSION / "run.mcap")


@pytest.fixture(scope="module")
def attempts():
    return read_attempts(MISSION / "mission.jsonl")


def entered(run, attempts):
    return [one.stance.index for _, one in Journal(run, attempts).enter(IncrementalSolver(run.team))]


def test_a_stance_of_whose_data_the_record_lost_a_part_does_not_enter_again(run, attempts):
    first, second = attempts
    (detections, odometry) = second.recorded["A"]
    for lost in ((detections + 10_000, odometry), (detections, odometry + 10_000)):
        assert entered(run, [first, replace(second, recorded=second.recorded | {"A": lost})]) == [0]


def test_an_attempt_is_repeated_with_what_was_recorded_then(run, attempts):
    journal = Journal(run, attempts)
    for attempt in attempts:
        record = journal._then(attempt)
        for name, (detections, odometry) in attempt.recorded.items():
            assert [one.time for one in record.odometry(name)] == [one.time for one in run.odometry(name)][:odometry]
            assert sum(1 for _ in record.detections(name, 0.0, np.inf)) == detections
    # before the last attempt those that failed are repeated, since they left their trace in the estimate
    failed = replace(attempts[0], stance=replace(attempts[0].stance, index=5))
    assert [one.stance.index for one in Journal(run, [failed, *attempts]).attempts] == [0, 1, 5]
    assert [one.stance.index for one in Journal(run, [*attempts, failed]).attempts] == [0, 1]
    assert Journal(run, attempts[1:]).attempts[0] == Attempt(run.stances[0], {})  # of which the log has nothing


def test_a_continued_mission_has_its_robots_where_the_estimate_says(tmp_path, run):
    with Record(tmp_path / "run.mcap", run.team) as record:
        for name in run.team.names:
            for one in (*run.detections(name), *run.odometry(name)):
                record.take(one)
        starts = dict.fromkeys(run.team.names, (50.0, 50.0, 1.0))
        registry = RobotRegistry(record, starts, lambda _: lambda stamp: stamp, 0, {})
        stances = restore(run, MISSION / "mission.jsonl", IncrementalSolver(run.team), registry, threading.Event())
        assert stances == list(run.stances)
        rows = [json.loads(line) for line in (MISSION / "mission.jsonl").read_text().splitlines()]
        last = [row for row in rows if row["what"] == "entered"][-1]
        for name in "AB":  # who stood until the end
            x, y, _ = registry[name].tracker.pose()
            np.testing.assert_allclose((x, y), np.array(last["poses"][name])[:2, 3], atol=1e-3)
        # what comes again is taken once: odometry by its time, to 5 ms of a clock compared anew, images by their pixels
        for later, kept in ((0.004, False), (0.006, True)):
            for name in "AB":
                wheels, seen = list(run.odometry(name))[-1], list(run.detections(name))[-1]
                at = [round((one.time + later) * 1e9) for one in (wheels, seen)]
                registry.take_wheels(name, Wheels.of(wheels, session="1", number=0, stamp=at[0]))
                assert (record.last_odometry(name).time > wheels.time) == kept
                sample = Sample.of(seen, session="1", number=0, capture=0, stamp=at[1])
                assert registry.take_sample(name, sample) is None
                moved = msgspec.structs.replace(sample, uv=[(u + 0.1, v) for u, v in sample.uv])
                assert registry.take_sample(name, moved) is not None
        stop = threading.Event()
        stop.set()
        assert restore(run, MISSION / "mission.jsonl", IncrementalSolver(run.team), registry, stop) == []


def test_a_record_can_be_continued_from_its_first_moment(tmp_path, run):
    def left_behind(name):  # as by a coordinator that is killed now
        return shutil.copy(tmp_path / "run.mcap", tmp_path / name)

    with begun(tmp_path / "run.mcap", run.team) as record:
        again, before = continued(left_behind("killed.mcap"), run.team)
        again.__exit__(None, None, None)
        assert before.team == run.team and not before.stances
        for one in run.detections("A"):
            record.take(one)
    with continued(tmp_path / "run.mcap", run.team)[0]:
        copied = [one.time for one in open_run(left_behind("again.mcap")).detections("A")]
    assert copied == [one.time for one in run.detections("A")]
