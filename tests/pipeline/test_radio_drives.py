import json
from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_fields
from ros_bags import of_run, range_, write_bag

from coloc_graph.backend import Estimator, KeyframeGraph, diagnose, joint
from coloc_graph.backend.planar.range_alignment import MIRRORED, OPEN, RangeAlignment
from coloc_graph.cli import main
from coloc_graph.errors import BagError, EstimationError
from coloc_graph.exchange.pyfg import write_pyfg
from coloc_graph.exchange.range_graph_files import letters_of
from coloc_graph.exchange.ranging_factors import ranging_gtsam_files
from coloc_graph.exchange.ranging_graph import ranging_graph
from coloc_graph.exchange.ros_import import import_ros
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.measurements import RangeBearing
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.range_graph import solve_range_graph
from coloc_graph.results.writer import assess
from coloc_graph.run import OdometrySample, Ranges, RunWriter, open_run, read_true_team
from coloc_graph.simulation.drives import simulate_drives
from coloc_graph.team import Floor, Landmark, Ranging, Robot, Team, Wheels, write_team

WRONG = {"sigma": 0.05, "offset_sigma": 0.1, "nlos": 0.05}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("radio")


@pytest.fixture(scope="module", params=["map known", "map unknown", "robots alone"])
def run(folder, request):
    """Three robots that range each other and four landmarks, or each other alone."""
    path = folder / f"{request.param}.mcap"
    marks = 0 if request.param == "robots alone" else 4
    simulate_drives(path, seed=3, seconds=30.0, landmarks=marks, known=request.param == "map known", **WRONG)
    return open_run(path)


@pytest.fixture(scope="module")
def solution(run):
    """The batch solution of the run."""
    return solve(run)


def test_robots_that_range_each_other_by_radio_are_where_they_are(run, solution):
    estimate, (accuracy, _) = solution.estimate, assess(solution)
    assert set(estimate.trajectories) == {"R1", "R2", "R3"}
    assert 0.8 < estimate.chi2 / estimate.dof < 1.25
    assert max(one.ate for one in accuracy.robots) < (
        0.03 if estimate.ranging.on_map else 0.04 if estimate.landmarks else 0.15
    )
    excess = sum(one.measurement.range > 0 for one in estimate.rejected) / len(estimate.ranging.measurements)
    assert 0.005 < excess < 0.06  # 5 % have no line of sight, a part of them by less than their noise
    offsets = {name: one.errors.ranging for name, one in estimate.calibration.sensors.items()}
    for name, (errors, C) in offsets.items():
        true = read_true_team(run.path)[name].ranging.offset
        assert abs(errors[0] - true) < 4 * np.sqrt(C[0, 0])
        assert np.sqrt(C[0, 0]) < (0.01 if estimate.landmarks else 0.1)
    assert all(isinstance(one, RangeBearing) and np.isnan(one.bearing) for one in estimate.ranging.measurements)


def test_second_by_second_ends_where_batch_does(run, solution):
    batch, live = solution, solve(run, SolveOptions(incremental=True))
    for name, path in batch.estimate.trajectories.items():
        there = live.estimate.trajectories[name]
        off = np.linalg.norm(there.positions[-20:] - path.positions[-20:], axis=1)
        assert np.median(off) < 0.3 * np.sqrt(np.trace(path.covariances[-1][3:5, 3:5])) + 0.002
        assert name in live.online


def test_joint_and_diagnose_take_keyframes_as_they_take_stances(run, solution):
    graph = KeyframeGraph(run.team, keyframes_of(run))
    assert diagnose(graph) == ()
    estimate = joint(graph)
    np.testing.assert_allclose(
        estimate.trajectories["R2"].positions, solution.estimate.trajectories["R2"].positions, atol=1e-9
    )
    assert graph.nodes[:2] == (("R1", 0), ("R1", 1)) and len(graph.measurements) == len(graph.keyframes.measured)
    live = Estimator.of(run.team, "ranging", lag=5.0)
    assert live.add(graph.keyframes).poses.keys() == {"R1", "R2", "R3"}


def test_nees_of_radio_drives(tmp_path):
    found = []
    for seed in range(8):
        simulate_drives(tmp_path / f"{seed}.mcap", seed=seed, seconds=20.0, known=True, **WRONG)
        accuracy, _ = assess(solve(open_run(tmp_path / f"{seed}.mcap")))
        found.append(accuracy.anees)
    assert 0.6 < np.mean(found) < 1.5


def straight(path, names=("A", "B"), landmarks=(), wheels=Wheels()):  # noqa: B008 (frozen)
    """Robots that drive straight on and range all others and the landmarks."""
    ranging = Ranging(range_sigma=0.02, two_way=True)
    robots = tuple(Robot(name=name, ranging=ranging, wheels=wheels) for name in names)
    team = Team(reference=names[0], robots=robots, floor=Floor(), landmarks=landmarks)
    C, start = np.diag([1e-6, 1e-8, 1e-8]), 1_700_000_000.0
    with RunWriter(path, team) as writer:
        for t in np.arange(0.0, 30.0, 0.1).tolist():
            places = {name: np.array([0.2 * t, 1.5 * n]) for n, name in enumerate(names)}
            for name in names:
                writer.write(OdometrySample(name, start + t, pose=np.array([0.2 * t, 0.0, 0.0]), covariance=C))
            seen = {**places, **{one.name: np.array(one.position) for one in landmarks if one.position}}
            targets = tuple(name for name in seen if name != names[-1])
            distances = np.array([np.linalg.norm(seen[name] - places[names[-1]]) for name in targets])
            writer.write(Ranges(names[-1], start + t, targets, distances))
    return path


def test_ranges_that_fit_two_mirrored_places_are_told_with_what_is_missing(tmp_path, capsys):
    path = straight(tmp_path / "run.mcap")
    (part,) = diagnose(KeyframeGraph(open_run(path).team, keyframes_of(open_run(path))))
    assert str(part) in (f"robot B has no pose: {MIRRORED}", f"robot B has no pose: {OPEN}")
    assert {robot for robot, _ in part.nodes} == {"B"}
    assert main(["solve", str(path), "--out", str(tmp_path / "result")]) == 2
    assert f"no measurement could be used; {part}" in capsys.readouterr().err
    assert main(["info", str(path)]) == 0
    assert str(part) in capsys.readouterr().out


def test_two_landmarks_leave_a_straight_way_mirrored_and_three_do_not(tmp_path):
    places = {"U1": (3.0, 2.0), "U2": (0.0, -3.0), "U3": (8.0, -1.0)}
    marks = tuple(Landmark(name=name, position=xy) for name, xy in places.items())
    path = straight(tmp_path / "run.mcap", ("A",), marks)
    run = open_run(path)
    solution = solve(run)
    np.testing.assert_allclose(solution.estimate.trajectories["A"].positions[-1, :2], (5.98, 0.0), atol=0.05)
    loose = with_fields(run.team, landmarks=(*marks[:2], Landmark(name="U3")))
    (part,) = diagnose(KeyframeGraph(loose, keyframes_of(run)))
    assert str(part) == f"robot A has no pose: {MIRRORED}"


def test_a_turn_scale_of_a_robot_that_never_turns_is_reported_as_not_observable(tmp_path):
    places = {"U1": (3.0, 2.0), "U2": (0.0, -3.0), "U3": (8.0, -1.0)}
    marks = tuple(Landmark(name=name, position=xy) for name, xy in places.items())
    wheels = Wheels(scale_sigma=0.02, turn_scale_sigma=0.02)
    solution = solve(open_run(straight(tmp_path / "run.mcap", ("A",), marks, wheels)))
    said = [one for one in solution.warnings if "not observable" in one]
    assert len(said) == 1 and said[0].startswith("A: odometry turn scale not observable, and as uncertain as stated")
    assert said[0].endswith("[robots.wheels]")


@pytest.mark.parametrize("turns", [True, False])
def test_an_alignment_by_ranges_finds_the_one_place_that_fits(rng, turns):
    aligning = RangeAlignment(turns=turns)
    pose = np.array([1.0, -2.0, 2.5 * turns])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = rng.uniform(-3, 3, (40, 2))
    found = None
    for n, to in enumerate(world):
        own = rng.uniform(-2, 2, 2) * turns
        at = pose[:2] + np.array([[c, -s], [s, c]]) @ own
        too_long = 2.0 if n % 8 == 0 else 0.0  # no line of sight
        aligning.add(tuple(own), tuple(to), np.linalg.norm(to - at) + 0.02 * rng.standard_normal() + too_long, 0.02)
        found = aligning.pose() or found
    np.testing.assert_allclose(found, pose, atol=0.15)


def test_an_alignment_says_what_is_open_and_what_is_mirrored(rng):
    still, along = RangeAlignment(turns=True), RangeAlignment(turns=False)
    for x in np.linspace(0.0, 4.0, 40).tolist():
        still.add((0.0, 0.0), (float(rng.uniform(-1, 1)), 1.0), 2.0, 0.02)
        along.add((0.0, 0.0), (x, 0.0), float(np.hypot(x - 2.0, 1.5)), 0.02)
        assert still.pose() is None and along.pose() is None
    assert (still.why, along.why) == (OPEN, MIRRORED)


def test_bearings_whose_noise_is_not_stated_are_said_to_be_unused(folder, tmp_path):
    simulate_drives(tmp_path / "run.mcap", seconds=10.0, known=True)
    run = open_run(tmp_path / "run.mcap")
    with RunWriter(tmp_path / "both.mcap", run.team) as writer:
        for name in run.team.names:
            for one in run.odometry(name):
                writer.write(one)
            for one in run.ranges(name):
                writer.write(Ranges(one.robot, one.time, one.targets, one.range, np.zeros(len(one.targets))))
    solution = solve(open_run(tmp_path / "both.mcap"))
    assert any("bearings of R1 are not used: the team states no noise" in one for one in solution.warnings)
    assert set(solution.estimate.trajectories) == {"R1", "R2", "R3"}


def test_what_other_programs_get_has_our_optimum(run, solution):
    import gtsam

    estimate = solution.estimate
    files = ranging_gtsam_files(estimate, run.team)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.deserialize(files["graph.txt"])
    values.deserialize(files["values.txt"])
    marginals = gtsam.Marginals(graph, values)
    assert graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()) > graph.error(values) * (1 - 1e-3)
    key = next(int(row.split(",")[0]) for row in files["keys.csv"].splitlines() if row.endswith("planar pose,R2@30"))
    C = marginals.marginalCovariance(key)
    ours = estimate.covariance("R2", 30)[3:5, 3:5]
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(C[:2, :2])), np.sort(np.linalg.eigvalsh(ours)), rtol=0.02)
    portable = ranging_graph(estimate, run.team)
    assert not portable.bearings and len(portable.ranges) == int(estimate.ranging.used.sum())


def test_an_exported_range_graph_is_solved_where_its_priors_put_it(run, solution, tmp_path):
    estimate = solution.estimate
    write_pyfg(ranging_graph(estimate, run.team), tmp_path / "graph.pyfg")
    solution = solve_range_graph(tmp_path / "graph.pyfg")
    path, letter = estimate.trajectories["R2"], letters_of(estimate.ranging.robots)["R2"]
    here = np.array([solution.values[f"{letter}{n}"].translation() for n in range(len(path.times))])
    assert np.abs(here - path.positions[:, :2]).max() < 0.02
    assert solution.errors.position < 0.01 and len(solution.rejected) < 5


def test_ranges_of_which_most_are_wrong_give_no_poses(run, solution, tmp_path, rng):
    graph = ranging_graph(solution.estimate, run.team)
    wrong = [replace(one, distance=rng.uniform(1.0, 6.0)) if rng.random() < 0.8 else one for one in graph.ranges]
    write_pyfg(replace(graph, ranges=tuple(wrong)), tmp_path / "graph.pyfg")
    with pytest.raises(EstimationError, match=r"graph.pyfg: .*(contradict the others|leave open|two arrangements)"):
        solve_range_graph(tmp_path / "graph.pyfg")


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--points", "5"], "--points does not apply to drives, without stances"),
        (["--robots", "1", "--uwb-landmarks", "0"], "1 robots and 0 landmarks range nobody"),
        (["--seconds", "-1"], "`seconds` is -1.0; give a number above 0"),
        (["--uwb-nlos", "2"], "the share without line of sight is 0 to 1"),
        (["--depth", "images"], "drives have no cameras"),
    ],
)
def test_drives_that_cannot_be_simulated_are_refused(arguments, why, tmp_path, capsys):
    assert main(["simulate", "drives", *arguments, "--out", str(tmp_path / "run.mcap")]) == 2
    assert why in capsys.readouterr().err


def test_drives_are_simulated_solved_and_judged_from_the_command_line(tmp_path, capsys):
    run, result = tmp_path / "run.mcap", tmp_path / "result"
    arguments = ["--robots", "2", "--seconds", "20", "--uwb-offset", "0.1", "--known"]
    assert main(["simulate", "drives", *arguments, "--out", str(run)]) == 0
    assert main(["solve", str(run), "--out", str(result)]) == 0
    assert json.loads((result / "summary.json").read_text())["world"] == "map"
    rows = (result / "measurements.csv").read_text().splitlines()
    header, first = rows[0].split(","), rows[1].split(",")
    assert first[header.index("bearing")] == first[header.index("residual_bearing")] == ""
    for kind in ("g2o", "dot", "jrl", "pyfg"):
        assert main(["export", kind, str(result), "--out", str(tmp_path / f"graph.{kind}")]) == 0
    assert "ranges and bearings" in capsys.readouterr().out


@pytest.fixture
def csvs(run, tmp_path):
    """A run as a team.toml and CSV files of ranges and odometry."""
    write_team(run.team, tmp_path / "team.toml")
    names = run.team.names
    ranges = [
        f"{one.time!r},{name},{target},{distance!r}"
        for name in names for one in run.ranges(name)
        for target, distance in zip(one.targets, one.range.tolist(), strict=True)
    ]  # fmt: skip
    odometry = [
        ",".join([repr(one.time), name, *map(repr, one.pose.tolist())]) for name in names for one in run.odometry(name)
    ]
    (tmp_path / "ranges.csv").write_text("\n".join(["time,robot,target,range", *ranges]))
    (tmp_path / "odometry.csv").write_text("\n".join(["time,robot,x,y,yaw", *odometry]))
    return tmp_path


def imported(folder):
    files = [str(folder / name) for name in ("team.toml", "ranges.csv", "odometry.csv")]
    return main(["import", "ranges", *files, "--along", "0.01", "--turn", "0.01", "--out", str(folder / "own.mcap")])


def test_ranges_and_odometry_are_imported_from_csv(run, solution, csvs, capsys):
    assert imported(csvs) == 0
    assert f"{sum(len(one.targets) for name in run.team.names for one in run.ranges(name))} ranges and" in (
        capsys.readouterr().out
    )
    ours, theirs = solution.estimate, solve(open_run(csvs / "own.mcap")).estimate
    path, other = ours.trajectories["R3"], theirs.trajectories["R3"]
    sigma = np.sqrt(path.covariances[:, 3:5, 3:5].trace(axis1=1, axis2=2))
    assert (np.linalg.norm(path.positions - other.positions, axis=1) < sigma).all()


@pytest.mark.parametrize(
    ("file", "row", "why"),
    [
        ("ranges.csv", "1700000001.0,R1,R1,2.0", "R1 ranges itself"),
        ("ranges.csv", "1700000001.0,R1,Q,2.0", "target `Q` is neither a robot nor a landmark"),
        ("ranges.csv", "1700000001.0,R1,R2,-2.0", "`range` is -2"),
        ("ranges.csv", "1700000001.0,R1,R2,nan", "`range` is `nan`"),
        ("odometry.csv", "1700000000.0,R1,0,0,0", "the time of R1 does not increase"),
        ("odometry.csv", "1700000001.0,Q,0,0,0", "robot `Q` is not in the team"),
        ("odometry.csv", "1700000001.0,R1,0,inf,0", "`y` is `inf`"),
    ],
)
def test_wrong_rows_are_named_with_their_line(csvs, capsys, file, row, why):
    text = (csvs / file).read_text()
    (csvs / file).write_text(f"{text}\n{row}\n")
    assert imported(csvs) == 2
    error = capsys.readouterr().err
    assert f"{file}, line {len(text.splitlines()) + 1}: " in error and why in error
    assert not (csvs / "own.mcap").exists()


@pytest.fixture(params=["ros1", "mcap"])
def bag(run, tmp_path, request):
    """A run as a ROS bag with a map of its topics; one reading is out of the sensor's limits."""
    sent = of_run(run.path)
    sent.append(range_("/R1/uwb/R2", sent[-1].received, float("inf")))
    write_team(run.team, tmp_path / "team.toml")
    targets = {name: {target for one in run.ranges(name) for target in one.targets} for name in run.team.names}
    robots = [
        f'[[robots]]\nname = "{name}"\nodometry = "/{name}/odom"\ntruth = "/{name}/truth"\nranges = {{'
        + ", ".join(f'{target} = "/{name}/uwb/{target}"' for target in sorted(to)) + "}"
        for name, to in targets.items()
    ]  # fmt: skip
    (tmp_path / "map.toml").write_text("\n".join(['team = "team.toml"', *robots]))
    return write_bag(tmp_path, request.param, sent)


def test_ranges_of_a_ros_bag_without_cameras_are_imported(run, solution, bag, tmp_path):
    summary = import_ros(bag, tmp_path / "map.toml", tmp_path / "own.mcap")
    ours = [one for name in run.team.names for one in run.ranges(name)]
    assert summary.counts["ranges"] == sum(len(one.targets) for one in ours) and not summary.stances
    assert any("1 of" in one and "/R1/uwb/R2 are outside min_range and max_range" in one for one in summary.warnings)
    estimate, theirs = solution.estimate, solve(open_run(tmp_path / "own.mcap")).estimate
    path, other = estimate.trajectories["R3"], theirs.trajectories["R3"]
    assert np.linalg.norm(path.positions[-1] - other.positions[-1]) < 0.01


def test_a_range_topic_of_nobody_is_refused(bag, tmp_path):
    text = (tmp_path / "map.toml").read_text()
    (tmp_path / "map.toml").write_text(text.replace("ranges = {R2", "ranges = {Q"))
    with pytest.raises(BagError, match=r"map.toml: `Q` is no other robot or landmark of the team - at `\$.robots"):
        import_ros(bag, tmp_path / "map.toml", tmp_path / "own.mcap")
