"""Decoding of messages. A `MalformedError` describes the fault, the reader adds topic and time."""

import math
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import RunError
from coloc_graph.run import schemas
from coloc_graph.run.encode import check_planes, check_ranges, check_stance
from coloc_graph.run.image_header import read_image_header, too_large
from coloc_graph.run.messages import (
    Clocks,
    Detections,
    Flag,
    Image,
    Motion,
    OdometrySample,
    Planes,
    Ranges,
    RobotClock,
    Stance,
)
from coloc_graph.team import Team

Array = NDArray[np.float64]
T = TypeVar("T")


class MalformedError(ValueError):
    """Message that does not have its topic's format; its text is the reason."""


def _json(data: bytes, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        raise MalformedError(str(error)) from error


def decode_team(data: bytes) -> Team:
    """Decode a team from its JSON."""
    return _json(data, Team)


def decode_detections(robot: str, ns: int, data: bytes) -> Detections:
    """Decode the detections in one image."""
    wire = _json(data, schemas.DetectionsWire)
    n = len(wire.u)
    for name in ("v", "covariance", "marker", "flags", "peak", "area"):
        if len(getattr(wire, name)) != n:
            raise MalformedError(f"`{name}` has {len(getattr(wire, name))} entries for {n} in `u`")
    uu, uv, vv = np.array(wire.covariance, float).reshape(n, 3).T
    flags = [sum(Flag[name.upper()] for name in set(names)) for names in wire.flags]
    return Detections(
        robot=robot,
        time=schemas.to_seconds(ns),
        uv=np.stack([np.array(wire.u, float), np.array(wire.v, float)], axis=-1),
        covariance=np.stack([uu, uv, uv, vv], axis=-1).reshape(n, 2, 2),
        markers=tuple(wire.marker),
        flags=np.array(flags, np.uint8),
        peak=np.array(wire.peak, float),
        area=np.array(wire.area, float),
    )


def decode_odometry(robot: str, ns: int, data: bytes) -> OdometrySample:
    """Decode one sample of a robot's odometry."""
    wire = _json(data, schemas.OdometryWire)
    return OdometrySample(
        robot, schemas.to_seconds(ns), np.array([wire.x, wire.y, wire.yaw]), np.array(wire.covariance)
    )


def decode_motion(robot: str, ns: int, data: bytes) -> Motion:
    """Decode the begin or the end of a movement."""
    return Motion(robot, schemas.to_seconds(ns), _json(data, schemas.MotionWire).moving)


def decode_ranges(robot: str, ns: int, data: bytes) -> Ranges:
    """Decode the measurements of a range and bearing sensor at one time."""
    wire = _json(data, schemas.RangesWire)
    if len(wire.target) != len(wire.range) or len(wire.bearing) not in (0, len(wire.target)):
        lengths = f"`range` has {len(wire.range)} and `bearing` {len(wire.bearing)}"
        raise MalformedError(f"{lengths} entries for {len(wire.target)} in `target`")
    try:
        check_ranges(wire.range, "`range`")
    except RunError as error:
        raise MalformedError(str(error)) from error
    time = schemas.to_seconds(ns)
    bearing = np.array(wire.bearing, float) if wire.bearing else None
    return Ranges(robot, time, tuple(wire.target), np.array(wire.range, float), bearing)


def decode_stance(ns: int, data: bytes) -> Stance:
    """Decode a stance; its start is the message's time."""
    wire = _json(data, schemas.StanceWire)
    end = schemas.to_seconds(wire.end_ns) if abs(wire.end_ns) < 2**64 else -1.0
    stance = Stance(wire.index, schemas.to_seconds(ns), end, wire.observers, wire.movers, wire.anchors)
    try:
        check_stance(stance, f"stance {stance.index}")
    except RunError as error:
        raise MalformedError(str(error)) from error
    return stance


def decode_planes(ns: int, data: bytes) -> Planes:
    """Decode the marker planes of one stance."""
    wire = _json(data, schemas.PlanesWire)
    planes = Planes(wire.stance, schemas.to_seconds(ns), wire.planes, wire.sigmas)
    try:
        check_planes(planes, f"the planes of stance {planes.stance}")
    except RunError as error:
        raise MalformedError(str(error)) from error
    return planes


def decode_clocks(ns: int, data: bytes) -> Clocks:
    """Errors of clocks by which the run's stamps were corrected."""
    wire = _json(data, schemas.ClocksWire)
    found = (RobotClock(one.robot, one.offset, one.drift, one.steps, one.jitter, one.known) for one in wire.clocks)
    return Clocks(schemas.to_seconds(ns), tuple(found))


def decode_image(robot: str, ns: int, schema: str, data: bytes) -> Image:
    """An image, whichever way it is encoded."""
    message = _protobuf(schema, ns, data)
    pixels = _raw(message) if schema == schemas.RAW_IMAGE else _decompress(message)
    return Image(robot, schemas.to_seconds(ns), pixels)


def decode_pose(ns: int, data: bytes) -> Array:
    """T_world_body (4, 4) [m]."""
    message = _protobuf(schemas.POSE_IN_FRAME, ns, data)
    if message.frame_id != "world":
        raise MalformedError(f"`frame_id` is `{message.frame_id}`; it must be `world`")
    p, o = message.pose.position, message.pose.orientation
    # plain floats: there are a hundred of these a second and robot
    norm = math.hypot(o.x, o.y, o.z, o.w)
    if not abs(norm - 1) <= 1e-6 or not all(map(math.isfinite, (p.x, p.y, p.z))):
        raise MalformedError("`pose` is not a position and a unit quaternion")
    x, y, z, w = o.x / norm, o.y / norm, o.z / norm, o.w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), p.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), p.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), p.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _protobuf(schema: str, ns: int, data: bytes) -> Any:
    from google.protobuf.message import DecodeError

    message = schemas.protobuf_type(schema)()
    try:
        message.ParseFromString(bytes(data))
    except DecodeError as error:
        raise MalformedError(f"not a {schema}") from error
    stamp = message.timestamp.seconds * 1_000_000_000 + message.timestamp.nanos
    if stamp != ns:
        raise MalformedError(f"`timestamp` is {schemas.to_seconds(stamp)} s, not the message's log time")
    return message


def _raw(message: Any) -> NDArray[np.uint8]:
    channels = {"mono8": 1, "bgr8": 3}.get(message.encoding)
    if channels is None:
        raise MalformedError(f"`encoding` is `{message.encoding}`; it must be mono8 or bgr8")
    width, height, step, data = message.width, message.height, message.step, message.data
    if not width or not height or step < width * channels or len(data) != step * height:
        raise MalformedError(f"{len(data)} bytes of `data` are not {width} x {height} {message.encoding}")
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * channels]
    return rows.reshape((height, width) if channels == 1 else (height, width, 3)).copy()


def _decompress(message: Any) -> NDArray[np.uint8]:
    import cv2  # heavy, and only needed where there are images

    if message.format not in ("jpeg", "png"):
        raise MalformedError(f"`format` is `{message.format}`; it must be jpeg or png")
    data = message.data  # a copy each time
    header = read_image_header(data)
    if header is None:
        raise MalformedError(f"`data` is not a {message.format}")
    if header.bits != 8 or header.channels not in (1, 3):
        raise MalformedError(f"`data` has {header}; it must be 8-bit grey or BGR")
    if why := too_large(header, data):
        raise MalformedError(f"`data` {why}")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        raise MalformedError(f"`data` is not a {message.format}") from error
    if pixels is None:
        raise MalformedError(f"`data` is not a {message.format}")
    if pixels.dtype != np.uint8 or not (pixels.ndim == 2 or pixels.shape[2] == 3):
        raise MalformedError(f"`data` has shape {pixels.shape} of {pixels.dtype}; it must be 8-bit grey or BGR")
    return np.asarray(pixels, np.uint8)
