"""What cameras see of the marker plane, against independent arithmetic; every Jacobian against differences."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from coloc_graph.backend.batched_factors import BatchedFactor, BatchedFactors, FactorEvaluator
from coloc_graph.backend.camera_model import UNEVALUABLE, MarkersModel, Mounts
from coloc_graph.backend.homography_model import HomographyModel, StatedPlaneModel, level_plane
from coloc_graph.backend.span_factor import SpanModel, Spans, spans_on_plane
from coloc_graph.geometry.lie import floor_pose, se3_exp, se3_inverse, sl3_log, sl3_normalise
from coloc_graph.measurements import HomographyMeasurement, MarkerSpan
from coloc_graph.team import Markers, Mount
from coloc_graph.team.camera import LENS_TERMS

MOUNT_I = Mount(height=0.4, tilt_deg=20.0, roll_deg=1.0, yaw_deg=5.0, x=0.05, y=-0.02)
MOUNT_J = Mount(height=0.38, tilt_deg=17.0, roll_deg=-2.0, yaw_deg=-3.0, x=0.02, y=0.01)
MARKERS = Markers(height=0.15, positions=((0.0, 0.125), (0.03, -0.125)))
T_WORLD_I = floor_pose(0.3, 0.1, 0.2) @ se3_exp(np.array([2e-3, -1e-3, 0, 0, 0, 1e-3]))
EXACT = np.zeros(6), np.zeros(6), np.zeros(2), np.zeros(1)
T_WORLD_J = floor_pose(0.4, -0.6, 0.5) @ se3_exp(np.array([-1e-3, 2e-3, 0, 0, 0, -1e-3]))


def seen_by(T_world_body, mount, points):
    T = se3_inverse(T_world_body @ mount.T_body_camera)
    p = points @ T[:3, :3].T + T[:3, 3]
    return p[..., :2] / p[..., 2:]


def homography(rng, T_i=T_WORLD_I, T_j=T_WORLD_J, offset=None):
    """The true homography of the plane of the markers, by four points on it, with an information that mixes all."""
    points = np.array([[1.0, 0.0, 0.15], [2.0, 0.5, 0.15], [1.5, -0.7, 0.15], [2.4, -0.3, 0.15]])
    rows = []
    for (x, y), (u, v) in zip(seen_by(T_i, MOUNT_I, points), seen_by(T_j, MOUNT_J, points), strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    H = sl3_normalise(np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3))
    root = rng.normal(size=(8, 8)) * 300
    return HomographyMeasurement(
        0, "A", "B", H, root @ root.T, 100, 100, 200.0, 192, 1e4,
        by_time_offset=offset, time_offset_sigma=0.0 if offset is None else 1e-4,
    )  # fmt: skip


def span_of(rng, T_i=T_WORLD_I, noise=0.0, n=40):
    """Both markers of a robot that drives about, as camera i sees them."""
    at = [floor_pose(*rng.uniform((0.9, -0.5, -3), (2.0, 0.7, 3))) for _ in range(n)]
    x_i = np.array([seen_by(T_i, MOUNT_I, MARKERS.p_body @ T[:3, :3].T + T[:3, 3]) for T in at])
    x_i += noise * rng.normal(size=x_i.shape)
    covariance = np.broadcast_to(1e-6 * np.array([[1.0, 0.2], [0.2, 0.8]]), (n, 2, 2, 2))
    return MarkerSpan("C", x_i, covariance, 0.05 * rng.normal(size=(n, 2, 2, 8)), np.zeros((n, 2, 2, 0)))


def model_of(rng, on_floor=True, measured=None, spans=None):
    spans = (span_of(rng),) if spans is None else spans
    measured = measured or homography(rng, offset=rng.normal(size=8))
    return homography_model(measured, spans, {"C": MARKERS}, on_floor)


def near(spans, n, sigma, lengths):
    return SpanModel.near(spans, np.tile(n, (len(spans), 1)), np.full(len(spans), sigma), lengths)


def homography_model(measured, spans, markers, on_floor=True):
    level = level_plane(MOUNT_I, (0.0,) * 6, MARKERS.height)
    models = near(spans, level, 0.01, [MARKERS.span] * len(spans))
    return HomographyModel(measured, models, MOUNT_I, MOUNT_J, markers, on_floor)


def at(model, T_i, T_j, *errors):
    """The residual of one model, its Jacobian by everything, and whether it can be evaluated."""
    e, by, possible = model.batch([model]).at(T_i[None], T_j[None], [np.atleast_1d(one)[None] for one in errors])
    return e[0], np.concatenate(by, axis=2)[0], possible[0]


def by_differences(f, x, step=1e-6):
    """The Jacobian of f at x."""
    return np.array([(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(len(x))]).T


def test_a_mount_that_is_off_sits_where_one_that_is_stated_so_does(rng):
    height, tilt, roll, yaw, x, y = at = 0.01, 0.03, -0.02, 0.04, 0.006, -0.007
    stated = Mount(
        height=0.40 + height,
        tilt_deg=20.0 + np.rad2deg(tilt),
        roll_deg=1.0 + np.rad2deg(roll),
        yaw_deg=5.0 + np.rad2deg(yaw),
        x=0.05 + x,
        y=-0.02 + y,
    )
    camera = Mounts([MOUNT_I]).at(np.array([at]))
    R, t = camera.R[0], camera.t[0]
    np.testing.assert_allclose(R, stated.R_body_camera, atol=1e-14)
    np.testing.assert_allclose(t, [0.056, -0.027, 0.41], atol=1e-14)

    def tangent(errors):
        """Of the camera that is off in the one that is not."""
        off = Mounts([MOUNT_I]).at(np.array([at]) + errors)
        W = R.T @ off.R[0]
        return np.array([W[2, 1], W[0, 2], W[1, 0], *(R.T @ (off.t[0] - t))])

    np.testing.assert_allclose(camera.by_errors[0], by_differences(tangent, np.zeros(6)), atol=1e-9)


@pytest.mark.parametrize("on_floor", [True, False])
def test_nothing_is_left_at_the_truth(rng, on_floor):
    level = [floor_pose(0.3, 0.1, 0.2), floor_pose(0.4, -0.6, 0.5)]
    T_i, T_j = (T_WORLD_I, T_WORLD_J) if on_floor else level
    model = model_of(rng, on_floor, homography(rng, T_i, T_j), ())
    assert model.rows == 8 and np.abs(at(model, T_i, T_j, *EXACT)[0]).max() < 1e-6


@pytest.mark.parametrize("on_floor", [True, False])
def test_jacobians_of_homography_and_spans(rng, on_floor):
    model = model_of(rng, on_floor)
    assert model.rows == 11
    # far from the truth, so that nothing that counts is small
    x = np.concatenate([0.02 * rng.normal(size=12), 0.02 * rng.normal(size=12), 0.01 * rng.normal(size=2), [3e-3]])

    def moved(step):
        """Poses move from where they are, everything else adds up."""
        T_i = T_WORLD_I @ se3_exp(x[:6]) @ se3_exp(step[:6])
        T_j = T_WORLD_J @ se3_exp(x[6:12]) @ se3_exp(step[6:12])
        y = x + step
        return at(model, T_i, T_j, y[12:18], y[18:24], y[24:26], y[26])

    J = moved(np.zeros(27))[1]
    expected = by_differences(lambda step: moved(step)[0], np.zeros(27))
    np.testing.assert_allclose(J, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
    assert (np.abs(expected).max(axis=0) > 1e-3 * np.abs(expected).max()).sum() >= 21  # the test says something


def test_the_residual_is_the_whitened_logarithm(rng):
    measured = homography(rng)
    model = model_of(rng, measured=measured, spans=())
    T_j = T_WORLD_J @ se3_exp(0.01 * rng.normal(size=6))
    e, _, _ = at(model, T_WORLD_I, T_j, *EXACT)
    predicted = homography(rng, T_j=T_j).H_j_i
    h = sl3_log(np.linalg.inv(measured.H_j_i) @ predicted)
    assert e @ e == pytest.approx(h @ measured.information @ h, rel=1e-6)


def test_a_clock_that_is_known_apart_leaves_the_information_at_the_right_offset(rng):
    b = rng.normal(size=8)
    measured = homography(rng, offset=b)
    model = model_of(rng, measured=measured, spans=())
    at_offset = np.linalg.inv(model.by_h.T @ model.by_h)
    np.testing.assert_allclose(at_offset + 1e-8 * np.outer(b, b), np.linalg.inv(measured.information), rtol=1e-5)


def test_what_cannot_be_seen_is_told_apart(rng):
    model = model_of(rng)
    in_plane = T_WORLD_I.copy()
    in_plane[2, 3] = -0.25  # the camera is at the markers' height
    assert not at(model, in_plane, T_WORLD_J, *EXACT)[2]
    below = T_WORLD_J.copy()
    below[2, 3] = -1.0
    assert not at(model, T_WORLD_I, below, *EXACT)[2]
    sight = MarkersModel(np.zeros((2, 2)), 1e-6 * np.eye(4), MOUNT_I, MARKERS)
    assert not at(sight, T_WORLD_I, T_WORLD_I @ floor_pose(-2, 0, 0), np.zeros(6), np.zeros(2))[2]


def test_spans_on_the_true_plane_are_the_markers(rng):
    span = span_of(rng)
    T = T_WORLD_I @ MOUNT_I.T_body_camera
    N = T[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    n = N / (T[2, 3] - 0.15)
    lengths, by_n, _, _ = spans_on_plane(span.x_i, n)
    np.testing.assert_allclose(lengths, MARKERS.span, rtol=1e-12)
    np.testing.assert_allclose(by_n, by_differences(lambda m: spans_on_plane(span.x_i, m)[0], n), rtol=1e-6, atol=1e-8)


def test_a_span_has_unit_covariance_and_no_bias(rng):
    """Over draws of the noise: what noise adds to a length is taken off, and what is left is what is promised."""
    T = T_WORLD_I @ MOUNT_I.T_body_camera
    n = T[:3, :3].T @ np.array([0.0, 0.0, -1.0]) / (T[2, 3] - 0.15)
    true = span_of(rng)
    true = replace(true, covariance=6 * true.covariance)
    root = np.linalg.cholesky(true.covariance)
    off, without, by_noisy_weights = [], [], []
    for _ in range(800):
        noisy = true.x_i + (root @ rng.normal(size=(*true.x_i.shape, 1)))[..., 0]
        span = MarkerSpan("C", noisy, true.covariance, true.by_h, true.shared)
        (model,) = near([span], n, 0.0, [MARKERS.span])
        off.append(Spans([model]).at(n[None], np.zeros(1))[0][0])
        without.append(off[-1] + model.weights @ model.noise)
        (cautious,) = near([span], n, 6e-3, [MARKERS.span])
        by_noisy_weights.append(Spans([cautious]).at(n[None], np.zeros(1))[0][0])
    off = np.array(off)
    np.testing.assert_allclose(np.cov(off.T), np.eye(3), atol=0.15)
    assert np.abs(off.mean(axis=0)).max() < 4 / np.sqrt(len(off))
    # that is no little: without either correction the test fails
    assert np.abs(np.mean(without, axis=0)).max() > 4 / np.sqrt(len(off))
    assert np.abs(np.mean(by_noisy_weights, axis=0)).max() > 4 / np.sqrt(len(off))


def test_rays_near_the_horizon_and_few_of_them_say_nothing(rng):
    span = span_of(rng)
    T = T_WORLD_I @ MOUNT_I.T_body_camera
    n = T[:3, :3].T @ np.array([0.0, 0.0, -1.0]) / (T[2, 3] - 0.15)
    every, cautious, none = (near([span], n, sigma, [MARKERS.span]) for sigma in (0.0, 0.06, 0.5))
    assert len(every[0].x_i) == 40
    assert 4 <= len(cautious[0].x_i) < 40  # 3 sigmas are 10 deg: farther than 1.4 m
    assert none == (None,)


def test_spans_taken_together_are_those_taken_alone(rng):
    one, other = span_of(rng, noise=1e-3, n=20), replace(span_of(rng, noise=1e-3, n=45), mover="D")
    shared = [replace(span, shared=1e-3 * rng.normal(size=(len(span.x_i), 2, 2, 6))) for span in (one, other)]
    T = T_WORLD_I @ MOUNT_I.T_body_camera
    n = T[:3, :3].T @ np.array([0.0, 0.0, -1.0]) / (T[2, 3] - 0.15)
    for spans in ([one, other], shared):
        alone = [near([span], n, 0.0, [length])[0] for span, length in zip(spans, (0.25, 0.26), strict=True)]
        for a, b in zip(alone, near(spans, n, 0.0, [0.25, 0.26]), strict=True):
            assert (a.mover, a.length) == (b.mover, b.length)
            for name in ("x_i", "noise", "weights", "by_h"):
                np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=1e-9, atol=1e-9)


def test_jacobians_of_a_stated_plane(rng):
    measured = replace(homography(rng), by_lenses=1e-3 * rng.normal(size=(2, 8, LENS_TERMS)))
    T = T_WORLD_I @ MOUNT_I.T_body_camera
    n = T[:3, :3].T @ np.array([0.0, 0.0, -1.0]) / (T[2, 3] - 0.15)
    model = StatedPlaneModel(measured, n, MOUNT_I, MOUNT_J)
    none = np.zeros(LENS_TERMS)
    assert np.abs(at(model, T_WORLD_I, T_WORLD_J, np.zeros(3), none, none)[0]).max() < 1e-6
    T_j = T_WORLD_J @ se3_exp(0.01 * rng.normal(size=6))
    errors = np.concatenate([0.01 * rng.normal(size=3), rng.normal(size=2 * LENS_TERMS)])

    def parts(all_errors):
        return np.split(all_errors, [3, 3 + LENS_TERMS])

    def moved(step):
        return at(model, T_WORLD_I @ se3_exp(step[:6]), T_j @ se3_exp(step[6:12]), *parts(errors + step[12:]))[0]

    expected = by_differences(moved, np.zeros(15 + 2 * LENS_TERMS))
    got = at(model, T_WORLD_I, T_j, *parts(errors))[1]
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_sighted_markers(rng):
    T_seen = floor_pose(1.4, 0.2, 0.7)
    x = seen_by(floor_pose(0.3, 0.1, 0.2), MOUNT_I, MARKERS.p_body @ T_seen[:3, :3].T + T_seen[:3, 3])
    root = np.tril(rng.standard_normal((4, 4))) + 3 * np.eye(4)
    covariance = 1e-6 * root @ root.T
    model = MarkersModel(x, covariance, MOUNT_I, MARKERS)
    level = floor_pose(0.3, 0.1, 0.2)
    assert np.abs(at(model, level, T_seen, np.zeros(6), np.zeros(2))[0]).max() < 1e-9
    np.testing.assert_allclose(level @ floor_pose(*model.planar_pose(np.zeros(6), np.zeros(2))), T_seen, atol=1e-12)
    assert model.planar_pose(np.array([0.0, -0.5, 0, 0, 0, 0]), np.zeros(2)) is None  # it looks up
    T_off, mount, markers = (
        T_seen @ se3_exp(0.02 * rng.normal(size=6)),
        0.01 * rng.normal(size=6),
        np.array([0.01, 2e-3]),
    )

    def moved(step):
        T_i, T_j = T_WORLD_I @ se3_exp(step[:6]), T_off @ se3_exp(step[6:12])
        return at(model, T_i, T_j, mount + step[12:18], markers + step[18:])[0]

    expected = by_differences(moved, np.zeros(20))
    got = at(model, T_WORLD_I, T_off, mount, markers)[1]
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_factors_evaluated_at_once_are_those_evaluated_alone(rng):
    """Spans of several lengths, two and no spans, an exact mount, one that cannot be evaluated, and a sighting."""
    short, long = span_of(rng, n=25), replace(span_of(rng, n=40), mover="D")
    both = {"C": MARKERS, "D": MARKERS}
    made = [model_of(rng), model_of(rng, spans=(short,)), model_of(rng, False), model_of(rng, spans=())]
    made += [homography_model(homography(rng), spans, both) for spans in ((short, long), (long, short), (long,))]
    seen = [FactorEvaluator(model, (1, 2), (11, 12, *[21] * len(model.movers), 31), (6, 6, *[2] * len(model.movers), 1))
            for model in made]  # fmt: skip
    seen.append(FactorEvaluator(made[0], (2, 1), (None, 12, 21, None), (6, 6, 2, 1)))
    seen.append(FactorEvaluator(made[0], (1, 3), (11, 12, 21, 31), (6, 6, 2, 1)))  # robot 3 is below the floor
    x = seen_by(T_WORLD_I, MOUNT_I, MARKERS.p_body @ T_WORLD_J[:3, :3].T + T_WORLD_J[:3, 3] + (1.0, 0.0, 0.0))
    sight = MarkersModel(x, 1e-6 * np.eye(4), MOUNT_I, MARKERS)
    seen.append(FactorEvaluator(sight, (1, 2), (11, 21), (6, 2)))

    def values_of(step):
        values = gtsam.Values()
        down = floor_pose(0.4, -0.6, 0.5)
        down[2, 3] = -1.0
        for key, T in ((1, T_WORLD_I), (2, T_WORLD_J @ se3_exp(step * np.ones(6))), (3, down)):
            values.insert(key, gtsam.Pose3(T))
        for key, size in ((11, 6), (12, 6), (21, 2), (31, 1)):
            values.insert(key, (step + 1e-3) * np.arange(1.0, size + 1))
        return values

    factors, together = [BatchedFactor(one) for one in seen], BatchedFactors(seen)
    for step in (0.0, 1e-3):  # what was found at other values is not handed out at these
        values = values_of(step)
        alone = [factor.linearize(values).jacobian() for factor in factors]
        assert (np.abs(alone[-2][1]) == UNEVALUABLE).all() and not alone[-2][0].any()
        with together:
            for factor, (A, b) in zip(factors, alone, strict=True):
                A_too, b_too = factor.linearize(values).jacobian()
                np.testing.assert_allclose(A_too, A, rtol=1e-9, atol=1e-9 * np.abs(A).max())
                np.testing.assert_allclose(b_too, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())
                assert factor.error(values) == pytest.approx(b @ b / 2, rel=1e-9)


def test_within_a_graph_a_factor_is_evaluated_alone_where_nothing_else_is_known(rng):
    model = model_of(rng)
    seen = [FactorEvaluator(model, (1, j), (None, None, None, None), (6, 6, 2, 1)) for j in (2, 3)]
    values = gtsam.Values()
    values.insert(1, gtsam.Pose3(T_WORLD_I))
    values.insert(2, gtsam.Pose3(T_WORLD_J))
    factor = BatchedFactor(seen[0])
    alone = factor.error(values)
    with BatchedFactors(seen):
        assert factor.error(values) == pytest.approx(alone, rel=1e-9)
    assert seen[0].among is None
