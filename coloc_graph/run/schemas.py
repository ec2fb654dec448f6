"""Format of a run: topics, their messages on disk, and times.

docs/run-format.md is the specification; this file and it change together.
"""

import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec

from coloc_graph.errors import RunError
from coloc_graph.team import Team

PROFILE_PREFIX = "coloc-graph-run-"  # of the MCAP profile, followed by the format
FORMAT = 1  # that this version writes and reads
LIBRARY = "coloc-graph"  # MCAP's name of the program that wrote a file

TEAM_TOPIC = "/team"
TRUE_TEAM_TOPIC = "/truth/team"
STANCE_TOPIC = "/stance"
PLANES_TOPIC = "/planes"
CLOCKS_TOPIC = "/clocks"

RAW_IMAGE = "foxglove.RawImage"
COMPRESSED_IMAGE = "foxglove.CompressedImage"
POSE_IN_FRAME = "foxglove.PoseInFrame"

FlagName = Literal["saturated", "clipped", "merged", "blurred"]


class Wire(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of the JSON messages. Their time is the message's log time and is not repeated in them."""


class DetectionsWire(Wire, frozen=True):
    """Columns over the markers of one image; `covariance` rows are (uu, uv, vv) [px^2]."""

    u: list[float]
    v: list[float]
    covariance: list[tuple[float, float, float]]
    marker: list[str]
    flags: list[list[FlagName]]
    peak: list[float]
    area: list[float]


class OdometryWire(Wire, frozen=True):
    """x, y [m], yaw [rad] in the robot's odometry frame; covariance of the increment since the last."""

    x: float
    y: float
    yaw: float
    covariance: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class RangesWire(Wire, frozen=True):
    """Columns over the measurements of one time: target, range [m], bearing [rad]."""

    target: list[str]
    range: list[float]
    bearing: list[float] = []


class MotionWire(Wire, frozen=True):
    """Begin (true) or end of a movement."""

    moving: bool


class StanceWire(Wire, frozen=True):
    """A stance; its start is the message's log time, `end_ns` is UTC nanoseconds too."""

    index: int
    end_ns: int
    observers: tuple[str, ...]
    movers: tuple[str, ...]
    anchors: tuple[str, ...]


class PlanesWire(Wire, frozen=True):
    """Per observer (nx, ny, nz, d) with N . X = d in its camera frame, d > 0 [m]; sigmas of the normal [rad], d [m]."""

    stance: int
    planes: dict[str, tuple[float, float, float, float]]
    sigmas: dict[str, tuple[float, float]] = {}


class ClockWire(Wire, frozen=True):
    """Error of one robot's clock: offset [s], drift [s/s], steps (UTC s, s), jitter [s], and by what it is known."""

    robot: str
    offset: float
    drift: float
    steps: tuple[tuple[float, float], ...]
    jitter: float
    known: str


class ClocksWire(Wire, frozen=True):
    """Errors of clocks by which the run's stamps were corrected."""

    clocks: tuple[ClockWire, ...]


#: Last parts of a robot's topics, `/<robot>/...`, with the schemas that their messages can have.
ROBOT_SCHEMAS: Mapping[str, tuple[str, ...]] = {
    "image": (RAW_IMAGE, COMPRESSED_IMAGE),
    "detections": ("coloc_graph.Detections",),
    "odometry": ("coloc_graph.Odometry",),
    "motion": ("coloc_graph.Motion",),
    "ranges": ("coloc_graph.Ranges",),
    "truth": (POSE_IN_FRAME,),
}
TEAM_SCHEMAS: Mapping[str, tuple[str, ...]] = {
    TEAM_TOPIC: ("coloc_graph.Team",),
    TRUE_TEAM_TOPIC: ("coloc_graph.Team",),
    STANCE_TOPIC: ("coloc_graph.Stance",),
    PLANES_TOPIC: ("coloc_graph.Planes",),
    CLOCKS_TOPIC: ("coloc_graph.Clocks",),
}
JSON_TYPES: Mapping[str, type[msgspec.Struct]] = {
    "coloc_graph.Team": Team,
    "coloc_graph.Detections": DetectionsWire,
    "coloc_graph.Odometry": OdometryWire,
    "coloc_graph.Motion": MotionWire,
    "coloc_graph.Ranges": RangesWire,
    "coloc_graph.Stance": StanceWire,
    "coloc_graph.Planes": PlanesWire,
    "coloc_graph.Clocks": ClocksWire,
}


def topic_of(robot: str, kind: str) -> str:
    """Return the topic of one robot's messages of one kind."""
    return f"/{robot}/{kind}"


def robot_and_kind(topic: str) -> tuple[str, str] | None:
    """Split a robot's topic into (robot, kind); None for the team's topics and those that no run has."""
    parts = topic.split("/")
    if topic not in TEAM_SCHEMAS and len(parts) == 3 and not parts[0] and parts[2] in ROBOT_SCHEMAS:
        return parts[1], parts[2]
    return None


def schemas_of(topic: str) -> tuple[str, ...]:
    """Return the schemas that a topic's messages can have; () for a topic that no run has."""
    split = robot_and_kind(topic)
    return ROBOT_SCHEMAS[split[1]] if split else TEAM_SCHEMAS.get(topic, ())


def is_truth(topic: str) -> bool:
    """Return whether a topic holds truth, which is for evaluation alone."""
    return topic == TRUE_TEAM_TOPIC or topic.endswith("/truth")


def schema_of(name: str) -> tuple[str, str, bytes]:
    """Return schema encoding, message encoding and schema for an MCAP file, the same bytes every time."""
    if name in JSON_TYPES:
        schema = msgspec.json.schema(JSON_TYPES[name])
        return "jsonschema", "json", msgspec.json.encode(schema, order="deterministic")
    return "protobuf", "protobuf", file_descriptors(protobuf_type(name))


def protobuf_type(name: str) -> Any:
    """Return the class of one of Foxglove's messages."""
    # protobuf takes 30 ms to import, and a run without images or truth does not need it
    if name == RAW_IMAGE:
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        return RawImage
    if name == COMPRESSED_IMAGE:
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        return CompressedImage
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    return PoseInFrame


def file_descriptors(message: Any) -> bytes:
    """Return a FileDescriptorSet, dependencies first, as MCAP requires for protobuf."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()

    def add(file: Any) -> None:
        if file.name not in {known.name for known in files.file}:
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(files.file.add())

    add(message.DESCRIPTOR.file)
    return bytes(files.SerializeToString(deterministic=True))


def to_ns(seconds: float) -> int:
    """Convert UTC seconds to integer nanoseconds; RunError where an MCAP cannot hold the time."""
    if not math.isfinite(seconds) or not 0 <= seconds < 2**63 / 1e9:
        raise RunError(f"the time {seconds} cannot be recorded; give UTC seconds, finite and not negative")
    # seconds * 1e9 would lose 100 ns at today's dates; both terms here are exact
    whole = math.floor(seconds)
    return whole * 1_000_000_000 + round((seconds - whole) * 1e9)


def to_seconds(ns: int) -> float:
    """Convert integer nanoseconds to UTC seconds: the inverse of `to_ns` for today's dates, else exact to 0.5 ns."""
    return ns / 1_000_000_000  # int by int, which Python rounds correctly
