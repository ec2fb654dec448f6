"""Encoding of records, with checks that they can be read back."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import RunError
from coloc_graph.geometry.lie import quaternion
from coloc_graph.run import schemas
from coloc_graph.run.messages import (
    Clocks,
    Detections,
    EncodedImage,
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
ImageFormat = Literal["jpeg", "png", "raw"]
Record = Detections | Image | EncodedImage | OdometrySample | Motion | Ranges | Stance | Planes | Clocks

JPEG_QUALITY = 95  # of OpenCV's scale from 0 to 100


def flag_names(flag: int) -> list[schemas.FlagName]:
    """Return the lower-case names of the flags that are set."""
    return [flag_.name.lower() for flag_ in Flag if flag_ and flag & flag_]  # type: ignore[union-attr, misc]


def encode_team(team: Team) -> bytes:
    """Encode a team as JSON."""
    return msgspec.json.encode(msgspec.to_builtins(team))


def check_robots(team: Team, names: tuple[str, ...], where: str) -> None:
    """Raise `RunError` where one of the names is not a robot of the team."""
    known = team.names
    for name in names:
        if name not in known:
            raise RunError(
                f"{where} names robot `{name}`, which is not in the team ({', '.join(team.names)}); "
                "correct the name or add the robot to the team"
            )


def encode_record(record: Record, image_format: ImageFormat) -> tuple[str, str, float, bytes]:
    """Encode a record: topic, schema, time [s] and bytes."""
    match record:
        case Image():
            schema = schemas.RAW_IMAGE if image_format == "raw" else schemas.COMPRESSED_IMAGE
            return _robot(record, "image"), schema, record.time, _image(record, image_format)
        case EncodedImage():
            return _robot(record, "image"), schemas.COMPRESSED_IMAGE, record.time, _encoded(record)
        case Detections():
            return _json(_robot(record, "detections"), record.time, _detections(record))
        case OdometrySample():
            return _json(_robot(record, "odometry"), record.time, _odometry(record))
        case Motion():
            moving = schemas.MotionWire(moving=bool(record.moving))
            return _json(_robot(record, "motion"), record.time, moving)
        case Ranges():
            return _json(_robot(record, "ranges"), record.time, _ranges(record))
        case Stance():
            return _json(schemas.STANCE_TOPIC, record.start, _stance(record))
        case Planes():
            return _json(schemas.PLANES_TOPIC, record.time, _planes(record))
        case Clocks():
            return _json(schemas.CLOCKS_TOPIC, record.time, _clocks(record))
    raise TypeError(f"a {type(record).__name__} is not a record of a run")


def encode_pose(time: float, T_world_body: Array) -> bytes:
    """Encode a pose as foxglove.PoseInFrame in frame `world`."""
    T = np.asarray(T_world_body, float)
    if T.shape != (4, 4) or not _is_rigid(T.tolist()):
        raise RunError(f"the true pose at {time} s is not a finite rigid transform (4, 4); give T_world_body")
    w, x, y, z = quaternion(T[:3, :3])
    message = schemas.protobuf_type(schemas.POSE_IN_FRAME)(frame_id="world")
    _stamp(message, time)
    pose = message.pose
    pose.position.x, pose.position.y, pose.position.z = T[:3, 3]
    pose.orientation.x, pose.orientation.y, pose.orientation.z = x, y, z
    pose.orientation.w = w
    return bytes(message.SerializeToString(deterministic=True))


def _is_rigid(T: list[list[float]]) -> bool:
    """Return whether a transform is finite and its first three columns are those of a rotation."""
    if not all(math.isfinite(value) for row in T for value in row):
        return False
    a, b, c = zip(*(row[:3] for row in T[:3]), strict=True)
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    # two orthogonal unit vectors, and the third their cross product
    off = (_dot(a, a) - 1, _dot(b, b) - 1, _dot(a, b))
    return all(abs(one) <= 1e-6 for one in (*off, *(u - v for u, v in zip(cross, c, strict=True))))


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _robot(record: Detections | Image | EncodedImage | OdometrySample | Motion | Ranges, kind: str) -> str:
    return schemas.topic_of(record.robot, kind)


def _json(topic: str, time: float, wire: schemas.Wire) -> tuple[str, str, float, bytes]:
    return topic, schemas.schemas_of(topic)[0], time, msgspec.json.encode(wire)


def _finite(what: str, time: float, shape: tuple[int, ...], values: Any) -> Array:
    array = np.asarray(values, float)
    if array.shape != shape:
        raise RunError(f"{what} at {time} s has shape {array.shape}; give {shape}")
    if not math.isfinite(array.sum()) and not np.isfinite(array).all():  # a finite sum has finite terms
        raise RunError(f"{what} at {time} s holds NaN or infinity; leave out what was not measured")
    return array


def _covariance(what: str, time: float, shape: tuple[int, ...], values: Any) -> Array:
    array = _finite(what, time, shape, values)
    other = array.swapaxes(-1, -2)
    if (array != other).any() and not (np.abs(array - other) <= 1e-6 * np.abs(array)).all():
        raise RunError(f"{what} at {time} s is not symmetric; give a covariance")
    return array


def _detections(record: Detections) -> schemas.DetectionsWire:
    n, time = len(record.uv), record.time
    of = f"`{record.robot}`'s detections"
    uv = _finite(f"`uv` of {of}", time, (n, 2), np.reshape(record.uv, (n, 2)) if n == 0 else record.uv)
    C = np.asarray(record.covariance, float)
    C = _covariance(f"`covariance` of {of}", time, (n, 2, 2), C.reshape(0, 2, 2) if n == C.size == 0 else C)
    if len(record.markers) != n:
        raise RunError(f"{of} at {time} s have {len(record.markers)} `markers` for {n} points; give one a point")
    return schemas.DetectionsWire(
        u=uv[:, 0].tolist(),
        v=uv[:, 1].tolist(),
        covariance=np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=-1).tolist(),
        marker=list(record.markers),
        flags=[flag_names(int(flag)) for flag in _finite(f"`flags` of {of}", time, (n,), record.flags)],
        peak=_finite(f"`peak` of {of}", time, (n,), record.peak).tolist(),
        area=_finite(f"`area` of {of}", time, (n,), record.area).tolist(),
    )


def _odometry(record: OdometrySample) -> schemas.OdometryWire:
    of = f"`{record.robot}`'s odometry"
    x, y, yaw = _finite(f"`pose` of {of}", record.time, (3,), record.pose).tolist()
    C = _covariance(f"`covariance` of {of}", record.time, (3, 3), record.covariance)
    return schemas.OdometryWire(x=x, y=y, yaw=yaw, covariance=C.tolist())


def _ranges(record: Ranges) -> schemas.RangesWire:
    n, time = len(record.targets), record.time
    of = f"`{record.robot}`'s ranges"
    range_ = _finite(f"`range` of {of}", time, (n,), record.range)
    bearing = [] if record.bearing is None else _finite(f"`bearing` of {of}", time, (n,), record.bearing).tolist()
    check_ranges(range_.tolist(), f"`range` of {of} at {time} s")
    return schemas.RangesWire(target=list(record.targets), range=range_.tolist(), bearing=bearing)


def check_ranges(ranges: Sequence[float], where: str) -> None:
    """Raise `RunError` where a range is not positive."""
    for one in ranges:
        if not one > 0:
            raise RunError(f"{where} is {one}; give metres above 0, and leave out what was not measured")


def check_targets(team: Team, ranges: Ranges, where: str) -> None:
    """Raise `RunError` where a target is neither another robot nor a landmark of the team."""
    known = {*team.names, *(landmark.name for landmark in team.landmarks)} - {ranges.robot}
    for target in ranges.targets:
        if target not in known:
            raise RunError(
                f"{where} name `{target}`, which is neither another robot nor a landmark of the team; leave it out"
            )


def _stance(record: Stance) -> schemas.StanceWire:
    check_stance(record, f"stance {record.index}")
    return schemas.StanceWire(
        index=int(record.index),
        end_ns=schemas.to_ns(record.end),
        observers=tuple(record.observers),
        movers=tuple(record.movers),
        anchors=tuple(record.anchors),
    )


def check_stance(stance: Stance, where: str) -> None:
    """Raise `RunError` where a stance contradicts itself."""
    if stance.index < 0:
        raise RunError(f"{where}: the index is {stance.index}; number the stances from 0")
    if not stance.end >= stance.start:
        raise RunError(f"{where}: it ends at {stance.end} s, before it starts at {stance.start} s; correct the times")
    both = sorted(set(stance.observers) & set(stance.movers))
    if both:
        raise RunError(f"{where}: robot `{both[0]}` is an observer and a mover; a robot either stands or moves")


def _planes(record: Planes) -> schemas.PlanesWire:
    check_planes(record, f"the planes of stance {record.stance}")
    planes = {robot: _four(plane) for robot, plane in record.planes.items()}
    sigmas = {robot: (float(normal), float(d)) for robot, (normal, d) in record.sigmas.items()}
    return schemas.PlanesWire(stance=int(record.stance), planes=planes, sigmas=sigmas)


def _four(plane: Any) -> tuple[float, float, float, float]:
    nx, ny, nz, d = (float(value) for value in plane)
    return nx, ny, nz, d


def _clocks(record: Clocks) -> schemas.ClocksWire:
    return schemas.ClocksWire(clocks=tuple(map(_clock, record.clocks)))


def _clock(clock: RobotClock) -> schemas.ClockWire:
    numbers = (clock.offset, clock.drift, clock.jitter, *(value for step in clock.steps for value in step))
    if not all(map(math.isfinite, numbers)):
        raise RunError(f"the clock of {clock.robot} has a number that is not finite; give seconds")
    steps = tuple((float(time), float(change)) for time, change in clock.steps)
    return schemas.ClockWire(
        robot=clock.robot,
        offset=float(clock.offset),
        drift=float(clock.drift),
        steps=steps,
        jitter=float(clock.jitter),
        known=clock.known,
    )


def check_planes(planes: Planes, where: str) -> None:
    """Raise `RunError` where a plane is not four finite numbers with a unit normal and a distance above 0."""
    for robot, plane in planes.planes.items():
        values = np.asarray(plane, float)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise RunError(f"{where}: that of `{robot}` is not four finite numbers; give (nx, ny, nz, d)")
        if abs(np.linalg.norm(values[:3]) - 1) > 1e-3 or values[3] <= 0:
            raise RunError(f"{where}: that of `{robot}` needs a unit normal and d > 0; give (nx, ny, nz, d)")
    for robot, sigmas in planes.sigmas.items():
        values = np.asarray(sigmas, float)
        if robot not in planes.planes or values.shape != (2,) or not (np.isfinite(values) & (values >= 0)).all():
            raise RunError(f"{where}: the sigmas of `{robot}` are not those of a plane; give two numbers, 0 or above")


def _image(record: Image, image_format: ImageFormat) -> bytes:
    pixels = np.asarray(record.pixels)
    of = f"`{record.robot}`'s image at {record.time} s"
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)) or not pixels.size:
        raise RunError(f"{of} has shape {pixels.shape}; give (height, width) grey or (height, width, 3) BGR")
    if pixels.dtype != np.uint8:
        raise RunError(f"{of} holds {pixels.dtype}; give uint8")
    if image_format == "raw":
        height, width = pixels.shape[:2]
        message = schemas.protobuf_type(schemas.RAW_IMAGE)(
            width=width,
            height=height,
            encoding="mono8" if pixels.ndim == 2 else "bgr8",
            step=width * (1 if pixels.ndim == 2 else 3),
            data=pixels.tobytes(),
        )
        return _of_camera(message, record)
    return _compressed(record, image_format, _compress(pixels, image_format, of))


def _encoded(record: EncodedImage) -> bytes:
    if record.format not in ("jpeg", "png"):
        raise RunError(f"`{record.robot}`'s image at {record.time} s is `{record.format}`; give jpeg or png")
    return _compressed(record, record.format, record.data)


def _compressed(record: Image | EncodedImage, image_format: str, data: bytes) -> bytes:
    return _of_camera(schemas.protobuf_type(schemas.COMPRESSED_IMAGE)(format=image_format, data=data), record)


def _of_camera(message: Any, record: Image | EncodedImage) -> bytes:
    message.frame_id = f"{record.robot}/camera"
    _stamp(message, record.time)
    return bytes(message.SerializeToString(deterministic=True))


def _compress(pixels: NDArray[np.uint8], image_format: ImageFormat, of: str) -> bytes:
    import cv2  # heavy, and only needed where there are images

    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if image_format == "jpeg" else []
    try:
        done, data = cv2.imencode("." + image_format, np.ascontiguousarray(pixels), options)
    except cv2.error as error:
        raise RunError(f"{of} cannot be written as {image_format} ({error}); use `raw`") from error
    if not done:
        raise RunError(f"{of} cannot be written as {image_format}; use `raw`")
    return bytes(data)


def _stamp(message: Any, time: float) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(schemas.to_ns(time), 1_000_000_000)
