"""graph.g2o and the exported factors, solved by GTSAM alone: its poses are ours, and so are its covariances."""

import importlib.util

import gtsam
import numpy as np
import pytest
from teams import graph_of_team, team_of

from coloc_graph import SolveOptions, open_run, solve
from coloc_graph.backend import smooth
from coloc_graph.backend.factors import Factors
from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.gtsam_files import gtsam_files, unpack_gtsam, write_gtsam
from coloc_graph.exchange.relative_edges import UPRIGHT, relative_edges
from coloc_graph.simulation import Imperfections, simulate
from coloc_graph.team import Floor

STARTS = np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.02])  # rad, m: errors of the initial poses


@pytest.fixture(scope="module", params=["level", "uneven", pytest.param("team", marks=pytest.mark.long)])
def run(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / f"{request.param}.mcap"
    scenario = "team" if request.param == "team" else "hallway"
    wrong = Imperfections(mount_sigma_deg=0.5, floor_sigma_deg=0.1 if request.param == "uneven" else 0.0)
    simulate(scenario, path, stances=6 if scenario == "team" else 4, seed=4, imperfections=wrong)
    return open_run(path)


@pytest.fixture(scope="module", params=["joint", "smooth", "chain"])
def estimate(request, run):
    return solve(run, SolveOptions(method=request.param)).estimate


def test_a_stock_optimiser_returns_to_our_poses_of_graph_g2o(estimate, tmp_path):
    write_g2o(estimate, tmp_path / "graph.g2o")
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    rng, start = np.random.default_rng(0), gtsam.Values()
    keys = list(values.keys())
    for key in keys:
        start.insert(key, values.atPose3(key).retract((key != 0) * STARTS * rng.normal(size=6)))
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, start)
    found = optimiser.optimize()
    off = [np.linalg.norm(found.atPose3(key).translation() - values.atPose3(key).translation()) for key in keys]
    assert optimiser.iterations() > 0 and max(off) < 1e-4  # m; asked is 1e-3
    marginals = gtsam.Marginals(factors, found)  # throws where a variable is indeterminate
    assert all(np.isfinite(marginals.marginalCovariance(key)).all() for key in keys)


def exported(estimate, folder):
    """The script of exported factors, and what it loads: factors, values, names of the keys."""
    write_gtsam(gtsam_files(estimate), folder / "factors.zip")
    unpack_gtsam(folder / "factors.zip", folder / "out")
    spec = importlib.util.spec_from_file_location("solve_factors", folder / "out" / "solve.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script, *script.load()


def test_a_bare_script_gets_our_poses_and_covariances(estimate, tmp_path):
    script, factors, values, names = exported(estimate, tmp_path)
    assert set(names) == set(values.keys())
    found, iterations = script.solve(factors, script.perturbed(values, names, 0.05))
    assert iterations > 0
    covariances = script.covariances(factors, found, names)
    graph = estimate.graph
    for robot, trajectory in estimate.trajectories.items():
        for stance, T, C in zip(trajectory.stances, trajectory.T_world_body, trajectory.covariances, strict=True):
            key = graph.key(robot, int(stance))
            assert f"{robot}@{stance}" in names[key][1].split()
            off = gtsam.Pose3(T).localCoordinates(found.atPose3(key))
            assert np.abs(off / np.sqrt(C.diagonal())).max() < 0.01  # asked is 0.1
            ratio = np.sqrt(covariances[key].diagonal() / C.diagonal())
            np.testing.assert_allclose(ratio, 1, atol=1e-3)  # asked is 0.02


def test_a_bare_script_gets_sigmas_of_uncertain_headings(tmp_path):
    """A tilt must not tell a heading, as it seems to in the world frame where headings are uncertain."""
    estimate = smooth(graph_of_team(team_of(3, 250, floor=Floor(tilt_sigma_deg=0.3), odometry=False, sightings=False)))
    script, factors, values, names = exported(estimate, tmp_path)
    found, iterations = script.solve(factors, script.perturbed(values, names, 0.05))
    assert iterations > 0
    covariances = script.covariances(factors, found, names)
    for robot, trajectory in estimate.trajectories.items():
        last = int(trajectory.stances[-1])
        C, key = estimate.covariance(robot, last), estimate.graph.key(robot, last)
        off = estimate.pose(robot, last).localCoordinates(found.atPose3(key))
        assert C[2, 2] > 0.05**2 and np.sqrt(off @ np.linalg.solve(C, off)) < 0.01
        np.testing.assert_allclose(np.sqrt(covariances[key].diagonal() / C.diagonal()), 1, atol=1e-3)


def test_edges_know_no_more_of_height_roll_and_pitch_than_the_floor():
    graph = graph_of_team(team_of(5, 8))
    estimate = smooth(graph)
    edges, sigmas = relative_edges(estimate), Factors(graph.floor).gauge_sigmas[UPRIGHT]
    keys = {key: n for n, key in enumerate(dict.fromkeys(key for one in edges for key in (one.i, one.j)))}
    total = np.zeros((6 * len(keys), 6 * len(keys)))
    for edge, link in zip(edges, graph.measurements, strict=True):
        C, known = link.covariance, np.zeros((6, 6))
        part = slice(0, 6) if len(C) == 6 else slice(2, 5)
        known[part, part] = np.linalg.inv(C)
        T_j_i = estimate.values.atPose3(edge.j).between(estimate.values.atPose3(edge.i))
        J = np.zeros((6, len(total)))
        J[:, 6 * keys[edge.j] :][:, :6], J[:, 6 * keys[edge.i] :][:, :6] = np.eye(6), -T_j_i.AdjointMap()
        total += J.T @ (edge.information - known) @ J
    floor = np.zeros(6)
    floor[UPRIGHT] = sigmas**-2
    assert np.linalg.eigvalsh(np.diag(np.tile(floor, len(keys))) - total).min() > -1e-4 * floor.max()
    assert np.linalg.eigvalsh(total).max() > 0.1 * floor.max()  # and not much less either


def test_the_factors_are_exported_of_a_result(result, tmp_path, capsys):
    assert main(["export", "gtsam", str(result), "--out", str(tmp_path / "gtsam")]) == 0
    assert {path.name for path in (tmp_path / "gtsam").iterdir()} == {"graph.txt", "values.txt", "keys.csv", "solve.py"}
    (tmp_path / "damaged.zip").write_bytes((result / "factors.zip").read_bytes()[:-300])
    with pytest.raises(InputError, match="is damaged"):
        unpack_gtsam(tmp_path / "damaged.zip", tmp_path / "x")
