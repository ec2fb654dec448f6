"""What two robots on one floor can see: lights, and not their mirror images."""

import gtsam
import numpy as np
import pytest
from msgspec.structs import replace
from planar_scene import CAMERA, MARKERS, MOUNT, Scene

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import FrontendOptions, Track, correspond, fit_homography, measure_pair, plane_from_mount
from coloc_graph.frontend.pairing.floor_checks import of_some_span, on_one_floor, require_on_floor
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import RelativePose
from coloc_graph.run import Detections, RunWriter, Stance, open_run
from coloc_graph.simulation import reference_team
from coloc_graph.team import Floor

SCENE = Scene()
ROBOT = reference_team()["A"]
PLANE = plane_from_mount(MOUNT, MARKERS)
UP = (1.0, 1.0, 1.0)
DOWN = (1.0, 1.0, -1.0)


def driven(n=120):
    """Both markers of a robot on a winding way, (n, 2, 3)."""
    s = np.linspace(0, 2 * np.pi, n)
    x, y = 1.3 + 0.3 * np.cos(s), 0.25 * np.sin(2 * s)
    yaw = np.arctan2(np.gradient(y), np.gradient(x))
    side = 0.125 * np.stack([-np.sin(yaw), np.cos(yaw), 0 * yaw], axis=1)
    middle = np.stack([x, y, np.full(n, 0.15)], axis=1)
    return np.stack([middle + side, middle - side], axis=1)


def tracks(T_world_camera, robot, scale, seed=0):
    """Of both markers, or of their mirror images, in a camera."""
    rng, n = np.random.default_rng(seed), 120
    out = []
    for p in np.moveaxis(driven() * scale, 1, 0):
        uv, inside = CAMERA.project((p - T_world_camera[:3, 3]) @ T_world_camera[:3, :3])
        assert inside.mean() > 0.5
        times, noisy = 100 + 0.1 * np.arange(n)[inside], uv[inside] + 0.1 * rng.standard_normal((inside.sum(), 2))
        C = np.broadcast_to(0.01 * np.eye(2), (inside.sum(), 2, 2))
        out.append(Track(robot, "", times, noisy, C, np.full(inside.sum(), 200.0), body=0))
    return out


def seen(scale_i, scale_j):
    return tracks(SCENE.T_world_ci, "A", scale_i), tracks(SCENE.T_world_cj, "B", scale_j, 1)


@pytest.mark.parametrize(("i", "j", "right"), [(UP, UP, True), (UP, DOWN, False), (DOWN, UP, False)])
def test_of_a_light_and_a_mirror_image_one_robot_would_be_below_the_floor(i, j, right):
    both = seen(i, j)
    found = correspond(*both, CAMERA, CAMERA, alone=True)
    fit = fit_homography(found.pairs)
    assert fit.inliers.mean() > 0.95  # nothing in the images speaks against it
    assert on_one_floor(fit.H, ROBOT, ROBOT, PLANE) == right
    if not right:
        with pytest.raises(DegenerateGeometry, match="no pairing of the tracks of A and B"):
            correspond(*both, CAMERA, CAMERA, alone=True, plausible=lambda H, _: on_one_floor(H, ROBOT, ROBOT, PLANE))


def between(baseline, errors, rise=0.0):
    """Homography of two robots abreast, toed in by 25 deg, with mounts off by `errors` (2, 3); B higher by `rise`."""
    T_i_ci, T_j_cj = MOUNT.off_by(errors)
    T_j_cj[2, 3] += rise
    T_cj_ci = np.linalg.inv(floor_pose(0.0, -baseline, 0.44) @ T_j_cj) @ floor_pose(0.0, 0.0, -0.44) @ T_i_ci
    return T_cj_ci[:3, :3] - np.outer(T_cj_ci[:3, 3], T_i_ci[2, :3]) / (T_i_ci[2, 3] - MARKERS.height)


@pytest.mark.parametrize("baseline", [1.1, 1.6, 2.2])
def test_mounts_off_within_their_tolerances_leave_two_robots_on_one_floor(baseline):
    """Of right homographies with mounts to 1 deg 1 in 20 at 1.6 m, and 1 in 6 at 2.2 m, placed one 10 cm too high."""
    loose = replace(MOUNT, height_sigma=0.005, tilt_sigma_deg=1.0, roll_sigma_deg=1.0)
    robot, rng = replace(ROBOT, mount_if_any=loose), np.random.default_rng(0)
    drawn = rng.standard_normal((200, 2, 3)) * [0.005, np.deg2rad(1.0), np.deg2rad(1.0)]
    on_floor = [on_one_floor(between(baseline, errors), robot, robot, PLANE) for errors in drawn]
    assert np.mean(on_floor) > 0.985
    mirrored = [on_one_floor(between(baseline, errors, 2 * MARKERS.height), robot, robot, PLANE) for errors in drawn]
    assert np.mean(mirrored) < 0.1
    stated_exact = [on_one_floor(between(baseline, errors), ROBOT, ROBOT, PLANE) for errors in drawn]
    assert np.mean(stated_exact) < np.mean(on_floor)


def mirrored_run(path, names):
    """A sees the lights of C, and B their mirror images alone."""
    team = reference_team()
    with RunWriter(path, team) as writer:
        writer.write(Stance(0, 99.0, 115.0, ("A", "B"), ("C",)))
        for both in seen(UP, DOWN):
            lights = {}
            for n, track in enumerate(both):
                for time, uv in zip(track.times.tolist(), track.uv, strict=True):
                    lights.setdefault(time, []).append((names[n], uv))
            for time, found in sorted(lights.items()):
                marks, uv = zip(*found, strict=True)
                k = len(uv)
                C, none = np.broadcast_to(0.01 * np.eye(2), (k, 2, 2)), np.full(k, 200.0)
                writer.write(Detections(both[0].robot, time, np.array(uv), C, marks, np.zeros(k, np.uint8), none, none))
    return open_run(path)


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("C/0", "C/1"), "although both stand on one floor: it shows reflections"),
        (("", ""), "no pairing of the tracks"),
    ],
)
def test_a_stance_of_lights_and_mirror_images_measures_nothing(tmp_path, names, why):
    run = mirrored_run(tmp_path / "run.mcap", names)
    measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
    assert measured.relative_pose is None
    assert why in measured.homography.unusable


def test_a_camera_tilted_within_its_tolerance_sees_the_markers_their_span_apart_and_no_mirror_image():
    """A camera two degrees off took 17 of 40 stances of a hallway for reflections."""
    lights, mirrored = (tracks(SCENE.T_world_ci, "A", scale) for scale in (UP, DOWN))
    loose = replace(ROBOT, mount_if_any=replace(ROBOT.mount, tilt_sigma_deg=1.0))
    for off in (-3.0, 3.0):
        plane = plane_from_mount(replace(MOUNT, tilt_deg=MOUNT.tilt_deg + off), MARKERS)
        assert of_some_span(lights, loose, plane, [0.25])
    assert not of_some_span(mirrored, loose, PLANE, [0.25])


def test_mirror_images_are_no_span_apart():
    lights, mirrored = (tracks(SCENE.T_world_ci, "A", scale) for scale in (UP, DOWN))
    assert of_some_span(lights, ROBOT, PLANE, [0.25])
    assert not of_some_span(mirrored, ROBOT, PLANE, [0.25])
    assert of_some_span(mirrored, ROBOT, PLANE, [])  # nothing is known of spans
    assert of_some_span(mirrored[:1], ROBOT, PLANE, [0.25])  # nor of one light


@pytest.mark.parametrize(
    ("z", "tilt_deg", "said"),
    [(0.0, 0.0, None), (0.04, 2.0, None), (0.30, 0.0, "B 0.30 m above A"), (-0.3, 0.0, "B 0.30 m below A"),
     (0.0, 20.0, "tilted by 20.0 deg")],
)  # fmt: skip
def test_a_pose_that_is_not_on_the_floor_is_refused_in_words(z, tilt_deg, said):
    T = floor_pose(0.3, -0.8, 0.4)
    T[2, 3] = z
    T_i_j = gtsam.Pose3(T).compose(gtsam.Pose3(gtsam.Rot3.Roll(np.deg2rad(tilt_deg)), np.zeros(3)))
    pose = RelativePose(0, "A", "B", T_i_j, 1e-6 * np.eye(6), T_i_j, 0, 0.0)
    if said is None:
        require_on_floor(pose, Floor())
        return
    with pytest.raises(DegenerateGeometry, match=said):
        require_on_floor(pose, Floor())
