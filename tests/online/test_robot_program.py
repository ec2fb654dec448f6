"""A robot's program without a network: what it sends of an image, and what it asks of its wheels."""

import time
from types import SimpleNamespace

import numpy as np

from coloc_graph.frontend.images.detection import MAX_LIGHTS
from coloc_graph.machine import machine
from coloc_graph.online.devices import Devices
from coloc_graph.online.robot import REOPEN_PERIOD, RobotProgram
from coloc_graph.robot_io.camera.source import CameraSource, Frame
from coloc_graph.robot_io.link.messages import Capture, Event, Recover, Sample, decode
from coloc_graph.simulation.rig import reference_team


class Session:
    """A session that keeps what is sent, by key."""

    def __init__(self, **_):
        self.sent = {}

    def publisher(self, key):
        return self.sent.setdefault(key, []).append

    kept_publisher = publisher

    def __getattr__(self, name):
        return lambda *_, **__: None


class Dark:
    """A camera that delivers nothing by itself."""

    def grab(self):
        machine.sleep(0.01)

    def close(self):
        pass


def test_a_robot_says_once_that_lights_are_left_out_of_its_images(tmp_path):
    team, session = reference_team(), Session()
    devices = Devices(
        camera=lambda spec, camera, name, clock: CameraSource(name, camera, Dark), session=lambda **_: session
    )
    image = np.zeros((240, 320), np.uint8)
    rows, columns = np.mgrid[4:240:14, 4:320:14]
    image[rows, columns] = image[rows, columns + 1] = image[rows + 1, columns] = image[rows + 1, columns + 1] = 220
    with RobotProgram("A", team, connect="tcp/127.0.0.1:1", folder=tmp_path, camera="none", devices=devices) as robot:
        robot._obey(Capture(capture=1))
        for stamp in range(3):
            robot._see(Frame(stamp, image))
    (event,) = [decode(data, Event) for data in session.sent["coloc/A/events"]]
    assert event.kind == "lights"
    assert event.text.startswith(f"an image has {rows.size - MAX_LIGHTS} lights more than are measured")
    samples = [decode(data, Sample) for data in session.sent["coloc/A/samples"]]
    assert [one.number for one in samples] == [0, 1, 2] and all(0 < len(one.uv) <= MAX_LIGHTS for one in samples)


class Standing:
    """Wheels that stand, and whose line can be lost."""

    fault, moving, lost, awaits_port, state = None, False, False, False, SimpleNamespace(ticks=None, hazards=dict)

    def __init__(self, *_, **__):
        self.asked = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def __getattr__(self, name):
        return lambda: self.asked.append(name)

    def take_odometry(self):
        return []

    def open(self):
        self.asked.append("open")
        self.lost = False


class Steps:
    """Ends a program's loop after some steps; the first comes when a lost line may be opened again."""

    def __init__(self, steps):
        self.left = steps

    def wait(self, seconds):
        self.left -= 1
        time.sleep(0.0 if machine.monotonic() > REOPEN_PERIOD else REOPEN_PERIOD)
        return self.left < 0


def test_wheels_are_opened_again_only_if_their_line_was_lost_and_recover_only_if_it_was_not(tmp_path):
    team = reference_team()
    devices = Devices(
        camera=lambda spec, camera, name, clock: CameraSource(name, camera, Dark),
        wheels=Standing,
        session=lambda **_: Session(),
    )
    options = {"connect": "tcp/127.0.0.1:1", "folder": tmp_path, "camera": "none", "devices": devices}
    with RobotProgram("A", team, **options, wheels="none") as robot:
        robot.run(Steps(3))
        robot._obey(Recover())
        assert robot._wheels.asked == ["recover"]
        robot._wheels.lost = robot._wheels.awaits_port = True
        robot._obey(Recover())
        robot.run(Steps(3))
        assert robot._wheels.asked == ["recover"]  # its driver stops it first
        robot._wheels.awaits_port = False
        robot.run(Steps(3))
        until = time.monotonic() + 10
        while robot._opening or ("open" not in robot._wheels.asked and time.monotonic() < until):
            time.sleep(0.01)
        assert robot._wheels.asked == ["recover", "close", "open"]
    with RobotProgram("B", team, **options) as observer:  # without wheels
        observer._obey(Recover())
        observer.run(Steps(1))
