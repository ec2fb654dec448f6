"""Clocks of robots that differ by seconds, or are set: found from motion, corrected, and told."""

import re
from dataclasses import replace

import msgspec
import pytest
from teams import graph_of_team, team_of

from coloc_graph.backend import smooth
from coloc_graph.evaluation import align, evaluate
from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.frontend.clock_evidence import ClockEvidence
from coloc_graph.frontend.pairing.clock_offset import ClockOffset
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Odometry
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.clock_table import clock_table
from coloc_graph.pipeline.clocks import clocks_instead, clocks_of_images_apart, run_clocks, unknown_clocks
from coloc_graph.planning.formation import PAPER
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.run import Clocks, RobotClock, RunWriter, atomic_run, open_run, read_truth
from coloc_graph.simulation import Imperfections, build_world, record, reference_team, simulate
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import MILD_LENS
from coloc_graph.simulation.world import stream

STANCES = 5


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """A run of four robots whose clocks are right."""
    path = tmp_path_factory.mktemp("clocks") / "run.mcap"
    simulate("team", path, robots=4, stances=STANCES, points=300, seed=4)
    return open_run(path)


@pytest.fixture(scope="module")
def solved_right(right):
    return solve(right)


def with_clock(run, path, robot, error, kinds=("detections", "odometry")):
    """The same run where one robot's stamps are off by `error` [s] at each time."""
    records = [*run.stances]
    for name in run.team.names:
        wrong = name == robot
        for kind in ("detections", "odometry"):
            every = list(getattr(run, kind)(name))
            if wrong and kind in kinds:
                every = [replace(one, time=one.time + error(one.time)) for one in every]
            records += every
    with RunWriter(path, run.team, flush_every=None) as writer:
        for one in sorted(records, key=lambda one: getattr(one, "time", getattr(one, "start", 0.0))):
            writer.write(one)
    return open_run(path)


def ate(solution, run):
    true = align(solution.estimate.trajectories, read_truth(run.path), run.team.reference, on_floor=True)
    return evaluate(solution.estimate.trajectories, true, on_floor=True).ate


def middle(run):
    return (run.stances[1].end + run.stances[2].start) / 2


CASES = {
    "a second ahead": (lambda run: lambda t: 1.0, "B's clock is 1.00", "ahead of"),
    "three seconds behind": (lambda run: lambda t: -3.0, "s behind the other robots'", "B's clock is "),
    "set": (lambda run: lambda t: 1.0 if t > middle(run) else 0.0, "B's clock was set ahead by 1.00", "by motion"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_clock_that_is_off_is_found_from_motion_and_told_and_costs_no_accuracy(right, solved_right, tmp_path, case):
    error, told, way = CASES[case]
    solution = solve(with_clock(right, tmp_path / "wrong.mcap", "B", error(right)))
    sentences = [one for one in solution.warnings if "clock" in one and "not observable" not in one]
    assert len(sentences) == 1, sentences
    sentence = sentences[0]
    assert told in sentence and way in sentence
    assert not solution.estimate.bumped and not solution.estimate.rejected
    assert ate(solution, right) < 1.5 * ate(solved_right, right) + 2e-4


def test_wheels_whose_clock_is_off_are_found_against_the_cameras(right, solved_right, tmp_path):
    solution = solve(with_clock(right, tmp_path / "wrong.mcap", "D", lambda t: 0.6, kinds=("odometry",)))
    sentences = [one for one in solution.warnings if "clock" in one and "not observable" not in one]
    assert len(sentences) == 1 and "the clock of D's odometry is " in sentences[0]
    offset, sigma = (float(one) for one in re.findall(r"[\d.]+(?= s ahead| ms)", sentences[0]))
    assert offset == pytest.approx(0.6, abs=4e-3 * sigma) and sigma < 4  # [s] and [ms]: near the Cramer-Rao bound
    assert not solution.estimate.bumped and not solution.estimate.rejected
    assert ate(solution, right) < 1.5 * ate(solved_right, right) + 2e-4


def test_a_clock_that_is_off_is_found_stance_by_stance(right, tmp_path):
    solution = solve(with_clock(right, tmp_path / "wrong.mcap", "B", lambda t: 0.7), SolveOptions(incremental=True))
    assert any("B's clock is 0.70" in one for one in solution.warnings)
    assert not solution.estimate.bumped and not solution.estimate.rejected


def test_clocks_that_are_right_are_left_alone(solved_right):
    assert not any("clock" in one for one in solved_right.warnings)


@pytest.mark.parametrize(
    ("offsets", "wrong"),
    [
        ((1.7,), False),  # one stance alone
        ((1.7, 1.7), True),
        ((0.0, 1.7, -0.4, 2.2, 0.9), False),  # no clock explains it
        ((1.7, 1.7, 1.7, 1.7, 1.7), True),
    ],
)
def test_a_clock_is_wrong_only_where_stances_agree_on_it(right, offsets, wrong):
    evidence = [
        ClockEvidence(stance.index, stance.start, ("A", "camera"), ("B", "camera"), ClockOffset(offset, 1e-3))
        for stance, offset in zip(right.stances, offsets, strict=False)
    ]
    clocks = run_clocks(right.team, right.stances, evidence)
    assert (clocks is not None) == wrong
    if clocks is not None:
        assert (
            "B's clock is 1.700 s" in clocks.sentences()[0]
            and "A's clock may be the wrong one" in clocks.sentences()[0]
        )


@pytest.mark.parametrize(("drift", "wrong"), [(2e-4, True), (0.1, False)])
def test_a_clock_drifts_no_faster_than_computers_do(right, drift, wrong):
    evidence = [
        ClockEvidence(n, 100.0 * n, ("A", "camera"), ("B", "camera"), ClockOffset(100.0 * drift * n, 2e-3))
        for n in range(STANCES)
    ]
    clocks = run_clocks(right.team, right.stances, evidence)
    assert (clocks is not None) == wrong
    if clocks is not None:
        assert clocks.clocks["B", "camera"].segments[0].drift == pytest.approx(drift, rel=0.1)


def test_the_reference_s_clock_is_wrong_where_most_robots_share_another(right):
    """Stances are of the clock that most share, and the time of others must not be moved away from it."""
    evidence = [
        ClockEvidence(stance.index, stance.start, ("A", "camera"), (robot, kind), ClockOffset(1.5 + late, sigma))
        for stance in right.stances
        for robot, kind, late, sigma in (("B", "camera", 0.0, 1e-4), ("C", "wheels", 4e-3, 4e-3))
    ]
    clocks = run_clocks(right.team, right.stances, evidence)
    (sentence,) = clocks.sentences()
    assert "A's clock is 1.500 s behind the other robots'" in sentence
    assert [sensor for sensor, clock in clocks.clocks.items() if not clock.is_right] == [("A", "camera")]


def test_the_table_shows_offsets_by_motion(right, tmp_path):
    rows = clock_table(with_clock(right, tmp_path / "wrong.mcap", "B", lambda t: 1.0))
    offsets = {(row.robot, row.known.split(", ")[1]): float(row.offset.split(" s")[0]) for row in rows}
    assert offsets["B", "camera"] == pytest.approx(1.0, abs=0.01)
    assert all(abs(one) < 0.03 for (robot, _), one in offsets.items() if robot != "B")


def test_the_table_shows_what_an_import_found_and_who_is_unknown(right, tmp_path):
    found = RobotClock("B", -1.0, 1e-4, ((right.stances[1].start, 0.5),), 2e-3, "stamps against reception of /B/odom")
    with RunWriter(tmp_path / "run.mcap", msgspec.structs.replace(right.team, clock_sigma=5e-3)) as writer:
        writer.write(Clocks(right.stances[0].start, (found,)))
        for name in "AB":
            writer.write(next(iter(right.odometry(name))))
    run = open_run(tmp_path / "run.mcap")
    assert run.clocks() == (found,) and not run.warnings
    unknown, row = clock_table(run)
    assert (row.robot, row.offset, row.drift, row.jitter) == ("B", "-1.0000 s", "+100 ppm", "2.0 ms")
    assert row.steps.startswith("+0.500 s at") and "/B/odom (corrected)" in row.known
    assert unknown.robot == "A" and "5 ms (clock_sigma)" in unknown.known


def test_cameras_that_take_no_images_at_once_are_taken_to_differ_by_what_lies_between(right):
    stance = right.stances[0]
    one = measure_pair(right, stance, *stance.observers[:2], FrontendOptions())
    assert clocks_of_images_apart([one]) is None
    later = [replace(track, times=track.times + 0.05) for track in one.seen[1]]
    found = clocks_of_images_apart([replace(one, seen=(one.seen[0], later))])
    assert found.corrected(right).team.clock_sigma == pytest.approx(0.05, abs=1e-3)
    assert "images are 50 ms apart" in found.sentences()[0] and "`clock_sigma`" in found.sentences()[0]


def test_unknown_clocks_are_weighed_against_other_causes(right):
    team = team_of(3, 4, 2)
    (way, *_) = [m for m in team.measurements if isinstance(m, Odometry)]
    bad = replace(way, T_before_after=way.T_before_after @ floor_pose(0.3, 0.2, 0.0))
    healthy = smooth(graph_of_team(team))
    plain = smooth(graph_of_team(team, [bad if m is way else m for m in team.measurements]))
    assert plain.rejected or plain.bumped
    said = clocks_instead(right, plain, healthy)
    assert "A's clock or B's clock" in said and "or else" in said and "equally well" in said
    assert clocks_instead(right, healthy, plain) is None
    contradictory = replace(plain, chi2=plain.chi2 + 1000)
    assert "or else" not in clocks_instead(right, contradictory, healthy)
    assert unknown_clocks(right).corrected(right).team.clock_sigma == pytest.approx(0.25)


@pytest.mark.long
def test_paths_by_wheels_that_fit_no_better_with_another_clock_correct_none(tmp_path):
    stances = []
    for k in range(10):
        anchor, leaper = ("A", "B") if k % 2 == 0 else ("B", "A")
        x = PAPER.leap * k
        standing = {anchor: PAPER.stop(k), leaper: PAPER.stop(k + 1)}
        drive = ((x + 1.2, 0.0), (x + 2.2, 0.5), (x + 2.2, -0.5))
        stances.append(PlannedStance(standing, (anchor,) if k else (), "C", drive, 5.0))
    uneven = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
    scenario, team = planned(Plan(tuple(stances)), stream(1, "formation")), reference_team(MILD_LENS)
    world = build_world(scenario, seed=1, fps=10.0, imperfections=uneven, depth="images", team=team)
    with atomic_run(tmp_path / "run.mcap", world.team, image_format="raw") as writer:
        record(world, writer, "images")
    solution = solve(open_run(tmp_path / "run.mcap"))
    assert not [one for one in solution.warnings if "stamps were corrected" in one]  # one by 0.14 s, and 30 mm
