"""Headings contain how far a body's axis may be off the way its wheels drive."""

import numpy as np

from coloc_graph.backend.floor_poses import trajectory


def test_the_direction_of_wheels_is_in_the_headings_alone():
    covariances = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (2, 1, 1))  # x, y, heading
    exact, unsure = (trajectory("A", np.arange(2.0), np.zeros((2, 3)), covariances, sigma) for sigma in (0.0, 2.0))
    more = unsure.covariances - exact.covariances
    assert np.allclose(more[:, 2, 2], np.deg2rad(2.0) ** 2)
    more[:, 2, 2] = 0.0
    assert not more.any()
