"""ROS bags in: every format gives the run that was recorded, and every bad bag or map has its sentence."""

import bz2
import contextlib
import itertools
import json
import re
import shutil
import sqlite3
import struct
from pathlib import Path
from types import SimpleNamespace

import cv2
import lz4.frame
import msgspec
import numpy as np
import pytest
import ros_bags
from ros_bags import KINDS, Sent, camera_info, compressed, image, odometry, tf, truth, write_bag
from rosbags import rosbag2
from rosbags.typesys import get_types_from_msg

from coloc_graph.cli import main
from coloc_graph.errors import BagError, ColocError, TeamError
from coloc_graph.exchange.ros_bag import BagMessage, open_bag
from coloc_graph.exchange.ros_images import ENCODINGS, camera_of, image_of
from coloc_graph.exchange.ros_import import import_ros
from coloc_graph.exchange.ros_map import OdometrySigmas, RobotTopics, RosMap
from coloc_graph.exchange.ros_order import InOrder, order_of
from coloc_graph.exchange.ros_poses import T_of, stated_increments
from coloc_graph.exchange.stances import MotionThresholds
from coloc_graph.frontend.odometry import WheelTrack
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.pipeline.batch import solve
from coloc_graph.pipeline.inspection import inspect
from coloc_graph.run import EncodedImage, open_run, read_truth
from coloc_graph.simulation import simulate
from coloc_graph.team import Camera, Floor, Markers, Mount, Robot, Team, write_team

SECOND = 10**9
T0 = 1_700_000_000 * SECOND
CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=3.5, cy=2.5)
MARKERS = Markers(height=0.15, positions=((0.0, 0.1), (0.0, -0.1)))
TEAM = Team(
    reference="A",
    robots=tuple(
        Robot(name=name, camera_if_any=CAMERA, mount_if_any=Mount(height=0.4, tilt_deg=20.0), markers=MARKERS)
        for name in "ABC"
    ),
    floor=Floor(),
)
#: Of the round trip: the simulated robots rest half a second before they go on.
QUICK = "[motion]\nwindow = 0.2\nsettle = 0.0\n"
SIGMAS = "odometry_sigmas = { along = 0.01, turned = 0.01, veer = 0.005 }\n"


def robot(name, *lines):
    return f'[[robots]]\nname = "{name}"\n' + "".join(line if line.endswith("\n") else line + "\n" for line in lines)


def map_of(*robots, head=""):
    return f'team = "team.toml"\n{head}' + "".join(robots)


#: Two tripods, and C that is carried about between them.
TRIPODS = map_of(
    robot("A", 'image = "/A/image"', 'motion = "stands"'),
    robot("B", 'image = "/B/image"', 'motion = "stands"'),
    robot("C", 'motion = "moves"'),
)


def pictures(topics=("/A/image", "/B/image"), n=20, pixels=None):
    pixels = np.full((6, 8), 50, np.uint8) if pixels is None else pixels
    return [image(topic, T0 + k * SECOND // 5, pixels) for k in range(n) for topic in topics]


@pytest.fixture
def bring_in(tmp_path):
    """Writes a bag, a team and a map, imports, and gives (run, summary)."""

    def run(sent, text=TRIPODS, kind="bare mcap", team=TEAM, out="run.mcap", **options):
        bag = sent
        if isinstance(sent, list):
            shutil.rmtree(tmp_path / "bag", ignore_errors=True)
            (tmp_path / "bag.bag").unlink(missing_ok=True)
            bag = write_bag(tmp_path, kind, sent)
        run.bag = bag
        write_team(team, tmp_path / "team.toml")
        (tmp_path / "map.toml").write_text(text)
        summary = import_ros(bag, tmp_path / "map.toml", tmp_path / out, **options)
        return open_run(tmp_path / out), summary

    return run


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A hallway of two stances as rendered images."""
    path = tmp_path_factory.mktemp("recorded") / "recorded.mcap"
    simulate("hallway", path, depth="images", stances=2, points=40, seed=2, image_format="png")
    return path


def round_trip_map(sigmas=""):
    seen = [
        robot(n, *(f'{key} = "/{n}/{topic}"' for key, topic in
                   (("image", "image"), ("camera_info", "info"), ("odometry", "odom"), ("truth", "truth"))), sigmas)
        for n in "AB"
    ]  # fmt: skip
    return map_of(*seen, robot("C", 'odometry = "/C/odom"', 'truth_tf = ["world", "/C/base_link"]', sigmas), head=QUICK)


@pytest.fixture(scope="module")
def imported(recorded, tmp_path_factory):
    """The run that comes of each kind of bag, and what was said."""
    found, sent = {}, ros_bags.of_run(recorded, by_tf=("C",), encodings={"B": "png"})
    for kind in KINDS:
        folder = tmp_path_factory.mktemp("imported")
        bag = write_bag(folder, kind, sent)
        write_team(open_run(recorded).team, folder / "team.toml")
        (folder / "map.toml").write_text(round_trip_map())
        found[kind] = folder / "run.mcap", import_ros(bag, folder / "map.toml", folder / "run.mcap", image_format="png")
    return found


def test_every_kind_of_bag_gives_the_same_run(imported):
    runs = {kind: path.read_bytes() for kind, (path, _) in imported.items()}
    assert all(data == runs["mcap"] for data in runs.values()), list(runs)


def test_what_comes_in_is_what_was_recorded(imported, recorded):
    (path, summary), was = imported["ros1"], open_run(recorded)
    run = open_run(path)
    assert run.team == was.team and summary.warnings == () and inspect(run) == []
    assert summary.counts["images"] == sum(was.topics[f"/{n}/image"] for n in "AB")
    for name in "AB":
        for a, b in zip(run.images(name), was.images(name), strict=True):
            assert a.time == b.time and np.array_equal(a.pixels, b.pixels)
    true = read_truth(recorded)
    for name, found in read_truth(path).items():
        assert len(found) == len(true[name]) >= 4
        np.testing.assert_allclose(found.T_world_body, true[name].T_world_body, atol=1e-9)  # C's by tf, from elsewhere
        np.testing.assert_allclose(found.times, true[name].times, atol=1e-6)
    for name in "ABC":
        a, b = WheelTrack(name, list(run.odometry(name))), WheelTrack(name, list(was.odometry(name)))
        if not len(b):
            continue
        x, y = (one.between(0, 1, b.times[0], b.times[-1]) for one in (a, b))
        np.testing.assert_allclose(x.T_i_j, y.T_i_j, atol=1e-9)
        np.testing.assert_allclose(x.covariance, y.covariance, rtol=1e-6, atol=1e-12)


def test_stances_are_those_that_were_recorded(imported, recorded):
    run, was = open_run(imported["ros1"][0]), open_run(recorded)
    assert len(run.stances) == len(was.stances) == 2
    for a, b in zip(run.stances, was.stances, strict=True):
        assert ({*a.observers}, a.movers, a.anchors) == ({*b.observers}, b.movers, b.anchors)
        assert b.start <= a.start <= b.start + 0.3 and b.end - 0.3 <= a.end <= b.end
        inside = {name: len(list(run.images(name, a.start, a.end))) for name in a.observers}
        assert inside == {name: len(list(was.images(name, b.start, b.end))) for name in a.observers}
    for name in "ABC":
        ends = [one.time for one in was.motions(name) if not one.moving]
        assert all(min(abs(one.time - end) for one in run.motions(name)) < 0.2 for end in ends)


def test_a_run_that_went_through_a_bag_is_solved_as_it_was(imported, recorded):
    solution, before = solve(open_run(imported["bare mcap"][0])), solve(open_run(recorded))
    assert solution.warnings == () and solution.count.used == before.count.used == 2
    for name, trajectory in solution.estimate.trajectories.items():
        other = before.estimate.trajectories[name]
        off = np.abs(trajectory.positions - other.positions).max()
        assert off < 2e-4, name  # half a window off each stance's ends; a tenth of a sigma
        # errors that a stance shares are learnt from two stances, within a factor of two
        np.testing.assert_allclose(trajectory.covariances, other.covariances, atol=other.covariances.max())


def test_odometry_may_have_its_errors_stated(recorded, bring_in):
    run, _ = bring_in(ros_bags.of_run(recorded, by_tf=("C",)), round_trip_map(SIGMAS), team=open_run(recorded).team)
    samples = list(run.odometry("C"))
    way = sum(np.hypot(*(b.pose - a.pose)[:2]) for a, b in itertools.pairwise(samples))
    assert sum(one.covariance[0, 0] for one in samples) == pytest.approx(0.01**2 * way)


def test_stated_errors_are_of_the_body_of_the_sample_before_and_grow_with_the_root_of_the_way():
    poses = [[0, 0, 0.3], [0.6, 0.8, 0.3], [0.6, 0.8, 0.3 + 2 * np.pi - 0.5]]
    C = stated_increments(poses, OdometrySigmas(along=0.02, turned=0.04, veer=0.01, across=0.003))
    np.testing.assert_allclose(C[0], 0)
    np.testing.assert_allclose(C[1], np.diag([0.02**2, 0.003**2, 0.01**2]))
    np.testing.assert_allclose(C[2], np.diag([0, 0, 0.04**2 * 0.5]), atol=1e-15)


def some_odometry(name="A", covariance=None, n=40):
    """It drives ahead from the first second to the third."""
    sent = []
    for k in range(n):
        x = min(max(k - 10, 0), 20) * 0.02
        C = covariance(k) if covariance else None
        sent.append(odometry(f"/{name}/odom", T0 + k * SECOND // 10, (x, 0, 0), C))
    return sent


#: A drives by its odometry, and B and a second tripod watch.
DRIVES = map_of(
    robot("A", 'odometry = "/A/odom"', SIGMAS),
    robot("B", 'image = "/B/image"', 'motion = "stands"'),
    robot("C", 'image = "/C/image"', 'motion = "stands"'),
)


def test_covariances_that_do_not_grow_are_refused_and_the_remedy_is_named(bring_in):
    for covariance in (lambda k: np.eye(6), None):
        sent = [*pictures(("/B/image", "/C/image")), *some_odometry(covariance=covariance)]
        with pytest.raises(BagError, match=r"/A/odom \(`odometry` of A\) has covariances that do not grow.*sigmas"):
            bring_in(sent, DRIVES.replace(SIGMAS, ""), kind="ros1")
    run, _ = bring_in(sent, DRIVES, kind="sqlite3")
    assert [(one.movers, one.observers) for one in run.stances] == [(("A",), ("B", "C"))]
    assert [one.moving for one in run.motions("A")] == [True, False]


def driven(child="base_link", restart=None, n=60):
    """A robot that drives 2 cm a sample ahead, whose odometry is of the frame `child`, and may begin anew."""
    begun = [k if restart is None or k < restart else k - restart for k in range(n)]
    return [odometry_of_frame(child, "/A/odom", T0 + k * SECOND // 10, (0.02 * x, 0, 0)) for k, x in enumerate(begun)]


def odometry_of_frame(child, topic, ns, pose):
    def content(make):
        message = make.odometry(ns, floor_pose(*pose))
        message.child_frame_id = child
        return message

    return Sent(topic, ns, "nav_msgs/msg/Odometry", content)


def test_a_driver_that_restarts_is_named_and_its_jump_is_no_way(bring_in):
    run, summary = bring_in([*pictures(("/B/image", "/C/image")), *driven(restart=40)], DRIVES)
    assert any(
        re.search(r"/A/odom .*jumped by 0.78 m within 0.10 s .*restarted at the origin", one)
        for one in summary.warnings
    )
    samples = list(run.odometry("A"))
    assert [round(one.pose[0], 3) for one in samples][38:42] == [0.76, 0.78, 0.78, 0.8]
    sigmas = [float(np.sqrt(one.covariance[0, 0])) for one in samples]
    assert sigmas[40] > 5 * max(sigmas[:40]) and sigmas[41] < sigmas[40] / 5


def test_odometry_of_another_frame_is_moved_to_the_body_by_static_tf_or_named(bring_in):
    sent = [*pictures(("/B/image", "/C/image")), *driven("camera_pose_frame")]
    run, summary = bring_in(sent, DRIVES)
    assert any("is of the frame `camera_pose_frame`, which may not be the body's" in one for one in summary.warnings)
    T_body_camera = floor_pose(0.4, 0.0, np.pi / 2)
    sent.append(tf("/tf_static", T0, "A/base_link", "camera_pose_frame", T_body_camera))
    run, summary = bring_in(sent, DRIVES)
    assert any("was moved to `A/base_link` by the static tf" in one for one in summary.warnings)
    first, last = (list(run.odometry("A"))[k].pose for k in (0, 59))
    # the camera drives along its own x, which is the body's y
    assert first == pytest.approx([0.0, 0.4, -np.pi / 2]) and last == pytest.approx([1.18, 0.4, -np.pi / 2])


def test_tripods_and_who_is_carried_need_no_odometry(bring_in):
    run, summary = bring_in(pictures())
    ((stance,), begin) = run.stances, T0 / SECOND
    assert (stance.observers, stance.movers, stance.start, stance.end) == (("A", "B"), ("C",), begin, begin + 3.8)
    assert summary.stood == {
        "A": (pytest.approx(3.8),) * 2,
        "B": (pytest.approx(3.8),) * 2,
        "C": (0, pytest.approx(3.8)),
    }


def test_jpeg_and_png_stay_as_they_are(bring_in, rng):
    pixels = rng.integers(0, 255, (6, 8, 3), np.uint8)
    sent = [
        compressed(f"/{name}/image", T0 + k * SECOND // 5, pixels, kind)
        for k in range(20)
        for name, kind in (("A", "jpeg"), ("B", "png"))
    ]
    run, _ = bring_in(sent, image_format="raw")
    first = next(run.images("B"))
    assert np.array_equal(first.pixels, pixels)
    encoded = cv2.imdecode(cv2.imencode(".jpeg", pixels)[1], cv2.IMREAD_UNCHANGED)
    assert np.array_equal(next(run.images("A")).pixels, encoded)


def mosaic(bgr, pattern):
    """What a sensor with a Bayer pattern sees of a picture, by ROS's name: the first two rows."""
    grey = np.empty(bgr.shape[:2], np.uint8)
    for at, colour in enumerate(pattern):
        y, x = divmod(at, 2)
        grey[y::2, x::2] = bgr[y::2, x::2, "bgr".index(colour)]
    return grey


def encoded(bgr, encoding):
    if encoding.startswith("bayer"):
        return mosaic(bgr, encoding[6:10])
    if encoding in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv"):
        # BT.601, as cameras and OpenCV mean it: black is 16, white 235
        to_yuv = np.array([[0.098, 0.504, 0.257], [0.439, -0.291, -0.148], [-0.071, -0.368, 0.439]])
        Y, U, V = np.moveaxis(np.rint(bgr @ to_yuv.T + (16, 128, 128)).astype(np.uint8), -1, 0)
        chroma = np.where(np.arange(Y.shape[1]) % 2, V, U)
        order = (Y, chroma) if encoding in ("yuv422_yuy2", "yuyv") else (chroma, Y)
        return np.stack(order, axis=-1)
    if encoding in ("mono8", "8UC1"):
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    alpha = np.full(bgr.shape[:2], 255, np.uint8)
    rgb = bgr[..., ::-1]
    return {"bgr8": bgr, "8UC3": bgr, "rgb8": rgb, "bgra8": np.dstack([bgr, alpha]), "8UC4": np.dstack([bgr, alpha]),
            "rgba8": np.dstack([rgb, alpha])}[encoding]  # fmt: skip


def test_every_encoding_is_read_with_its_colours_where_they_are(tmp_path):
    """Red above, blue below: what a pattern or an order got wrong would be another colour."""
    bgr = np.zeros((16, 24, 3), np.uint8)
    bgr[:8], bgr[8:] = (20, 40, 200), (220, 60, 30)
    camera = msgspec.structs.replace(CAMERA, width=24, height=16)
    sent = []
    for number, encoding in enumerate(ENCODINGS):
        data = encoded(bgr, encoding).reshape(16, -1)
        padded = np.pad(data, ((0, 0), (0, 5)), constant_values=77)
        make = lambda make, p=padded, e=encoding: make.image(T0, p, e, step=p.shape[1], size=(16, 24))  # noqa: E731
        sent.append(Sent(f"/{number}", T0, "sensor_msgs/msg/Image", make))
    with open_bag(write_bag(tmp_path, "ros1", sent)) as bag:
        for message in bag.messages(bag.topics):
            encoding = list(ENCODINGS)[int(message.topic[1:])]
            found = image_of(bag, message, "A", 0.0, camera).pixels
            wanted = encoded(bgr, "mono8") if encoding in ("mono8", "8UC1") else bgr
            rough = 0 if encoding in ("mono8", "8UC1", "bgr8", "8UC3", "rgb8", "bgra8", "8UC4", "rgba8") else 4
            middle = np.abs(found.astype(int) - wanted)[[3, 4, 11, 12], 3:-3]
            assert found.shape == wanted.shape and middle.max() <= rough, encoding


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (
            lambda: image("/B/image", T0 + 1, np.zeros((6, 16), np.uint8), "16UC1"),
            "has encoding `16UC1`; what is read is",
        ),
        (
            lambda: image("/B/image", T0 + 1, np.zeros((6, 4), np.uint8), "rgb8"),
            "has 24 bytes, which are not 4 x 6 rgb8",
        ),
        (lambda: image("/B/image", T0 + 1, np.zeros((6, 9), np.uint8)), "has 9 x 6 pixels, and the camera is 8 x 6"),
    ],
)
def test_an_image_that_is_none_is_named_by_topic_and_time(bring_in, tmp_path, one, words):
    with pytest.raises(BagError, match=f"bag.mcap: the message of /B/image received at 1700000000.0.* s {words}"):
        bring_in([*pictures(), one()])
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "team.toml", "map.toml"}


def test_compressed_images_that_are_damaged_or_not_8_bit_are_named(bring_in):
    deep = np.zeros((6, 8), np.uint16)
    whole = cv2.imencode(".png", np.zeros((6, 8), np.uint8))[1].tobytes()
    sent = [compressed(topic, T0 + k * SECOND // 5, np.zeros((6, 8), np.uint8), "png")
            for k in range(20) for topic in ("/A/image", "/B/image")]  # fmt: skip
    kind = "sensor_msgs/msg/CompressedImage"
    for number, (data, words) in enumerate([
        (whole[:40], "is a png that is damaged"),
        (cv2.imencode(".png", deep)[1].tobytes(), r"is a png of uint16 \(6, 8\)"),
        (b"RVL" + whole, "has format `odd`; record JPEG, PNG"),
    ]):  # fmt: skip
        bad = Sent("/A/image", T0 + 1, kind, lambda make, data=data: make.compressed(T0 + 1, data, "odd"))
        with pytest.raises(BagError, match=rf"/A/image received at .* s {words}"):
            bring_in([*sent, bad], kind=KINDS[number])


def test_a_camera_in_the_bag_is_that_of_the_run_and_what_the_team_says_otherwise_is_told(bring_in):
    other = msgspec.structs.replace(CAMERA, fx=11.0, distortion=(-0.1, 0.01, 0.0, 0.0), noise_px=9.0)
    text = TRIPODS.replace('image = "/A/image"', 'image = "/A/image"\ncamera_info = "/A/info"')
    sent = [camera_info("/A/info", T0 + k, other) for k in range(3)] + pictures()
    run, summary = bring_in(sent, text)
    expected = msgspec.structs.replace(CAMERA, fx=11.0, distortion=(-0.1, 0.01, 0.0, 0.0))
    assert run.team["A"].camera == expected and run.team["B"] == TEAM["B"]
    (warning,) = summary.warnings
    assert re.search(r"A's camera is that of /A/info.*: fx 11 \(stated 10\), distortion \[-0.1, 0.01, 0, 0\]", warning)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"model": "kannala"},
            "has the lens model `kannala`; calibrate with plumb_bob, rational_polynomial or equidistant",
        ),
        ({"roi": (2, 0, 4, 8)}, r"has a `roi` of 8 x 4 px at \(2, 0\), and the full image is 8 x 6"),
        ({"D": [0.1] * 14}, "has 14 coefficients of distortion"),
        ({"D": [np.nan] * 5}, "of a camera that is not calibrated"),
    ],
)
def test_a_camera_info_that_is_not_read_is_named(bring_in, options, words):
    text = TRIPODS.replace('image = "/A/image"', 'image = "/A/image"\ncamera_info = "/A/info"')
    with pytest.raises(BagError, match=rf"/A/info received at 1700000000.0 s .*{words}"):
        bring_in([camera_info("/A/info", T0, CAMERA, **options), *pictures()], text)


def test_cameras_as_ros_says_them(tmp_path):
    P = np.array([[20.0, 0, 4, 0], [0, 21, 3, 0], [0, 0, 1, 0]])
    sent = [
        camera_info("/a", T0, CAMERA, D=[0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0], model="rational_polynomial"),
        camera_info("/b", T0, CAMERA, D=[1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0], model="rational_polynomial"),
        camera_info("/c", T0, CAMERA, D=[0.5] * 5, P=P, roi=(0, 0, 6, 8)),
        camera_info("/d", T0, CAMERA, D=[], model=""),
        camera_info("/e", T0, CAMERA, D=[0.1, 0.02, 0.003, 0.0004], model="equidistant"),
        camera_info("/f", T0, CAMERA, roi=(2, 1, 4, 6), binning=2),  # y, x, height, width in ROS's order
    ]
    found = {}
    for kind in ("ros1", "mcap"):
        with open_bag(write_bag(tmp_path, kind, sent)) as bag:
            for m in bag.messages(bag.topics):
                found[m.topic] = camera_of(bag, m, CAMERA, rectified=m.topic == "/c")
        assert found["/a"].distortion == (0.1, 0.2, 0.3, 0.4, 0.5)
        assert found["/b"].distortion == (1, 2, 3, 4, 5, 6, 7, 8)
        c = found["/c"]
        assert (c.fx, c.fy, c.cx, c.cy, c.distortion) == (20.0, 21.0, 4.0, 3.0, ())
        assert found["/d"] == CAMERA
        f = found["/f"]
        assert (f.width, f.height, f.fx, f.fy, f.cx, f.cy) == (3, 2, 5.0, 5.0, 0.5, 0.5)
        assert (found["/e"].model, found["/e"].distortion) == ("fisheye", (0.1, 0.02, 0.003, 0.0004))


def test_a_calibration_that_changes_in_the_bag_is_refused(bring_in):
    text = TRIPODS.replace('image = "/A/image"', 'image = "/A/image"\ncamera_info = "/A/info"')
    changed = msgspec.structs.replace(CAMERA, fx=10.5)
    cameras = ((0, CAMERA), (1, changed), (2, CAMERA))
    sent = [*(camera_info("/A/info", T0 + k * SECOND, one) for k, one in cameras), *pictures()]
    with pytest.raises(BagError, match=r"/A/info received at 1700000001.0 s is of another camera than the first"):
        bring_in(sent, text)


def numbered(topic, *times, received=None):
    """Images whose grey level is their number; received in the order in which they are given."""
    return [
        image(topic, T0 + time, np.full((6, 8), k, np.uint8), received=T0 + 10 * SECOND + k)
        for k, time in enumerate(times)
    ]


def test_images_are_sorted_by_their_own_time_and_what_is_there_twice_is_dropped_and_counted(bring_in):
    ticks = [k * SECOND // 5 for k in range(20)]
    mixed = [ticks[2], ticks[0], ticks[1], ticks[1], *ticks[3:], ticks[5]]
    run, summary = bring_in([*numbered("/A/image", *mixed), *numbered("/B/image", *ticks)], image_format="raw")
    found = list(run.images("A"))
    assert [one.pixels[0, 0] for one in found] == [1, 2, 0, *range(4, 21)]
    assert [round((one.time - T0 / SECOND) * 5) for one in found] == list(range(20))
    late, twice = summary.warnings
    assert "bag.mcap: 4 messages of /A/image came after later ones" in late
    assert "bag.mcap: 2 messages of /A/image have the time of another one" in twice


def test_of_messages_of_one_instant_the_first_is_kept_and_the_others_are_not_held():
    order = order_of([3, 1, 2, 1, 3])
    assert (order.ns.tolist(), order.kept.tolist(), order.late, order.repeated) == ([1, 2, 3], [1, 2, 0], 3, 2)
    waiting = InOrder(order.ns)
    given = [list(waiting.take(ns, f"{number}: {ns}")) for number, ns in enumerate([3, 3, 1, 2, 1])]
    assert given == [[], [], [(1, "2: 1")], [(2, "3: 2"), (3, "0: 3")], []]
    all_twice = InOrder(np.arange(1000))
    assert sum(len(list(all_twice.take(ns, ns))) for ns in (*range(999), *range(999))) == 999


def test_images_that_are_hopelessly_out_of_order_are_refused_before_they_fill_the_memory(bring_in):
    times = [k * SECOND // 50 for k in range(250)]
    with pytest.raises(
        BagError, match=r"/A/image received at .* comes more than 200 images before one that is earlier"
    ):
        bring_in([*numbered("/A/image", *times[1:], times[0]), *numbered("/B/image", *times)])


def test_odometry_out_of_order_is_sorted(bring_in):
    sent = some_odometry()
    sent[11] = sent[11]._replace(received=sent[12].received + 1)
    run, summary = bring_in([*pictures(("/B/image", "/C/image")), *sent], DRIVES)
    assert [round(one.pose[0], 3) for one in run.odometry("A")][9:14] == [0, 0, 0.02, 0.04, 0.06]
    assert len(summary.warnings) == 1 and "1 messages of /A/odom came after" in summary.warnings[0]


def test_the_time_may_be_the_bags(bring_in):
    run, _ = bring_in(
        [one._replace(received=one.received + 100 * SECOND) for one in pictures()], 'time = "bag"\n' + TRIPODS
    )
    assert run.start == T0 / SECOND + 100
    # of tf, too
    sent = [*pictures(), *(tf("/tf", T0 + k * SECOND, "world", "C/base", floor_pose(k, 0, 0)) for k in range(4))]
    later = [one._replace(received=one.received + 100 * SECOND) for one in sent]
    run, _ = bring_in(later, 'time = "bag"\n' + TRIPODS + 'truth_tf = ["world", "C/base"]\n')
    np.testing.assert_allclose(read_truth(run.path)["C"].times - T0 / SECOND, [100, 101, 102, 103])


def test_a_stamp_is_read_whichever_of_its_bytes_comes_first(tmp_path):
    with open_bag(write_bag(tmp_path, "bare mcap", pictures(n=1))) as bag:
        for first, order in ((b"\0\1\0\0", "<iI"), (b"\0\0\0\0", ">iI")):
            message = BagMessage("/A/image", "sensor_msgs/msg/Image", 0, first + struct.pack(order, 5, 6))
            assert bag.stamp(message) == 5 * SECOND + 6


def without_stamps(sent, topic, every=1):
    out = []
    for k, one in enumerate(sent):
        if one.topic == topic and k % every == 0:
            pixels = np.zeros((6, 8), np.uint8)
            one = one._replace(content=lambda make, pixels=pixels: make.image(0, pixels, "mono8"))
        out.append(one)
    return out


def test_a_topic_without_stamps_has_the_bags_time_and_says_so(bring_in):
    run, summary = bring_in(without_stamps(pictures(), "/B/image"))
    assert [one.time for one in run.images("A")] == [one.time for one in run.images("B")]
    assert any("no message of /B/image has a time in its header" in one for one in summary.warnings)


def test_stamps_that_are_missing_here_and_there_are_refused(bring_in):
    with pytest.raises(BagError, match=r"10 of 20 messages of /A/image have no time in their header.*time = \"bag\""):
        bring_in(without_stamps(pictures(), "/A/image", every=4))


def test_headers_of_different_clocks_are_told_of(bring_in):
    sent = [one._replace(received=one.received - 50 * SECOND) if one.topic == "/A/image" else one for one in pictures()]
    _, summary = bring_in(sent)
    assert any(re.search(r"clock \(/A/image\) is 50.0\d* s ahead of", one) for one in summary.warnings)


def test_truth_by_tf_is_the_product_along_the_tree_at_the_instants_when_anything_moved(bring_in):
    """C stands on a turntable on a cart; the tree's root is the cart's, and the world is a leaf of it."""
    text = TRIPODS + 'truth_tf = ["/world", "C/base"]\n'
    T_cart_world, T_table_base = floor_pose(0, 0, np.pi / 2), floor_pose(0.1, 0, 0)
    sent = [*pictures(), tf("/tf_static", T0, "cart", "world", T_cart_world),
            tf("/tf_static", T0, "/table", "C/base", T_table_base)]  # fmt: skip
    sent += [tf("/tf", T0 + k * SECOND, "cart", "table", floor_pose(0, k, 0.2 * k)) for k in range(4)]
    for kind in ("ros1", "mcap"):
        run, _ = bring_in(sent, text, kind=kind, out=f"{kind}.mcap")
        true = read_truth(run.path)["C"]
        np.testing.assert_allclose(true.times - T0 / SECOND, [0, 1, 2, 3])
        for k, T in enumerate(true.T_world_body):
            expected = floor_pose(0, 0, -np.pi / 2) @ floor_pose(0, k, 0.2 * k) @ T_table_base
            np.testing.assert_allclose(T, expected, atol=1e-12)


def test_tf_between_two_instants_is_in_between():
    from coloc_graph.exchange.ros_tf import Frames

    frames = Frames()
    for ns, yaw in ((0, 3.0), (10, 3.4)):
        frames.add("world", "body", ns, floor_pose(ns, 0, yaw), static=False)
    for ns in (-5, 5, 20):
        frames.add("body", "top", ns, np.eye(4), static=False)
    ns, T = frames.poses("world", "top")
    assert ns.tolist() == [0, 5, 10]
    np.testing.assert_allclose(T[1], floor_pose(5, 0, 3.2), atol=1e-12)
    assert frames.poses("world", "elsewhere") is None


def test_a_static_frame_is_where_it_was_told_last_and_one_that_changes_its_parent_begins_anew():
    from coloc_graph.exchange.ros_tf import Frames

    frames = Frames()
    for x in (1.0, 2.0):
        frames.add("world", "mast", 0, floor_pose(x, 0, 0), static=True)
    for ns in (0, 10):
        frames.add("mast", "camera", ns, floor_pose(0, 0.5, 0), static=False)
    np.testing.assert_allclose(frames.poses("world", "camera")[1][:, :2, 3], [[2, 0.5]] * 2)
    frames.add("world", "camera", 20, floor_pose(7, 7, 0), static=False)
    ns, T = frames.poses("world", "camera")
    assert ns.tolist() == [20] and T[0, 0, 3] == 7


def test_what_is_no_unit_quaternion_is_no_pose_and_one_that_nearly_is_becomes_a_rotation():
    def pose(w, x=1.0):
        return T_of(SimpleNamespace(x=x, y=2.0, z=3.0), SimpleNamespace(x=0.0, y=0.0, z=0.6, w=w))

    expected = floor_pose(1, 2, 2 * np.arctan2(0.6, 0.8))
    expected[2, 3] = 3.0
    np.testing.assert_allclose(pose(0.8), expected, atol=1e-12)
    R = pose(0.8005)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert pose(0.9) is None and pose(np.nan) is None and pose(0.8, np.inf) is None


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        ([], "has no /tf and no /tf_static, which `truth_tf` of C needs"),
        (
            [tf("/tf", T0, "world", "C/base", floor_pose(np.nan, 0.0, 0.0))],
            "/tf received at .* has no finite translation and unit quaternion of `C/base`",
        ),
        ([tf("/tf", T0, "map", "C/base", np.eye(4))], "tf has no frame `world`.*it has: C/base, map"),
        ([tf("/tf_static", T0, "world", "C/base", np.eye(4))], "`C/base` in `world`.*never moves"),
        ([tf("/tf", T0, "world", "x", np.eye(4)), tf("/tf", T0, "y", "C/base", np.eye(4))], "is not known"),
    ],
)
def test_truth_that_tf_does_not_tell_is_refused(bring_in, sent, words):
    with pytest.raises(BagError, match=words):
        bring_in([*pictures(), *sent], TRIPODS + 'truth_tf = ["world", "C/base"]\n')


def test_what_is_odd_is_told(bring_in):
    team = msgspec.structs.replace(TEAM, robots=(*TEAM.robots, msgspec.structs.replace(TEAM["C"], name="D")))
    text = DRIVES.replace('"/A/odom"\n', '"/A/odom"\ntruth = "/A/truth"\nimage = "/A/image"\n')
    text = text.replace('"/B/image"\n', '"/B/image"\ntruth = "/B/truth"\n')
    tilted = floor_pose(0, 0, 0)
    tilted[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    kind = "nav_msgs/msg/Odometry"
    lying = Sent("/A/odom", T0 + 4 * SECOND, kind, lambda make: make.odometry(T0 + 4 * SECOND, tilted))
    sent = [*pictures(("/A/image", "/B/image", "/C/image"), n=60), *some_odometry(), lying,
            truth("/A/truth", T0, np.eye(4)), truth("/B/truth", T0, np.eye(4), frame="mocap")]  # fmt: skip
    _, summary = bring_in(sent, text, team=team)
    said = "\n".join(summary.warnings)
    for words in ("/A/odom is tilted by up to 90 deg", "images of A are up to 7.8 s before or after its odometry",
                  "nothing is imported for D", "not all in one frame .A in `world`, B in `mocap`."):  # fmt: skip
        assert re.search(words, said), (words, said)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"map.toml: Object missing required field `team`"),
        ("team = 3", r"map.toml: Expected `str`, got `int` - at `\$.team`"),
        ("team", r"map.toml: "),
        (map_of(), r"map.toml: Object missing required field `robots`"),
        (map_of(head="robots = []\n"), r"map.toml: no robot has a topic"),
        (TRIPODS.replace("motion", "movement"), r"unknown field `movement` - at `\$.robots\[0\]`"),
        (TRIPODS.replace('"stands"', '"sits"'), r"Invalid enum value 'sits' - at `\$.robots\[0\].motion`"),
        (TRIPODS.replace('"B"', '"A"', 1), "robot `A` is there twice"),
        (TRIPODS.replace('name = "C"', 'name = "Z"'), r"map.toml: robot `Z` is not in the team .* at `\$.robots\[2\]"),
        (TRIPODS.replace("/B/image", "/A/image"), "/A/image is there twice, as image of A and as image of B"),
        (TRIPODS.replace('motion = "moves"', ""), "when `C` moves is not known: give its `odometry`, or say"),
        (TRIPODS + "rectified = true\n", "`rectified` is true and there is no `camera_info`"),
        (TRIPODS + 'truth = "/t"\ntruth_tf = ["a", "b"]\n', "`truth` and `truth_tf` are both there"),
        (TRIPODS + SIGMAS, "there are `odometry_sigmas` and no `odometry`"),
        (DRIVES.replace("0.005", "-1"), r"`veer` is -1(.0)?; give a number that is not negative - at"),
        ('time = "mine"\n' + TRIPODS, r"Invalid enum value 'mine' - at `\$.time`"),
        (TRIPODS + "[motion]\nspeed = 0\n", r"`speed` is 0(.0)?; give a number above 0 - at `\$.motion`"),
    ],
)
def test_a_map_that_is_wrong_is_one_sentence_with_its_place(bring_in, tmp_path, text, words):
    with pytest.raises(BagError, match=words) as refusal:
        bring_in(pictures(), text)
    assert str(refusal.value).startswith(str(tmp_path)) and "\n" not in str(refusal.value)
    assert not list(tmp_path.glob("run*"))


def test_a_team_that_the_map_names_wrongly_is_a_team_error(bring_in):
    with pytest.raises(TeamError, match=r"nowhere.toml: cannot be read"):
        bring_in(pictures(), TRIPODS.replace("team.toml", "nowhere.toml"))


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_topic_that_the_bag_lacks_or_has_of_another_type_is_told_with_those_that_it_could_be(bring_in, kind):
    sent = [*pictures(), odometry("/odom", T0, (0, 0, 0))]
    lists = "of sensor_msgs/msg/Image or sensor_msgs/msg/CompressedImage it has: /A/image, /B/image$"
    with pytest.raises(BagError, match=f"has no topic /B/pics, which the map has as `image` of B; {lists}"):
        bring_in(sent, TRIPODS.replace("/B/image", "/B/pics"), kind=kind)
    bag = "bag.bag" if kind == "ros1" else "bag"
    with pytest.raises(BagError, match=f"{bag}: the messages of /odom, .* are nav_msgs/msg/Odometry; {lists}"):
        bring_in(bring_in.bag, TRIPODS.replace("/B/image", "/odom"))
    with pytest.raises(BagError, match=r"of nav_msgs/msg/Odometry it has: /odom$"):
        bring_in(bring_in.bag, DRIVES)
    with pytest.raises(BagError, match=r"of sensor_msgs/msg/CameraInfo it has: none$"):
        bring_in(bring_in.bag, TRIPODS.replace('"/B/image"', '"/B/image"\ncamera_info = "/i"'))


def test_messages_of_types_that_nobody_knows_do_no_harm(tmp_path, bring_in):
    store = ros_bags.store_of("mcap")
    store.register(get_types_from_msg("uint8[] odd\n", "ours/msg/Odd"))
    with rosbag2.Writer(tmp_path / "odd", version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        odd = writer.add_connection("/odd", "ours/msg/Odd", msgdef="what is this? {", rihs01="RIHS01_" + 64 * "0")
        writer.write(odd, T0, b"\0\1\0\0")
        make = ros_bags.Make("mcap")
        for topic in ("/A/image", "/B/image"):
            pictured = writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=store)
            for one in pictures((topic,)):
                writer.write(pictured, one.received, store.serialize_cdr(one.content(make), one.type))
    run, summary = bring_in(tmp_path / "odd")
    assert len(run.stances) == 1 and summary.warnings == ()
    with pytest.raises(BagError, match=r"the messages of /odd, .* are ours/msg/Odd"):
        bring_in(tmp_path / "odd", TRIPODS.replace("/A/image", "/odd"))


def test_a_standard_message_that_is_another_here_is_refused(tmp_path, bring_in):
    with rosbag2.Writer(tmp_path / "odd", version=9) as writer:
        for topic in ("/A/image", "/B/image"):
            odd = writer.add_connection(
                topic, "sensor_msgs/msg/Image", msgdef="uint8 ours\n", rihs01="RIHS01_" + 64 * "0"
            )
            writer.write(odd, T0, b"\0\1\0\0" + bytes(20))
    with pytest.raises(BagError, match="/A/image has messages of a sensor_msgs/msg/Image that is not the standard one"):
        bring_in(tmp_path / "odd")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.98])
def test_a_bag_that_was_cut_off_is_one_sentence_and_nothing_is_left(tmp_path, bring_in, kind, share, rng):
    noise = rng.integers(0, 255, (6, 8), np.uint8)
    bag = write_bag(tmp_path, kind, pictures(n=400, pixels=noise))
    file = bag if bag.is_file() else next(one for one in bag.iterdir() if one.suffix in (".db3", ".mcap"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    if "mcap" in kind and share == 0.98:  # all chunks are there, and only what comes behind them is missing
        assert any("was cut off, its last" in one for one in bring_in(bag)[1].warnings)
        return
    words = "cannot be read as a ROS bag|without tables|is empty|was cut off before its first message"
    with pytest.raises(BagError, match=rf"{re.escape(str(bag))}.*: .*({words})") as refusal:
        bring_in(bag)
    assert "\n" not in str(refusal.value)
    assert not list(tmp_path.glob("run*"))


def of_a_bag(tmp_path, name="bag.mcap", profile="", **options):
    """A copy of a bag by another writer, with another profile."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    bag = write_bag(tmp_path, "bare mcap", pictures())
    copy = tmp_path / "copy" / name
    copy.parent.mkdir()
    with bag.open("rb") as source, copy.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile)
        known = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.id not in known:
                as_it_is = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, as_it_is)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    return copy


def test_a_bag_without_a_profile_or_metadata_is_read(tmp_path, bring_in):
    copy = of_a_bag(tmp_path)
    assert bring_in(copy)[1].warnings == ()
    (said,) = bring_in(copy.parent)[1].warnings
    assert said == f"{copy.parent}: has no metadata.yaml (its recorder was ended); read is bag.mcap"


def test_a_database_with_a_topic_without_a_name_is_one_sentence(tmp_path, bring_in):
    bag = write_bag(tmp_path, "sqlite3", pictures())
    file = next(bag.glob("*.db3"))
    with contextlib.closing(sqlite3.connect(file)) as database:
        (definition,) = database.execute("SELECT sql FROM sqlite_master WHERE name = 'topics'").fetchone()
        rows = database.execute("SELECT * FROM topics").fetchall()
        database.execute("DROP TABLE topics")
        database.execute(definition.replace("NOT NULL", ""))
        database.executemany(f"INSERT INTO topics VALUES ({','.join('?' * len(rows[0]))})", rows)
        database.execute("UPDATE topics SET name = NULL")
        database.commit()
    with pytest.raises(BagError, match="cannot be read as a ROS bag"):
        bring_in(file)


def test_slashes_before_topics_do_not_matter(tmp_path, bring_in):
    bag = write_bag(tmp_path, "mcap", pictures())
    counts = bring_in(bag)[1].counts
    slashes = TRIPODS.replace('"/A/image"', '"A/image"').replace('"/B/image"', '"//B/image"')
    assert bring_in(bag, slashes)[1].counts == counts


def test_a_topic_that_is_counted_and_not_there_is_refused(tmp_path, bring_in):
    bag = write_bag(tmp_path, "sqlite3", pictures())
    with contextlib.closing(sqlite3.connect(next(bag.glob("*.db3")))) as database:
        database.execute("DELETE FROM messages")
        database.commit()
    with pytest.raises(BagError, match=r"says that it has 20 messages of /A/image, and none was found"):
        bring_in(bag)


def test_a_chunk_of_ros_1_that_is_a_bomb_is_refused(monkeypatch):
    from coloc_graph.exchange.ros_files import _bunzip, _unlz4

    monkeypatch.setattr("coloc_graph.exchange.ros_files.MAX_RECORD", 8 << 20)
    zeros = bytes(1 << 20)
    assert _bunzip(bz2.compress(zeros)) == _unlz4(lz4.frame.compress(zeros)) == zeros
    for bounded, packed in ((_bunzip, bz2.compress(bytes(9 << 20))), (_unlz4, lz4.frame.compress(bytes(9 << 20)))):
        with pytest.raises(ValueError, match="a chunk of more than"):
            bounded(packed)


def test_a_bag_whose_middle_is_damaged_is_refused_with_how_far_it_was_good(tmp_path, bring_in):
    for kind in ("ros1", "bare mcap"):
        bag = write_bag(tmp_path, kind, pictures(n=3000))
        data = bytearray(bag.read_bytes())
        data[len(data) // 2 : len(data) // 2 + 3000] = bytes(3000)
        bag.write_bytes(data)
        with pytest.raises(BagError, match=r"bag\.(bag|mcap): "):
            bring_in(bag)
    assert not list(tmp_path.glob("run*"))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("nowhere.bag", None, "there is no such bag"),
        ("folder", "folder", "is a folder without metadata.yaml"),
        ("pictures.zip", b"PK", "is no bag by its name"),
        ("text.bag", b"this is no bag", "cannot be read as a ROS bag"),
        ("text.mcap", b"this is no bag", "is not an MCAP file"),
        ("view.db3", "view", "is a database without tables of messages and topics"),
    ],
)
def test_what_is_no_bag_is_named(tmp_path, bring_in, name, content, words):
    if content == "folder":
        (tmp_path / name).mkdir()
    elif content == "view":
        with contextlib.closing(sqlite3.connect(tmp_path / name)) as database:
            database.execute("CREATE TABLE topics (id INTEGER)")
            endless = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id FROM n"
            database.execute(f"CREATE VIEW messages AS {endless}")
    elif content:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match=f"{name}: {words}"):
        bring_in(tmp_path / name)


def test_a_run_of_ours_is_no_ros_bag_and_that_is_said(short, bring_in):
    with pytest.raises(BagError, match=r"short.mcap: is a run already"):
        bring_in(short)


def test_an_mcap_without_an_index_is_read(tmp_path, bring_in):
    from mcap.reader import make_reader
    from mcap.writer import IndexType, Writer

    bag = write_bag(tmp_path, "bare mcap", pictures())
    bare = tmp_path / "bare.mcap"
    with bag.open("rb") as source, bare.open("wb") as file:
        writer = Writer(file, index_types=IndexType.NONE, use_chunking=False, repeat_channels=False,
                        repeat_schemas=False, use_statistics=False, use_summary_offsets=False)  # fmt: skip
        writer.start(profile="ros2")
        channels = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", known)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    run, _ = bring_in(bare)
    assert run.topics["/A/image"] == run.topics["/B/image"] == 20


def test_where_nobody_watches_anybody_how_long_each_one_stood_is_told(bring_in):
    nobody = DRIVES.replace('motion = "stands"', 'motion = "moves"', 1)
    sent = [*pictures(("/B/image", "/C/image")), *some_odometry()]
    with pytest.raises(
        BagError, match=r"no stance: A stood 1\.\d of 3.9 s, B stood 0.0 of 3.9 s, C stood 3.9 of 3.9 s"
    ):
        bring_in(sent, nobody)
    with pytest.raises(BagError, match=r"map.toml: 1 of its robots have an `image`; a stance needs two that watch"):
        bring_in(bring_in.bag, TRIPODS.replace('image = "/A/image"\n', "").replace("/B/", "/C/"))
    bare = msgspec.structs.replace(TEAM, robots=tuple(msgspec.structs.replace(r, markers=None) for r in TEAM.robots))
    with pytest.raises(BagError, match=r"map.toml: no robot in it carries markers by team.toml"):
        bring_in(sent, DRIVES, kind="ros1", team=bare)


def test_a_run_may_not_replace_what_it_is_made_of_and_one_that_was_there_survives_a_failure(bring_in, tmp_path):
    bag = write_bag(tmp_path, "bare mcap", pictures())
    with pytest.raises(BagError, match="is to be read and to be replaced"):
        bring_in(bag, out="bag/bag.mcap")
    (tmp_path / "run.mcap").write_bytes(b"before")
    with pytest.raises(ColocError):
        bring_in(bag, TRIPODS.replace("/B/image", "/none"))
    assert (tmp_path / "run.mcap").read_bytes() == b"before"


def test_on_the_command_line(bring_in, tmp_path, capsys):
    bring_in(pictures())
    command = ["import", "ros", str(tmp_path / "bag"), str(tmp_path / "map.toml"), "--out", str(tmp_path / "run.mcap")]
    capsys.readouterr()
    assert main(command) == 2 and "replace it with --force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    out, err = capsys.readouterr()
    first, *stood = out.splitlines()
    assert first.endswith("run.mcap: 40 images, 0 odometry samples, 0 ranges, 0 true poses; 1 stance, observers A, B")
    assert stood == ["A stood 3.8 of 3.8 s", "B stood 3.8 of 3.8 s", "C stood 0.0 of 3.8 s"]
    assert "messages read: 80 of 80" in err
    assert main([*command, "--force", "--json", "--image-format", "png"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"]["images"] == 40
    (tmp_path / "map.toml").write_text(TRIPODS.replace("/B/image", "/none"))
    assert main([*command, "--force"]) == 2
    err = capsys.readouterr().err
    assert "has no topic /none" in err and "Traceback" not in err


def test_an_encoded_image_is_written_as_it_is_and_only_jpeg_and_png_are(tmp_path):
    from coloc_graph.errors import RunError
    from coloc_graph.run import RunWriter

    data = cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()
    with RunWriter(tmp_path / "run.mcap", TEAM) as writer:
        writer.write(EncodedImage("A", 1.0, "png", data))
        with pytest.raises(RunError, match="is `webp`; give jpeg or png"):
            writer.write(EncodedImage("A", 2.0, "webp", data))
        with pytest.raises(RunError, match="names robot `Z`"):
            writer.write(EncodedImage("Z", 2.0, "png", data))
    assert np.array_equal(next(open_run(tmp_path / "run.mcap").images("A")).pixels.ravel(), np.arange(48))


def test_the_example_of_the_documentation_is_a_map_with_every_field():
    text = (Path(__file__).parents[2] / "docs" / "ros.md").read_text(encoding="utf-8")
    example = re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1]
    found = msgspec.toml.decode(example, type=RosMap)
    assert found.motion == MotionThresholds()  # the defaults, as it says
    for kind in (RosMap, MotionThresholds, RobotTopics, OdometrySigmas):
        assert all(re.search(rf"\b{field}\b", example) for field in kind.__struct_fields__), kind
    for encoding in ENCODINGS:
        assert encoding in text or encoding.startswith(("bayer", "8UC")), encoding
