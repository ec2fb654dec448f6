"""A robot's program without a network: what it sends of an image."""

import numpy as np

from coloc_graph.frontend.images.detection import MAX_LIGHTS
from coloc_graph.machine import machine
from coloc_graph.online.devices import Devices
from coloc_graph.online.robot import RobotProgram
from coloc_graph.robot_io.camera.source import CameraSource, Frame
from coloc_graph.robot_io.link.messages import Capture, Event, Sample, decode
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
