"""Cameras of the browsers: framing the data, following a robot, and the scale at which robots are visible."""

from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from coloc_graph.viewer.frame import Frame
from coloc_graph.viewer.motion import extent
from coloc_graph.viewer.scene import Scene

TRUE_SIZE_DISTANCE = 25.0  # m; robots that are farther away are enlarged
MAX_ENLARGEMENT = 64.0  # factor by which they are
FOV = float(np.radians(40))  # rad, vertical field of view
PITCH = float(np.radians(40))  # rad, by which the first camera looks down
ASPECT = 1.3  # width over height of a picture, at least
FILLED = 0.85  # share of the picture that the data fill
TALL = 0.6  # m, height of a robot with its label


class Cameras:
    """Cameras of all connected browsers; moved by the render thread alone."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server

    def on_size_change(self, current: Callable[[], float], wake: Callable[[], None]) -> None:
        """Call `wake` when a camera has moved and robots are drawn at another size than the current."""

        @self._server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            @client.camera.on_update
            def _(_: viser.CameraHandle) -> None:
                if self.size() != current():
                    wake()

    def size(self) -> float:
        """Return the factor by which robots are enlarged, by the nearest camera."""
        eyes = [(client.camera.position, client.camera.look_at) for client in self._server.get_clients().values()]
        if not eyes:
            first = self._server.initial_camera
            eyes = [(np.asarray(first.position), np.asarray(first.look_at))]
        return seen_size(min(float(np.linalg.norm(eye - at)) for eye, at in eyes))

    def frame_all(self, scene: Scene, aside: float = 0.0) -> None:
        """Frame all of the data with all cameras."""
        initial_camera(self._server, scene, aside)
        position, look_at = camera_on(scene, aside)
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = position, look_at

    def follow(self, robot: str, scene: Scene, frame: Frame) -> None:
        """Have all cameras look at a robot, from their direction and distance; an unknown name does nothing."""
        if robot not in scene.robots:
            return
        here = frame.poses[scene.robots.index(robot), :3]
        if not np.isfinite(here).all():
            return
        for client in self._server.get_clients().values():
            camera = client.camera
            if np.abs(here - camera.look_at).max() > 1e-6:
                # both together: a browser may still answer with an earlier camera, of which the two agree
                camera.position, camera.look_at = here + camera.position - camera.look_at, here


def seen_size(distance: float) -> float:
    """Return the factor by which robots are enlarged for a camera at a distance [m]: a power of two."""
    return (
        float(2 ** np.floor(np.log2(np.clip(distance / TRUE_SIZE_DISTANCE, 1.0, MAX_ENLARGEMENT))))
        if np.isfinite(distance)
        else 1.0
    )


def initial_camera(server: viser.ViserServer, scene: Scene, aside: float = 0.0) -> None:
    """Frame the data: from behind and the right of the team's direction, looking down."""
    position, look_at = camera_on(scene, aside)
    server.initial_camera.fov = FOV
    server.initial_camera.far = max(1000.0, 10 * float(np.linalg.norm(position - look_at)))
    server.initial_camera.position, server.initial_camera.look_at = position, look_at


def camera_on(scene: Scene, aside: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return position (3,) of a camera that sees all of the data, and the point (3,) it looks at [m], world frame."""
    low, high = extent(scene)
    high = high + np.array([0.0, aside])
    middle, along = (low + high) / 2, high - low
    # a long way is seen from its side, and a little from behind
    side = np.array([-0.35, -1.0]) if along[0] >= along[1] else np.array([-1.0, -0.35])
    side *= np.cos(PITCH) / np.linalg.norm(side)
    back = np.array([*side, np.sin(PITCH)])
    right = np.cross([0.0, 0.0, 1.0], back) / np.cos(PITCH)
    up = np.cross(back, right)
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.0, TALL)])
    corners -= (*middle, 0.0)
    # from how far a corner is just seen, across and up: its offset is the half angle's tangent times its depth
    tangent = np.tan(FOV / 2) * FILLED
    needed = np.maximum(np.abs(corners @ right) / (tangent * ASPECT), np.abs(corners @ up) / tangent) + corners @ back
    return np.array([*middle, 0.0]) + float(needed.max()) * back, np.array([*middle, 0.0])
