"""Filters of points: what they predict, and whether their covariances are true."""

import numpy as np
import pytest
from scipy.stats import chi2

from coloc_graph.frontend.tracks.kalman import PointFilters


def walked(n, k, dt, q, sigma, rng):
    """n points of white-noise acceleration for k steps, and their measurements: (k, n, 2) each."""
    place, speed = np.zeros((n, 2)), 100.0 * rng.standard_normal((n, 2))
    L = np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    places = []
    for _ in range(k):
        noise = np.einsum("ab,nbc->nac", L, rng.standard_normal((n, 2, 2)))
        place, speed = place + dt * speed + noise[:, 0], speed + noise[:, 1]
        places.append(place)
    places = np.array(places)
    return places, places + sigma * rng.standard_normal(places.shape)


def test_covariances_tell_the_truth():
    rng, n, sigma, dt = np.random.default_rng(0), 400, 0.3, 0.03
    true, seen = walked(n, 30, dt, 3e3, sigma, rng)
    filters = PointFilters(3e3, 60.0, 100.0)
    R = np.broadcast_to(sigma**2 * np.eye(2), (n, 2, 2))
    filters.predict(0.0)
    filters.add(seen[0], R)
    for k in range(1, 30):
        filters.predict(k * dt)
        if k % 7:  # and each seventh image shows nothing
            filters.update(np.arange(n), seen[k], R)
    off = true[-1] - filters.position
    nees = np.einsum("nc,ncd,nd->n", off, np.linalg.inv(filters.position_covariance), off)
    assert chi2.ppf(5e-4, 2 * n) < nees.sum() < chi2.ppf(1 - 5e-4, 2 * n)


def test_a_point_at_constant_speed_is_found_where_it_will_be():
    filters = PointFilters(3e3, 60.0, 200.0)
    filters.predict(0.0)
    filters.add(np.array([[10.0, 20.0]]), np.array([0.01 * np.eye(2)]))
    for k in range(1, 20):
        filters.predict(0.1 * k)
        filters.update(np.array([0]), np.array([[10.0 + 3 * k, 20.0 - k]]), np.array([0.01 * np.eye(2)]))
    filters.predict(2.0)
    assert filters.position[0] == pytest.approx([70.0, 0.0], abs=1e-3)
    assert filters.velocity[0] == pytest.approx([30.0, -10.0], abs=1e-2)


def test_what_changes_its_speed_at_once_is_nearer_in_units_of_that():
    filters = PointFilters(100.0, 60.0, 200.0)
    R = np.array([0.01 * np.eye(2)])
    filters.predict(0.0)
    filters.add(np.zeros((1, 2)), R)
    for k in range(1, 40):
        filters.predict(0.05 * k)
        filters.update(np.array([0]), np.zeros((1, 2)), R)
    filters.predict(2.0)
    squared, _, jerked = filters.distances(np.array([[5.0, 0.0]]), R)
    assert squared[0, 0] > 100
    assert jerked[0, 0] < 6
    filters.jerk(np.array([0]))
    filters.update(np.array([0]), np.array([[5.0, 0.0]]), R)
    assert filters.velocity[0, 0] == pytest.approx(100.0, rel=0.1)


def test_an_earlier_time_changes_nothing():
    filters = PointFilters(3e3, 60.0, 200.0)
    filters.predict(1.0)
    filters.add(np.zeros((1, 2)), np.array([np.eye(2)]))
    filters.predict(0.5)
    assert filters.time == 1.0
    assert filters.position_covariance[0] == pytest.approx(np.eye(2))
