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
    R = sigma**2, 0.0, sigma**2
    filters.predict(0.0)
    for u, v in seen[0].tolist():
        filters.add(u, v, R)
    for k in range(1, 30):
        filters.predict(k * dt)
        if k % 7:  # and each seventh image shows nothing
            for point, (u, v) in zip(filters.points, seen[k].tolist(), strict=True):
                point.update(u, v, R)
    off = true[-1] - filters.position
    covariance = np.array([((p[0], p[1]), (p[1], p[2])) for p in (one.p for one in filters.points)])
    nees = np.einsum("nc,ncd,nd->n", off, np.linalg.inv(covariance), off)
    assert chi2.ppf(5e-4, 2 * n) < nees.sum() < chi2.ppf(1 - 5e-4, 2 * n)


def test_a_point_at_constant_speed_is_found_where_it_will_be():
    filters = PointFilters(3e3, 60.0, 200.0)
    filters.predict(0.0)
    filters.add(10.0, 20.0, (0.01, 0.0, 0.01))
    for k in range(1, 20):
        filters.predict(0.1 * k)
        filters.points[0].update(10.0 + 3 * k, 20.0 - k, (0.01, 0.0, 0.01))
    filters.predict(2.0)
    assert filters.position[0] == pytest.approx([70.0, 0.0], abs=1e-3)
    assert (filters.points[0].du, filters.points[0].dv) == pytest.approx((30.0, -10.0), abs=1e-2)


def test_what_changes_its_speed_at_once_is_nearer_in_units_of_that():
    filters = PointFilters(100.0, 60.0, 200.0)
    R = 0.01, 0.0, 0.01
    filters.predict(0.0)
    filters.add(0.0, 0.0, R)
    for k in range(1, 40):
        filters.predict(0.05 * k)
        filters.points[0].update(0.0, 0.0, R)
    filters.predict(2.0)
    (point,) = filters.points
    squared, density, jerked = point.compare(5.0, 0.0, R, 60.0, 25.0)
    assert squared > 100
    assert jerked < 6
    variance = point.p[0] + 0.01
    assert density == pytest.approx(-np.log(2 * np.pi * variance) - 0.5 * squared, rel=1e-6)
    assert point.compare(50.0, 0.0, R, 60.0, 25.0) is None
    before = point.p, point.b, point.w
    point.allow_jerk(60.0)
    dt = filters.time - 1.95  # since the last measurement
    change = 60.0**2 * np.array([dt * dt, dt, 1.0])
    for old, new, added in zip(before, (point.p, point.b, point.w), change, strict=True):
        covariance, diagonal = np.subtract(new, old), [0, -1]
        assert covariance[diagonal] == pytest.approx([added, added], rel=1e-6) and not covariance[1:-1].any()
    point.update(5.0, 0.0, R)
    assert point.du == pytest.approx(100.0, rel=0.1)


def test_a_correlated_measurement_updates_as_the_matrices_say():
    filters = PointFilters(3e3, 60.0, 200.0)
    filters.predict(0.0)
    filters.add(1.0, 2.0, (0.3, 0.1, 0.2))
    filters.predict(0.1)
    (point,) = filters.points
    P = np.zeros((4, 4))
    P[:2, :2], P[2:, 2:] = [[0.3, 0.1], [0.1, 0.2]], 200.0**2 * np.eye(2)
    F = np.eye(4) + 0.1 * np.eye(4, k=2)
    G = np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]])
    P, R = F @ P @ F.T + 3e3 * np.kron(G, np.eye(2)), np.array([[0.5, -0.2], [-0.2, 0.4]])
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
    state = np.array([1.0, 2.0, 0.0, 0.0]) + K @ (3.0, -1.0)
    P = P - K @ P[:2]
    point.update(4.0, 1.0, (0.5, -0.2, 0.4))
    assert (point.u, point.v, point.du, point.dv) == pytest.approx(tuple(state))
    assert point.p == pytest.approx((P[0, 0], P[0, 1], P[1, 1]))
    assert point.b == pytest.approx(tuple(P[:2, 2:].ravel()))
    assert point.w == pytest.approx((P[2, 2], P[2, 3], P[3, 3]))


def test_an_earlier_time_changes_nothing():
    filters = PointFilters(3e3, 60.0, 200.0)
    filters.predict(1.0)
    filters.add(0.0, 0.0, (1.0, 0.0, 1.0))
    filters.predict(0.5)
    assert filters.time == 1.0
    assert filters.points[0].p == (1.0, 0.0, 1.0)
