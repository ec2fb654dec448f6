"""Cameras: `open_camera` opens a device, a video or the camera of a simulated robot; docs/cameras.md."""

import time

from coloc_graph.errors import InputError
from coloc_graph.robot_io.camera.source import CameraSource, Clock, Device
from coloc_graph.team import Camera

#: What a camera may be given as, by the word before the colon.
KINDS = {
    "v4l2": "v4l2:/dev/video0",
    "video": "video:FILE or video:FOLDER of images",
    "world": "world:SOCKET of a simulated world",
}


def open_camera(spec: str, camera: Camera, robot: str, clock: Clock = time.monotonic_ns) -> CameraSource:
    """The open camera of a robot: `spec` is one of `KINDS`, `camera` what the team says of it.

    Frames are stamped by `clock` [ns]. Raises `InputError` where the spec is none, `CameraError` where the camera
    does not open.
    """
    kind, _, where = spec.partition(":")
    if kind not in KINDS or not where:
        raise InputError(f"`{spec}` is no camera for robot {robot}; use {', '.join(KINDS.values())}")
    name = f"the camera of robot {robot} ({spec})"

    def connect() -> Device:
        # imported here: who has no such camera needs none of it
        if kind == "v4l2":
            from coloc_graph.robot_io.camera.v4l2 import V4l2Camera

            return V4l2Camera(name, where, camera, clock)
        if kind == "video":
            from coloc_graph.robot_io.camera.video import Video

            return Video(name, where, camera, clock)
        from coloc_graph.robot_io.camera.simulated import WorldCamera

        return WorldCamera(name, where, robot, clock)

    return CameraSource(name, camera, connect)
