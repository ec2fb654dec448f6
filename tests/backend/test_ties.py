"""Homographies that alone tie a new pose, tested by the rows they have beyond its unknowns."""

from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.backend import Estimator, diagnose, joint
from coloc_graph.backend.calibration import is_calibration
from coloc_graph.backend.factors import calibrations_in
from coloc_graph.measurements import Odometry, RelativePose
from coloc_graph.pipeline.batch import solve
from coloc_graph.pipeline.explanations import warnings_of_graph
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, simulate

WRONG_MOUNTS = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    """A hallway of six stances without odometry: each moved observer is tied by one homography alone."""
    path = tmp_path_factory.mktemp("ties") / "hallway.mcap"
    simulate("hallway", path, stances=6, seed=0, points=200, imperfections=WRONG_MOUNTS)
    whole = solve(open_run(path)).estimate.graph
    return replace(whole, measurements=tuple(m for m in whole.measurements if not isinstance(m, Odometry)))


def spoilt(graph, stance, size=0.05):
    """The graph with the homography of a stance off, and that homography."""
    (right,) = (m for m in graph.measurements if isinstance(m, RelativePose) and m.stance == stance)
    H = right.homography.H_j_i @ (np.eye(3) + size * np.random.default_rng(stance).standard_normal((3, 3)))
    wrong = replace(right, homography=replace(right.homography, H_j_i=H / np.cbrt(np.linalg.det(H))))
    return replace(graph, measurements=tuple(wrong if m is right else m for m in graph.measurements)), wrong, right


def estimator_of(graph):
    return Estimator(graph.reference, graph.robots, graph.floor, graph.slips, graph.robot_models, graph.landmarks)


def of_stance(graph, stance):
    return [m for m in graph.measurements if m.stance == stance.index]


def calibration(estimator):
    """Calibration variables by key."""
    return calibrations_in(estimator._live.isam.calculateEstimate())


def test_right_homographies_that_alone_tie_a_robot_enter(graph):
    estimator = estimator_of(graph)
    for stance in graph.stances:
        said = estimator.add(stance, of_stance(graph, stance))
        assert not said.rejected and not said.disconnected


@pytest.mark.parametrize("stance", [1, 2, 3, 4, 5])
def test_a_wrong_homography_that_alone_ties_a_robot_leaves_it_disconnected_and_the_calibration_as_it_was(graph, stance):
    bad, wrong, right = spoilt(graph, stance)
    estimator = estimator_of(bad)
    for one in bad.stances[:stance]:
        assert not estimator.add(one, of_stance(bad, one)).rejected
    before = calibration(estimator)
    moved = next(robot for robot, _ in wrong.ends if robot not in bad.stances[stance].anchors)

    said = estimator.add(bad.stances[stance], [m for m in of_stance(bad, bad.stances[stance]) if m is wrong])
    (rejection,) = said.rejected
    assert rejection.measurement is wrong
    assert rejection.reason == f"an outlier: {rejection.sigmas:.0f} sigmas from the other measurements"
    assert said.disconnected == (moved,)
    after = calibration(estimator)
    assert after.keys() == before.keys() and all(map(is_calibration, after))
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value)
    (part,) = diagnose(estimator.graph.without([wrong]))
    assert str(part).startswith(f"{moved} at stance {stance}: not tied to the reference; a relative pose or a sighting")

    said = estimator.insert(right)  # it waits, and comes in by what is right
    assert not said.rejected and not said.disconnected


@pytest.mark.parametrize("stance", [1, 3, 5])
def test_batch_rejects_such_a_homography_too_and_says_what_would_tie_the_robot(graph, stance):
    bad, wrong, _ = spoilt(graph, stance)
    estimate = joint(bad)
    (rejection,) = estimate.rejected
    assert rejection.measurement is wrong and "sigmas from the other measurements" in rejection.reason
    moved = next(robot for robot, _ in wrong.ends if robot not in bad.stances[stance].anchors)
    assert (moved, stance) in estimate.disconnected
    (sentence,) = (one for one in warnings_of_graph(estimate, ()) if one.endswith("(left out of the result)"))
    assert "not tied to the reference; a relative pose or a sighting between" in sentence
