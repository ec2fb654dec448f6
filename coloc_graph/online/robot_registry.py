"""State of each robot as the coordinator knows it: presence, status, pose, clock; `RobotRegistry`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from coloc_graph.geometry.se2 import Planar
from coloc_graph.machine import machine
from coloc_graph.measurements import Sighting
from coloc_graph.online.odometry_restart import DROVE, JoinedOdometry
from coloc_graph.online.pose_tracker import PoseTracker
from coloc_graph.online.record import Record
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.robot_io.link.messages import Drive, Event, Sample, Status, Wheels
from coloc_graph.robot_io.link.session import CACHED
from coloc_graph.run import Detections, OdometrySample
from coloc_graph.run.schemas import to_seconds

SILENT = 1.0  # a robot without a status message for this time is taken for absent [s]
SAME = 0.005  # samples closer in time are the same one: clocks are compared anew after a restart [s]


@dataclass(eq=False)
class RobotState:
    """State of one robot.

    Attributes
    ----------
    name
        Name of the robot.
    tracker
        Its pose in the world.
    to_coordinator
        Converts its stamps [ns] to the coordinator's clock [ns].
    status_times
        When the newest status of each robot came [s, monotonic clock], even where it has not been taken in yet.
    odometry
        Joins its odometry across restarts.
    frame
        Odometry frame of its newest sample.
    present
        True while its program is connected.
    status, session
        Newest status message, and its program's session.
    drive, arrived, interrupted
        Last drive command, whether it has been completed, and whether the robot stopped on the way.
    odometry_until, detections_until
        Odometry, and images without lights, up to these times are in the record already [UTC s].
    recorded
        Pixels of the images that are in the record already: noise makes each another one, whatever the clocks.
    """

    name: str
    tracker: PoseTracker
    to_coordinator: Callable[[int], int]
    status_times: Mapping[str, float]
    odometry: JoinedOdometry = field(default_factory=JoinedOdometry)
    frame: str | None = None
    present: bool = False
    status: Status | None = None
    session: str | None = None
    drive: Drive | None = None
    arrived: bool = True
    interrupted: bool = False
    odometry_until: float = -math.inf
    detections_until: float = -math.inf
    recorded: set[bytes] = field(default_factory=set)

    def trouble(self, *, drives: bool = False) -> str | None:
        """Describe what keeps the robot from taking part; None if nothing does. Hazards do not stop one that drives."""
        if not self.present or self.status is None:
            return f"{self.name} is not there: start its program, or check the network"
        silent = machine.monotonic() - self.status_times.get(self.name, -math.inf)
        if silent > SILENT:
            return f"{self.name} has sent nothing for {silent:.1f} s: check the network"
        if self.status.camera_fault:
            return f"{self.name}: {self.status.camera_fault}"
        if self.status.fault:
            return f"{self.name}: its wheels do not drive: {self.status.fault}"
        if not drives and self.status.hazards:
            return f"{self.name}, which stands, met {', '.join(self.status.hazards)}"
        return None

    def take_status(self, status: Status) -> bool:
        """Take in a status message; return whether its session is a new one: the robot's program was restarted."""
        self.status = status
        if status.session == self.session:
            return False
        self.session = status.session
        return True

    def take_event(self, event: Event) -> None:
        """Take in an event: the end of a drive, or a stop on the way."""
        self.arrived |= self.drive is not None and (event.kind, event.text) == ("arrived", str(self.drive.number))
        self.interrupted |= event.kind in ("stopped", "fault")

    def stands_since(self) -> int | None:
        """Time since when it stands, by the coordinator's clock [ns]; None if it moves, or nothing is known."""
        since = self.status.still_since if self.status is not None else None
        return None if since is None else self.to_coordinator(since)


class RobotRegistry:
    """States of a team's robots; writes all that they send into the record, in the coordinator's time [UTC s].

    Parameters
    ----------
    record
        Record of the mission.
    starts
        Pose of each robot in the world at the beginning (x [m], y [m], yaw [rad]).
    clock_of
        Returns the conversion of a robot's stamps to the coordinator's clock.
    epoch
        UTC minus the coordinator's monotonic clock [ns].
    status_times
        When the newest status of each robot came [s, monotonic clock].
    """

    def __init__(
        self,
        record: Record,
        starts: dict[str, Planar],
        clock_of: Callable[[str], Callable[[int], int]],
        epoch: int,
        status_times: Mapping[str, float],
    ) -> None:
        self.record, self.epoch = record, epoch
        self.robots = {
            name: RobotState(name, PoseTracker(start), clock_of(name), status_times) for name, start in starts.items()
        }

    def __getitem__(self, name: str) -> RobotState:
        return self.robots[name]

    def utc(self, stamp: int | None = None) -> float:
        """Convert an instant of the coordinator's clock [ns], by default now, to the record's time [UTC s]."""
        return to_seconds((machine.monotonic_ns() if stamp is None else stamp) + self.epoch)

    def take_wheels(self, name: str, wheels: Wheels) -> None:
        """Take in a sample of odometry, unless it is recorded already."""
        robot = self.robots[name]
        sample = wheels.sample(name, self.utc(robot.to_coordinator(wheels.stamp)))
        if sample.time <= robot.odometry_until:
            x, y, yaw = map(float, sample.pose)
            robot.odometry.align((x, y, yaw))
            return
        if robot.frame is not None and wheels.frame != robot.frame:
            robot.odometry.restart(moving=robot.status is None or robot.status.moving)
        robot.frame = wheels.frame
        kept = self.record.take(robot.odometry.take(sample))
        assert isinstance(kept, OdometrySample)
        robot.tracker.add(kept)

    def take_sample(self, name: str, sample: Sample) -> Detections | None:
        """Take in the detections of one image; return them as recorded, None if they are recorded already."""
        robot = self.robots[name]
        new = sample.detections(name, self.utc(robot.to_coordinator(sample.stamp)))
        if new.uv.tobytes() in robot.recorded if len(new.uv) else new.time <= robot.detections_until:
            return None
        seen = self.record.take(new)
        assert isinstance(seen, Detections)
        return seen

    def restore(self) -> None:
        """Continue from what an earlier coordinator recorded of all robots."""
        for name, robot in self.robots.items():
            images = list(self.record.detections(name, 0.0, math.inf))[-CACHED:]
            robot.recorded = {image.uv.tobytes() for image in images}
            robot.detections_until = images[-1].time + SAME if images else -math.inf
            for sample in self.record.odometry(name):
                robot.tracker.add(sample)
                robot.odometry_until = sample.time + SAME
            if (last := self.record.last_odometry(name)) is not None:
                x, y, yaw = map(float, last.pose)
                robot.odometry.go_on((x, y, yaw), DROVE)

    def displace(self, name: str, pose: Planar) -> None:
        """Set the pose of a robot that was moved while it stood, which its wheels cannot tell."""
        robot = self.robots[name]
        robot.odometry.carried()
        robot.tracker.displace(self.utc(), pose)

    def follow(self, entered: EnteredStance) -> None:
        """Set the poses of the robots that a stance's estimate has newly found."""
        sighted = {m.seen: m.time for m in entered.measurements if isinstance(m, Sighting)}
        standing = {*entered.stance.observers, *entered.stance.anchors}
        for name, pose in entered.estimate.poses.items():
            if name in standing or name in sighted:
                T = pose.matrix()
                planar = float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])
                self.robots[name].tracker.fix(sighted.get(name, entered.stance.start), planar)

    def poses(self, names: Sequence[str] | None = None) -> dict[str, Planar]:
        """Return the present poses in the world, of all robots by default."""
        return {name: self.robots[name].tracker.pose() for name in names or self.robots}

    def stand_since(self, time: float, names: Sequence[str]) -> tuple[str, ...]:
        """Return those of some robots that have not moved since an instant [UTC s], by their wheels or otherwise."""
        return tuple(name for name in names if not self.robots[name].tracker.moved_since(time))

    def stood(self, seconds: float) -> bool:
        """Return whether all robots have stood for `seconds` [s]."""
        since = [robot.stands_since() for robot in self.robots.values()]
        now = machine.monotonic_ns()
        return all(one is not None and now - one >= seconds * 1e9 for one in since)
