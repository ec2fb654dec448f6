"""What a plan promises, against what the estimator then states, and what the estimate is off by."""

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from test_plan import straight_plan

from coloc_graph.errors import InputError
from coloc_graph.evaluation import align
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.batch import solve
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.planning.belief import WHEELS, Belief, leap_model, updated
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.mission import best_stance, leap_frog
from coloc_graph.planning.prediction import Predictor
from coloc_graph.run import atomic_run, open_run
from coloc_graph.simulation import Imperfections, build_world, record, reference_team
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import stated_team, wide_team
from coloc_graph.simulation.world import stream
from coloc_graph.team import CentreNoise

FIELD = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)


def team_of(imperfections=FIELD):
    return stated_team(reference_team(), imperfections)


def estimated(plan, folder, seed, imperfections=FIELD, **options):
    """The world that follows a plan, and its estimate."""
    world = build_world(planned(plan, stream(seed, "formation")), seed=seed, imperfections=imperfections)
    with atomic_run(folder / f"{seed}.mcap", world.team) as writer:
        record(world, writer, "tracks")
    return world, solve(open_run(folder / f"{seed}.mcap"), SolveOptions("joint", **options)).estimate


def predicted(plan, team, *, odometry=True):
    start = Belief.start(team, {**plan.stances[0].standing, "C": (1.5, 0.0, 0.0)})
    return Predictor(team, fps=10.0, wheels=WHEELS if odometry else None).of_plan(start, plan)


@pytest.mark.parametrize(("gait", "seconds"), [(Gait(0.8, 0.6, 10.0), 16.0), (PAPER, 6.0)])
@pytest.mark.parametrize("odometry", [True, False])
def test_the_promised_sigmas_are_those_that_the_estimator_states(tmp_path, gait, seconds, odometry):
    plan = straight_plan(5, gait, seconds)
    world, estimate = estimated(plan, tmp_path, 1, odometry=odometry)
    promises = predicted(plan, world.team, odometry=odometry)
    end = promises[-1].belief
    for robot in ("A", "B"):
        C = estimate.trajectories[robot].covariances[-1]
        assert end.position_sigma([robot]) == pytest.approx(math.sqrt(np.trace(C[3:5, 3:5])), rel=0.1)
        assert end.heading_sigma([robot]) == pytest.approx(math.sqrt(C[2, 2]), rel=0.1)
    counts = [captures[0].recorded.sum() for captures in world.captures]
    assert np.mean([promise.points for promise in promises]) == pytest.approx(np.mean(counts), rel=0.1)


@pytest.mark.parametrize(("gait", "seconds"), [(Gait(0.8, 0.6, 10.0), 8.0), (PAPER, 6.0)])
@pytest.mark.parametrize(("noise_px", "least"), [
    (0.1, 0.9),
    (0.04, 0.7),  # there the estimator states more than errors are: it sees slopes in the residuals, too
])  # fmt: skip
def test_the_floors_slope_under_the_mover_is_promised(tmp_path, gait, seconds, noise_px, least):
    plan, given = straight_plan(5, gait, seconds), replace(FIELD, noise_px=noise_px)
    world, estimate = estimated(plan, tmp_path, 1, given)
    end = predicted(plan, world.team)[-1].belief
    last = [estimate.trajectories[robot].covariances[-1] for robot in ("A", "B")]
    position = math.sqrt(np.mean([np.trace(C[3:5, 3:5]) for C in last]))
    heading = math.sqrt(np.mean([C[2, 2] for C in last]))
    assert least < end.position_sigma(("A", "B")) / position < 1.1
    assert least < end.heading_sigma(("A", "B")) / heading < 1.1


@pytest.mark.long
@pytest.mark.parametrize(("gait", "seconds", "noise_px", "seeds"), [
    (Gait(0.7, 0.6, 10.0), 6.0, 0.3, 16),
    (PAPER, 6.0, 0.04, 24),
])  # fmt: skip
def test_the_promised_sigma_is_the_spread_of_errors(tmp_path, gait, seconds, noise_px, seeds):
    plan = straight_plan(2 if noise_px == 0.3 else 5, gait, seconds)
    squares = []
    for seed in range(seeds):
        world, estimate = estimated(plan, tmp_path, seed, replace(FIELD, noise_px=noise_px))
        times = np.array([stance.start for stance in world.stances])
        truth = {name: Trajectory(name, times, path.pose_at(times)) for name, path in world.paths.items()}
        true = align(estimate.trajectories, truth, "A", on_floor=True)
        off = [estimate.trajectories[r].T_world_body[-1][:2, 3] - true[r][-1][:2, 3] for r in ("A", "B")]
        squares.append(np.mean(np.square(off).sum(axis=1)))
    promise = predicted(plan, world.team)[-1].belief.position_sigma(("A", "B"))
    ratio = promise / math.sqrt(np.mean(squares))
    assert 0.7 < ratio < 1.4  # 16 runs know it to 13 %; benchmarks/planning.py has more


def test_a_leap_turns_an_error_of_the_heading_into_one_of_the_place():
    F, Q = leap_model((1.0, 0.5, 0.3), (1e-3, 1e-4))
    xi = np.zeros(6)
    xi[2] = 1e-4
    moved = F @ xi
    c, s = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(moved[3:5], 1e-4 * np.array([c * -0.5 + s * 1.0, s * 0.5 + c * 1.0]))
    assert moved[2] == pytest.approx(1e-4)
    assert np.linalg.eigvalsh(Q).min() >= 0
    assert np.sqrt(np.trace(Q[3:5, 3:5])) == pytest.approx(0.013, abs=0.004)


def test_information_on_some_variables_is_the_kalman_update():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    P, rows, half = root @ root.T, np.array([1, 4, 5]), rng.standard_normal((3, 3))
    information = np.zeros((6, 6))
    information[np.ix_(rows, rows)] = half @ half.T
    np.testing.assert_allclose(
        updated(P, rows, half @ half.T), np.linalg.inv(np.linalg.inv(P) + information), atol=1e-9
    )


def test_designed_drives_leave_less_variance_at_the_goal_than_the_patrol():
    predictor, goal, ratios = Predictor(team_of(), fps=10.0), (5.0, 0.0), []
    for gait in (PAPER, Gait(0.6, 0.6, 10.0), Gait(0.9, 0.5, 25.0)):
        standing = {"A": gait.stop(0), "B": gait.stop(1)}
        belief = Belief.start(predictor.team, {**standing, "C": (1.5, 0.0, 0.0)})
        variances = []
        for designed in (True, False):
            _, promise = best_stance(predictor, belief, standing, (), "C", 6.0, goal, designed=designed)
            variances.append(promise.belief.end_variance(("A", "B"), goal))
        ratios.append(variances[0] / variances[1])
    assert max(ratios) <= 1.0
    assert min(ratios) < 0.7


def test_noise_that_all_images_share_is_not_averaged_away():
    exact = Imperfections(noise_px=0.02)
    plan = straight_plan(1, duration=60.0)
    sigmas = []
    for bias in (0.0, 0.05):
        team = stated_team(reference_team(bias_px=bias), exact)
        sigmas.append(predicted(plan, team)[-1].belief.position_sigma(("B",)))
    assert sigmas[1] > 3 * sigmas[0]


def test_a_calibrated_team_promises_what_the_noise_does_that_it_has_learnt():
    plan, team = straight_plan(2), team_of()
    learnt = CentreNoise(typical_px=0.045)
    robots = [
        structs.replace(robot, camera_if_any=structs.replace(robot.camera, centre_noise=learnt))
        for robot in team.robots
    ]  # fmt: skip
    of_learnt = predicted(plan, structs.replace(team, robots=tuple(robots)))[-1].belief.position_sigma(("B",))
    stated = predicted(plan, team_of(replace(FIELD, noise_px=0.045)))[-1].belief.position_sigma(("B",))
    assert of_learnt == pytest.approx(stated)
    assert of_learnt < 0.7 * predicted(plan, team)[-1].belief.position_sigma(("B",))


def test_a_stance_without_a_common_view_promises_nothing():
    plan = straight_plan(1)
    (stance,) = plan.stances
    apart = {"A": (0.0, 0.0, 2.0), "B": (0.0, 1.0, -2.0)}
    blind = type(plan)((type(stance)(apart, (), "C", stance.waypoints, 8.0),))
    promise = predicted(blind, team_of())[0]
    assert promise.points == 0
    assert promise.belief.position_sigma(("B",)) > 1.0
    with pytest.raises(InputError, match="no common view"):
        leap_frog(Predictor(team_of()), Gait(1.5, 4.0, -40.0), 3.0, 5.0, ("A", "B"), "C")


def test_a_team_without_a_floor_is_refused():
    team = reference_team()
    with pytest.raises(InputError, match=r"\[floor\]"):
        Belief.start(type(team)(reference="A", robots=team.robots), {"A": (0.0, 0.0, 0.0)})


def test_the_promised_sigmas_of_fisheyes_are_those_that_the_estimator_states(tmp_path):
    plan = straight_plan(3, Gait(0.8, 0.6, 10.0), 16.0)
    world = build_world(
        planned(plan, stream(1, "formation")), seed=1, imperfections=FIELD, team=wide_team(160.0)
    )  # fmt: skip
    with atomic_run(tmp_path / "wide.mcap", world.team) as writer:
        record(world, writer, "tracks")
    estimate = solve(open_run(tmp_path / "wide.mcap"), SolveOptions("joint", odometry=False)).estimate
    end = predicted(plan, world.team, odometry=False)[-1].belief
    for robot in ("A", "B"):
        C = estimate.trajectories[robot].covariances[-1]
        assert end.position_sigma([robot]) == pytest.approx(math.sqrt(np.trace(C[3:5, 3:5])), rel=0.15)
