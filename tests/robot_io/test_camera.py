"""Cameras: videos and folders of images, sockets that fail in every way, and what of V4L2 can be tried without one."""

import contextlib
import itertools
import json
import logging
import socket
import threading
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.errors import CameraError, InputError
from coloc_graph.machine import machine
from coloc_graph.robot_io import Frame, open_camera
from coloc_graph.robot_io.camera.simulated import HEADER
from coloc_graph.robot_io.camera.source import STALE, CameraSource, clock_ahead
from coloc_graph.robot_io.camera.v4l2 import luma
from coloc_graph.simulation import reference_team

CAMERA = replace(reference_team().robots[0].camera, width=64, height=48, fps=50.0)


def picture(number):
    """An image that says which one it is, by its brightness."""
    return np.full((CAMERA.height, CAMERA.width), 10 + 20 * number, np.uint8)


def number_in(frame):
    return round((float(np.median(frame.pixels)) - 10) / 20)


def write_video(path, images, size=(CAMERA.width, CAMERA.height)):
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, size, isColor=False)
    assert writer.isOpened()
    for image in images:
        writer.write(image)
    writer.release()
    return path


def no_thread_of(name):
    deadline = time.monotonic() + 3
    while any(thread.name == name for thread in threading.enumerate()):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


# ---- videos


@pytest.fixture(params=["file", "folder"])
def video(request, tmp_path):
    images = [picture(n) for n in range(10)]
    if request.param == "file":
        return write_video(tmp_path / "seen.avi", images)
    for n, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{n:03d}.png"), image)
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


@pytest.mark.realtime
def test_a_video_is_shown_at_the_cameras_rate_and_ends_with_a_sentence(video):
    camera = replace(CAMERA, fps=20.0)
    with open_camera(f"video:{video}", camera, "A") as source:
        frames = []
        with pytest.raises(CameraError, match=r"camera of robot A .video:.* has ended after 10 images; open it anew"):
            while True:
                frames.append(source.read())
        numbers = [number_in(frame) for frame in frames]
        assert numbers == sorted(set(numbers)) and len(numbers) + source.dropped == 10
        gaps = np.diff([frame.stamp_ns for frame in frames]) / np.diff(numbers) * 1e-9
        assert np.median(gaps) == pytest.approx(1 / 20, abs=0.01)
        assert source.fault is not None
        source.reopen()
        assert source.fault is None
        assert number_in(source.read()) <= 5


@pytest.mark.realtime
def test_who_reads_slowly_gets_the_newest_image_and_the_number_of_those_that_he_missed(video):
    with open_camera(f"video:{video}", CAMERA, "A") as source:
        first = number_in(source.read())
        time.sleep(0.1)
        second = number_in(source.read())
        assert second >= first + 4
        assert source.dropped == second - 1


def test_stamps_are_of_the_clock_that_was_given(video):
    with open_camera(f"video:{video}", CAMERA, "A", clock=lambda: time.monotonic_ns() + 7_000_000_000) as source:
        ahead = source.read().stamp_ns - time.monotonic_ns()
    assert 6.5 < ahead * 1e-9 <= 7.0


def test_how_far_a_clock_is_ahead():
    assert clock_ahead(machine.monotonic_ns) == 0
    assert clock_ahead(lambda: time.monotonic_ns() - 123_000_000) == pytest.approx(-123e6, abs=5e7)


def test_how_far_a_clock_is_ahead_is_read_where_nothing_came_between(monkeypatch):
    own = iter([0, 400_000, 500_000, 560_000, 600_000, 900_000, 910_000, 990_000, 1_000_000, 1_070_000])
    other = iter([7_000_000, 7_530_000, 7_900_000, 7_950_000, 8_100_000])
    monkeypatch.setattr("coloc_graph.robot_io.camera.source.machine", SimpleNamespace(monotonic_ns=own.__next__))
    assert clock_ahead(other.__next__) == 7_000_000  # of the second reading, 60 us apart
    assert next(own, None) is None


def test_images_of_another_size_than_the_teams_are_refused(tmp_path):
    write_video(tmp_path / "large.avi", [np.zeros((96, 128), np.uint8)] * 3, (128, 96))
    with (
        open_camera(f"video:{tmp_path / 'large.avi'}", CAMERA, "B") as source,
        pytest.raises(CameraError, match=r"robot B .* delivers images of 128 x 96 px, but the team says 64 x 48: set"),
    ):
        source.read()


@pytest.mark.parametrize(("make", "words"), [
    (lambda path: None, "there is no file or folder"),
    (lambda path: path.mkdir(), "holds no images"),
    (lambda path: path.write_text("no video"), "is no video that OpenCV reads"),
])  # fmt: skip
def test_what_is_no_video_is_refused(tmp_path, make, words):
    make(tmp_path / "it")
    with pytest.raises(CameraError, match=words):
        open_camera(f"video:{tmp_path / 'it'}", CAMERA, "A")


def test_an_image_that_cannot_be_read_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), picture(0))
    (tmp_path / "1.png").write_bytes(b"not a PNG")
    with open_camera(f"video:{tmp_path}", CAMERA, "A") as source, pytest.raises(CameraError, match=r"1\.png: cannot"):
        for _ in range(2):
            source.read()


@pytest.mark.parametrize("spec", ["", "video", "video:", "usb:0", "/dev/video0"])
def test_a_spec_that_is_none_is_refused(spec):
    with pytest.raises(InputError, match="is not a camera for robot A; use v4l2:/dev/video0, video:FILE"):
        open_camera(spec, CAMERA, "A")


# ---- a simulated camera whose world misbehaves


class World(threading.Thread):
    """A socket that does as `script` says with each connection; the real world is in test_live_world.py."""

    def __init__(self, path, script):
        super().__init__(daemon=True)
        self.path, self.script = str(path), script
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(self.path)
        self.listener.listen(4)
        self.ended = threading.Event()
        self.start()

    def run(self):
        with contextlib.suppress(OSError):
            while not self.ended.is_set():
                connection, _ = self.listener.accept()
                with connection, contextlib.suppress(OSError):
                    self.asked = json.loads(connection.recv(4096))
                    self.script(connection, self.ended)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        self.join(timeout=2)


def frame_bytes(pixels, stamp=5):
    return HEADER.pack(stamp, *pixels.shape) + pixels.tobytes()


def test_a_frame_comes_whole_however_it_is_cut(tmp_path):
    def script(connection, ended):
        data = b"{}\n" + frame_bytes(picture(3), 77)
        for part in (data[:1], data[1:9], data[9:1000], data[1000:]):
            connection.sendall(part)
            time.sleep(0.15)  # longer than the device waits
        ended.wait(2)

    with World(tmp_path / "w", script) as world, open_camera(f"world:{world.path}", CAMERA, "C") as source:
        frame = source.read(2.0)
        assert world.asked == {"robot": "C"}
        assert frame.stamp_ns == 77 and np.array_equal(frame.pixels, picture(3))


@pytest.mark.parametrize(("answer", "words"), [
    (b'{"error": "there is no robot C here"}\n', "there is no robot C here"),
    (b"hello\n", "is the simulated world running there"),
    (b'{"strange": 1}\n', "is the simulated world running there"),
    (b"", "closed the connection"),
])  # fmt: skip
def test_a_world_that_refuses_or_is_none(tmp_path, answer, words):
    with (
        World(tmp_path / "w", lambda connection, _: connection.sendall(answer)) as world,
        pytest.raises(CameraError, match=words),
    ):
        open_camera(f"world:{world.path}", CAMERA, "C")


def test_a_world_that_does_not_answer_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("coloc_graph.robot_io.camera.simulated.ANSWER_TIMEOUT", 0.2)
    with World(tmp_path / "w", lambda _, ended: ended.wait(5)) as world:
        since = time.monotonic()
        with pytest.raises(CameraError, match=r"cannot be opened .timed out.: is the simulated world running"):
            open_camera(f"world:{world.path}", CAMERA, "C")
        assert time.monotonic() - since < 4


def test_no_world_at_all(tmp_path):
    with pytest.raises(CameraError, match=r"cannot be opened .No such file or directory"):
        open_camera(f"world:{tmp_path / 'none'}", CAMERA, "C")


@pytest.mark.parametrize(("sent", "words"), [
    (b"", "the simulated world closed the connection; open it again"),
    (frame_bytes(picture(1))[:500], "the simulated world closed the connection"),
    (frame_bytes(np.zeros((10, 20), np.uint8)), "delivers images of 20 x 10 px, but the team says 64 x 48"),
    (HEADER.pack(0, 1 << 20, 1 << 20), "sent an image of"),
])  # fmt: skip
def test_a_world_that_goes_or_sends_what_is_no_frame(tmp_path, sent, words):
    def script(connection, _):
        connection.sendall(b"{}\n" + sent)

    with World(tmp_path / "w", script) as world, open_camera(f"world:{world.path}", CAMERA, "C") as source:
        with pytest.raises(CameraError, match=words):
            source.read(2.0)
        with pytest.raises(CameraError, match=words):  # and again, at once
            source.read(2.0)


def test_silence_is_an_error_in_time_and_no_end(tmp_path):
    go = threading.Event()

    def script(connection, ended):
        connection.sendall(b"{}\n" + frame_bytes(picture(1)))
        go.wait(5)
        connection.sendall(frame_bytes(picture(2)))
        ended.wait(5)

    with World(tmp_path / "w", script) as world, open_camera(f"world:{world.path}", CAMERA, "C") as source:
        assert number_in(source.read(2.0)) == 1
        since = time.monotonic()
        with pytest.raises(CameraError, match=r"robot C .* has delivered no image for 0\.2 s: check"):
            source.read(0.2)
        assert 0.19 < time.monotonic() - since < 2.0
        assert source.fault is None
        go.set()
        assert number_in(source.read(2.0)) == 2


def test_an_image_that_came_long_ago_is_not_given_as_the_newest(tmp_path):
    def script(connection, ended):
        connection.sendall(b"{}\n" + frame_bytes(picture(1)))
        ended.wait(5)

    with World(tmp_path / "w", script) as world, open_camera(f"world:{world.path}", CAMERA, "C") as source:
        time.sleep(STALE + 0.4)
        with pytest.raises(CameraError, match="no image"):
            source.read(0.1)
        assert source.dropped == 1


# ---- a device that hangs, of which there is no real one here


class Hanging:
    """It answers nothing until it is let go."""

    def __init__(self, let_go, open_at_once=True):
        self.let_go, self.closed = let_go, threading.Event()
        if not open_at_once:
            let_go.wait(10)

    def grab(self):
        self.let_go.wait(10)
        return Frame(1, picture(0))

    def close(self):
        self.closed.set()


def test_a_device_that_hangs_keeps_nobody_from_closing_and_opening_anew(monkeypatch):
    monkeypatch.setattr("coloc_graph.robot_io.camera.source.ENDING", 0.1)
    let_go, made = threading.Event(), []

    def connect():
        made.append(Hanging(let_go))
        return made[-1]

    source = CameraSource("the camera that hangs", CAMERA, connect)
    with pytest.raises(CameraError, match=r"the camera that hangs has delivered no image for 0\.1 s"):
        source.read(0.1)
    since = time.monotonic()
    source.reopen()
    source.close()
    assert time.monotonic() - since < 4
    with pytest.raises(CameraError, match="is closed: open it again"):
        source.read(1.0)
    let_go.set()
    assert all(device.closed.wait(2) for device in made) and len(made) == 2
    assert no_thread_of("the camera that hangs")


def test_a_device_that_hangs_while_it_is_opened_is_given_up():
    let_go, made = threading.Event(), []

    def connect():
        made.append(Hanging(let_go, open_at_once=False))
        return made[-1]

    with pytest.raises(CameraError, match=r"did not open within 0\.2 s: check that it is plugged in"):
        CameraSource("the slow camera", CAMERA, connect, opening=0.2)
    let_go.set()
    assert no_thread_of("the slow camera")
    assert made[0].closed.is_set()


def test_a_reader_waits_no_longer_once_another_closes():
    let_go = threading.Event()
    source = CameraSource("a camera", CAMERA, lambda: Hanging(let_go))
    threading.Timer(0.2, source.close).start()
    since = time.monotonic()
    with pytest.raises(CameraError, match="is closed"):
        source.read(10.0)
    assert time.monotonic() - since < 2
    let_go.set()
    assert no_thread_of("a camera")


def test_a_bug_in_a_device_is_told_to_who_reads():
    class Broken(Hanging):
        def grab(self):
            raise ZeroDivisionError("a bug")

    with (
        CameraSource("a camera", CAMERA, lambda: Broken(threading.Event())) as source,
        pytest.raises(CameraError, match=r"its reader failed .ZeroDivisionError.'a bug'"),
    ):
        source.read(2.0)


# ---- V4L2: there is no such camera here, so OpenCV's capture is played; what refuses is real


@pytest.mark.parametrize(("spec", "words"), [
    ("v4l2:/dev/video-none", "cannot be opened .No such file or directory.: check that it is plugged in"),
    ("v4l2:/", "/ is not a device; use video:/ for"),
    ("v4l2:/dev/null", "check that it is free and delivers images"),
    ("v4l2:/dev/null?gain=high", "`gain=high` is not a setting"),
    ("v4l2:/dev/null?zoom=1", "`zoom=1` is not a setting; use exposure=NUMBER and gain=NUMBER"),
])  # fmt: skip
def test_what_is_no_v4l2_camera_is_refused(spec, words):
    with pytest.raises(CameraError, match=words):
        open_camera(spec, CAMERA, "A")


class Capture:
    """What OpenCV's V4L2 capture does, as its source has it: raw bytes in one row where CONVERT_RGB is 0."""

    unplugged = epoch = False
    formats = ("YUYV",)

    def __init__(self, *_):
        self.options = {cv2.CAP_PROP_FPS: 30.0, cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}
        self.released = False

    def isOpened(self):
        return True

    def set(self, option, value):
        if option != cv2.CAP_PROP_FOURCC or value in [cv2.VideoWriter.fourcc(*name) for name in self.formats]:
            self.options[option] = value
        return True

    def get(self, option):
        if option == cv2.CAP_PROP_POS_MSEC:
            return self.stamp * 1e3
        return float(self.options.get(option, 0))

    def grab(self):
        time.sleep(0.02)
        self.stamp = (time.time() if self.epoch else time.monotonic()) - 0.004
        return not self.unplugged

    def retrieve(self):
        assert self.options[cv2.CAP_PROP_CONVERT_RGB] == 0
        y = picture(4)
        return True, np.stack([y, np.full_like(y, 128)], axis=-1).reshape(1, -1)

    def release(self):
        self.released = True


@pytest.fixture
def capture(monkeypatch):
    class Played(Capture):
        pass

    monkeypatch.setattr("coloc_graph.robot_io.camera.v4l2.cv2.VideoCapture", Played)
    return Played


def test_a_v4l2_cameras_y_comes_with_the_kernels_stamp(capture, caplog):
    with open_camera("v4l2:/dev/null?exposure=60&gain=10", CAMERA, "A") as source:
        for _ in range(3):
            frame = source.read()
            assert np.array_equal(frame.pixels, picture(4))
            assert -0.5 < (frame.stamp_ns - time.monotonic_ns()) * 1e-9 < -0.003
    said = "\n".join(record.getMessage() for record in caplog.records)
    # /dev/null takes no controls
    assert "automatic exposure cannot be switched off" in said
    assert "refuses exposure=60" in said and "refuses gain=10" in said
    assert "time stamps" not in said


def test_stamps_of_another_clock_are_found_out_and_told_once(capture, caplog):
    capture.epoch = True
    caplog.set_level(logging.WARNING)
    with open_camera("v4l2:/dev/null", CAMERA, "A") as source:
        for _ in range(3):
            assert -0.5 < (source.read().stamp_ns - time.monotonic_ns()) * 1e-9 <= 0
    assert sum("are not of CLOCK_MONOTONIC" in record.getMessage() for record in caplog.records) == 1


def test_a_v4l2_camera_without_the_format_or_the_size_is_refused(capture, monkeypatch):
    capture.formats = ()
    with pytest.raises(CameraError, match=r"robot A .* does not deliver the format YUYV: list its formats"):
        open_camera("v4l2:/dev/null", CAMERA, "A")
    capture.formats = ("YUYV",)
    with (
        open_camera("v4l2:/dev/null", replace(CAMERA, width=62), "A") as source,
        pytest.raises(CameraError, match="6144 bytes an image, but 62 x 48 px in YUYV have 5952: set the camera's"),
    ):
        source.read()


def test_a_v4l2_camera_that_is_unplugged_is_told_from_one_that_is_silent(capture, monkeypatch):
    with open_camera("v4l2:/dev/null", CAMERA, "A") as source:
        source.read()
        capture.unplugged = True
        with pytest.raises(CameraError, match="no image"):
            for _ in itertools.count():
                source.read(0.3)
        assert source.fault is None
        monkeypatch.setattr("coloc_graph.robot_io.camera.v4l2.Path.exists", lambda _: False)
        with pytest.raises(CameraError, match="was unplugged: plug it in and open it again"):
            source.read(2.0)


def test_luma_is_the_first_of_two_bytes():
    raw = np.arange(2 * 4 * 2, dtype=np.uint8)
    camera = replace(CAMERA, width=4, height=2)
    for shape in ((1, 16), (2, 4, 2), (16,)):
        assert np.array_equal(luma("it", raw.reshape(shape), camera), [[0, 2, 4, 6], [8, 10, 12, 14]])
