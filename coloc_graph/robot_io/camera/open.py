"""Opening of cameras: a device, a video, or the camera of a simulated robot; `open_camera`, docs/cameras.md."""

from coloc_graph.errors import InputError
from coloc_graph.machine import machine
from coloc_graph.robot_io.camera.source import CameraSource, Clock, Device
from coloc_graph.team import Camera

#: Kinds of camera specifications, by the word before the colon.
KINDS = {
    "v4l2": "v4l2:/dev/video0",
    "video": "video:FILE or video:FOLDER of images",
    "world": "world:SOCKET of a simulated world",
}


def open_camera(spec: str, camera: Camera, robot: str, clock: Clock = machine.monotonic_ns) -> CameraSource:
    """Open a robot's camera.

    Parameters
    ----------
    spec
        One of `KINDS`.
    camera
        The team's description of the camera.
    robot
        Name of the robot.
    clock
        Clock of the time stamps [ns].

    Returns
    -------
    CameraSource
        The open camera.

    Raises
    ------
    InputError
        If the specification is not valid.
    CameraError
        If the camera does not open.
    """
    kind, _, where = spec.partition(":")
    if kind not in KINDS or not where:
        raise InputError(f"`{spec}` is not a camera for robot {robot}; use {', '.join(KINDS.values())}")
    name = f"the camera of robot {robot} ({spec})"

    def connect() -> Device:
        # imported here, since other cameras do not need it
        if kind == "v4l2":
            from coloc_graph.robot_io.camera.v4l2 import V4l2Camera

            return V4l2Camera(name, where, camera, clock)
        if kind == "video":
            from coloc_graph.robot_io.camera.video import Video

            return Video(name, where, camera, clock)
        from coloc_graph.robot_io.camera.simulated import WorldCamera

        return WorldCamera(name, where, robot, clock)

    return CameraSource(name, camera, connect)
