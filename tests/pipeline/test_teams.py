"""Teams of many robots: the scenario, homographies of every pair that sees enough, and robots that see robots stand."""

import itertools
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from crowd_scene import FACTS, lockstep_run, movers, seen_by_both
from msgspec.structs import replace as msgspec_replace

from coloc_graph.backend import Estimator, joint
from coloc_graph.errors import InputError
from coloc_graph.frontend import FrontendOptions, StanceTracks, Track, correspond, little_in_common, measure_pair
from coloc_graph.frontend.pairing.observer_pairs import MIN_PARTNERS, information_weight, pairs_of
from coloc_graph.measurements import Sighting
from coloc_graph.pipeline import incremental as stance_solver
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import Detections, RunWriter, open_run
from coloc_graph.simulation import Imperfections, record, reference_team, simulate
from coloc_graph.simulation.scenarios import team_of
from coloc_graph.simulation.teams import build_team_world
from coloc_graph.team import Floor

UNEVEN = Imperfections(mount_sigma_deg=0.5, height_sigma=0.003, floor_sigma_deg=0.1)


@pytest.fixture(scope="module")
def ten(tmp_path_factory):
    """Ten robots, three stances."""
    path = tmp_path_factory.mktemp("team") / "run.mcap"
    simulate("team", path, stances=3, seed=1, imperfections=UNEVEN)
    return open_run(path)


@pytest.fixture(scope="module")
def ten_solved(ten):
    return solve(ten)


@pytest.mark.parametrize(("robots", "at_once"), [(3, None), (5, 1), (10, None), (10, 3), (30, 7)])
def test_roles_rotate_and_who_does_not_move_is_an_anchor(robots, at_once):
    what = team_of(robots, at_once, 8)
    assert what.stances == 8
    for k in range(8):
        observers, driving = set(what.observers(k)), set(what.driving(k))
        assert observers | driving == set(what.names)
        assert not observers & driving
        assert len(driving) == (at_once or max(robots // 4, 1))
        if k:
            assert set(what.anchors(k)) == observers - set(what.driving(k - 1))
            assert what.anchors(k)
            assert set(what.driving(k - 1)) <= observers
    assert what.names[0] in what.observers(0)
    moved = {name for k in range(8) for name in what.driving(k)}
    assert len(moved) == min(robots, 8 * (at_once or max(robots // 4, 1)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": 2}, "3 to 255 robots, not 2"),
        ({"robots": 5, "at_once": 4}, "1 to 3 may move at once, not 4: two must watch"),
        ({"robots": 5, "at_once": 0}, "1 to 3 may move at once, not 0"),
        ({"stances": 0}, "0 stances; give at least 1"),
        ({"depth": "images"}, "has tracks and no images"),
        ({"messy": True}, "`messy` is of images"),
    ],
)
def test_a_team_that_cannot_be_is_refused(tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        simulate("team", tmp_path / "run.mcap", **arguments)
    assert not (tmp_path / "run.mcap").exists()


def test_robots_belong_to_a_team_only(tmp_path):
    with pytest.raises(InputError, match="belong to team, not to hallway"):
        simulate("hallway", tmp_path / "run.mcap", robots=5)


def test_a_team_is_solved_and_its_covariances_are_believable(ten, ten_solved):
    solution = ten_solved
    assert not solution.estimate.disconnected
    assert not solution.estimate.rejected
    assert 0.8 < solution.estimate.chi2 / solution.estimate.dof < 1.25
    accuracy, _ = assess(solution)
    assert len(accuracy.robots) == 10
    assert accuracy.ate < 0.02
    assert accuracy.anees < 3
    # the graph has loops, and nobody is warned of robots that are far from each other
    stance = ten.stances[0]
    pairs = [m for m in solution.measurements if m.homography.stance == 0]
    assert (
        len(stance.observers) * MIN_PARTNERS / 2 <= len(pairs) <= len(list(itertools.combinations(stance.observers, 2)))
    )
    apart = [m for m in pairs if little_in_common(m.homography, stance)]
    assert apart
    assert len(stance.observers) <= sum(m.relative_pose is not None for m in pairs) < len(pairs)
    assert not [warning for warning in solution.warnings if "never see a marker" in warning]


def test_many_robots_come_out_the_same_though_most_of_the_way_is_by_cholesky(ten_solved, monkeypatch):
    by_qr = ten_solved.estimate
    graph = by_qr.graph
    monkeypatch.setattr("coloc_graph.backend.solver.MAX_GAUSS_NEWTON", 0)  # as where it diverges
    taken = []
    genuine = gtsam.LevenbergMarquardtParams.setLinearSolverType
    monkeypatch.setattr(
        gtsam.LevenbergMarquardtParams,
        "setLinearSolverType",
        lambda self, kind: taken.append(kind) or genuine(self, kind),
    )
    monkeypatch.setattr("coloc_graph.backend.optimize.MANY_ROBOTS", 10)
    both = joint(graph)
    assert "MULTIFRONTAL_CHOLESKY" in taken and taken[-1] == "MULTIFRONTAL_QR"
    assert both.chi2 == pytest.approx(by_qr.chi2, rel=1e-6)
    for robot, trajectory in by_qr.trajectories.items():
        np.testing.assert_allclose(both.trajectories[robot].positions, trajectory.positions, atol=1e-6)


def test_incrementally_a_team_comes_out_the_same(ten, ten_solved):
    batch, step = ten_solved.estimate, solve(ten, SolveOptions(incremental=True)).estimate
    assert step.chi2 / step.dof == pytest.approx(batch.chi2 / batch.dof, rel=0.05)
    for robot, trajectory in batch.trajectories.items():
        # spans are taken apart for mounts as they were known then
        sigma = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2)) + 1e-5
        off = np.linalg.norm(step.trajectories[robot].positions - trajectory.positions, axis=1)
        assert (off < 0.5 * sigma).all()


def test_what_is_saved_of_a_team_knows_what_its_pairs_share(ten, tmp_path):
    solver = stance_solver.IncrementalSolver(ten.team)
    for stance in ten.stances[:2]:
        solver.enter(ten, stance)
    shares = [m.homography.share for m in solver.estimator.graph.relative_poses]
    assert min(shares) < 0.6
    solver.estimator.save(tmp_path / "point.json")
    again = Estimator.resume(tmp_path / "point.json")
    assert [m.homography.share for m in again.graph.relative_poses] == shares
    assert again.estimate().dof == solver.estimator.estimate().dof


def test_robots_that_share_no_view_of_a_mover_are_tied_by_seeing_each_other_stand(ten, ten_solved, monkeypatch):
    graph = ten_solved.estimate.graph
    standing = [
        m for m in graph.measurements if isinstance(m, Sighting) and m.seen in graph.by_index[m.stance].observers
    ]
    assert standing
    for one in standing:
        assert one.observer in graph.by_index[one.stance].observers
        # two that have stood since the last stance are not measured again
        stance = graph.by_index[one.stance]
        before = graph.by_index.get(one.stance - 1)
        assert before is None or not {one.observer, one.seen} <= set(stance.anchors) & set(before.observers)
    monkeypatch.setattr(stance_solver, "sight_standing", lambda *_: [])
    without = solve(ten, SolveOptions(odometry=False)).estimate
    assert without.disconnected


def test_pixels_that_three_observers_share_count_once():
    both = seen_by_both(movers(1, 3), 3)
    in_i, in_j = both[0][0], both[1][0]
    found = correspond(in_i, in_j, FACTS.camera, FACTS.camera, alone=True)

    def of(*others, pairs=None, tracks_i=in_i):
        tracks = {"A": tracks_i, "B": in_j} | {f"C{n}": other for n, other in enumerate(others)}
        every = list(itertools.combinations(tracks, 2))
        return information_weight(found, ("A", "B"), every if pairs is None else pairs, tracks, 0.005)

    assert of() == 1.0
    assert of(in_j) == pytest.approx(2 / 3, abs=0.02)
    assert of(in_j, in_j) == pytest.approx(2 / 4, abs=0.02)
    # of three that see it two pairs are measured, and know all there is
    assert of(in_j, pairs=[("A", "B"), ("B", "C0")]) == 1.0
    named = [replace(track, marker=f"C/{n}") for n, track in enumerate(in_i)]
    assert of([replace(track, marker="D/0") for track in in_j], tracks_i=named) == 1.0
    assert of([replace(track, times=track.times + 100.0) for track in in_j]) == 1.0


def test_of_many_observers_each_is_measured_with_those_that_see_most_of_the_same():
    times = np.arange(100) / 10

    def track(marker, n):
        return Track("", marker, times[:n], np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n))

    few = {name: [track("Z/0", 50)] for name in "ABCD"}
    assert len(pairs_of(tuple(few), few, 0.005)) == 6
    # two groups that watch different movers
    many = {f"{group}{n}": [track(f"{group}/0", 100), track("Z/0", 5)] for group in "XY" for n in range(10)}
    pairs = pairs_of(tuple(many), many, 0.005)
    assert all(sum(name in pair for pair in pairs) >= MIN_PARTNERS for name in many)
    assert len(pairs) < 70
    assert sum(i[0] != j[0] for i, j in pairs) == 1  # which ties the two groups


class Nameless:
    """A writer that takes the names off what moves, and leaves out what stands."""

    def __init__(self, writer, movers):
        self._writer, self._movers = writer, movers

    def __getattr__(self, name):
        return getattr(self._writer, name)

    def write(self, one):
        if isinstance(one, Detections):
            moves = [n for n, marker in enumerate(one.markers) if marker.split("/")[0] in self._movers]
            one = replace(
                one, markers=("",) * len(moves),
                **{field: getattr(one, field)[moves] for field in ("uv", "covariance", "flags", "peak", "area")},
            )  # fmt: skip
        self._writer.write(one)


def test_without_names_the_markers_of_several_movers_find_themselves(tmp_path):
    world = build_team_world(team_of(4, 2, 1), seed=2, points=800)
    path = tmp_path / "run.mcap"

    with RunWriter(path, world.team) as writer:
        record(world, Nameless(writer, world.stances[0].movers), "tracks")
    run = open_run(path)
    measured = measure_pair(run, run.stances[0], *run.stances[0].observers, FrontendOptions())
    assert measured.homography.unusable is None
    assert measured.homography.points > 200
    assert measured.homography.inliers > 0.95 * measured.homography.points
    true = [world.paths[name].pose_at(run.stances[0].start)[0] for name in run.stances[0].observers]
    off = measured.relative_pose.T_i_j - np.linalg.inv(true[0]) @ true[1]
    assert np.abs(off[:3, 3]).max() < 0.02


def test_a_messy_world_gives_a_right_pose_or_none(tmp_path):
    right = 0
    for seed in range(2):
        path = tmp_path / f"{seed}.mcap"
        world = simulate("single-step", path, depth="images", seed=seed, messy=True)
        run = open_run(path)
        measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
        if measured.relative_pose is None:
            continue
        i, j = (world.paths[name].pose_at(run.stances[0].start)[0] for name in "AB")
        off = measured.relative_pose.T_i_j - np.linalg.inv(i) @ j
        assert np.abs(off[:3, 3]).max() < 0.02
        right += 1
    assert right
    assert run.team.floor == Floor()


def coloured(uv, colours):
    """A BGR image of soft spots at pixels (n, 2)."""
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    image = np.full((240, 320, 3), 8.0)
    for (x, y), colour in zip(uv, colours, strict=True):
        image += np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.3**2))[..., None] * colour
    return np.clip(image, 0, 255).astype(np.uint8)


def test_colours_tell_two_movers_apart_even_in_lock_step(tmp_path):
    """Side by side they drive the same way, and only their colours say which is which."""
    team = reference_team(names=("A", "B", "C", "D"))
    hues = {"C": 0.0, "D": 120.0}
    robots = tuple(
        msgspec_replace(one, markers=msgspec_replace(one.markers, hue_deg=hues.get(one.name))) for one in team.robots
    )
    team = msgspec_replace(team, robots=robots)
    colours = [(0, 0, 230)] * 2 + [(0, 230, 0)] * 2
    run, poses, _ = lockstep_run(tmp_path / "run.mcap", team, lambda uv, k: coloured(uv, colours))
    tracks = StanceTracks(run, run.stances[0])
    for robot in "AB":
        assert {track.mover for track in tracks.of(robot)} == {"C", "D"}
    measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions(), tracks)
    assert measured.homography.unusable is None
    off = measured.relative_pose.T_i_j - np.linalg.inv(poses["A"]) @ poses["B"]
    assert np.abs(off[:3, 3]).max() < 0.02
    assert {span.mover for span in measured.relative_pose.spans} == {"C", "D"}


def test_the_tracks_of_a_stance_that_goes_on_go_on_for_all_of_its_observers(tmp_path):
    """Judged while it lasts, a stance of three observers is in the end what it is when it is measured once."""
    world = build_team_world(team_of(4, 1, 1), seed=3, points=800)
    stance = world.stances[0]
    with RunWriter(tmp_path / "run.mcap", world.team) as writer:
        record(world, Nameless(writer, stance.movers), "tracks")
    run = open_run(tmp_path / "run.mcap")
    begun = StanceTracks(run, replace(stance, end=stance.start))
    for end in (stance.start + 6.0, stance.start + 12.0, stance.end):
        for pair in itertools.combinations(stance.observers, 2):
            measure_pair(run, replace(stance, end=end), *pair, FrontendOptions(), begun)
    once = StanceTracks(run, stance)
    for robot in stance.observers:
        went_on, whole = begun.of(robot, stance.end), once.of(robot, stance.end)
        assert [len(track) for track in went_on] == [len(track) for track in whole]
        assert all((a.times == b.times).all() for a, b in zip(went_on, whole, strict=True))
        assert all((np.diff(track.times) > 0).all() for track in went_on)
