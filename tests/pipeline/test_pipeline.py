"""From a run to an estimate: accuracy, repeatability, ignorance of the truth, and runs that are partly bad."""

import dataclasses
import itertools
import re

import msgspec
import numpy as np
import pytest

from coloc_graph.errors import EstimationError, InputError
from coloc_graph.evaluation import align, evaluate
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.pipeline.batch import METHODS, SolveOptions, solve
from coloc_graph.pipeline.inspection import inspect
from coloc_graph.results.writer import summarise
from coloc_graph.run import Detections, Planes, Stance, atomic_run, open_run, read_truth
from coloc_graph.simulation import reference_team


def same_trajectories(a, b):
    assert list(a.estimate.trajectories) == list(b.estimate.trajectories)
    for robot, one in a.estimate.trajectories.items():
        other = b.estimate.trajectories[robot]
        for name in ("times", "T_world_body", "stances", "covariances"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), (robot, name)


@pytest.mark.parametrize("method", METHODS)
def test_the_hallway_is_found_within_its_own_sigmas(solutions, hallway, method):
    solution = solutions[method]
    trajectories = solution.estimate.trajectories
    true = align(trajectories, read_truth(hallway), "A", on_floor=True)
    accuracy = evaluate(trajectories, true, on_floor=True)
    # the mover has a pose at every stance too, where it was seen; the paper's chain has the observers alone
    assert {row.robot for row in accuracy.robots} == ({"A", "B"} if method == "chain" else {"A", "B", "C"})
    assert accuracy.ate < 0.03 and accuracy.end_position_error < 0.06 and accuracy.heading_error_deg < 2
    for robot, trajectory in trajectories.items():
        off = (
            trajectory.T_world_body[:, :3, :3].swapaxes(1, 2)
            @ (trajectory.positions - true[robot][:, :3, 3])[..., None]
        )
        sigma = np.sqrt(trajectory.covariances[:, [3, 4], [3, 4]])
        assert (np.abs(off[:, :2, 0]) < 4.5 * sigma + 1e-5).all(), robot
        # not so large that anything would fit
        assert sigma.max() < 0.1
    assert accuracy.nees_poses == (8 if method == "chain" else 16) and 0.05 < accuracy.anees < 4
    # a chain says that it takes no odometry
    assert [one.split(" ", 1)[1] for one in solution.warnings] == [
        "odometry samples not used: a chain composes relative poses alone"
    ] * (method == "chain")
    assert [m.homography.stance for m in solution.measurements] == list(range(8))


def test_maximum_likelihood_promises_more_than_the_papers_road(solutions):
    """The same run, the smaller covariance: otherwise smoothing threw something away."""
    sigma = {
        method: np.sqrt(np.trace(solutions[method].estimate.trajectories["A"].covariances[-1][3:5, 3:5]))
        for method in ("smooth", "chain")
    }
    assert sigma["smooth"] < sigma["chain"]


@pytest.mark.parametrize("method", METHODS)
def test_solving_twice_gives_the_same_to_the_bit(short, method):
    first, second = (solve(open_run(short), SolveOptions(method=method)) for _ in range(2))
    same_trajectories(first, second)
    assert first.estimate.chi2 == second.estimate.chi2


def test_the_estimate_does_not_depend_on_the_truth_in_the_run(short, short_solution, copied, tmp_path):
    without = copied(short, tmp_path / "without.mcap")
    assert read_truth(short) and not read_truth(without)
    same_trajectories(short_solution, solve(open_run(without)))


def test_a_run_has_no_way_to_its_truth(short):
    run = open_run(short)
    assert not [topic for topic in run.topics if "truth" in topic]
    assert not [name for name in dir(run) if "tru" in name]
    assert not [info.topic for info in run._index.channels.values() if "tru" in info.topic]


def spoilt(source, to, copied, collinear, stance_numbers):
    spans = [(s.start, s.end) for s in open_run(source).stances if s.index in stance_numbers]

    def change(record):
        if isinstance(record, Detections) and any(start <= record.time <= end for start, end in spans):
            return collinear(record)
        return record

    return open_run(copied(source, to, change=change))


@pytest.mark.parametrize("method", ["chain", "joint"])
def test_a_straight_drive_in_the_middle_is_a_warning_and_what_hung_on_it_is_untied(
    hallway, solutions, copied, collinear, tmp_path, method
):
    run = spoilt(hallway, tmp_path / "bad.mcap", copied, collinear, {3})
    solution = solve(run, SolveOptions(method=method, odometry=False))
    assert [m.homography.stance for m in solution.measurements if m.homography.unusable] == [3]
    assert any("stance 3" in warning and "line" in warning and "turn" in warning for warning in solution.warnings)
    # at stance 3 B is the anchor and A has moved: from there on nothing ties A, and with it anything
    assert solution.estimate.disconnected[0] == ("A", 3)
    assert {stance for _, stance in solution.estimate.disconnected} == set(range(3, 8))
    assert any(
        re.match(r"A.* at stances 3 to 7: not tied to the reference; .*A.* would tie", w) for w in solution.warnings
    )
    # what came before is as if nothing had happened
    for robot, whole in solutions[method].estimate.trajectories.items():
        part = solution.estimate.trajectories[robot]
        if robot == "C":
            continue
        assert part.stances.max() <= 3
        np.testing.assert_allclose(part.T_world_body, whole.T_world_body[: len(part)], atol=0.02)


def test_wheels_bridge_a_stance_without_a_homography_with_the_sigma_that_wheels_have(
    hallway, solutions, copied, collinear, tmp_path
):
    solution = solve(spoilt(hallway, tmp_path / "bad.mcap", copied, collinear, {3}))
    whole = solutions["joint"].estimate
    assert not solution.estimate.disconnected
    ratio = solution.estimate.covariance("A", 3)[3, 3] / whole.covariance("A", 3)[3, 3]
    assert ratio > 1.5
    for robot, trajectory in whole.trajectories.items():
        part = solution.estimate.trajectories[robot]
        off = part.positions - trajectory.positions[np.isin(trajectory.stances, part.stances)]
        assert np.abs(off).max() < 0.06, robot


def test_a_straight_drive_at_the_end_costs_the_last_pose_alone(hallway, copied, collinear, tmp_path):
    run = spoilt(hallway, tmp_path / "bad.mcap", copied, collinear, {7})
    solution = solve(run, SolveOptions(method="chain"))
    assert {stance for _, stance in solution.estimate.disconnected} == {7} and len(solution.estimate.disconnected) == 1


def test_nothing_but_straight_drives_is_an_error_with_its_remedy(short, copied, collinear, tmp_path):
    run = spoilt(short, tmp_path / "bad.mcap", copied, collinear, {0, 1, 2})
    with pytest.raises(EstimationError, match=r"bad.mcap: no stance gives a relative pose; stance 0, .*turn") as e:
        solve(run)
    assert "let it turn (the same in 3 of 3 measurements)" in str(e.value)


def test_of_several_reasons_each_is_counted(hallway, copied, collinear, tmp_path):
    stances = open_run(hallway).stances

    def change(record):
        if not isinstance(record, Detections):
            return record
        (index,) = [s.index for s in stances if s.start <= record.time <= s.end] or [-1]
        return (
            collinear(record)
            if index < 3
            else dataclasses.replace(record, markers=tuple(f"{one}{record.robot}" for one in record.markers))
        )

    with pytest.raises(EstimationError) as refusal:
        solve(open_run(copied(hallway, tmp_path / "bad.mcap", change=change)))
    first, second, *_ = str(refusal.value).split("; ")[1:]
    assert "no marker name is shared" in first and first.endswith("(the same in 5 of 8 measurements)")
    assert "one line" in second and second.endswith("(the same in 3 of 8 measurements)")


def test_a_bad_first_stance_ties_nobody_and_says_so(short, copied, collinear, tmp_path):
    run = spoilt(short, tmp_path / "bad.mcap", copied, collinear, {0})
    with pytest.raises(EstimationError, match=r"no measurement ties a robot to the reference A; stance 0, .*turn"):
        solve(run, SolveOptions(odometry=False))


def test_a_healthy_run_agrees_with_itself_as_well_as_its_noise_lets_it(solutions):
    estimate = solutions["smooth"].estimate
    # 3 a homography from the floor, 3 for each of 6 ways of A and B and of 7 of C that wheels measured too
    assert estimate.dof == 66
    assert 35 < estimate.chi2 < 108  # the 0.1 % tails


def test_mounts_that_are_not_as_stated_are_warned_of(hallway, copied, tmp_path):
    team = open_run(hallway).team
    tilted = tuple(
        msgspec.structs.replace(
            robot, mount_if_any=msgspec.structs.replace(robot.mount, tilt_deg=robot.mount.tilt_deg + d)
        )
        for robot, d in zip(team.robots, (2.0, -2.0, 0.0), strict=True)
    )
    run = open_run(copied(hallway, tmp_path / "tilted.mcap", team=msgspec.structs.replace(team, robots=tilted)))
    options = SolveOptions("smooth", odometry=False)
    (warning,) = [one for one in solve(run, options).warnings if "the measurements disagree" in one]
    assert "with 24 degrees of freedom" in warning and "by noise alone below 1e-9" in warning


def test_whether_measurements_disagree_depends_on_the_degrees_of_freedom(solutions):
    from coloc_graph.pipeline.explanations import warnings_of_graph

    estimate = solutions["smooth"].estimate
    for dof, chi2, warned in ((1, 10.0, False), (1, 20.0, True), (24, 55.0, False), (600, 1500.0, True)):
        warnings = warnings_of_graph(dataclasses.replace(estimate, chi2=chi2, dof=dof), ())
        assert (len(warnings) == 1) == warned, (dof, chi2)
        assert all(f"chi2/dof {chi2 / dof:.1f}" in one and "by noise alone" in one for one in warnings)


def test_a_prediction_that_is_off_by_half_is_warned_of_and_a_tenth_is_not(solutions):
    from coloc_graph.pipeline.explanations import warnings_of_graph

    estimate = solutions["smooth"].estimate
    for chi2, said in ((750.0, None), (950.0, "disagree"), (450.0, None), (200.0, "agree better than expected")):
        warnings = warnings_of_graph(dataclasses.replace(estimate, chi2=chi2, dof=600), (), ())
        assert len(warnings) == (said is not None), (chi2, warnings)
        assert said is None or said in warnings[0]


def with_camera_at(run, copied, to, **mount):
    team = run.team
    robots = tuple(
        msgspec.structs.replace(robot, mount_if_any=msgspec.structs.replace(robot.mount, **mount))
        for robot in team.robots
    )
    return open_run(copied(run.path, to, team=msgspec.structs.replace(team, robots=robots)))


@pytest.mark.parametrize(
    ("mount", "words"),
    [
        ({"height": 0.55}, "0.40 m apart, and the team says 0.25 m"),
        ({"height": 400.0}, "m away from A"),
        ({"tilt_deg": -30.0}, "above the horizon"),
    ],
)
def test_heights_and_tilts_that_the_markers_contradict_are_warned_of_and_found(short, copied, tmp_path, mount, words):
    run = with_camera_at(open_run(short), copied, tmp_path / "run.mcap", **mount)
    try:
        said = " ".join(solve(run).warnings)
    except EstimationError as refusal:
        said = str(refusal)
    assert "correct heights, tilt or units (metres?) in the team" in said
    assert "stance 0 (and 1 more alike): " in said and words in said
    assert [finding.where for finding in inspect(run) if words in finding.what][:1] == ["stance 0"]


def test_a_stated_plane_that_the_markers_contradict_is_warned_of(short, copied, tmp_path):
    run = open_run(short)
    with atomic_run(tmp_path / "run.mcap", run.team) as writer:
        for stance in run.stances:
            writer.write(stance)
            writer.write(Planes(stance.index, stance.start, {stance.observers[0]: (0.0, 0.93969262, 0.34202014, 0.5)}))
            for robot in stance.observers:
                for one in run.detections(robot, stance.start, stance.end):
                    writer.write(one)
    planes = open_run(tmp_path / "run.mcap")
    assert any("correct the stated plane" in warning for warning in solve(planes).warnings)
    found = [finding.where for finding in inspect(planes) if "correct the stated plane" in finding.what]
    assert found == ["stance 0", "stance 1", "stance 2"]


def test_a_healthy_run_is_neither_warned_of_nor_found_fault_with(hallway, solutions):
    assert solutions["smooth"].warnings == () and inspect(open_run(hallway)) == []


def test_a_solution_and_a_run_are_shown_in_a_line(short_solution):
    assert len(repr(short_solution)) < 400 and "3 of 3 measurements used" in repr(short_solution)
    assert "robots A, B, C, 3 stances in" in repr(short_solution.run)


def test_progress_counts_every_pair(short):
    seen = []
    solve(open_run(short), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_run_without_stances_or_with_one_observer_is_refused(short, copied, tmp_path):
    with pytest.raises(
        InputError, match=r"empty.mcap: there is nothing to solve: the run holds no stances and no ranges \(only"
    ):
        solve(open_run(copied(short, tmp_path / "empty.mcap", stances=())))
    alone = [Stance(s.index, s.start, s.end, s.observers[:1], s.movers) for s in open_run(short).stances]
    with pytest.raises(InputError, match=r"alone.mcap: stance 0 has one observer only"):
        solve(open_run(copied(short, tmp_path / "alone.mcap", stances=alone)))


def test_an_unknown_method_is_refused_when_it_is_chosen():
    with pytest.raises(InputError, match="no method `guess`: choose one of chain, smooth"):
        SolveOptions(method="guess")


def test_three_observers_at_once_make_three_measurements_that_agree(tmp_path):
    """A square of points seen by A, B and C: redundancy is averaged, and the loop closes."""
    team = reference_team()
    markers = team.robots[0].markers
    watched = msgspec.structs.replace(team.robots[0], name="D", markers=markers)
    team = msgspec.structs.replace(team, robots=(*team.robots, watched))
    poses = {"A": floor_pose(0, 0, 0), "B": floor_pose(0.05, 0.5, -0.3), "C": floor_pose(0.1, -0.5, 0.3)}
    x, y = np.meshgrid(np.linspace(1.0, 1.6, 6), np.linspace(-0.2, 0.2, 6))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, markers.height)], axis=1)
    rng = np.random.default_rng(0)
    with atomic_run(tmp_path / "three.mcap", team) as writer:
        writer.write(Stance(0, 100.0, 110.0, ("A", "B", "C"), ("D",)))
        for robot, T_world_body in poses.items():
            T = se3_inverse(T_world_body @ team[robot].mount.T_body_camera)
            uv, inside = team[robot].camera.project(points @ T[:3, :3].T + T[:3, 3])
            assert inside.all()
            uv += rng.normal(0, 0.3, uv.shape)
            for k, one in enumerate(uv):
                flat = np.zeros(1)
                writer.write(
                    Detections(
                        robot,
                        100 + 0.1 * k,
                        one[None],
                        0.09 * np.eye(2)[None],
                        ("D/0",),
                        flat.astype(np.uint8),
                        flat,
                        flat,
                    )
                )
    solution = solve(open_run(tmp_path / "three.mcap"))
    pairs = {(m.homography.robot_i, m.homography.robot_j) for m in solution.measurements}
    assert pairs == set(itertools.combinations("ABC", 2))
    # rows: the gauge's 6, the floor's 3 for B and for C, 8 for each homography, of which three images make two that are
    # independent; unknowns: 6 for each robot
    assert solution.estimate.dof == 6 + 2 * 3 + 2 * 8 - 3 * 6
    for robot, T in poses.items():
        sigma = np.sqrt(np.diag(solution.estimate.covariance(robot, 0))[3:5])
        off = solution.estimate.pose(robot, 0).matrix()[:2, 3] - T[:2, 3]
        assert np.linalg.norm(off) < 5 * np.linalg.norm(sigma) + 1e-6
    chained = solve(open_run(tmp_path / "three.mcap"), SolveOptions(method="chain"))
    assert set(chained.estimate.trajectories) == {"A", "B", "C"}


def test_each_robot_of_the_team_has_a_row_or_a_reason(short, copied, tmp_path):
    team = open_run(short).team
    no_floor = msgspec.structs.replace(team, floor=None)
    run = open_run(copied(short, tmp_path / "run.mcap", team=no_floor))
    solution = solve(run)
    assert set(solution.estimate.trajectories) == {"A", "B"}
    assert solution.without_pose == {"C": "nothing says how it stands under its markers; state the [floor] in the team"}
    assert any(one.startswith("robot C has no pose: nothing says how it stands") for one in solution.warnings)
    assert solve(open_run(short), SolveOptions(method="chain")).without_pose["C"].startswith("a chain places observers")
    assert summarise(solution, None)["without_pose"] == dict(solution.without_pose)
