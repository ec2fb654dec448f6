"""Program of one robot: it detects markers, counts its wheels, and drives on command; `RobotProgram`."""

import contextlib
import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from coloc_graph.errors import CameraError, ColocError, InputError, RobotError
from coloc_graph.geometry.se2 import compose
from coloc_graph.machine import machine
from coloc_graph.online.devices import Devices
from coloc_graph.online.encoder_log import Counted, EncoderLog, way_since
from coloc_graph.online.motion import Follower
from coloc_graph.online.odometry_restart import JoinedOdometry
from coloc_graph.online.record import Record
from coloc_graph.robot_io.camera.source import CameraSource, Frame, clock_ahead
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.robot_io.deadlines import PERMISSION_LEASE
from coloc_graph.robot_io.link.messages import (
    Body,
    Capture,
    Drive,
    EndCapture,
    Event,
    Halt,
    Recover,
    Sample,
    Status,
    Wheels,
)
from coloc_graph.robot_io.link.robot_link import RobotLink
from coloc_graph.robot_io.link.zenoh_config import Tls
from coloc_graph.run import Detections, OdometrySample
from coloc_graph.run.schemas import to_seconds
from coloc_graph.team import Team

log = logging.getLogger(__name__)

CONTROL_PERIOD = 0.04  # time between two steps of control [s]
REPORT_PERIOD = 0.1  # time between two status messages [s]
NO_IMAGE = 1.0  # a camera without an image for this time has a fault [s]
REOPEN_PERIOD = 1.0  # time between two attempts to open a lost camera, or lost wheels [s]


class RobotProgram:
    """Program of one robot; a context manager, at whose end the wheels stand.

    Parameters
    ----------
    name, team
        Name of the robot, and its team.
    connect
        Address of the coordinator.
    folder
        Folder for its own record, in the time of its own clock.
    camera
        Source of images; None for that of the team's description.
    wheels, model
        Serial port and model of its Create; None for those of the team's description. A robot without wheels only
        observes.
    tls
        Its certificate.
    clock
        Its monotonic clock [ns].
    devices
        Its devices; others than the real ones in a simulation.

    Raises
    ------
    InputError, CameraError, RobotError
        If it cannot begin.
    """

    def __init__(
        self,
        name: str,
        team: Team,
        *,
        connect: str,
        folder: str | Path,
        camera: str | None = None,
        wheels: str | None = None,
        model: int | None = None,
        tls: Tls | None = None,
        clock: Callable[[], int] = machine.monotonic_ns,
        devices: Devices | None = None,
    ) -> None:
        self.robot, self.team, self._clock = team[name], team, clock
        self.name = name
        opened, described = devices or Devices(), self.robot.devices
        spec = camera or (described.camera if described else None)
        if spec is None:
            raise InputError(f"robot {name} has no camera: give one with --camera, or in team.toml under devices")
        port = wheels or (described.wheels if described else None)
        model = model or (described.model if described else None)
        self.session = machine.unique()
        self._epoch = machine.time_ns() - clock()  # fixed: steps of the system's clock are not ours
        self._lock = machine.new_lock()
        self._ended = machine.new_event()
        self._capture: int | None = None
        self._seen = self._samples = self._rolled = self._events = self._drive = 0
        self._follower: Follower | None = None
        self._still_since: int | None = clock()
        self._odometry, self._frame = JoinedOdometry(), self.session
        self._opening = False
        self._crowded = False  # True once an image had more lights than are measured
        self._encoder_log = EncoderLog(Path(folder) / f"{name}.wheels.json")
        self._pose = (0.0, 0.0, 0.0)
        self._wheels_fault: str | None = None
        self._camera_fault: str | None = None
        colours = {robot.markers.hue_deg for robot in team.robots if robot.markers and robot.name != name}
        watched = next((robot.markers for robot in team.robots if robot.markers and robot.name != name), None)
        if len(colours) > 1:
            raise InputError(
                "the robots' markers have several colours, but a robot's program detects one: give all the same hue"
            )
        self._detect = opened.detector(watched, self.robot.camera)
        with contextlib.ExitStack() as undo:
            undo.callback(self._encoder_log.close)
            self._camera: CameraSource = undo.enter_context(opened.camera(spec, self.robot.camera, name, clock))
            self._wheels: Create | None = None
            if port is not None:
                self._wheels = undo.enter_context(opened.wheels(port, model, robot=name, epoch=0.0))
                self._wheels_fault = self._wheels.fault
                self._go_on_counting()
            self._record = undo.enter_context(Record(_new_file(Path(folder), name), team))
            self._link = undo.enter_context(
                RobotLink(
                    name,
                    connect=connect,
                    handler=self._obey,
                    session=self.session,
                    tls=tls,
                    clock=clock,
                    open_session=opened.session,
                )
            )
            self._watcher = machine.new_thread(target=self._watch, name=f"camera of {name}")
            self._watcher.start()
            undo.callback(self._end)
            self._close = undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close.__exit__(kind, error, trace)

    def _end(self) -> None:
        self._ended.set()
        self._halt()
        self._watcher.join(2.0)

    def run(self, stop: threading.Event, *, on_step: Callable[[], None] | None = None) -> None:
        """Control the wheels and report, until `stop` is set; `on_step` is called in each step."""
        report, reopened = 0.0, 0.0
        while not stop.wait(CONTROL_PERIOD):
            if self._link.refused is not None:
                raise RobotError(self._link.refused)
            self._roll()
            if on_step is not None:
                on_step()
            now = machine.monotonic()
            wheels = self._wheels
            if wheels is not None and wheels.lost and not wheels.awaits_port and now - reopened > REOPEN_PERIOD:
                reopened = now
                machine.new_thread(target=self._reopen_wheels, name=f"wheels of {self.name}").start()
            if now - report >= REPORT_PERIOD:
                report = now
                self._link.put(self._status())

    def _obey(self, body: Body) -> str:
        """Carry out a command and return the answer for the coordinator. Raises `RobotError` if it cannot."""
        with self._lock:
            match body:
                case Capture(capture=capture):
                    self._capture, self._seen = capture, 0
                case EndCapture():
                    self._capture = None
                    return str(self._seen)
                case Drive():
                    self._set_off(Follower(body.places, body.yaw, body.speed, backwards=body.backwards), body.number)
                case Halt():
                    self._halt()
                case Recover():
                    self._recover()
        return ""

    def _set_off(self, follower: Follower, number: int) -> None:
        if self._wheels is None:
            raise RobotError(f"robot {self.name} has no wheels: give their port with --wheels")
        if self._wheels_fault is not None:
            raise RobotError(f"robot {self.name} does not drive: {self._wheels_fault}")
        self._follower, self._drive = follower, number

    def _halt(self) -> None:
        with self._lock:
            self._follower = None
            if self._wheels is not None:
                with contextlib.suppress(RobotError):
                    self._wheels.stop()

    def _recover(self) -> None:
        self._follower = None
        if self._wheels is not None and not self._wheels_lost:
            self._wheels.recover()
            self._wheels_fault = self._wheels.fault

    @property
    def _wheels_lost(self) -> bool:
        return self._wheels is not None and self._wheels.lost

    def _reopen_wheels(self) -> None:
        """Open the wheels' line again after it was lost."""
        wheels = self._wheels
        assert wheels is not None
        with contextlib.suppress(ColocError):
            wheels.close()
            with self._lock:
                for sample in wheels.take_odometry():
                    self._take(self._odometry.take(sample))
                self._opening = True
            wheels.open()
            with self._lock:
                self._go_on_counting()
            self._wheels_fault = wheels.fault
            self._tell("recovered", "the line to the wheels is back")
        self._opening = False

    def _go_on_counting(self) -> None:
        """Join the odometry of a newly opened line to what was counted before, also by an earlier program."""
        assert self._wheels is not None
        before, ticks = self._encoder_log.read(), self._wheels.state.ticks
        since = way_since(before, ticks) if before is not None and ticks is not None else None
        if before is None or since is None:
            self._odometry, self._frame = JoinedOdometry(), machine.unique()
            return
        self._frame = before.frame
        self._odometry.go_on(compose(before.pose, since[0]), since[1])

    def _roll(self) -> None:
        """Do one step of control: take in odometry, then steer or stop."""
        wheels = self._wheels
        if wheels is None or self._opening:
            return
        with self._lock:
            for sample in wheels.take_odometry():
                self._take(self._odometry.take(sample))
            fault = wheels.fault
            if fault is not None and fault != self._wheels_fault:
                self._tell("fault", fault)
            self._wheels_fault = fault
            moving = self._follower is not None or wheels.moving
            self._record.moves(self.name, self._utc(self._clock()), moving)
            if moving:
                self._still_since = None
            elif self._still_since is None:
                self._still_since = self._clock()
            if self._follower is None:
                return
            if machine.monotonic_ns() - self._link.last_heard > PERMISSION_LEASE * 1e9:
                self._halt()
                self._tell("stopped", f"no permission from the coordinator for {PERMISSION_LEASE} s")
                return
            try:
                twist = self._follower.step(*self._pose)
                if twist is None:
                    self._halt()
                    self._tell("arrived", str(self._drive))
                else:
                    wheels.drive(twist.v, twist.w, granted=self._link.last_heard * 1e-9)
            except RobotError as error:
                self._halt()
                self._wheels_fault = wheels.fault
                self._tell("fault", str(error))

    def _take(self, sample: OdometrySample) -> None:
        self._pose = tuple(map(float, sample.pose))  # type: ignore[assignment]
        stamp = round(sample.time * 1e9) + clock_ahead(self._clock)
        self._link.put(Wheels.of(sample, session=self.session, number=self._rolled, stamp=stamp, frame=self._frame))
        if self._wheels is not None and not self._wheels.lost and (ticks := self._wheels.state.ticks) is not None:
            self._encoder_log.write(Counted(self._frame, ticks, self._pose))
        self._rolled += 1
        self._record.take(replace(sample, time=self._utc(stamp)))

    def _watch(self) -> None:
        """Camera's thread: detect markers in each image while a stance is captured, and watch for faults."""
        reopened = 0.0
        while not self._ended.is_set():
            try:
                frame = self._camera.read(NO_IMAGE)
                self._camera_fault = None
            except CameraError as error:
                self._camera_fault = str(error)
                if self._camera.fault is not None and machine.monotonic() - reopened > REOPEN_PERIOD:
                    reopened = machine.monotonic()
                    with contextlib.suppress(CameraError):
                        self._camera.reopen()
                self._ended.wait(0.05)
                continue
            if self._capture is not None:
                try:
                    self._see(frame)
                except Exception as error:  # a full disk, a fault of ours: the coordinator must hear of it
                    log.exception("an image came to nothing")
                    self._camera_fault = f"its images come to nothing ({error}): see its log"
                    self._ended.wait(NO_IMAGE)

    def _see(self, frame: Frame) -> None:
        """Send and record the markers in an image."""
        blobs, stamp = self._detect(frame.pixels), frame.stamp_ns
        if blobs.left_out and not self._crowded:
            self._crowded = True
            self._tell(
                "lights",
                f"an image has {blobs.left_out} lights more than are measured, and the smallest are left out: darken "
                "the room, or lower exposure and gain",
            )
        seen = Detections(
            self.name, self._utc(stamp), blobs.uv, blobs.covariance, ("",) * len(blobs.uv),
            blobs.flags, blobs.peak, blobs.area,
        )  # fmt: skip
        with self._lock:
            if self._capture is not None:
                number, capture = self._samples, self._capture
                self._link.put(Sample.of(seen, session=self.session, number=number, capture=capture, stamp=stamp))
                self._record.take(seen)
                self._samples += 1
                self._seen += 1

    def _utc(self, stamp: int) -> float:
        return to_seconds(stamp + self._epoch)

    def _tell(self, kind: str, text: str) -> None:
        log.info("%s: %s %s", self.name, kind, text)
        with self._lock:
            self._link.put(Event(session=self.session, number=self._events, stamp=self._clock(), kind=kind, text=text))
            self._events += 1

    def _status(self) -> Status:
        with self._lock:
            hazards: list[str] = []
            if self._wheels is not None:
                with contextlib.suppress(RobotError):
                    hazards = list(self._wheels.state.hazards().values())
            phase = "driving" if self._follower else "idle" if self._capture is None else "capturing"
            return Status(
                session=self.session,
                stamp=self._clock(),
                phase=phase,
                capture=self._capture,
                moving=self._still_since is None,
                still_since=self._still_since,
                fault=self._wheels_fault,
                camera_fault=self._camera_fault,
                hazards=hazards,
            )


def _new_file(folder: Path, name: str) -> Path:
    """Return a path for the robot's record that does not exist yet: a restarted program overwrites nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    return next(path for n in range(100_000) if not (path := folder / f"{name}-{n}.mcap").exists())
