"""Runs that hold stances and ranges: one estimate of both, in batch and as it happens."""

import csv
import dataclasses
import json

import gtsam
import msgspec
import numpy as np
import pytest

from coloc_graph.backend import Estimator, PoseGraph, joint, smooth
from coloc_graph.backend.range_model import RangeModel
from coloc_graph.cli import main
from coloc_graph.errors import EstimationError, MeasurementError
from coloc_graph.exchange.dot import to_dot
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.range_graph import factors_of, key_of, values_of
from coloc_graph.exchange.range_graph_files import read_range_graph
from coloc_graph.exchange.stance_graph import ranges_in, stance_graph
from coloc_graph.frontend import WheelTrack
from coloc_graph.frontend.ranged_landmarks import locate
from coloc_graph.frontend.stance_ranges import OUTLIER_SIGMAS, Standing, ranges_of_stances
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Range
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.contents import unused_in, unused_ranges
from coloc_graph.pipeline.explanations import warnings_of_graph
from coloc_graph.pipeline.inspection import inspect
from coloc_graph.pipeline.range_graph import solve_range_graph
from coloc_graph.pipeline.ranges import OUTSIDE, unusable_ranges
from coloc_graph.results.measurement_table import measurement_table
from coloc_graph.results.writer import write_result
from coloc_graph.run import OdometrySample, Ranges, open_run, read_true_team, read_truth
from coloc_graph.simulation import Imperfections, simulate
from coloc_graph.simulation.uwb import NLOS_EXCESS
from coloc_graph.team import Ranging, write_team
from coloc_graph.viewer import scene_of_result

WRONG = Imperfections(uwb_sigma=0.05, uwb_offset_sigma=0.1, uwb_nlos=0.05)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A hallway of 5 stances with ranges between its robots."""
    path = tmp_path_factory.mktemp("mixed") / "mixed.mcap"
    simulate("hallway", path, stances=5, seed=2, points=60, imperfections=WRONG)
    return path


@pytest.fixture(scope="module")
def solution(mixed):
    """Its solution."""
    return solve(open_run(mixed))


def ranges_of(estimate):
    return [one for one in estimate.graph.measurements if isinstance(one, Range)]


@pytest.mark.parametrize("bearing", [{}, {"bearing": 0.3, "bearing_sigma": 0.02}])
def test_jacobians_of_ranges_are_those_of_their_residuals(rng, bearing):
    root = rng.normal(size=(4, 4))
    sensor = Ranging(range_sigma=0.05, x=0.1, two_way=True, scale=1.1, offset=0.2)
    other = Ranging(range_sigma=0.05, y=0.1, offset=0.1)
    models = [
        RangeModel(
            Range("A", "B", 0, 0, 0.0, rng.uniform(1, 2, 4), rng.normal(0, 0.3, (4, 3)), rng.normal(0, 0.3, (4, 3)),
                  root @ root.T + np.eye(4), 5, **bearing),
            sensor, other,
        )
        for _ in range(3)
    ]  # fmt: skip
    batch = RangeModel.batch(models)
    poses = [[gtsam.Pose3.Expmap(rng.normal(0, 0.3, 6) + far * np.eye(6)[3]) for _ in models] for far in (0, 2)]
    errors = [rng.normal(0, 0.05, (3, 7)) for _ in range(2)]

    def at(T, errors):
        return batch.at(*(np.array([one.matrix() for one in each]) for each in T), errors)[0]

    _, by, _ = batch.at(*(np.array([one.matrix() for one in each]) for each in poses), errors)
    for slot in range(4):
        for d in range(by[slot].shape[-1]):
            step = np.zeros(by[slot].shape[-1])
            step[d] = 1e-6
            ahead, back = (
                at([[one.retract(sign * step) if slot == k else one for one in each] for k, each in enumerate(poses)],
                   [one + sign * step if slot == k + 2 else one for k, one in enumerate(errors)])
                for sign in (1, -1)
            )  # fmt: skip
            np.testing.assert_allclose((ahead - back) / 2e-6, by[slot][..., d], atol=1e-6)


def test_stances_and_ranges_are_one_estimate_and_offsets_calibrate(mixed, solution):
    ranges = ranges_of(solution.estimate)
    used = sum(one.samples for one in ranges)
    left_out = {one.reason: one.count for one in solution.unused}
    stances = open_run(mixed).stances
    recorded = sum(
        len(one.targets)
        for robot in "ABC"
        for one in open_run(mixed).ranges(robot)
        if stances[0].start <= one.time <= stances[-1].end
    )
    outside = left_out.pop("they are from before the first stance, or after the last", 0)
    assert used + sum(left_out.values()) == recorded and outside < 0.05 * recorded
    # 5 % have no line of sight; those that are too long by less than noise are not told from the others
    told = np.exp(-OUTLIER_SIGMAS * WRONG.uwb_sigma / NLOS_EXCESS)
    assert left_out["they are outliers among those next to them"] == pytest.approx(0.05 * told * recorded, rel=0.4)
    assert solution.counts["range"].used >= 0.9 * len(ranges) > 10
    true = read_true_team(mixed)
    sensors = solution.estimate.calibration.sensors
    offsets = np.array([sensors[name].ranging.offset - true[name].ranging.offset for name in "ABC"])
    sigmas = np.array([sensors[name].ranging.offset_sigma for name in "ABC"])
    assert (sigmas < 0.6 * WRONG.uwb_offset_sigma).all() and (np.abs(offsets) < 3.5 * sigmas).all()
    assert {row.what for row in solution.estimate.calibration.rows} == {"range offset"}
    assert solution.calibrated_team["A"].ranging.offset == sensors["A"].ranging.offset


def test_ranges_make_poses_more_certain_and_move_them_within_that(mixed, solution, copied, tmp_path):
    alone = copied(mixed, tmp_path / "alone.mcap")
    without = solve(open_run(alone))
    assert not any(one.kind == "ranges" for one in without.unused)
    for robot, one in solution.estimate.trajectories.items():
        other = without.estimate.trajectories[robot]
        before, after = np.array(other.covariances), np.array(one.covariances)
        assert np.trace(after[-1][3:, 3:]) < np.trace(before[-1][3:, 3:])
        off = one.positions - other.positions
        assert (np.abs(off) <= 4 * np.sqrt(np.diagonal(before, axis1=1, axis2=2)[:, 3:]) + 1e-4).all()


def test_incremental_estimate_of_stances_and_ranges_is_that_of_the_batch(mixed, solution):
    live = solve(open_run(mixed), SolveOptions(incremental=True))
    assert abs(sum(one.samples for one in ranges_of(live.estimate)) - sum(
        one.samples for one in ranges_of(solution.estimate))) < 60  # fmt: skip
    for robot, one in solution.estimate.trajectories.items():
        np.testing.assert_allclose(live.estimate.trajectories[robot].positions, one.positions, atol=3e-3)


def test_bearings_while_both_stand_count_and_calibrate_their_sensor(mixed, copied, rng, tmp_path, capsys):
    run, truth, true = open_run(mixed), read_truth(mixed), read_true_team(mixed)
    offset, sigma = np.deg2rad([3.0, 2.0])

    def at(robot, time):
        path, antenna = truth[robot], true[robot].ranging
        T = path.T_world_body[min(np.searchsorted(path.times, time), len(path.times) - 1)]
        return T, T @ [antenna.x, antenna.y, 0.0, 1.0]

    def seen(one):
        T, here = at(one.robot, one.time)
        d = np.array([T[:3, :3].T @ (at(target, one.time)[1] - here)[:3] for target in one.targets])
        noise = sigma * rng.standard_normal(len(d))
        return dataclasses.replace(one, bearing=np.arctan2(d[:, 1], d[:, 0]) + offset + noise)

    records = [seen(one) for robot in "ABC" for one in run.ranges(robot)]
    robots = tuple(
        msgspec.structs.replace(robot, ranging=msgspec.structs.replace(
            robot.ranging, bearing_sigma_deg=2.0, bearing_offset_sigma_deg=5.0))
        for robot in run.team.robots
    )  # fmt: skip
    team = msgspec.structs.replace(run.team, robots=robots)
    path = copied(mixed, tmp_path / "bearings.mcap", team=team, more=records)
    found = solve(open_run(path))
    used = [one for one in ranges_of(found.estimate) if one.bearing is not None]
    (left_out,) = [one for one in found.unused if one.kind == "bearings"]
    assert len(used) > 4 and sum(one.bearings for one in used) + left_out.count == sum(
        len(one.targets) for one in records)  # fmt: skip
    assert "while both ends stand" in str(left_out)
    (certain,) = [one for one in unused_ranges(unusable_ranges(open_run(path))) if one.kind == "bearings"]
    assert 0.8 * left_out.count < certain.count <= left_out.count
    measured = {one.robot for one in used}
    for robot in measured:
        sensor = found.estimate.calibration.sensors[robot].ranging
        assert sensor.bearing_offset_sigma_deg < 1.0
        assert abs(sensor.bearing_offset_deg - 3.0) < 4 * sensor.bearing_offset_sigma_deg
    assert 0.6 < found.estimate.chi2 / found.estimate.dof < 1.4
    write_result(found, tmp_path / "result")
    assert main(["export", "jrl", str(tmp_path / "result"), "--out", str(tmp_path / "graph.jrl")]) == 0
    assert f"left out: {len(used)} mean bearings, which" in capsys.readouterr().out


def test_a_blocked_pair_is_an_outlier_with_a_reason(mixed, copied, tmp_path, capsys):
    run = open_run(mixed)
    stance = run.stances[2]
    blocked = [
        dataclasses.replace(one, range=one.range + 0.6 * (stance.start <= one.time <= stance.end) * np.array(
            [target == "B" for target in one.targets]))
        for robot in "AB" for one in run.ranges(robot)
    ]  # fmt: skip
    found = solve(open_run(copied(mixed, tmp_path / "blocked.mcap", more=blocked)))
    rejected = [one.measurement for one in found.estimate.rejected]
    assert [(one.robot, one.target, one.stance) for one in rejected] == [("A", "B", stance.index)]
    assert "line of sight" in found.estimate.rejected[0].reason
    assert any("was rejected" in warning and "range of B by A" in warning for warning in found.warnings)
    rows = list(csv.DictReader(measurement_table(found).splitlines()))
    (row,) = (one for one in rows if one["kind"] == "range" and one["used"] == "no")
    assert "line of sight" in row["reason"] and float(row["range"]) > 1.0 and int(row["points"]) > 50
    write_result(found, tmp_path / "result")
    assert main(["export", "pyfg", str(tmp_path / "result"), "--out", str(tmp_path / "graph.pyfg")]) == 0
    assert "left out: 1 rejected pair\n" in capsys.readouterr().out
    live = solve(open_run(tmp_path / "blocked.mcap"), SolveOptions(incremental=True)).estimate
    assert [str(one.measurement)[:15] for one in live.rejected] == ["range of B by A"]


@pytest.fixture(scope="module")
def with_landmarks(tmp_path_factory):
    """A hallway of 5 stances with ranges between robots and to four landmarks."""
    path = tmp_path_factory.mktemp("landmarks") / "landmarks.mcap"
    simulate("hallway", path, stances=5, seed=4, points=60, imperfections=WRONG, uwb_landmarks=4)
    return path


@pytest.fixture(scope="module")
def landmarks_solved(with_landmarks):
    """Its solution."""
    return solve(open_run(with_landmarks))


@pytest.mark.parametrize("incremental", [False, True])
def test_landmarks_are_located_by_ranges_on_the_way(with_landmarks, landmarks_solved, incremental):
    found = solve(open_run(with_landmarks), SolveOptions(incremental=True)) if incremental else landmarks_solved
    true = read_true_team(with_landmarks)
    start = read_truth(with_landmarks)["A"].T_world_body[0]
    assert set(found.estimate.landmarks) == {"U1", "U2", "U3", "U4"}
    for one in true.landmarks:
        here = np.linalg.inv(start) @ [*one.position, 0.0, 1.0]
        located = found.estimate.landmarks[one.name]
        assert not located.has_heading
        off, C = np.array(located.planar[:2]) - here[:2], located.covariance_xy_yaw[:2, :2]
        assert off @ np.linalg.solve(C, off) < 20.0 and np.sqrt(np.trace(C)) < 0.3
    assert not [one for one in found.unused if "is not located" in one.reason]
    ranges = ranges_of(found.estimate)
    assert {one.target for one in ranges} == {"B", "C", *found.estimate.landmarks}
    assert 0.6 < found.estimate.chi2 / found.estimate.dof < 1.4


def test_a_landmark_that_could_be_on_either_side_of_the_way_is_named(rng):
    x = np.linspace(0, 3, 60)
    places = np.column_stack([x, np.zeros(60)])
    for y, why in ((1.0, "mirrored"), (0.0, None)):
        ranges = np.hypot(x - 1.2, y) + 0.02 * rng.standard_normal(60)
        located = locate(places, ranges, [0] * 60, 0.02, 0.0)
        assert (why is None and located.position is not None) or why in located.why
    aside = places + np.column_stack([np.zeros(60), 0.7 * (np.arange(60) % 2)])
    ranges = np.hypot(*(aside - [1.2, 2.0]).T) + 0.02 * rng.standard_normal(60)
    ranges[::9] += rng.exponential(1.0, len(ranges[::9]))
    np.testing.assert_allclose(locate(aside, ranges, [0] * 60, 0.02, 0.0).position, [1.2, 2.0], atol=0.1)
    assert "too close" in locate(places[:3], ranges[:3], [0] * 3, 0.02, 0.0).why


def test_exports_hold_ranges_or_say_what_is_missing(solution, tmp_path):
    dot = to_dot(solution.estimate.graph)
    assert dot.count('color="#999999"') == len(ranges_of(solution.estimate))
    write_g2o(solution.estimate, tmp_path / "graph.g2o")
    assert f"# left out: {len(ranges_of(solution.estimate))} ranges" in (tmp_path / "graph.g2o").read_text()
    assert len(read_g2o(tmp_path / "graph.g2o").ends)


def test_every_part_of_a_result_with_ranges_is_written(landmarks_solved, tmp_path, capsys):
    out = tmp_path / "result"
    write_result(landmarks_solved, out)
    counts = json.loads((out / "summary.json").read_text())["measurements"]["kinds"]
    assert counts["range"]["used"] > 20
    for kind in ("g2o", "gtsam", "dot", "pyfg", "jrl"):
        capsys.readouterr()
        assert main(["export", kind, str(out), "--out", str(tmp_path / f"graph.{kind}")]) == 0
        said = capsys.readouterr().out
        assert ("ranges, which a pose graph cannot express" in said) == (kind == "g2o")
        assert ("robots A = A, B = B, C = C; landmarks L0 = U1, L1 = U2, L2 = U3, L3 = U4\n" in said) == (
            kind in ("pyfg", "jrl")
        )
    rows = list(csv.DictReader((out / "landmarks.csv").read_text().splitlines()))
    assert all(int(row["measurements"]) > 5 and row["yaw_deg"] in ("", "nan") for row in rows)
    scene = scene_of_result(out)
    drawn = sum(kind == "range" for kind in (row["kind"] for row in csv.DictReader(
        (out / "measurements.csv").read_text().splitlines()) if row["used"] == "yes"))  # fmt: skip
    of_landmarks = len(scene.landmarks.sightings)
    assert of_landmarks > 20 and len(scene.sightings) + of_landmarks >= drawn
    assert "range sensor errors" in (tmp_path / "graph.gtsam" / "keys.csv").read_text()
    assert main(["view", str(out), "--export", str(tmp_path / "page.html")]) == 0
    capsys.readouterr()


def test_exported_ranges_have_the_estimate_as_optimum(landmarks_solved, tmp_path, rng):
    estimate, team = landmarks_solved.estimate, landmarks_solved.run.team
    write_result(landmarks_solved, tmp_path / "result")
    for kind in ("pyfg", "jrl"):
        path = tmp_path / f"graph.{kind}"
        assert main(["export", kind, str(tmp_path / "result"), "--out", str(path)]) == 0
        graph = read_range_graph(path)
        assert len(graph.ranges) == sum(len(one.range) for one in ranges_in(estimate)) > 100
        exact = values_of(graph.truth or graph.initial)
        for robot, trajectory in estimate.trajectories.items():
            here = graph.times[f"{robot}0"], exact.atPose2(key_of(f"{robot}0")).translation()
            assert here[0] == pytest.approx(trajectory.times[0], abs=1e-6)
            assert here[1] == pytest.approx(trajectory.positions[0, :2], abs=1e-9)
        factors, reference = factors_of(graph), key_of("A0")
        fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
        factors.add(gtsam.PriorFactorPose2(reference, exact.atPose2(reference), fixed))
        off = gtsam.VectorValues()
        for key in exact.keys():  # noqa: SIM118
            of_point = chr(gtsam.symbolChr(key)) == "L"
            off.insert(key, 0.03 * (key != reference) * rng.standard_normal(2 if of_point else 3))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-14)
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        found = gtsam.LevenbergMarquardtOptimizer(factors, exact.retract(off), parameters).optimize()
        distances = exact.localCoordinates(found)
        assert max(np.abs(distances.at(key)).max() for key in exact.keys()) < 1e-6  # noqa: SIM118
    # by their own measurements alone, from no initial values
    errors = solve_range_graph(tmp_path / "graph.pyfg").errors
    assert max(errors.position, errors.landmarks) < 1e-3
    # ranges are as they were read, but for offsets: what the estimate does not explain is still in them
    graph, sigma = stance_graph(estimate, team), team["A"].ranging.range_sigma
    values = graph.initial
    residuals = [
        one.distance - np.linalg.norm(values[one.first].translation() - _position(values[one.second]))
        for one in graph.ranges
    ]
    assert sigma / 10 < np.std(residuals) < sigma
    calibrated = estimate.calibration.sensors
    (one, *_) = (one for one in ranges_in(estimate) if one.target == "B" and not one.moved.any())
    offsets = sum(calibrated[name].ranging.offset for name in (one.robot, one.target))
    assert min(abs(far.distance + offsets - one.range[0]) for far in graph.ranges if far.time == one.time) < 0.01


def _position(value):
    return value.translation() if hasattr(value, "translation") else value


def test_checkpoints_keep_ranges(solution, tmp_path):
    graph = solution.estimate.graph
    team = solution.run.team
    estimator = Estimator.of(team)
    for before, stance in zip((None, *graph.stances), graph.stances, strict=False):
        here = [m for m in graph.measurements if max(index for _, index in m.ends) == stance.index]
        estimator.add(stance, [m for m in here if not isinstance(m, Range)], after=before and before.index)
        estimator.insert(*(m for m in here if isinstance(m, Range)))
    estimator.save(tmp_path / "checkpoint")
    again = Estimator.resume(tmp_path / "checkpoint")
    np.testing.assert_array_equal(again.pose("B").matrix(), estimator.pose("B").matrix())
    # a withdrawn stance leaves no range behind
    count = len(again.measurements)
    again.withdraw()
    assert not [m for m in again.measurements if isinstance(m, Range) and m.time > graph.stances[-2].end]
    assert len(again.measurements) < count


def test_offsets_that_nothing_measures_are_reported(solution):
    graph = solution.estimate.graph
    sensor = msgspec.structs.replace(graph.robot_models["A"].ranging, bearing_offset_sigma_deg=2.0)
    models = {**graph.robot_models, "A": msgspec.structs.replace(graph.robot_models["A"], ranging=sensor)}
    found = joint(dataclasses.replace(graph, robot_models=models))
    assert [(row.robot, row.what) for row in found.calibration.unobservable] == [("A", "bearing offset")]
    (warning,) = [one for one in warnings_of_graph(found, (), ()) if "observable" in one]
    assert "A: bearing offset not observable" in warning and "range" in warning


def range_of(**fields):
    given = {"robot": "A", "target": "B", "stance": 0, "target_stance": 0, "time": 0.0, "range": [1.0]}
    given |= {"moved": np.zeros((1, 3)), "target_moved": np.zeros((1, 3)), "covariance": [[1e-4]], "samples": 1}
    return Range(**(given | fields))


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"target": "A"}, "relates a robot to itself"),
        ({"target": "X"}, "robot X, which is not in the team"),
        ({"stance": 77}, "stance 77, which is none"),
        ({"range": [-1.0]}, "give metres above 0"),
        ({"range": [np.nan]}, "not finite"),
        ({"covariance": [[0.0]]}, "every range needs an uncertainty"),
        ({"moved": np.zeros((2, 3))}, "give (n,)"),
        ({"bearing": 0.1}, "has a bearing without a number or uncertainty"),
    ],
)
def test_ranges_that_cannot_be_are_refused_in_one_sentence(fields, why, solution):
    run = solution.run
    with pytest.raises(MeasurementError) as error:
        PoseGraph.of(run.team, run.stances, [range_of(**fields)])
    assert why in str(error.value)


def test_ranges_alone_tie_nothing(solution):
    run = solution.run
    graph = PoseGraph.of(run.team, run.stances[:1], [range_of()])
    with pytest.raises(EstimationError, match="no measurement ties a robot"):
        joint(graph)
    with pytest.raises(EstimationError, match="needs a joint estimate"):
        smooth(solution.estimate.graph)


def test_ranges_that_no_estimate_can_use_are_named_with_their_count(mixed, copied, tmp_path):
    run = open_run(mixed)
    records = [one for robot in "AB" for one in run.ranges(robot)]
    bare = copied(mixed, tmp_path / "bare.mcap", more=records,
                  change=lambda one: None if isinstance(one, OdometrySample) and one.robot == "C" else one)  # fmt: skip
    reasons = {one.reason: one.count for one in solve(open_run(bare)).unused}
    driving = "C drives and has no odometry then"
    (said,) = [one.what for one in inspect(open_run(bare)) if driving in one.what]
    assert 0.8 * reasons[driving] < int(said.split()[2]) <= reasons[driving]
    late = [dataclasses.replace(one, time=one.time + 1e4) for one in records]
    away = open_run(copied(mixed, tmp_path / "away.mcap", more=late))
    for incremental in (False, True):
        (unused,) = solve(away, SolveOptions(incremental=incremental)).unused
        assert (unused.count, unused.reason) == (sum(len(one.targets) for one in late), OUTSIDE)
    (unused,) = unused_in(run, SolveOptions("smooth"))
    assert str(unused).endswith("range records not used: `smooth` calibrates no range sensors; use `joint`")


def test_ranges_alone_that_place_nobody_are_refused_with_what_would(mixed, copied, tmp_path, capsys):
    records = [one for robot in "AB" for one in open_run(mixed).ranges(robot)]
    only = copied(mixed, tmp_path / "only.mcap", stances=(), more=records)
    assert main(["solve", str(only), "--out", str(tmp_path / "result")]) == 2
    error = capsys.readouterr().err
    assert "robot C has no pose: its ranges leave open where it is: range it from more places" in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "result").exists()


@pytest.fixture
def tracked(short, tmp_path):
    """The files of `coloc import tracks`: a team with range sensors, and tracks."""
    run = open_run(short)
    robots = tuple(msgspec.structs.replace(one, ranging=Ranging(range_sigma=0.05, two_way=True))
                   for one in run.team.robots)  # fmt: skip
    write_team(msgspec.structs.replace(run.team, robots=robots), tmp_path / "team.toml")
    rows = [
        f"{stance.index},{one.time!r},{robot},{marker},{u!r},{v!r}"
        for stance in run.stances for robot in stance.observers
        for one in run.detections(robot, stance.start, stance.end)
        for marker, (u, v) in zip(one.markers, one.uv.tolist(), strict=True)
    ]  # fmt: skip
    (tmp_path / "tracks.csv").write_text("stance,time,robot,marker,u,v\n" + "\n".join(rows))
    return tmp_path, run.stances


def test_ranges_come_from_a_csv(tracked, capsys):
    folder, stances = tracked
    times = np.linspace(stances[0].start + 1, stances[0].end - 1, 20).tolist()
    (folder / "ranges.csv").write_text("time,robot,target,range\n" + "\n".join(f"{t!r},A,B,0.75" for t in times))
    command = ["import", "tracks", str(folder / "team.toml"), str(folder / "tracks.csv"), "--ranges"]
    assert main([*command, str(folder / "ranges.csv"), "--out", str(folder / "run.mcap")]) == 0
    assert [one.targets for one in open_run(folder / "run.mcap").ranges("A")] == [("B",)] * 20
    capsys.readouterr()
    for row, why in (
        (f"{times[0]},A,A,1.0", "A ranges itself"),
        (f"{times[0]},A,X,1.0", "neither a robot nor a landmark"),
        (f"{times[0]},X,A,1.0", "not in the team"),
        (f"{times[0]},A,B,-1.0", "give metres above 0"),
        (f"{times[0]},A,B,nan", "remove rows that were not measured"),
        ("7.0,A,B,1.0", "no range is of the run's time"),
    ):
        (folder / "bad.csv").write_text(f"time,robot,target,range\n{row}")
        assert main([*command, str(folder / "bad.csv"), "--out", str(folder / "bad.mcap")]) == 2
        error = capsys.readouterr().err
        assert why in error and len(error.splitlines()) == 1
        assert not (folder / "bad.mcap").exists()


def test_errors_of_places_by_odometry_have_their_stated_covariance(rng):
    """Many noisy copies of one drive scatter as their joint covariance says, forwards and backwards in time."""
    times, steps = np.arange(41) * 0.1, np.tile([0.02, 0.0, 0.03], (41, 1))
    steps[0] = 0.0
    C = np.diag([4e-6, 1e-6, 1e-5])

    def driven(errors):
        poses = [np.zeros(3)]
        for step in (steps + errors)[1:]:
            x, y, yaw = poses[-1]
            c, s = np.cos(yaw), np.sin(yaw)
            poses.append(np.array([x + c * step[0] - s * step[1], y + s * step[0] + c * step[1], yaw + step[2]]))
        return WheelTrack("A", [OdometrySample("A", t, p, C) for t, p in zip(times.tolist(), poses, strict=True)])

    start, points = 2.0, np.array([[0.1, 0.05]] * 3)
    at = np.array([0.35, 3.0, 4.0])

    def places(track):
        x, y, yaw = track.moved(np.full(3, start), at).T
        c, s = np.cos(yaw), np.sin(yaw)
        return np.stack([x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]], 1).ravel()

    true = driven(np.zeros((41, 3)))
    drawn = [places(driven(rng.multivariate_normal(np.zeros(3), C, 41))) - places(true) for _ in range(1500)]
    root = true.place_errors(np.full(3, start), at, points).reshape(6, -1)
    predicted = root @ root.T
    scale = np.sqrt(np.outer(predicted.diagonal(), predicted.diagonal()))
    np.testing.assert_allclose(np.cov(np.array(drawn).T) / scale, predicted / scale, atol=0.13)


@pytest.mark.parametrize("driver", ["A", "B"])
def test_a_range_is_as_uncertain_as_the_odometry_of_whichever_end_drives(mixed, driver):
    team = open_run(mixed).team
    places = {"A": floor_pose(0.0, 0.0, 0.0), "B": floor_pose(3.0, 0.0, 0.0)}
    standing = {name: [Standing(0, 0.0, 2.0 if name == driver else 20.0, T)] for name, T in places.items()}
    times = np.arange(61) * 0.1
    way = np.column_stack([np.maximum(times - 2.0, 0.0) * 0.1, np.zeros(61), np.zeros(61)])
    samples = [OdometrySample(driver, t, p, 1e-2 * np.eye(3)) for t, p in zip(times.tolist(), way, strict=True)]
    apart = 3.0 - way[:, 0] * (1 if driver == "A" else -1)
    recorded = {"A": [Ranges("A", t, ("B",), np.array([r])) for t, r in zip(times.tolist(), apart, strict=True)]}
    found = ranges_of_stances(team, standing, {driver: WheelTrack(driver, samples)}, recorded)
    (made,) = found.ranges
    sigmas = np.sqrt(made.covariance.diagonal())
    assert len(sigmas) > 2 and sigmas.min() < 0.05 and np.median(sigmas) > 0.1


def test_sensors_that_measure_no_bearing_need_no_noise_of_it():
    assert Ranging(range_sigma=0.1).bearing_sigma_deg == 0.0
    with pytest.raises(ValueError, match="bearing_sigma_deg"):
        Ranging(range_sigma=0.1, bearing_sigma_deg=-1.0)
    assert Ranges("A", 0.0, ("B",), np.ones(1)).bearing is None
    assert msgspec.structs.asdict(Ranging(range_sigma=0.1))["two_way"] is False
