"""Robots on a floor in simulated time: wheels behind a line, and cameras that see markers; `Field`."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from coloc_graph.errors import RobotError
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.geometry.se2 import Planar
from coloc_graph.missions.scheduler import Process, Scheduler
from coloc_graph.missions.watchdog import SimulatedWatchdog
from coloc_graph.robot_io.camera.source import WAIT, CameraSource, Clock, Frame
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.firmware import Firmware
from coloc_graph.robot_io.create.line import LEAVE, READ, RETURN_PERIOD
from coloc_graph.robot_io.create.physics import Physics
from coloc_graph.robot_io.create.state import STREAMED
from coloc_graph.simulation.rig import true_team
from coloc_graph.simulation.uneven_floor import UnevenFloor
from coloc_graph.simulation.world import stream
from coloc_graph.team import Camera, Team
from coloc_graph.team.shared_view import View

DELIVERY = 0.008  # time from the middle of an exposure to its frame [s]
REACH = 4.0  # markers further away are too faint [m]
STEP = 0.01  # time step of the physics [s]
FRAMES_AT_ONCE = 2  # further frames of which only the newest is read, to save time


class Field:
    """True robots of a team; what is true is drawn from the team's tolerances.

    Parameters
    ----------
    scheduler
        Simulated time.
    team
        The team as it is described.
    starts
        Poses of the robots at the beginning (x [m], y [m], yaw [rad]).
    seed
        Seed of all that is drawn.

    Attributes
    ----------
    unplugged, frozen
        Robots whose serial line, and whose camera, does nothing.
    lines
        The line that was opened last to each robot's wheels.
    """

    def __init__(self, scheduler: Scheduler, team: Team, starts: Mapping[str, Planar], seed: int) -> None:
        self.scheduler, self.team = scheduler, team
        self.true_team = true_team(team, stream(seed, "team"))
        sigma = math.radians(team.floor.tilt_sigma_deg) if team.floor else 0.0
        self.robots = {
            name: Firmware(
                2,
                Physics(seed=int(stream(seed, "wheels", n).integers(1 << 31)), start=starts[name], step=STEP),
                (0, 0),
                1e-9 * scheduler.now,
            )
            for n, name in enumerate(team.names)
        }
        self._floor = UnevenFloor(sigma, stream(seed, "floor"))
        self.unplugged: set[str] = set()
        self.frozen: set[str] = set()
        self.lines: dict[str, SimulatedLine] = {}
        self._rng = np.random.default_rng((seed, 7))
        self._mounts = {robot.name: robot.mount.T_body_camera for robot in self.true_team.robots}
        self._markers = {
            robot.name: robot.markers.p_body if robot.markers else np.zeros((0, 3)) for robot in self.true_team.robots
        }

    def poses(self) -> dict[str, Planar]:
        """Return the true poses now: x, y [m], yaw [rad]."""
        now, poses = 1e-9 * self.scheduler.now, {}
        for name, robot in self.robots.items():
            robot.advance(now)
            body, left = robot.body, now - robot.body.time
            v, w = sum(body.speeds) / 2, (body.speeds[1] - body.speeds[0]) / body.base
            yaw = body.yaw + w * left
            poses[name] = body.x + v * left * math.cos(yaw), body.y + v * left * math.sin(yaw), yaw
        return poses

    def fastest(self, name: str) -> float:
        """Return the speed of a robot's faster wheel [m/s]."""
        robot = self.robots[name]
        robot.advance(1e-9 * self.scheduler.now)
        left, right = robot.body.speeds
        return max(abs(left), abs(right))

    def open_line(self, name: str, process: Process) -> "Callable[[str, int | None], SimulatedLine]":
        """Return what opens the line to a robot's wheels in a process."""
        return lambda port, model: SimulatedLine(self, name, process)

    def open_camera(self, process: Process) -> Callable[[str, Camera, str, Clock], CameraSource]:
        """Return what opens a robot's camera in a process."""

        def opened(spec: str, camera: Camera, robot: str, clock: Clock) -> CameraSource:
            text = f"the camera of robot {robot} ({spec})"
            return CameraSource(text, camera, lambda: _FieldCamera(self, robot, text, camera, clock))

        return opened

    def blobs(self, robot: str, poses: Mapping[str, Planar]) -> Blobs:
        """Return the markers that a robot's camera sees of the others."""
        camera = self.true_team[robot].camera
        T_world_body = dict(zip(poses, self._floor.pose(list(poses.values())), strict=True))
        view = View(camera, T_world_body[robot] @ self._mounts[robot])
        points = []
        for name, T in T_world_body.items():
            if name != robot and np.hypot(*(T[:2, 3] - T_world_body[robot][:2, 3])) < REACH:
                points.append(self._markers[name] @ T[:3, :3].T + T[:3, 3])
        uv, inside = view.project(np.concatenate([np.zeros((0, 3)), *points]))
        uv = uv[inside]
        sigma = camera.noise_px
        uv = uv + sigma * self._rng.standard_normal(uv.shape)
        n = len(uv)
        covariance = np.broadcast_to(sigma**2 * np.eye(2), (n, 2, 2))
        return Blobs(uv, covariance, np.zeros(n, np.uint8), np.full(n, 200.0), np.full(n, 9.0))


class Glimpse:
    """An image that is not drawn: true poses in the middle of its exposure."""

    def __init__(self, field: Field, robot: str, shape: tuple[int, int]) -> None:
        self._field, self._robot, self.shape, self._poses = field, robot, shape, field.poses()

    def blobs(self) -> Blobs:
        """Return the markers in it."""
        return self._field.blobs(self._robot, self._poses)


def detector(*_: Any) -> Callable[[Glimpse], Blobs]:
    """Return the detector of markers in glimpses."""
    return Glimpse.blobs


class _FieldCamera:
    """A camera's device; all cameras expose together, but for the scheduler's lateness."""

    def __init__(self, field: Field, robot: str, name: str, camera: Camera, clock: Clock) -> None:
        self._field, self._robot, self._name, self._clock = field, robot, name, clock
        self._shape, self._period = (camera.height, camera.width), 1 / (camera.fps or 30.0)

    def grab(self) -> Frame | None:
        """Return the next frame."""
        wait = self._field.scheduler.wait
        if self._robot in self._field.frozen:
            wait(WAIT)
            return None
        now = 1e-9 * self._field.scheduler.now
        wait((math.floor(now / self._period) + 1) * self._period - now)
        stamp, glimpse = self._clock(), Glimpse(self._field, self._robot, self._shape)
        wait(DELIVERY)
        pixels: Any = glimpse
        return Frame(stamp, pixels)

    def close(self) -> None:
        """Do nothing."""


class SimulatedLine:
    """The line to a robot's wheels, with a watchdog process beside it, as `create.line.Line` has them."""

    def __init__(self, field: Field, robot: str, process: Process) -> None:
        self._field, self._robot, self._port = field, robot, robot
        self.model, self.layouts = 2, [STREAMED[2]]
        self.lost: str | None = None
        self._good = 0
        if robot in field.unplugged:
            raise RobotError(f"cannot open the line of {robot}: check that it is plugged in, free and yours")
        self.send(bytes([oi.START]) + oi.stream(self.layouts[0]))
        self._watchdog = SimulatedWatchdog(field.scheduler, process, self._halt)
        field.lines[robot] = self

    def send(self, data: bytes) -> None:
        """Write these bytes."""
        if self._robot in self._field.unplugged:
            self.lost = self.lost or "unplugged"
        if self.lost is not None:
            raise RobotError(f"the line on {self._port} is lost ({self.lost}): check the cable and open it again")
        self._field.robots[self._robot].take(data, 1e-9 * self._field.scheduler.now)

    def read(self) -> list[dict[int, int]]:
        """Return the frame that comes next, if one comes within `READ`."""
        robot, scheduler = self._field.robots[self._robot], self._field.scheduler
        due = robot.next_frame + FRAMES_AT_ONCE * oi.STREAM_PERIOD - 1e-9 * scheduler.now
        scheduler.wait(min(max(due, 0.0), READ) if robot.streaming else READ)
        if self.lost is not None or self._robot in self._field.unplugged:
            self.lost = self.lost or "unplugged"
            raise RobotError(f"the line on {self._port} is lost ({self.lost}): check the cable, open it again")
        now = 1e-9 * scheduler.now
        robot.advance(now)
        values = robot.frame(now)
        self._good += values is not None
        return [values] if values is not None else []

    def permit(self, until: float | None) -> None:
        """Tell the watchdog until when the wheels may turn [s, monotonic]."""
        self._watchdog.permit(until)

    def beat(self) -> None:
        """Show the watchdog that the driver runs."""
        self._watchdog.beat()

    @property
    def watchdog_silence(self) -> float:
        """Time for which the watchdog has not answered [s]."""
        return self._watchdog.silence

    @property
    def frames(self) -> tuple[int, int]:
        """Counts of valid and of damaged frames."""
        return self._good, 0

    def stop_when_back(self, ended: Any) -> None:
        """Stop the robot as soon as its line comes back."""
        self.close()
        while not ended.wait(RETURN_PERIOD):
            if self._robot not in self._field.unplugged:
                self._field.robots[self._robot].take(LEAVE, 1e-9 * self._field.scheduler.now)
                return

    def close(self) -> None:
        """Close the line."""
        self.lost = self.lost or "closed"
        self._watchdog.end()

    def _halt(self, data: bytes) -> None:
        if self._robot not in self._field.unplugged:
            self._field.robots[self._robot].take(data, 1e-9 * self._field.scheduler.now)
