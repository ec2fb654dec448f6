import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.errors import TeamError
from coloc_graph.simulation.rig import wide_team
from coloc_graph.team import Camera, fisheye, read_team, write_team
from coloc_graph.team.camera import TurnedCamera

LENS = (0.02, -0.01, 0.003, -0.0005)
WIDE = Camera(width=640, height=480, fx=180.0, fy=181.0, cx=322.0, cy=238.0, model="fisheye", distortion=LENS)


def rays_within(degrees, n=300, seed=0):
    rng = np.random.default_rng(seed)
    theta, phi = np.arccos(rng.uniform(np.cos(np.deg2rad(degrees)), 1, n)), rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def test_projection_is_opencvs():
    rays = rays_within(88)
    wanted, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), WIDE.K, np.array(LENS))
    assert WIDE.project(3.0 * rays)[0] == pytest.approx(wanted[:, 0], abs=1e-9)


def test_rays_are_those_that_opencv_undistorts():
    uv = WIDE.project(rays_within(75))[0]
    wanted = cv2.fisheye.undistortPoints(uv[:, None], WIDE.K, np.array(LENS))[:, 0]
    assert WIDE.normalise(uv) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("lens", [(), LENS, (-0.012, 0.003, -0.0012, 0.0001)], ids=["ideal", "mild", "simulated"])
def test_rays_beside_and_behind_the_camera_come_back(lens):
    camera = replace(WIDE, distortion=lens)
    rays = rays_within(115)
    assert (rays[:, 2] < 0).any()
    assert camera.rays(camera.project(rays)[0]) == pytest.approx(rays, abs=1e-12)


def test_the_axis_and_the_point_behind_the_camera():
    uv, inside = WIDE.project([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    assert uv[0] == pytest.approx((322.0, 238.0))
    assert inside.tolist() == [True, False, False]
    assert WIDE.rays([[322.0, 238.0]]) == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


def test_derivative_is_that_of_the_projection():
    points, step = np.vstack([2.0 * rays_within(110), [[0.0, 0.0, 1.5]]]), 1e-6
    sides = [
        (fisheye.image_of(LENS, points + step * e)[0] - fisheye.image_of(LENS, points - step * e)[0]) / (2 * step)
        for e in np.eye(3)
    ]
    assert fisheye.derivative(LENS, points) == pytest.approx(np.stack(sides, axis=-1), abs=1e-8)


def test_pixels_beyond_the_lens_have_no_ray_and_what_it_folds_back_is_not_inside():
    folding = replace(WIDE, distortion=(-0.1, 0.0, 0.0, 0.0))
    limit = np.rad2deg(fisheye.largest_angle(folding.distortion))
    assert limit == pytest.approx(np.rad2deg(np.sqrt(1 / 0.3)), abs=0.1)
    reach = 180.0 * fisheye.largest_radius(folding.distortion)
    assert np.isfinite(folding.rays([[322.0 + reach - 1, 238.0], [322.0 + reach + 1, 238.0]])).all(axis=1).tolist() == [
        True,
        False,
    ]
    beyond = np.deg2rad(limit + 5)
    assert not folding.project([[np.sin(beyond), 0.0, np.cos(beyond)]])[1][0]


def test_a_lens_that_folds_before_90_deg_within_the_image_is_found():
    assert WIDE.fold_radius() is None
    assert replace(WIDE, distortion=(-0.1, 0.0, 0.0, 0.0)).fold_radius() is None  # at 105 deg the image ends
    assert replace(WIDE, distortion=(-0.3, 0.0, 0.0, 0.0)).fold_radius() == pytest.approx(180.5 * 0.703, rel=0.01)


def test_a_turned_view_has_rays_beside_the_camera():
    R = cv2.Rodrigues(np.array([-np.deg2rad(70.0), 0.0, 0.0]))[0]  # its z looks down
    view = WIDE.turned(R)
    assert isinstance(view, TurnedCamera)
    assert hash(view) == hash(WIDE.turned(R))
    rays = rays_within(105)
    seen = (rays @ R)[:, 2] > 0.05
    assert (rays[seen, 2] < 0).any()
    uv, _ = WIDE.project(rays[seen])
    in_view = rays[seen] @ R
    x = view.normalise(uv)
    assert x == pytest.approx(in_view[:, :2] / in_view[:, 2:], abs=1e-9)
    assert view.project(in_view)[0] == pytest.approx(uv, abs=1e-9)
    step = 1e-5
    by_pixel = np.stack([(view.normalise(uv + d) - view.normalise(uv - d)) / (2 * step) for d in step * np.eye(2)], -1)
    assert view.per_pixel(x) == pytest.approx(by_pixel, rel=1e-5, abs=1e-6)
    assert not view.project(-in_view)[1].any()


def test_a_team_file_states_a_fisheye_and_counts_its_coefficients(tmp_path):
    team = wide_team(160.0)
    write_team(team, tmp_path / "team.toml")
    assert read_team(tmp_path / "team.toml") == team
    text = (tmp_path / "team.toml").read_text()
    (tmp_path / "team.toml").write_text(text.replace("    0.0001,\n", "", 1))
    with pytest.raises(TeamError, match="`distortion` has 3 numbers; give none, or a fisheye's 4"):
        read_team(tmp_path / "team.toml")


def test_a_simulated_fisheye_spans_the_angle_that_was_asked_for():
    camera = wide_team(190.0)["A"].camera
    edge = camera.rays([[-0.5, camera.cy], [camera.width - 0.5, camera.cy]])
    assert np.rad2deg(np.arccos(edge[0] @ edge[1])) == pytest.approx(170.0, abs=0.01)  # the short way round
    assert edge[0, 2] < 0
