"""A result in Foxglove's own schemas: one MCAP file that Foxglove and rerun show without any configuration.

`world` is the root of the estimate, `world` -> `truth` that of the true poses, which are in the world of the estimate.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.camera_info import ros_coefficients, ros_model
from coloc_graph.exchange.landmarks import LandmarkRow
from coloc_graph.exchange.ros_poses import ros_covariance
from coloc_graph.geometry.lie import quaternion
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.run.messages import Detections
from coloc_graph.run.schemas import file_descriptors, to_ns
from coloc_graph.team import Camera, Team

Array = NDArray[np.float64]
Rgba = tuple[float, float, float, float]

WORLD = "world"  # root frame of the estimate
TRUTH = "truth"  # root frame of the true poses, and first part of their frames' names
LAYOUT = Path(__file__).with_name("foxglove_layout.json")
ELLIPSE_POINTS = 48  # vertices of a drawn ellipse
ELLIPSE_SIGMAS = 2.4477  # sigmas of an ellipse that holds 95 % in two dimensions
LARGE_RESIDUAL = 3.0  # RMS residual in units of the noise that is drawn red
BODY_SIZE = (0.3, 0.3, 0.1)  # m: box of a robot
MARKER_SIZE = 0.03  # m: diameter of a marker
GREEN = (0.2, 0.7, 0.3, 1.0)  # rgba of a measurement that agrees
RED = (0.9, 0.1, 0.1, 1.0)  # rgba of one that does not
GREY = (0.5, 0.5, 0.5, 0.6)  # rgba of one without a residual
BLUE = (0.2, 0.4, 0.9, 0.8)  # rgba of robots and their ellipses
WHITE = (1.0, 1.0, 1.0, 1.0)  # rgba of markers and names
ORANGE = (1.0, 0.6, 0.1, 1.0)  # rgba of landmarks


@dataclass(frozen=True)
class DrawnEdge:
    """A used measurement between two positions (3,) in the world [m], and its RMS residual in units of its noise."""

    a: tuple[float, ...]
    b: tuple[float, ...]
    residual: float


def write_foxglove(
    trajectories: Mapping[str, Trajectory],
    team: Team,
    path: str | Path,
    *,
    truth: Mapping[str, Array] | None = None,
    edges: Sequence[DrawnEdge] = (),
    landmarks: Sequence[LandmarkRow] = (),
    detections: Iterable[Detections] = (),
) -> int:
    """Write a result as an MCAP file with Foxglove's schemas.

    Parameters
    ----------
    trajectories : mapping of str to Trajectory
        Estimated poses T_world_body by robot.
    team : Team
        Cameras, mounts and markers.
    path : str or Path
        File to write.
    truth : mapping of str to (n, 4, 4) float, optional
        True poses at the times of the estimate, in its world; NaN where there is none.
    edges : sequence of DrawnEdge
        Measurements to draw.
    landmarks : sequence of LandmarkRow
        Landmarks to draw.
    detections : iterable of Detections
        Marker centres, as annotations of the images.

    Returns
    -------
    int
        Number of messages.

    Raises
    ------
    InputError
        There is no pose.
    """
    from mcap.writer import CompressionType, Writer

    trajectories = {robot: one for robot, one in trajectories.items() if len(one)}
    if not trajectories:
        raise InputError("the result holds no pose, so that there is nothing to export: solve the run again")
    first = min(to_ns(float(one.times[0])) for one in trajectories.values())
    messages = list(_statics(trajectories, team, first, truth or {}, edges, landmarks))
    for robot, one in trajectories.items():
        messages += _of_robot(robot, one, (truth or {}).get(robot))
    messages += [_annotations(one) for one in detections]
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            writer = Writer(file, compression=CompressionType.LZ4)
            writer.start(profile="", library="coloc-graph")
            schemas: dict[str, int] = {}
            channels: dict[str, int] = {}
            for number, (ns, topic, message) in enumerate(sorted(messages, key=lambda one: one[0])):
                name = message.DESCRIPTOR.full_name
                if name not in schemas:
                    schemas[name] = writer.register_schema(name, "protobuf", file_descriptors(type(message)))
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "protobuf", schemas[name])
                data = message.SerializeToString(deterministic=True)
                writer.add_message(channels[topic], ns, data, ns, number)
            writer.finish()  # type: ignore[no-untyped-call]
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return len(messages)


def _new(name: str, **fields: Any) -> Any:
    """Return a message of Foxglove's."""
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)(**fields)


def _stamp(message: Any, ns: int) -> Any:
    message.timestamp.seconds, message.timestamp.nanos = divmod(ns, 1_000_000_000)
    return message


def _vector(name: str, xyz: Iterable[float]) -> Any:
    return _new(name, **dict(zip("xyz", map(float, xyz), strict=False)))


def _rotation(T: Array) -> Any:
    w, x, y, z = quaternion(T[:3, :3])
    return _new("Quaternion", x=x, y=y, z=z, w=w)


def _pose(T: Array) -> Any:
    return _new("Pose", position=_vector("Vector3", T[:3, 3]), orientation=_rotation(T))


def _transform(ns: int, parent: str, child: str, T: Array) -> Any:
    one = _new("FrameTransform", parent_frame_id=parent, child_frame_id=child)
    one.translation.CopyFrom(_vector("Vector3", T[:3, 3]))
    one.rotation.CopyFrom(_rotation(T))
    return _stamp(one, ns)


def _color(rgba: Rgba) -> Any:
    return _new("Color", **dict(zip("rgba", rgba, strict=True)))


def _statics(
    trajectories: Mapping[str, Trajectory],
    team: Team,
    ns: int,
    true: Collection[str],
    edges: Sequence[DrawnEdge],
    landmarks: Sequence[LandmarkRow],
) -> Iterator[tuple[int, str, Any]]:
    transforms = [_transform(ns, WORLD, TRUTH, np.eye(4))]
    for robot in trajectories:
        if team[robot].camera_if_any is None:
            continue
        for body in (robot, f"{TRUTH}/{robot}") if robot in true else (robot,):
            mount = team[robot].mount.T_body_camera
            transforms.append(_transform(ns, f"{body}/base_link", f"{body}/camera", mount))
        yield ns, f"/{robot}/calibration", _calibration(ns, robot, team[robot].camera)
    yield ns, "/tf", _new("FrameTransforms", transforms=transforms)
    scene = [_body(ns, robot, team) for robot in trajectories]
    if edges:
        scene.append(_edges(ns, edges))
    scene += [_landmark(ns, one) for one in landmarks]
    yield ns, "/scene", _new("SceneUpdate", entities=scene)


def _calibration(ns: int, robot: str, camera: Camera) -> Any:
    """Return a camera; OpenCV's models have the same coefficients in Foxglove."""
    model, D = ros_model(camera), ros_coefficients(camera)
    size = {"plumb_bob": 5, "rational_polynomial": 8}.get(model, len(D))
    K = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    return _stamp(
        _new(
            "CameraCalibration",
            frame_id=f"{robot}/camera",
            width=camera.width,
            height=camera.height,
            distortion_model=model,
            D=[*D, *[0.0] * (size - len(D))],
            K=K,
            R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            P=[*K[:3], 0, *K[3:6], 0, *K[6:], 0],
        ),
        ns,
    )


def _entity(ns: int, frame: str, name: str, **primitives: Any) -> Any:
    return _stamp(_new("SceneEntity", frame_id=frame, id=name, frame_locked=True, **primitives), ns)


def _body(ns: int, robot: str, team: Team) -> Any:
    T = np.eye(4)
    T[2, 3] = BODY_SIZE[2] / 2
    box = _new("CubePrimitive", pose=_pose(T), size=_vector("Vector3", BODY_SIZE), color=_color(BLUE))
    spheres = []
    markers = team[robot].markers
    for p in () if markers is None else markers.p_body:
        at = np.eye(4)
        at[:3, 3] = p
        size = _vector("Vector3", [MARKER_SIZE] * 3)
        spheres.append(_new("SpherePrimitive", pose=_pose(at), size=size, color=_color(WHITE)))
    at = np.eye(4)
    at[2, 3] = 3 * BODY_SIZE[2]
    label = _new("TextPrimitive", pose=_pose(at), text=robot, billboard=True, font_size=0.1, color=_color(WHITE))
    return _entity(ns, f"{robot}/base_link", f"robot {robot}", cubes=[box], spheres=spheres, texts=[label])


def _line(points: Iterable[Iterable[float]], kind: str, **more: Any) -> Any:
    line = _new("LinePrimitive", thickness=2, scale_invariant=True, pose=_pose(np.eye(4)), **more)
    line.type = line.Type.Value(kind)
    line.points.extend(_vector("Point3", one) for one in points)
    return line


def _edges(ns: int, edges: Sequence[DrawnEdge]) -> Any:
    """Return lines between poses: green where a measurement agrees, red from `LARGE_RESIDUAL` on."""
    points, colors = [], []
    for one in edges:
        share = min(one.residual / LARGE_RESIDUAL, 1.0) if np.isfinite(one.residual) else None
        mixed = GREY if share is None else tuple((1 - share) * g + share * r for g, r in zip(GREEN, RED, strict=True))
        points += [one.a, one.b]
        colors += [_color(mixed)] * 2  # type: ignore[arg-type]
    return _entity(ns, WORLD, "measurements", lines=[_line(points, "LINE_LIST", colors=colors)])


def _ellipse(x: float, y: float, C: Array) -> Array:
    """Return points (n, 3) of the ellipse that holds 95 % of a position x, y with covariance (2, 2)."""
    angles = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS, endpoint=False)
    values, axes = np.linalg.eigh(C)
    around = axes @ (np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(angles), np.sin(angles)]))
    return np.column_stack([*(np.array([[x], [y]]) + ELLIPSE_SIGMAS * around), np.zeros(len(angles))])


def _landmark(ns: int, row: LandmarkRow) -> Any:
    at = np.eye(4)
    at[:2, 3] = row.x, row.y
    cross = row.xy_correlation * row.x_sigma * row.y_sigma
    C = np.array([[row.x_sigma**2, cross], [cross, row.y_sigma**2]])
    sphere = _new(
        "SpherePrimitive", pose=_pose(at), size=_vector("Vector3", [3 * MARKER_SIZE] * 3), color=_color(ORANGE)
    )
    drawn: dict[str, Any] = {"spheres": [sphere]}
    if np.isfinite(C).all():
        drawn["lines"] = [_line(_ellipse(row.x, row.y, C), "LINE_LOOP", color=_color(ORANGE))]
    return _entity(ns, WORLD, f"landmark {row.name}", **drawn)


def _of_robot(robot: str, trajectory: Trajectory, true: Array | None) -> Iterator[tuple[int, str, Any]]:
    """Yield a robot's frames, poses with covariances, ellipses, path, and its true frames."""
    poses = trajectory.T_world_body
    covariances = None
    if trajectory.covariances is not None:
        covariances = ros_covariance(trajectory.covariances, poses[:, :3, :3])
    for n, (time, T) in enumerate(zip(trajectory.times.tolist(), poses, strict=True)):
        ns = to_ns(time)
        frames = [_transform(ns, WORLD, f"{robot}/base_link", T)]
        if true is not None and np.isfinite(true[n]).all():
            frames.append(_transform(ns, TRUTH, f"{TRUTH}/{robot}/base_link", true[n]))
        yield ns, "/tf", _new("FrameTransforms", transforms=frames)
        pose = _new("Odometry", frame_id=WORLD, body_frame_id=f"{robot}/base_link", pose=_pose(T))
        if covariances is not None:
            pose.pose_covariance.extend(covariances[n].ravel().tolist())
            line = _line(_ellipse(T[0, 3], T[1, 3], covariances[n][:2, :2]), "LINE_LOOP", color=_color(BLUE))
            entity = _entity(ns, WORLD, f"ellipse {robot}", lines=[line])
            yield ns, "/scene", _new("SceneUpdate", entities=[entity])
        yield ns, f"/{robot}/pose", _stamp(pose, ns)
    path = _new("PosesInFrame", frame_id=WORLD, poses=[_pose(T) for T in poses])
    first = to_ns(float(trajectory.times[0]))
    yield first, f"/{robot}/path", _stamp(path, first)


def _annotations(seen: Detections) -> tuple[int, str, Any]:
    ns = to_ns(seen.time)
    message = _stamp(_new("ImageAnnotations"), ns)
    for (u, v), name in zip(seen.uv.tolist(), seen.markers, strict=True):
        at = _new("Point2", x=u, y=v)
        circle = _new("CircleAnnotation", position=at, diameter=12, thickness=1, outline_color=_color(GREEN))
        message.circles.append(_stamp(circle, ns))
        if name:
            text = _new("TextAnnotation", position=at, text=name, font_size=10, text_color=_color(GREEN))
            message.texts.append(_stamp(text, ns))
    return ns, f"/{seen.robot}/annotations", message
