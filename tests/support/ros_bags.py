"""ROS bags of a simulated run, written by rosbags in every format that is read."""

import contextlib
from collections import namedtuple

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from coloc_graph.geometry.lie import floor_pose, quaternion
from coloc_graph.run import open_run, read_truth
from coloc_graph.run.schemas import to_ns

#: A message for a bag: `received` is when the bag got it [ns]; `content` makes it of a store's types.
Sent = namedtuple("Sent", "topic received type content")
KINDS = ("ros1", "sqlite3", "mcap", "bare mcap")


def store_of(kind):
    if kind != "ros1":
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


class Make:
    """Makes messages of one kind of ROS."""

    def __init__(self, kind):
        self.ros1, self.types = kind == "ros1", store_of(kind).types

    def header(self, ns, frame):
        stamp = self.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        more = {"seq": 7} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def image(self, ns, pixels, encoding, step=None, size=None):
        height, width = size or pixels.shape[:2]
        data = np.ascontiguousarray(pixels).reshape(-1)
        return self.types["sensor_msgs/msg/Image"](
            self.header(ns, "camera"), height, width, encoding, 0, step or data.size // height, data
        )

    def compressed(self, ns, data, image_format):
        return self.types["sensor_msgs/msg/CompressedImage"](
            self.header(ns, "camera"), image_format, np.frombuffer(data, np.uint8)
        )

    def camera_info(self, ns, camera, model="plumb_bob", D=None, P=None, binning=0, roi=(0, 0, 0, 0)):
        D = np.array([*camera.distortion, *[0.0] * (5 - len(camera.distortion))] if D is None else D, float)
        P = np.column_stack([camera.K, np.zeros(3)]) if P is None else P
        region = self.types["sensor_msgs/msg/RegionOfInterest"](*roi, do_rectify=False)
        return self.types["sensor_msgs/msg/CameraInfo"](
            self.header(ns, "camera"), camera.height, camera.width, model, D, camera.K.ravel(), np.eye(3).ravel(),
            np.asarray(P, float).ravel(), binning, binning, region,
        )  # fmt: skip

    def pose(self, T):
        w, x, y, z = quaternion(T[:3, :3])
        point = self.types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
        return self.types["geometry_msgs/msg/Pose"](point, self.types["geometry_msgs/msg/Quaternion"](x, y, z, w))

    def pose_stamped(self, ns, T, frame="world"):
        return self.types["geometry_msgs/msg/PoseStamped"](self.header(ns, frame), self.pose(T))

    def with_covariance(self, T, C=None):
        C = np.zeros((6, 6)) if C is None else C
        return self.types["geometry_msgs/msg/PoseWithCovariance"](self.pose(T), C.ravel())

    def pose_with_covariance(self, ns, T, frame="world"):
        kind = self.types["geometry_msgs/msg/PoseWithCovarianceStamped"]
        return kind(self.header(ns, frame), self.with_covariance(T))

    def odometry(self, ns, T, C=None):
        zero = [self.types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0) for _ in range(2)]
        twist = self.types["geometry_msgs/msg/TwistWithCovariance"](
            self.types["geometry_msgs/msg/Twist"](*zero), np.zeros(36)
        )
        kind = self.types["nav_msgs/msg/Odometry"]
        return kind(self.header(ns, "odom"), "base_link", self.with_covariance(T, C), twist)

    def range(self, ns, value):
        header, limits = self.header(ns, "uwb"), {"min_range": 0.05, "max_range": 50.0}
        kind = self.types["sensor_msgs/msg/Range"]
        return kind(header=header, radiation_type=0, field_of_view=6.28, range=value, **limits)

    def tf(self, ns, parent, child, T):
        w, x, y, z = quaternion(T[:3, :3])
        transform = self.types["geometry_msgs/msg/Transform"](
            self.types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist()),
            self.types["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
        one = self.types["geometry_msgs/msg/TransformStamped"](self.header(ns, parent), child, transform)
        return self.types["tf2_msgs/msg/TFMessage"]([one])


def write_bag(folder, kind, sent):
    """The path of a bag of some messages, in the order in which they are given."""
    store, make = store_of(kind), Make(kind)
    path = folder / ("bag.bag" if kind == "ros1" else "bag")
    if kind == "ros1":
        writer, serialise = rosbag1.Writer(path), store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin.SQLITE3 if kind == "sqlite3" else rosbag2.StoragePlugin.MCAP
        writer, serialise = rosbag2.Writer(path, version=9, storage_plugin=plugin), store.serialize_cdr
    connections = {}
    with contextlib.closing(_opened(writer)):
        for one in sent:
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.type, typestore=store)
            writer.write(connections[one.topic], one.received, serialise(one.content(make), one.type))
    return path / "bag.mcap" if kind == "bare mcap" else path


def _opened(writer):
    writer.open()
    return writer


def image(topic, ns, pixels, encoding=None, received=None):
    encoding = encoding or ("mono8" if pixels.ndim == 2 else "bgr8")
    return Sent(topic, received or ns, "sensor_msgs/msg/Image", lambda make: make.image(ns, pixels, encoding))


def compressed(topic, ns, pixels, image_format):
    data = cv2.imencode("." + image_format, pixels)[1].tobytes()
    kind = "sensor_msgs/msg/CompressedImage"
    return Sent(topic, ns, kind, lambda make: make.compressed(ns, data, f"bgr8; {image_format} compressed bgr8"))


def camera_info(topic, ns, camera, **options):
    return Sent(topic, ns, "sensor_msgs/msg/CameraInfo", lambda make: make.camera_info(ns, camera, **options))


def odometry(topic, ns, pose, C=None, received=None):
    T = floor_pose(*pose)
    return Sent(topic, received or ns, "nav_msgs/msg/Odometry", lambda make: make.odometry(ns, T, C))


def truth(topic, ns, T, *, covariance=False, frame="world"):
    if covariance:
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        return Sent(topic, ns, kind, lambda make: make.pose_with_covariance(ns, T, frame))
    return Sent(topic, ns, "geometry_msgs/msg/PoseStamped", lambda make: make.pose_stamped(ns, T, frame))


def tf(topic, ns, parent, child, T):
    return Sent(topic, ns, "tf2_msgs/msg/TFMessage", lambda make: make.tf(ns, parent, child, T))


def range_(topic, ns, value):
    return Sent(topic, ns, "sensor_msgs/msg/Range", lambda make: make.range(ns, value))


def wheels(run, robot, begin, end, rate=10.0):
    """(times [s], poses, covariances of the poses) of a robot's odometry, told also while it stands.

    The covariances are those of the increments added up, to first order, as an odometer does it.
    """
    samples = list(run.odometry(robot))
    times = np.array([one.time for one in samples])
    resting = np.arange(begin, end, 1 / rate)
    if len(times):
        far = np.abs(resting[:, None] - times).min(axis=1) > 0.9 / rate
        resting = resting[far]
    every, poses, covariances = np.sort(np.concatenate([times, resting])), [], []
    pose, C = samples[0].pose if samples else np.zeros(3), np.zeros((3, 3))
    told = {one.time: one for one in samples}
    for time in every.tolist():
        if time in told and told[time] is not samples[0]:
            (dx, dy, _), yaw = told[time].pose - pose, pose[2]
            J = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
            R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
            pose, C = told[time].pose, J @ C @ J.T + R @ told[time].covariance @ R.T
        poses.append(pose)
        covariances.append(C)
    return every, np.array(poses), np.array(covariances)


def of_run(path, *, by_tf=(), encodings=None):
    """All that a ROS bag can hold of a run, in the order of time: topics /A/image, /A/info, /A/odom, /A/truth.

    The true poses of robots `by_tf` are in tf instead, with a frame in between. `encodings` are mono8, bgr8, png or
    jpeg, by robot.
    """
    run, sent = open_run(path), []
    first, last = run.start - 0.5, run.end + 0.5
    for robot in run.team.names:
        encoding = (encodings or {}).get(robot, "mono8")
        if run.has_images(robot):
            sent.append(camera_info(f"/{robot}/info", to_ns(first), run.team[robot].camera))
        for one in run.images(robot):
            ns = to_ns(one.time)
            if encoding in ("png", "jpeg"):
                sent.append(compressed(f"/{robot}/image", ns, one.pixels, encoding))
            else:
                pixels = cv2.cvtColor(one.pixels, cv2.COLOR_GRAY2BGR) if encoding == "bgr8" else one.pixels
                sent.append(image(f"/{robot}/image", ns, pixels))
        for time, pose, C in zip(*wheels(run, robot, first, last), strict=True):
            whole = np.zeros((6, 6))
            whole[np.ix_([0, 1, 5], [0, 1, 5])] = C
            sent.append(odometry(f"/{robot}/odom", to_ns(time), pose, whole))
        for one in run.ranges(robot):
            for target, value in zip(one.targets, one.range.tolist(), strict=True):
                sent.append(range_(f"/{robot}/uwb/{target}", to_ns(one.time), value))
        true = read_truth(path)[robot]
        for time, T in zip(true.times.tolist(), true.T_world_body, strict=True):
            if robot in by_tf:
                lifted = floor_pose(0.1, 0.2, 0.3)
                sent.append(tf("/tf", to_ns(time), "map", f"{robot}/footprint", lifted @ T))
            else:
                sent.append(truth(f"/{robot}/truth", to_ns(time), T, covariance=robot == "B"))
        if robot in by_tf:
            sent.append(tf("/tf_static", to_ns(first), "map", "world", floor_pose(0.1, 0.2, 0.3)))
            sent.append(tf("/tf_static", to_ns(first), f"{robot}/footprint", f"{robot}/base_link", np.eye(4)))
    return sorted(sent, key=lambda one: one.received)
