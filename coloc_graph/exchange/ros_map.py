"""Read MAP.toml, which assigns the topics of a ROS bag to robots; docs/ros.md shows one."""

import math
from pathlib import Path
from typing import Literal

import msgspec

from coloc_graph.errors import BagError
from coloc_graph.exchange.ros_bag import full_name
from coloc_graph.exchange.stances import MotionThresholds
from coloc_graph.input_file import convert, read_toml
from coloc_graph.team import Team, read_team

#: From what it is known when a robot moves.
MotionSource = Literal["odometry", "stands", "moves"]


class OdometrySigmas(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations of odometry, which grow with the root of the distance.

    `along` and `across` [m] are of the position after one metre, ahead and sideways; `turned` [rad] is of the heading
    after a rotation by one radian, `veer` [rad] after one metre.
    """

    along: float
    turned: float
    veer: float
    across: float = 0.0

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"`{name}` is {value}; give a number that is not negative")


class RobotTopics(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Topics of one robot, None if the bag has none.

    Attributes
    ----------
    rectified
        True if the images are rectified, so that the camera is P of its camera_info without distortion.
    ranges
        Topics of ranges by target: another robot, or a landmark of the team.
    truth_tf
        Two frames of tf whose transform is T_world_body: world, body.
    motion
        Source of the robot's motion: its `odometry`, or it always `stands` or always `moves`.
    """

    name: str
    image: str | None = None
    camera_info: str | None = None
    rectified: bool = False
    odometry: str | None = None
    odometry_sigmas: OdometrySigmas | None = None
    ranges: dict[str, str] = {}
    truth: str | None = None
    truth_tf: tuple[str, str] | None = None
    motion: MotionSource = "odometry"

    def __post_init__(self) -> None:
        if self.truth is not None and self.truth_tf is not None:
            raise ValueError("`truth` and `truth_tf` are both there; give one of them")
        if self.motion == "odometry" and self.odometry is None:
            raise ValueError(
                f"when `{self.name}` moves is not known: give its `odometry`, or say that it always "
                '`motion = "stands"` or `motion = "moves"`'
            )
        if self.rectified and self.camera_info is None:
            raise ValueError("`rectified` is true and there is no `camera_info`; give it, or leave `rectified` out")
        if self.odometry_sigmas is not None and self.odometry is None:
            raise ValueError("there are `odometry_sigmas` and no `odometry`; give it, or leave them out")

    @property
    def topics(self) -> dict[str, str]:
        """Topics by kind: image, camera_info, odometry, truth, and `range of` each target."""
        every = {kind: getattr(self, kind) for kind in ("image", "camera_info", "odometry", "truth")}
        every |= {f"range of {target}": topic for target, topic in self.ranges.items()}
        return {kind: topic for kind, topic in every.items() if topic is not None}


class RosMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Map of the topics of a ROS bag.

    Attributes
    ----------
    team
        Path of a team.toml, relative to the map.
    time
        Source of a message's time: its header stamp, or its reception.
    motion
        Thresholds of motion and of stances.
    """

    team: str
    robots: tuple[RobotTopics, ...]
    time: Literal["header", "bag"] = "header"
    motion: MotionThresholds = MotionThresholds()

    def __post_init__(self) -> None:
        names = [robot.name for robot in self.robots]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"robot `{twice[0]}` is there twice; give each robot once, with all of its topics")
        if not any(robot.topics for robot in self.robots):
            raise ValueError("no robot has a topic; give at least two robots, under [[robots]], with their topics")
        used: dict[str, str] = {}
        for robot in self.robots:
            for kind, topic in robot.topics.items():
                if topic in used:
                    raise ValueError(f"{topic} is there twice, as {used[topic]} and as {kind} of {robot.name}")
                used[topic] = f"{kind} of {robot.name}"


def _with_full_names(robot: RobotTopics) -> RobotTopics:
    ranges = {target: full_name(topic) for target, topic in robot.ranges.items()}
    named = {kind: full_name(topic) for kind, topic in robot.topics.items() if not kind.startswith("range of ")}
    return msgspec.structs.replace(robot, ranges=ranges, **named)


def read_map(path: str | Path) -> tuple[RosMap, Team]:
    """Read a map and its team; `BagError` (`TeamError` for the team) names the file and the path in it."""
    path = Path(path)
    fields = read_toml(path, "give the path of a map, see docs/ros.md", error=BagError)
    found = convert(path, fields, RosMap, "see docs/ros.md for the fields", error=BagError)
    try:
        found = msgspec.structs.replace(found, robots=tuple(map(_with_full_names, found.robots)))
    except ValueError as error:
        raise BagError(f"{path}: {error}; see docs/ros.md for the fields") from error
    if "\0" in found.team:
        raise BagError(f"{path}: `team` is no path; give the path of a team.toml")
    team = read_team(path.parent / found.team)
    for number, robot in enumerate(found.robots):
        if robot.name not in team.names:
            raise BagError(
                f"{path}: robot `{robot.name}` is not in the team ({', '.join(team.names)}) - at "
                f"`$.robots[{number}].name`; correct the name, or add the robot to {found.team}"
            )
        known = {*team.names, *(one.name for one in team.landmarks)} - {robot.name}
        if unknown := [target for target in robot.ranges if target not in known]:
            raise BagError(
                f"{path}: `{unknown[0]}` is no other robot or landmark of the team - at `$.robots[{number}].ranges`; "
                f"correct the name, or add it to {found.team}"
            )
    return found, team
