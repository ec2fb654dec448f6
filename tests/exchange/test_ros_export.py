"""A result as a ROS 2 bag: as rosbags and the mcap library read it, and what its covariances mean."""

import shutil

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.ros_export import write_ros2
from coloc_graph.exchange.ros_poses import T_of, ros_covariance
from coloc_graph.geometry.lie import se3_exp, so3_exp, so3_log
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.folder import read_result
from coloc_graph.results.writer import assess
from coloc_graph.run.schemas import to_ns
from coloc_graph.team import write_team


@pytest.fixture(scope="module")
def result(short_result):
    return short_result


@pytest.fixture(scope="module")
def bag(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("ros") / "result.mcap"
    assert main(["export", "ros2", str(result), "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def messages(bag):
    """{topic: [(received [ns], message)]}, by rosbags, with the definitions that the file brings."""
    found = {}
    with AnyReader([bag]) as reader:
        for connection, received, data in reader.messages():
            found.setdefault(connection.topic, []).append((received, reader.deserialize(data, connection.msgtype)))
    return found


def ns_of(stamp):
    return stamp.sec * 10**9 + stamp.nanosec


def test_each_pose_is_in_tf_and_in_its_topic_with_its_time_and_frames(messages, short_solution):
    trajectories = short_solution.estimate.trajectories
    assert set(messages) == {"/tf", "/tf_static", *(f"/{n}/{what}" for n in trajectories for what in ("pose", "path"))}
    tf = {}
    for received, message in messages["/tf"]:
        for one in message.transforms:
            assert ns_of(one.header.stamp) == received and one.header.frame_id == "world"
            tf.setdefault(one.child_frame_id, []).append((received, one.transform))
    for name, trajectory in trajectories.items():
        expected = [to_ns(time) for time in trajectory.times]
        posed, moved = messages[f"/{name}/pose"], tf.pop(f"{name}/base_link")
        ((first, path),) = messages[f"/{name}/path"]
        assert [ns for ns, _ in posed] == [ns for ns, _ in moved] == expected and first == expected[0]
        assert [ns_of(one.header.stamp) for one in path.poses] == expected and path.header.frame_id == "world"
        for k, T in enumerate(trajectory.T_world_body):
            for found in (
                T_of(posed[k][1].pose.pose.position, posed[k][1].pose.pose.orientation),
                T_of(moved[k][1].translation, moved[k][1].rotation),
                T_of(path.poses[k].pose.position, path.poses[k].pose.orientation),
            ):
                np.testing.assert_allclose(found, T, atol=1e-12)
            C = posed[k][1].pose.covariance.reshape(6, 6)
            np.testing.assert_allclose(C, ros_covariance(trajectory.covariances[k], T[:3, :3]))
            assert ns_of(posed[k][1].header.stamp) == posed[k][0] and posed[k][1].header.frame_id == "world"
    assert not tf


def test_cameras_sit_on_their_robots_and_look_down(messages, result, short_solution):
    ((received, message),) = messages["/tf_static"]
    assert received == min(ns for topic in messages.values() for ns, _ in topic)
    team = read_result(result).team
    assert [one.child_frame_id for one in message.transforms] == ["A/camera", "B/camera", "C/camera"]
    for one in message.transforms:
        name = one.header.frame_id.removesuffix("/base_link")
        T = T_of(one.transform.translation, one.transform.rotation)
        np.testing.assert_allclose(T, team[name].mount.T_body_camera, atol=1e-12)
        assert T[2, 3] == pytest.approx(0.4, abs=0.01) and T[2, 2] < 0  # above the floor, and looking down


def test_the_file_is_what_ros_2_records_into_mcap(bag):
    with bag.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        schemas = {one.name: one for one in summary.schemas.values()}
        assert {one.encoding for one in schemas.values()} == {"ros2msg"}
        assert {one.rpartition("/")[2] for one in schemas} == {"TFMessage", "Path", "PoseWithCovarianceStamped"}
        text = schemas["geometry_msgs/msg/PoseWithCovarianceStamped"].data.decode()
        assert "std_msgs/Header header" in text and "MSG: geometry_msgs/PoseWithCovariance" in text
        channels = {one.topic: one for one in summary.channels.values()}
        assert {one.message_encoding for one in channels.values()} == {"cdr"}
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
        assert times == sorted(times) and summary.statistics.message_count == len(times)
    with Reader(bag) as reader:  # as rosbag2's own readers do: by the channels' quality of service
        quality = [(one.topic, q.durability.name) for one in reader.connections for q in one.ext.offered_qos_profiles]
        assert {topic for topic, durability in quality if durability == "TRANSIENT_LOCAL"} == {
            "/tf_static",
            "/A/path",
            "/B/path",
            "/C/path",
        }


def test_covariances_are_those_of_ros_by_sampling(rng):
    """Poses are drawn by our covariance; how they err as ROS counts it has the covariance that is written."""
    A = rng.normal(size=(6, 6)) * np.array([0.01, 0.02, 0.03, 0.05, 0.02, 0.01])[:, None]
    C, T = A @ A.T, se3_exp([0.4, -0.3, 2.0, 1.0, 2.0, 0.5])
    drawn = T @ se3_exp(rng.multivariate_normal(np.zeros(6), C, 200_000))
    off = drawn[:, :3, 3] - T[:3, 3]
    turned = so3_log(drawn[:, :3, :3] @ T[:3, :3].T)  # about the fixed axes of the world
    sampled = np.cov(np.concatenate([off, turned], axis=1).T)
    found = ros_covariance(C, T[:3, :3])
    sigmas = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(found / np.outer(sigmas, sigmas), sampled / np.outer(sigmas, sigmas), atol=0.03)
    assert np.abs(found[:3, :3] - C[3:, 3:]).max() > 0.1 * found[:3, :3].max()  # the frames do differ


def test_a_robot_that_knows_its_way_ahead_knows_it_along_the_world_where_it_heads():
    """By hand: 1 cm ahead, 1 mm sideways, heading along y: x is known to 1 mm and y to 1 cm, in ROS's order."""
    C = np.diag(np.square([1e-4, 2e-4, 3e-4, 0.01, 0.001, 0.002]))
    found = ros_covariance(C, so3_exp([0, 0, np.pi / 2]))
    expected = np.square([0.001, 0.01, 0.002, 2e-4, 1e-4, 3e-4])
    np.testing.assert_allclose(found, np.diag(expected), atol=1e-18)


def test_the_same_result_gives_the_same_bytes(bag, result, tmp_path):
    read = read_result(result)
    poses = sum(map(len, read.trajectories.values()))
    assert write_ros2(read.trajectories, read.team, tmp_path / "again.mcap") == poses
    assert (tmp_path / "again.mcap").read_bytes() == bag.read_bytes()


def test_without_covariances_they_are_zero_as_ros_says_not_known(short_solution, tmp_path):
    one = short_solution.estimate.trajectories["A"]
    bare = {"A": Trajectory("A", one.times, one.T_world_body)}
    write_ros2(bare, short_solution.run.team, tmp_path / "bare.mcap")
    with AnyReader([tmp_path / "bare.mcap"]) as reader:
        for connection, _, data in reader.messages(connections=[c for c in reader.connections if c.topic == "/A/pose"]):
            assert not reader.deserialize(data, connection.msgtype).pose.covariance.any()


def test_nothing_is_exported_of_nothing_and_nothing_half(short_solution, tmp_path, monkeypatch):
    team, trajectories = short_solution.run.team, short_solution.estimate.trajectories
    with pytest.raises(InputError, match="holds no pose"):
        write_ros2({}, team, tmp_path / "none.mcap")

    def full(self, *metadata):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rosbags.rosbag2.storage_mcap.McapWriter.close", full)
    with pytest.raises(OSError, match="No space"):
        write_ros2(trajectories, team, tmp_path / "full.mcap")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "words"),
    [("bag", "is not the name of a ROS 2 bag: give one that ends in"), ("result.mcap", "exists; replace it")],
)
def test_where_it_cannot_go_is_told(bag, result, tmp_path, capsys, name, words):
    (tmp_path / "result.mcap").write_bytes(b"mine")
    assert main(["export", "ros2", str(result), "--out", str(tmp_path / name)]) == 2
    assert words in capsys.readouterr().err
    assert (tmp_path / "result.mcap").read_bytes() == b"mine"


def test_cameras_are_as_the_estimate_found_them_or_else_as_they_were_stated(short_solution, result, tmp_path, capsys):
    copy, stated = tmp_path / "copy", short_solution.run.team
    shutil.copytree(result, copy)
    (copy / "team.toml").unlink(missing_ok=True)  # the calibrated team: centre noise is learnt of any run
    assert read_result(copy).team == stated
    found = msgspec.structs.replace(stated, clock_sigma=0.5)
    write_team(found, copy / "team.toml")
    assert read_result(copy).team == found
    (copy / "team.toml").unlink()
    (copy / "config.toml").write_text("[options]\n")
    assert main(["export", "ros2", str(copy), "--out", str(tmp_path / "x.mcap")]) == 2
    assert "config.toml: Expected `object`, got `null`; solve the run again" in capsys.readouterr().err


def test_truth_is_exported_in_the_world_of_the_estimate(result, short, tmp_path, short_solution):
    path = tmp_path / "truth.mcap"
    assert main(["export", "ros2", str(result), "--out", str(path), "--truth", "--run", str(short)]) == 0
    true = assess(short_solution)[1]
    with AnyReader([path]) as reader:
        found = [reader.deserialize(data, one.msgtype) for one, _, data in reader.messages() if one.topic == "/C/truth"]
        frames = {
            transform.child_frame_id
            for one, _, data in reader.messages()
            if one.topic == "/tf"
            for transform in reader.deserialize(data, one.msgtype).transforms
        }
    poses = [T_of(one.pose.position, one.pose.orientation) for one in found]
    np.testing.assert_allclose(poses, true["C"], atol=1e-9)
    assert {f"truth/{robot}/base_link" for robot in true} <= frames
    assert {one.header.frame_id for one in found} == {"world"}
