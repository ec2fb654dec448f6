"""Which sample of one camera is which of the other: by time, by name, and by what the markers do."""

import numpy as np
import pytest
from planar_scene import CAMERA, MARKERS, MOUNT, Scene, mounted

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import Track, correspond, fit_homography, pair_by_time, plane_from_mount
from coloc_graph.frontend.pairing.correspondence import pair_each_by_time
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers, span_samples

T0 = 1_700_000_000.0
SCENE = Scene()
PLANE = plane_from_mount(MOUNT, MARKERS)


def test_series_with_nothing_in_them_pair_to_nothing():
    for a, b in (([], []), ([], [1.0]), ([1.0], [])):
        assert pair_by_time(np.array(a), np.array(b)).shape == (0, 2)


def test_one_sample_each():
    assert pair_by_time(np.array([1.0]), np.array([1.004])).tolist() == [[0, 0]]
    assert pair_by_time(np.array([1.0]), np.array([1.006])).tolist() == []


def test_samples_exactly_5_ms_apart_are_one_instant_at_any_time_of_day():
    times = T0 + 0.02 * np.arange(200)
    for sign in (1, -1):
        assert len(pair_by_time(times, times + sign * 0.005)) == 200
        assert len(pair_by_time(times, times + sign * 0.0051)) == 0
    assert pair_by_time(np.array([0.0]), np.array([0.005])).tolist() == [[0, 0]]


def test_no_sample_is_used_twice():
    rng = np.random.default_rng(0)
    for _ in range(50):
        a, b = (np.sort(rng.uniform(0, 0.2, rng.integers(1, 40))) for _ in range(2))
        pairs = pair_by_time(a, b)
        assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
        assert (np.abs(a[pairs[:, 0]] - b[pairs[:, 1]]) <= 0.005 + 1e-6).all()
        assert (np.diff(pairs, axis=0) > 0).all()
    pairs = pair_by_time(np.array([1.0, 1.0, 2.0]), np.array([1.0, 2.0, 2.0]))
    assert len(pairs) == 2
    assert set(pairs[:, 0]) & {0, 1}
    assert 2 in pairs[:, 0]


def test_a_fast_and_a_slow_camera_pair_at_the_slow_ones_instants_whichever_comes_first():
    fast, slow = T0 + 0.01 * np.arange(100), T0 + 0.002 + 0.1 * np.arange(10)
    wanted = np.stack([10 * np.arange(10), np.arange(10)], axis=1)
    assert pair_by_time(fast, slow).tolist() == wanted.tolist()
    assert pair_by_time(slow, fast).tolist() == wanted[:, ::-1].tolist()


def drive(n=80):
    """A robot on a winding way in the common view: both markers in the world, (n, 2, 3)."""
    s = np.linspace(0, 2 * np.pi, n)
    centre = np.column_stack([1.3 + 0.35 * np.cos(s), 0.25 * np.sin(2 * s)])
    heading = np.arctan2(*np.gradient(centre, axis=0)[:, ::-1].T)
    side = 0.125 * np.column_stack([-np.sin(heading), np.cos(heading)])
    both = np.stack([centre + side, centre - side], axis=1)
    return np.concatenate([both, np.full((n, 2, 1), 0.15)], axis=2)


def track(uv, name="", robot="A", offset=0.0, noise=0.3, seed=0, when=slice(None)):
    rng = np.random.default_rng(seed)
    n = len(uv)
    times = T0 + offset + 0.1 * np.arange(n)
    noisy = uv + noise * rng.normal(size=uv.shape)
    covariance = np.broadcast_to(0.09 * np.eye(2), (n, 2, 2))
    return Track(robot, name, times[when], noisy[when], covariance[when], np.full(n, 200.0)[when])


def views(points=None):
    """uv_i, uv_j (n, 2, 2) of both markers."""
    points = drive() if points is None else points
    uv_i, uv_j, both = SCENE.seen(points.reshape(-1, 3))
    assert both.all()
    return uv_i.reshape(*points.shape[:2], 2), uv_j.reshape(*points.shape[:2], 2)


def tracks(names=("", ""), **options):
    uv_i, uv_j = views()
    return (
        [track(uv_i[:, m], names[m], "A", seed=m, **options) for m in range(2)],
        [track(uv_j[:, m], names[m], "B", seed=9 + m, **options) for m in range(2)],
    )


def right(found):
    """Whether all of a set of correspondences obey the true homography."""
    X = np.column_stack([CAMERA.normalise(found.uv_i), np.ones(len(found))]) @ SCENE.H_j_i.T
    off = X[:, :2] / X[:, 2:] - CAMERA.normalise(found.uv_j)
    return np.linalg.norm(off, axis=1).max() < 10 * 0.3 / CAMERA.fx


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("names", [("C/0", "C/1"), ("", "")])
def test_both_markers_find_themselves_in_whatever_order_they_are_listed(names, swapped):
    in_i, in_j = tracks(names)
    found = correspond(in_i, in_j[::-1] if swapped else in_j, CAMERA, CAMERA)
    assert len(found) == 160
    assert right(found)
    assert found.uv_i[found.markers == 1] == pytest.approx(in_i[1].uv)
    assert found.times[found.markers == 0] == pytest.approx(in_i[0].times)
    fit = fit_homography(found.pairs)
    assert fit.inliers.mean() > 0.98


def test_covariances_are_those_of_normalised_coordinates():
    found = correspond(*tracks(("C/0", "C/1")), CAMERA, CAMERA)
    assert found.pairs.covariance_i == pytest.approx(
        np.broadcast_to(0.09 / 301.0**2 * np.eye(2), (160, 2, 2)), rel=1e-6
    )


def test_names_are_not_overruled_by_what_the_tracks_do():
    in_i, in_j = tracks(("C/0", "C/1"))
    crossed = [
        Track("B", name, t.times, t.uv, t.covariance, t.peak) for name, t in zip(("C/1", "C/0"), in_j, strict=True)
    ]
    found = correspond(in_i, crossed, CAMERA, CAMERA)
    assert not right(found)


def test_fragments_of_a_track_all_find_their_place():
    uv_i, uv_j = views()
    parts = [slice(0, 30), slice(33, 55), slice(60, 80)]
    in_i = [track(uv_i[:, m], seed=m, when=part) for m in (0, 1) for part in parts]
    in_j = [track(uv_j[:, m], seed=9 + m, when=part) for part in (slice(0, 45), slice(48, 80)) for m in (1, 0)]
    found = correspond(in_i, in_j, CAMERA, CAMERA)
    assert right(found)
    assert len(found) > 0.85 * 2 * 72


def test_a_track_that_has_no_partner_is_left_out():
    in_i, in_j = tracks()
    found = correspond(in_i, in_j[:1], CAMERA, CAMERA)
    assert set(found.markers) == {0}
    assert right(found)
    assert len(found) == 80


def test_cameras_that_never_see_a_marker_at_once_say_so():
    in_i, _ = tracks()
    _, late = tracks(offset=100.0)
    for a, b in ((in_i, late), (in_i, []), ([], late), ([], [])):
        with pytest.raises(DegenerateGeometry, match="never see a marker at the same instant"):
            correspond(a, b, CAMERA, CAMERA)


def test_markers_of_other_names_are_not_paired():
    in_i, _ = tracks(("C/0", "C/1"))
    _, in_j = tracks(("D/0", "D/1"))
    with pytest.raises(
        DegenerateGeometry, match=r"no marker name is shared: . saw `C/0`, `C/1` and . saw `D/0`, `D/1`"
    ):
        correspond(in_i, in_j, CAMERA, CAMERA)


def with_clutter():
    """Camera i's tracks: both markers, their mirror images in the floor, a lamp, a passing stranger, a flicker."""
    points = drive()
    uv, _ = views(points)
    T = SCENE.T_world_ci

    def seen(p):
        return CAMERA.project((p - T[:3, 3]) @ T[:3, :3])[0]

    mirrored = seen(points * (1, 1, -1))
    stranger = np.column_stack([np.linspace(0.9, 2.0, 80), np.linspace(-0.5, 0.1, 80), np.full(80, 0.15)])
    return [
        track(uv[:, 0], seed=1),
        track(mirrored[:, 0], seed=2),
        track(np.broadcast_to([250.0, 40.0], (80, 2)), seed=3, noise=0.1),
        track(uv[:, 1], seed=4),
        track(mirrored[:, 1], seed=5),
        track(seen(stranger), seed=6),
        track(uv[:, 0] + 30, seed=7, when=slice(0, 3)),
    ]


def numbers(tracks, one):
    return next(n for n, track in enumerate(tracks) if track.uv is one.uv)


def test_reflections_still_lights_and_strangers_are_not_markers_of_the_mover():
    clutter = with_clutter()
    kept = markers_of_movers(clutter, CAMERA, [PLANE], [0.25])
    assert [numbers(clutter, one) for one in kept] == [0, 3]
    assert [one.body for one in kept] == [0, 0]


def test_without_a_span_all_that_moves_is_kept():
    clutter = with_clutter()
    kept = markers_of_movers(clutter, CAMERA, [PLANE], [])
    assert [clutter.index(one) for one in kept] == [0, 1, 3, 4, 5]
    assert {one.body for one in kept} == {-1}


def test_the_span_binds_the_two_markers_at_all_their_instants_although_the_tilt_is_a_degree_off():
    clutter = with_clutter()
    markers = [clutter[0], clutter[3]]
    for tilt in (19.0, 20.0, 21.0):
        plane = plane_from_mount(mounted(MOUNT, tilt_deg=tilt), MARKERS)
        ((a, b, shared),) = span_samples(markers, CAMERA, plane, 0.25)
        assert (a, b, len(shared)) == (0, 1, 80)


def test_many_pairs_of_series_are_paired_as_one_by_one():
    rng = np.random.default_rng(5)

    def series(n):
        return T0 + np.sort(rng.uniform(0, 0.5, n))

    both = [(series(a), series(b)) for a, b in ((40, 30), (0, 5), (1, 60), (25, 0), (50, 50))]
    which, pairs = pair_each_by_time(both, 0.01)
    for number, (a, b) in enumerate(both):
        assert pairs[which == number].tolist() == pair_by_time(a, b, 0.01).tolist()
    assert len(pairs) > 40
    assert [len(one) for one in pair_each_by_time([])] == [0, 0]
