"""The names of the package itself, and a graph made of one's own measurements."""

import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest
from test_imports import loaded_by

import coloc_graph
from coloc_graph import ColocError, Estimator, Floor, PoseGraph, RelativePose, Sighting, Stance, smooth
from coloc_graph.geometry.lie import floor_pose

STANCES = (Stance(0, 0.0, 5.0, ("A", "B"), ("C",), ()), Stance(1, 10.0, 15.0, ("B", "C"), ("A",), ("B",)))
C = np.diag(np.square([0.002, 0.002, 0.005, 0.01, 0.01, 0.01]))
T_A_B, T_B_C = floor_pose(1.0, 0.2, 0.3), floor_pose(0.9, -0.1, -0.5)


def test_the_package_offers_its_names_and_loads_nothing_for_them():
    heavy = {"numpy", "scipy", "cv2", "gtsam", "mcap", "msgspec"}
    assert not heavy & loaded_by("import coloc_graph; dir(coloc_graph)")
    assert set(coloc_graph.__all__) <= set(dir(coloc_graph))
    for name in coloc_graph.__all__:
        assert getattr(coloc_graph, name) is not None
    with pytest.raises(AttributeError, match="module 'coloc_graph' has no attribute 'nothing'"):
        coloc_graph.nothing  # noqa: B018


def test_an_example_solves_measurements_of_its_own(tmp_path):
    example = Path(__file__).parents[1] / "examples" / "own_measurements.py"
    command = [sys.executable, example]
    shown = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(shown) == 12 and shown[0].startswith("A at stance 0: x 0.000 m")
    assert shown[-1].startswith("A at stance 5: x 5.9")


@pytest.mark.parametrize("pose", [np.asarray, gtsam.Pose3, np.ndarray.tolist])
def test_a_relative_pose_is_a_pose_and_its_covariance(pose):
    made = (RelativePose(0, "A", "B", pose(T_A_B), C), RelativePose(1, "B", "C", pose(T_B_C), C.tolist()))
    estimate = smooth(PoseGraph("A", ("A", "B", "C"), STANCES, made))
    estimator = Estimator("A", ("A", "B", "C"))
    for stance, measured in zip(STANCES, made, strict=True):
        estimator.add(stance, [measured])
    for found in (estimate, estimator):
        np.testing.assert_allclose(found.pose("B", 1).matrix(), T_A_B, atol=1e-9)
        np.testing.assert_allclose(found.pose("C", 1).matrix(), T_A_B @ T_B_C, atol=1e-9)
        np.testing.assert_allclose(found.covariance("B", 0), C, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("T", "covariance", "words"),
    [
        (np.eye(3), C, r"pose of shape \(3, 3\): give \(4, 4\)"),
        (np.zeros(7), C, r"pose of shape \(7,\)"),
        ([[1.0, 0.0], [0.0]], C, "T_i_j of the relative pose of A and B at stance 0 is no array of numbers"),
        ("here", C, "no array of numbers"),
        (None, C, r"T_i_j|pose of shape"),
        (np.full((4, 4), np.nan), C, "not finite"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), C, "no rigid motion"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), C, "reflection"),
        (T_A_B.T, C, "its last row is not 0, 0, 0, 1"),
        (T_A_B, C[:3, :3], r"covariance of shape \(3, 3\): give \(6, 6\)"),
        (T_A_B, np.full((6, 6), np.inf), "covariance that is not finite"),
        (T_A_B, -C, "not positive definite"),
        (T_A_B, np.triu(C + 1e-6), "not symmetric"),
    ],
)
def test_what_is_no_relative_pose_is_refused_in_one_sentence(T, covariance, words):
    with pytest.raises(ColocError, match=words) as refusal:
        PoseGraph("A", ("A", "B", "C"), STANCES, (RelativePose(0, "A", "B", T, covariance),))
    assert "\n" not in str(refusal.value)


def test_a_covariance_of_six_is_no_sighting():
    sighting = Sighting(0, "A", "C", 1.0, T_A_B, C)
    with pytest.raises(ColocError, match=r"covariance of shape \(6, 6\): give \(3, 3\)"):
        PoseGraph("A", ("A", "B", "C"), STANCES, (sighting,), Floor())
