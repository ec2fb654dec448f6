"""What the coordinator knows of each robot: whether it is there, how it is, where it is, and by which clock."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from coloc_graph.online.formation import Planar
from coloc_graph.online.odometry_restart import DROVE, JoinedOdometry
from coloc_graph.online.pose_tracker import PoseTracker
from coloc_graph.online.record import Record
from coloc_graph.robot_io.link.messages import Drive, Sample, Status, Wheels
from coloc_graph.run import Detections, OdometrySample
from coloc_graph.run.schemas import to_seconds

#: A robot that has said nothing of itself for this long is not there [s].
SILENT = 1.0
#: Samples whose times differ by less than this are the same one [s]: clocks are measured anew after a restart.
SAME = 0.005


@dataclass(eq=False)
class Member:
    """One robot of the team."""

    name: str
    whereabouts: PoseTracker
    to_coordinator: Callable[[int], int]
    odometry: JoinedOdometry = field(default_factory=JoinedOdometry)
    #: The odometry frame that its wheels' samples were in last.
    frame: str | None = None
    present: bool = False
    status: Status | None = None
    heard: float = -math.inf
    session: str | None = None
    #: Of the stance that is captured: how many samples came, and the time of the newest by the coordinator's clock.
    samples: int = 0
    newest: float = -math.inf
    #: What it was told to do last, whether it is there, and whether it stopped on the way.
    way: Drive | None = None
    arrived: bool = True
    stopped: bool = False
    #: What its wheels said up to then is recorded already [UTC s].
    recorded: float = -math.inf
    #: And what its camera saw.
    seen: float = -math.inf

    def trouble(self, *, drives: bool = False) -> str | None:
        """Why nothing can be done with it just now, in words."""
        if not self.present or self.status is None:
            return f"{self.name} is not there: start its program, or check the network"
        if time.monotonic() - self.heard > SILENT:
            return f"{self.name} has said nothing for {time.monotonic() - self.heard:.1f} s: check the network"
        if self.status.camera_fault:
            return f"{self.name}: {self.status.camera_fault}"
        if self.status.fault:
            return f"{self.name}: its wheels do not drive: {self.status.fault}"
        if not drives and self.status.hazards:
            return f"{self.name}, which stands, met {', '.join(self.status.hazards)}"
        return None

    def take_status(self, status: Status) -> bool:
        """Take in how it is; whether it is a new session, whose program began anew."""
        self.status, self.heard = status, time.monotonic()
        if status.session == self.session:
            return False
        self.session = status.session
        return True


class Roster:
    """The members of a team, and the record of all they send, in the coordinator's time [UTC s]."""

    def __init__(self, record: Record, starts: dict[str, Planar], clock_of: Callable[[str], Callable[[int], int]],
                 epoch: int) -> None:  # fmt: skip
        self.record, self.epoch = record, epoch
        self.members = {name: Member(name, PoseTracker(start), clock_of(name)) for name, start in starts.items()}

    def __getitem__(self, name: str) -> Member:
        return self.members[name]

    def utc(self, stamp: int) -> float:
        """An instant of the coordinator's clock [ns] as the record counts time [UTC s]."""
        return to_seconds(stamp + self.epoch)

    def take_wheels(self, name: str, wheels: Wheels) -> None:
        """Take in where a robot's wheels say it is; what is recorded already is not taken twice."""
        member = self.members[name]
        sample = wheels.sample(name, self.utc(member.to_coordinator(wheels.stamp)))
        if sample.time <= member.recorded:
            x, y, yaw = map(float, sample.pose)
            member.odometry.align((x, y, yaw))
            return
        if member.frame is not None and wheels.frame != member.frame:
            member.odometry.restart(moving=member.status is None or member.status.moving)
        member.frame = wheels.frame
        kept = self.record.take(member.odometry.take(sample))
        assert isinstance(kept, OdometrySample)
        member.whereabouts.take(kept)

    def go_on(self) -> None:
        """After a coordinator began anew: go on from what is recorded of all wheels."""
        for name, member in self.members.items():
            for detections in self.record.detections(name, 0.0, math.inf):
                member.seen = detections.time + SAME
            for sample in self.record.odometry(name):
                member.whereabouts.take(sample)
                member.recorded = sample.time + SAME
            if (last := self.record.last_odometry(name)) is not None:
                x, y, yaw = map(float, last.pose)
                member.odometry.go_on((x, y, yaw), DROVE)

    def carried(self, name: str, place: Planar) -> None:
        """A robot that stands was moved by what its wheels do not know, to a place in the world."""
        member = self.members[name]
        member.odometry.carried()
        member.whereabouts.carry(self.utc(time.monotonic_ns()), place)

    def take_sample(self, name: str, sample: Sample) -> Detections | None:
        """Take in what a robot's camera saw; None where it is recorded already."""
        member = self.members[name]
        if self.utc(member.to_coordinator(sample.stamp)) <= member.seen:
            return None
        seen = self.record.take(sample.detections(name, self.utc(member.to_coordinator(sample.stamp))))
        assert isinstance(seen, Detections)
        return seen

    def places(self) -> dict[str, Planar]:
        """Where all robots are now, in the world."""
        return {name: member.whereabouts.place() for name, member in self.members.items()}
