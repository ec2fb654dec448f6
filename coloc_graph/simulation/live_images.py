"""Images of the cameras of a live world, rendered in real time and served on a Unix socket: `ImageServer`.

The protocol is that of `robot_io.camera_world`. Each connection has a thread, which renders one robot's frames at its
camera's rate for as long as somebody listens.
"""

import contextlib
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.robot_io.camera.simulated import ANSWER_TIMEOUT, HEADER, MAX_LINE
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rendering import Field, Sensor
from coloc_graph.simulation.scenery import RobotInView, Scenery, backdrop, draw
from coloc_graph.team import Team

AFTER = 0.005  # s after its exposure that a frame is rendered, when all poses are known

NOISE = 5  # images of noise drawn in advance
LEAP = 104_729  # pixels by which the noise is shifted from image to image

log = logging.getLogger(__name__)

#: T_world_body (robots, n, 4, 4) of all robots, in the team's order, at instants (n,) [s, CLOCK_MONOTONIC].
Poses = Callable[[Array], Array]


class LiveCamera:
    """One robot's camera: `image` is what it sees at an instant, of all others as they stand in `poses`.

    While it stands still, what does not move is drawn once.
    """

    def __init__(self, robot: str, true_team: Team, poses: Poses, scenery: Scenery, sensor: Sensor, seed: int) -> None:
        self._index = true_team.names.index(robot)
        self._team, self._poses, self._scenery, self._sensor = true_team, poses, scenery, sensor
        self._seed = (seed, self._index)
        lens = true_team.robots[self._index].camera
        # drawn once: each image takes its noise from another place of it
        self._noise = np.random.default_rng(self._seed).standard_normal(
            NOISE * lens.height * lens.width, dtype=np.float32
        )
        self._field: Field | None = None
        self._stood = np.empty(0)

    def image(self, middle: float, number: int) -> NDArray[np.uint8]:
        """The image (height, width) of an exposure around the instant `middle` [s]; `number` draws its noise."""
        half = self._sensor.exposure / 2
        T_world_body = self._poses(np.array([middle, middle - half, middle + half]))
        own = self._team.robots[self._index]
        T_world_camera = T_world_body[self._index] @ own.mount.T_body_camera
        if self._field is None or not np.array_equal(T_world_camera[0], self._stood):
            rng = np.random.default_rng(self._seed)
            self._field = backdrop(own.camera, T_world_camera[0], self._scenery, rng)
            self._stood = T_world_camera[0]
        others = []
        for other, T in zip(self._team.robots, T_world_body, strict=True):
            if other is not own:
                p_body = np.zeros((0, 3)) if other.markers is None else other.markers.p_body
                others.append(RobotInView(own.camera, list(T_world_camera), list(T[:, None]), p_body, self._sensor))
        size = self._field.size
        first = number * LEAP % (self._noise.size - size)
        noise = self._noise[first : first + size].reshape(self._field.shape)
        return draw(self._field, others, 0, self._sensor, noise)


class ImageServer:
    """Serves the frames of `cameras` at their rates `fps` on a Unix socket at `path`, until it is closed.

    Cameras do not expose at the same instants: each is a part of a frame behind the one before. `frozen` names the
    robots whose cameras have stopped delivering.
    """

    def __init__(self, path: Path, cameras: Mapping[str, Callable[[], LiveCamera]], fps: Mapping[str, float]) -> None:
        self._cameras, self._fps = cameras, fps
        self.frozen: set[str] = set()
        self._began = time.monotonic()
        self._ended = threading.Event()
        self._connections: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen(16)
        self._listener.settimeout(0.2)
        self._start(self._accept, "images of the live world")

    def close(self) -> None:
        """End all connections."""
        self._ended.set()
        with self._lock:
            for connection in self._connections:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)  # wakes who is sending
            threads = list(self._threads)
        for thread in threads:
            thread.join(timeout=2.0)
        self._listener.close()

    def _start(self, work: Callable[..., None], name: str, *args: object) -> None:
        thread = threading.Thread(target=work, args=args, name=name, daemon=True)
        with self._lock:
            self._threads = [one for one in self._threads if one.is_alive()] + [thread]
            thread.start()

    def _accept(self) -> None:
        while not self._ended.is_set():
            with contextlib.suppress(TimeoutError, OSError):
                connection, _ = self._listener.accept()
                with self._lock:
                    self._connections.add(connection)
                self._start(self._serve, "a camera of the live world", connection)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, contextlib.suppress(OSError):  # the client has gone, or we end
                connection.settimeout(ANSWER_TIMEOUT)
                robot, error = self._asked(connection)
                connection.sendall(json.dumps({"error": error} if error else {}).encode() + b"\n")
                if not error:
                    connection.settimeout(None)  # a client that is stopped for a while is waited for
                    self._stream(connection, robot)
        finally:
            with self._lock:
                self._connections.discard(connection)

    def _asked(self, connection: socket.socket) -> tuple[str, str | None]:
        """The robot whose camera a client asks for, and what is wrong with that."""
        line = b""
        while not line.endswith(b"\n"):
            data = connection.recv(MAX_LINE)
            line += data
            if not data or len(line) > MAX_LINE:
                return "", "the request is none: send one line of JSON that names the robot"
        try:
            robot = str(json.loads(line)["robot"])
        except (ValueError, TypeError, KeyError):
            return "", "the request is none: send one line of JSON that names the robot"
        if robot not in self._cameras:
            return robot, f"the simulated world has no robot {robot}; it has {', '.join(self._cameras)}"
        return robot, None

    def _stream(self, connection: socket.socket, robot: str) -> None:
        camera, period = self._cameras[robot](), 1 / self._fps[robot]
        began = self._began + period * list(self._cameras).index(robot) / len(self._cameras)
        number = int((time.monotonic() - began) / period) + 1
        while not self._ended.is_set():
            middle = began + number * period
            if self._ended.wait(max(0.0, middle + AFTER - time.monotonic())):
                return
            if robot not in self.frozen:
                pixels = camera.image(middle, number)
                connection.sendall(HEADER.pack(round(middle * 1e9), *pixels.shape) + pixels.tobytes())
            # who comes too late leaves frames out
            number = max(number + 1, int((time.monotonic() - AFTER - began) / period))
