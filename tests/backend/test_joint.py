"""The joint estimate on runs whose mounts, markers, floor and clocks are not quite as the team says."""

import json
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.backend import Estimator, PoseGraph, joint, smooth
from coloc_graph.cli.accuracy import print_calibration
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.evaluation import align, evaluate
from coloc_graph.measurements import Odometry, RelativePose, Sighting
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import write_result
from coloc_graph.run import open_run, read_truth
from coloc_graph.run.reader import read_true_team
from coloc_graph.simulation import Imperfections, simulate
from coloc_graph.team import read_team

#: As the issue of the field has it: a degree, half a centimetre, a span by calipers, a floor that is a floor.
WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)


@pytest.fixture(scope="module")
def wrong_mounts(tmp_path_factory):
    """Path of a hallway of 12 stances with 200 points each."""
    path = tmp_path_factory.mktemp("joint") / "hallway.mcap"
    simulate("hallway", path, stances=12, seed=4, points=200, imperfections=WRONG)
    return path


@pytest.fixture(scope="module")
def solved(wrong_mounts):
    return solve(open_run(wrong_mounts))


def accuracy_of(estimate, path):
    return evaluate(
        estimate.trajectories, align(estimate.trajectories, read_truth(path), "A", on_floor=True), on_floor=True
    )


def test_mounts_and_span_are_found_to_what_is_promised(solved, wrong_mounts):
    true = read_true_team(wrong_mounts)
    rows = solved.estimate.calibration.rows
    assert {(row.robot, row.what) for row in rows} == {
        *((robot, what) for robot in "AB" for what in ("height", "tilt", "roll")), ("C", "span"),
    }  # fmt: skip
    for row in rows:
        robot = true[row.robot]
        truth = robot.markers.span if row.what == "span" else getattr(
            robot.mount, {"height": "height", "tilt": "tilt_deg", "roll": "roll_deg"}[row.what]
        )  # fmt: skip
        assert abs(row.found - truth) < 4 * row.found_sigma, row
        assert row.found_sigma <= row.stated_sigma
        if row.unit == "deg":
            assert row.found_sigma < 0.1  # of a degree that was stated
    assert solved.warnings == ()


def test_the_fit_is_as_good_as_its_noise_and_the_poses_as_their_covariances(solved, wrong_mounts):
    estimate = solved.estimate
    low, high = chi2.ppf([1e-3, 1 - 1e-3], estimate.dof)
    assert low < estimate.chi2 < high
    accuracy = accuracy_of(estimate, wrong_mounts)
    assert accuracy.anees < 4
    assert all(abs(row.length_error_percent) < 0.5 for row in accuracy.robots if row.robot != "C")
    # what the poses alone make of the same is worse, and does not know it
    smoothed = accuracy_of(smooth(estimate.graph), wrong_mounts)
    assert accuracy.ate < 0.5 * smoothed.ate


def test_incremental_is_batch(solved, wrong_mounts):
    again = solve(open_run(wrong_mounts), SolveOptions(incremental=True))
    assert again.estimate.method == "joint" and not again.estimate.rejected
    # but for the noise of pixels, of which the first stances knew less
    assert again.estimate.chi2 == pytest.approx(solved.estimate.chi2, rel=0.02)
    for robot, trajectory in solved.estimate.trajectories.items():
        other = again.estimate.trajectories[robot]
        sigma = np.sqrt(trajectory.covariances[:, [3, 4], [3, 4]]).max()
        assert np.abs(other.positions - trajectory.positions).max() < 0.2 * sigma + 1e-5, robot


def test_as_it_comes_mounts_that_are_many_degrees_off_are_found_as_in_batch(tmp_path):
    """A camera that is 7 degrees off: one full step from the first stance led to where nothing led on."""
    wrong = Imperfections(mount_sigma_deg=3.0, height_sigma=2e-2, span_sigma=1e-4, floor_sigma_deg=0.1)
    simulate("hallway", tmp_path / "run.mcap", stances=2, seed=7, points=60, imperfections=wrong)
    batch, by_stance = (
        solve(open_run(tmp_path / "run.mcap"), SolveOptions(incremental=incremental)).estimate
        for incremental in (False, True)
    )
    assert not batch.rejected and not by_stance.rejected
    for robot, trajectory in batch.trajectories.items():
        assert np.abs(by_stance.trajectories[robot].positions - trajectory.positions).max() < 1e-4, robot


def test_an_estimator_goes_on_from_its_checkpoint_with_mounts_as_they_were(solved, tmp_path):
    graph = solved.estimate.graph
    whole, before = Estimator.of(solved.run.team), None
    for stance in graph.stances:
        made = [m for m in graph.measurements if max(index for _, index in m.ends) == stance.index]
        whole.add(stance, made, after=before)
        before = stance.index
        if stance.index == 6:
            whole.save(tmp_path / "half.json")
            half = Estimator.resume(tmp_path / "half.json")
            for robot in "AB":
                np.testing.assert_array_equal(half.pose(robot).matrix(), whole.pose(robot).matrix())
                np.testing.assert_array_equal(half.covariance(robot), whole.covariance(robot))
        if stance.index > 6:
            half.add(stance, made, after=stance.index - 1)
    assert half.method == "joint" and half.measurements[0].homography is not None
    a, b = whole.estimate(), half.estimate()
    for robot, trajectory in a.trajectories.items():
        np.testing.assert_allclose(b.trajectories[robot].positions, trajectory.positions, rtol=0, atol=1e-9)


@pytest.mark.parametrize("signs", [(1, 1, -1), (-1, 1, 1)])
def test_from_mounts_three_degrees_and_two_centimetres_wrong_it_comes_to_the_same(signs, solved):
    graph, true = solved.estimate.graph, solved.estimate.calibration

    def off(robot, by):
        mount = true.mounts[robot].mount if robot in true.mounts else graph.robot_models[robot].mount
        height, tilt, roll = by
        wrong = msgspec.structs.replace(
            mount, height=mount.height + 0.02 * height, tilt_deg=mount.tilt_deg + 3 * tilt,
            roll_deg=mount.roll_deg + 3 * roll, height_sigma=0.02, tilt_sigma_deg=3.0, roll_sigma_deg=3.0,
        )  # fmt: skip
        return msgspec.structs.replace(graph.robot_models[robot], mount_if_any=wrong)

    robot_models = {"A": off("A", signs), "B": off("B", signs[::-1]), "C": graph.robot_models["C"]}
    estimate = joint(replace(graph, robot_models=robot_models))
    assert not estimate.rejected and estimate.chi2 / estimate.dof < 1.3
    for robot in "AB":
        a, b = true.mounts[robot].mount, estimate.calibration.mounts[robot].mount
        assert abs(a.tilt_deg - b.tilt_deg) < 0.05 and abs(a.roll_deg - b.roll_deg) < 0.1
        assert abs(a.height - b.height) < 0.002
    for robot, trajectory in solved.estimate.trajectories.items():
        assert np.abs(estimate.trajectories[robot].positions - trajectory.positions).max() < 0.02, robot


def test_a_mount_that_is_not_as_stated_is_warned_of_by_name(wrong_mounts, copied, tmp_path):
    run = open_run(wrong_mounts)
    a, *others = run.team.robots
    tilted = msgspec.structs.replace(a, mount_if_any=msgspec.structs.replace(a.mount, tilt_deg=a.mount.tilt_deg + 6.0))
    path = copied(
        wrong_mounts,
        tmp_path / "tilted.mcap",
        stances=run.stances[:5],
        team=msgspec.structs.replace(run.team, robots=(tilted, *others)),
    )
    solution = solve(open_run(path))
    (warning,) = [one for one in solution.warnings if "sigmas from the team's value" in one]
    assert warning.startswith("A: tilt") and "stated 26.00 +- 1.00" in warning


def test_residuals_are_in_units_of_the_noise(solved):
    homographies = [m for m in solved.estimate.graph.measurements if isinstance(m, RelativePose)]
    residuals = np.array([solved.estimate.residual(m) for m in homographies])
    assert 0.3 < np.mean(residuals**2) < 1.2  # less than 1: each pose was fitted to them
    far = replace(homographies[3], homography=homographies[4].homography)
    assert solved.estimate.residual(far) > 10


def test_a_wrong_homography_is_found(solved):
    graph = solved.estimate.graph
    first, second = [m for m in graph.measurements if isinstance(m, RelativePose)][4:6]
    # one stance's homography in place of another's
    wrong = replace(second, homography=first.homography, spans=first.spans, T_i_j=first.T_i_j)
    estimate = joint(replace(graph, measurements=tuple(wrong if m is second else m for m in graph.measurements)))
    assert [refusal.measurement for refusal in estimate.rejected] == [wrong]
    right = joint(graph.without([second]))
    for robot, trajectory in right.trajectories.items():
        np.testing.assert_allclose(estimate.trajectories[robot].positions, trajectory.positions, atol=1e-4)


def test_what_is_exact_is_no_variable(solutions):
    calibration = solutions["joint"].estimate.calibration
    assert calibration.rows == () and not calibration.values


def test_poses_alone_are_linked_as_before(solved):
    """Measurements of unknown origin, in a joint estimate: between-factors."""
    graph = solved.estimate.graph
    bare = tuple(
        replace(m, homography=None) if isinstance(m, RelativePose)
        else replace(m, x_markers=None) if isinstance(m, Sighting) else m
        for m in graph.measurements
    )  # fmt: skip
    bare_graph = replace(graph, measurements=bare)
    for a, b in zip(joint(bare_graph).trajectories.values(), smooth(bare_graph).trajectories.values(), strict=True):
        np.testing.assert_allclose(a.positions, b.positions, atol=1e-9)


def test_scale_by_the_span_leaves_heights_open(wrong_mounts, copied, tmp_path):
    """Cameras 6 cm higher than stated, and said to be exact: the heights of the mounts are not used."""
    run = open_run(wrong_mounts)
    robots = tuple(
        msgspec.structs.replace(
            r, mount_if_any=msgspec.structs.replace(r.mount, height=r.mount.height + 0.06, height_sigma=0.0)
        )
        for r in run.team.robots
    )
    team = msgspec.structs.replace(run.team, robots=robots)
    path = copied(wrong_mounts, tmp_path / "high.mcap", stances=run.stances[:6], team=team)
    options = SolveOptions().resolved()
    solution = solve(open_run(path), replace(options, frontend=replace(options.frontend, scale="span")))
    assert all(abs(row.length_error_percent) < 0.5 for row in accuracy_of(solution.estimate, wrong_mounts).robots)
    for robot in "AB":
        found, true = (
            solution.estimate.calibration.mounts[robot].mount.height,
            read_true_team(wrong_mounts)[robot].mount.height,
        )
        assert abs(found - true) < 2e-3


def test_clocks_that_differ_are_found_for_each_pair(tmp_path):
    path = tmp_path / "clocks.mcap"
    simulate("hallway", path, stances=3, seed=2, points=120, imperfections=replace(WRONG, clock_offset=0.02))
    solution = solve(open_run(path))
    calibration = solution.estimate.calibration
    (key,) = set(calibration.values) - {m.key for m in (*calibration.mounts.values(), *calibration.markers.values())}
    prior = next(m.homography.time_offset_sigma for m in solution.measurements)
    left, sigma = calibration.values[key][0], np.sqrt(calibration.covariances[key][0, 0])
    assert 0 < sigma <= prior and abs(left) < 4 * prior
    assert solution.estimate.chi2 / solution.estimate.dof < 1.4


def test_a_graph_that_knows_no_mounts_says_so(solved):
    with pytest.raises(EstimationError, match=r"mount of robot A cannot be calibrated.*PoseGraph.of.*smooth"):
        joint(replace(solved.estimate.graph, robot_models={}))
    with pytest.raises(InputError, match="no method `guess`: choose one of chain, smooth, joint"):
        SolveOptions(method="guess")


def test_joint_covariances_hold_the_calibration(solved):
    estimate = solved.estimate
    nodes = [("A", 11), ("B", 11)]
    both = estimate.joint_covariance(nodes)
    for n, node in enumerate(nodes):
        np.testing.assert_allclose(
            both[6 * n : 6 * n + 6, 6 * n : 6 * n + 6], estimate.covariance(*node), rtol=1e-3, atol=1e-9
        )


def test_what_is_asked_of_a_measurement_that_is_not_in_leaves_the_covariances_as_they_are(solved):
    """Its factor may need a variable that the estimate does not have: here a plane that was stated."""
    estimate = joint(solved.estimate.graph)
    other = next(m for m in estimate.graph.measurements if isinstance(m, RelativePose))
    plane = replace(other.plane, normal_from_mount=False, d_from_mount=False, normal_sigma=0.01, d_sigma=0.01)
    assert np.isnan(estimate.residual(replace(other, plane=plane)))
    assert estimate.joint_covariance([("A", 11)]).shape == (6, 6)


def test_an_estimator_that_is_rebuilt_finds_the_mounts_as_batch_does(solved, monkeypatch, tmp_path):
    """After a revocation: a long run's mounts come first there, too."""
    asked = []
    genuine = sys.modules["coloc_graph.backend.optimize"]._mounts_first
    monkeypatch.setattr(
        "coloc_graph.backend.optimize._mounts_first", lambda graph: asked.append(graph) or genuine(graph)
    )
    graph, estimator = solved.estimate.graph, Estimator.of(solved.run.team)
    for stance in graph.stances[:5]:
        made = [m for m in graph.measurements if max(index for _, index in m.ends) == stance.index]
        estimator.add(stance, made, after=stance.index - 1 if stance.index else None)
    assert not asked
    estimator.revoke(next(m for m in estimator.measurements if isinstance(m, Odometry)))
    assert len(asked) == 1
    # spans that come in from now on are taken apart where the mounts are, not where they were said to be
    anchors = estimator._live.factors_of.variables.anchors
    found = solved.estimate.calibration.mounts
    for robot in "AB":
        assert np.abs(anchors[found[robot].key] - found[robot].errors)[1:3].max() < np.deg2rad(0.3)
    estimator.save(tmp_path / "point.json")
    again = Estimator.resume(tmp_path / "point.json")
    assert len(asked) == 2
    for robot in "AB":
        np.testing.assert_array_equal(again.pose(robot).matrix(), estimator.pose(robot).matrix())


def test_a_part_of_a_graph_is_a_graph(solved):
    graph = solved.estimate.graph
    part = graph.up_to(5)
    assert isinstance(part, PoseGraph) and len(part.stances) == 5
    assert all(max(index for _, index in m.ends) < 5 for m in part.measurements)
    assert set(part.nodes) <= set(graph.nodes)


def test_a_result_reports_the_calibration_and_holds_the_team_as_it_turned_out(solved, wrong_mounts, tmp_path, capsys):
    out = tmp_path / "result"
    write_result(solved, out)
    rows = json.loads((out / "summary.json").read_text())["calibration"]
    assert (
        len(rows) == 7 and {"robot", "what", "unit", "stated", "stated_sigma", "found", "found_sigma"} <= rows[0].keys()
    )
    team = read_team(out / "team.toml")
    found = {(row["robot"], row["what"]): row for row in rows}
    assert team["A"].mount.tilt_deg == found["A", "tilt"]["found"]
    assert team["B"].mount.height_sigma == found["B", "height"]["found_sigma"]
    assert team["C"].markers.span == pytest.approx(found["C", "span"]["found"], abs=1e-12)
    assert team["C"].mount == solved.run.team["C"].mount  # it looked at nobody
    report = (out / "report.html").read_text()
    assert "<h2>Calibration</h2>" in report and f"{found['A', 'tilt']['found']:.3f} ±" in report
    print_calibration(solved.estimate.calibration)
    assert f"{found['A', 'roll']['found']:.2f} +- " in capsys.readouterr().out


def test_nothing_that_was_exact_is_reported(solutions, tmp_path, capsys):
    write_result(solutions["joint"], tmp_path / "result")
    team = read_team(tmp_path / "result" / "team.toml")  # of the noise that was learnt
    assert [one.mount_if_any for one in team.robots] == [one.mount_if_any for one in solutions["joint"].run.team.robots]
    assert "Calibration" not in (tmp_path / "result" / "report.html").read_text()
    print_calibration(solutions["joint"].estimate.calibration)
    assert capsys.readouterr().out == ""


def test_a_long_run_finds_its_mounts_in_its_first_part(solved, monkeypatch):
    """Composed by mounts a degree off, a hundred stances are bent too far for any search to unbend."""
    module = sys.modules["coloc_graph.backend.optimize"]
    monkeypatch.setattr(module, "LONG_RUN_STANCES", 8)
    started = []
    genuine = module.optimise
    monkeypatch.setattr(
        module,
        "optimise",
        lambda factors, values, **how: started.append(factors.error(values)) or genuine(factors, values, **how),
    )
    estimate = joint(solved.estimate.graph)
    for robot, trajectory in solved.estimate.trajectories.items():
        np.testing.assert_allclose(estimate.trajectories[robot].positions, trajectory.positions, atol=1e-4)
    assert estimate.chi2 == pytest.approx(solved.estimate.chi2, rel=5e-3)
    with_part = started[:]
    started.clear()
    monkeypatch.setattr(module, "LONG_RUN_STANCES", 80)
    joint(solved.estimate.graph)
    assert min(with_part[1:]) < 0.05 * started[0]  # the whole starts by far nearer


def seen_wrong(graph, factor):
    """The graph with the last sighting off along its span, in standard deviations, and alone in tying its robot."""
    last = [m for m in graph.measurements if isinstance(m, Sighting)][-1]
    span = last.x_markers[1] - last.x_markers[0]
    along = span / np.linalg.norm(span)
    off = factor * np.sqrt(along @ last.x_covariance[:2, :2] @ along) * along
    bad = replace(last, x_markers=last.x_markers + np.array([np.zeros(2), off]))
    measurements = tuple(
        bad if m is last else m
        for m in graph.measurements
        if not (isinstance(m, Odometry) and (m.robot, m.after) == (last.seen, last.stance))
    )
    return replace(graph, measurements=measurements), (last.seen, last.stance)


def test_a_sighting_that_alone_ties_a_pose_is_kept_unless_it_is_plainly_wrong(short_solution):
    graph, (robot, stance) = seen_wrong(short_solution.estimate.graph, 25)
    for estimate in (joint(graph), fed(graph).estimate()):
        assert not estimate.rejected and estimate.pose(robot, stance)
    graph, (robot, stance) = seen_wrong(short_solution.estimate.graph, 60)
    for estimate in (joint(graph), fed(graph).estimate()):
        (rejected,) = estimate.rejected
        assert rejected.measurement.ends[1] == (robot, stance) and rejected.sigmas > 15
        assert f" {rejected.sigmas:.0f} sigmas from the other measurements" in rejected.reason
        assert stance not in estimate.trajectories[robot].stances


def fed(graph):
    """An estimator that a graph was fed to, stance by stance."""
    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, graph.robot_models, graph.landmarks)
    for stance in graph.stances:
        estimator.add(stance, [m for m in graph.measurements if max(n for _, n in m.ends) == stance.index])
    return estimator


def test_the_yaw_of_a_mount_is_found_by_odometry_and_else_named_as_not_observable(tmp_path):
    imperfections = Imperfections(mount_sigma_deg=0.5, mount_yaw_sigma_deg=1.0, height_sigma=0.003)
    simulate(
        "hallway", tmp_path / "run.mcap", depth="tracks", seed=1, stances=10, points=200, imperfections=imperfections
    )
    run = open_run(tmp_path / "run.mcap")
    true = read_true_team(run.path)
    solution = solve(run)
    rows = {row.robot: row for row in solution.estimate.calibration.rows if row.what == "camera yaw"}
    for robot in "AB":
        row, yaw = rows[robot], true[robot].mount.yaw_deg
        assert abs(yaw) > 0.5 and row.found_sigma < 0.15
        assert abs(row.found - yaw) < 3 * row.found_sigma
        assert solution.estimate.calibration.of_team(run.team)[robot].mount.yaw_deg == row.found
    assert not solution.estimate.calibration.unobservable and not any("observable" in one for one in solution.warnings)

    simulate(
        "hallway", tmp_path / "short.mcap", depth="tracks", seed=1, stances=3, points=60, imperfections=imperfections
    )
    without = solve(open_run(tmp_path / "short.mcap"), SolveOptions(odometry=False))
    assert {row.robot for row in without.estimate.calibration.unobservable} >= {"A", "B"}
    assert any("A: camera yaw not observable" in one for one in without.warnings)
