"""ROS 2 live: what a second process, with types made of ROS's own definitions, receives of a team."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange import ros_live
from coloc_graph.exchange.ros_live import RosPublisher
from coloc_graph.exchange.ros_messages import BODY_SIZE, TEXT_ABOVE, TEXT_HEIGHT
from coloc_graph.exchange.ros_poses import ros_covariance
from coloc_graph.geometry.lie import se3, se3_exp
from coloc_graph.simulation.simulated_team import field_team

READER = Path(__file__).parents[1] / "support" / "ros2_reader.py"
DOMAIN = 73
TOPICS = [
    "tf2_msgs/msg/TFMessage=rt/tf", "tf2_msgs/msg/TFMessage=rt/tf_static", "nav_msgs/msg/Path=rt/B/path",
    "geometry_msgs/msg/PoseWithCovarianceStamped=rt/B/pose", "visualization_msgs/msg/MarkerArray=rt/markers",
]  # fmt: skip


@pytest.fixture
def heard():
    """Starts a reader, and returns a function that ends it: the newest message of each topic."""
    command = [sys.executable, str(READER), str(DOMAIN), "60", *TOPICS]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"

    def end():
        out, _ = process.communicate("end\n", timeout=60)
        assert process.returncode == 0
        return {one["topic"]: one for one in map(json.loads, out.splitlines())}

    yield end
    process.kill()
    process.wait()


def test_a_second_process_receives_and_decodes_all(heard, rng):
    team, now = field_team(), 1764444444.25
    T = se3_exp(np.array([0.02, -0.01, 0.7, 1.0, -0.5, 0.03]))
    root = rng.normal(size=(6, 6)) * 1e-2
    C = root @ root.T
    with RosPublisher(team, domain=DOMAIN) as publisher:
        for stance in range(2):
            publisher.publish_stance(stance, {"B": (now + stance, T, C)})
        until = time.monotonic() + 20  # discovery takes a moment, and tf is sent again and again
        while time.monotonic() < until and publisher.readers < len(TOPICS):
            time.sleep(0.05)
        publisher.publish_poses(now, {"A": np.eye(4), "C": T})
        publisher.publish_stance(1, {"B": (now + 1, T, C)})
        found = heard()
    stamp = {"sec": 1764444444, "nanosec": 250000000}
    tf = {one["child_frame_id"]: one for one in found["rt/tf"]["transforms"]}
    assert set(tf) == {"A/base_link", "C/base_link"}
    assert tf["C/base_link"]["header"] == {"stamp": stamp, "frame_id": "world"}
    assert list(tf["C/base_link"]["transform"]["translation"].values()) == T[:3, 3].tolist()
    assert _rotation(tf["C/base_link"]["transform"]["rotation"]) == pytest.approx(T[:3, :3], abs=1e-12)
    mount, *_ = found["rt/tf_static"]["transforms"]
    assert (mount["header"]["frame_id"], mount["child_frame_id"]) == ("A/base_link", "A/camera")
    at = mount["transform"]
    assert se3(_rotation(at["rotation"]), list(at["translation"].values())) == pytest.approx(
        team["A"].mount.T_body_camera, abs=1e-12
    )
    pose = found["rt/B/pose"]
    assert np.reshape(pose["pose"]["covariance"], (6, 6)) == pytest.approx(
        ros_covariance(C[None], T[None, :3, :3])[0], rel=1e-12
    )
    path = found["rt/B/path"]["poses"]
    assert [one["header"]["stamp"]["sec"] for one in path] == [1764444444, 1764444445]
    markers = {one["ns"]: one for one in found["rt/markers"]["markers"]}
    assert set(markers) == {"robots", "names", "ellipses"} and markers["names"]["text"] == "B"
    above = {ns: one["pose"]["position"]["z"] - T[2, 3] for ns, one in markers.items()}
    assert above == pytest.approx({"robots": BODY_SIZE[2] / 2, "names": TEXT_ABOVE, "ellipses": 0.0})
    assert BODY_SIZE[2] < TEXT_ABOVE and markers["names"]["scale"]["z"] == TEXT_HEIGHT  # all that a text's scale has
    x, y = np.linalg.eigvalsh(ros_covariance(C[None], T[None, :3, :3])[0][:2, :2])
    scale = markers["ellipses"]["scale"]
    assert sorted((scale["x"], scale["y"])) == pytest.approx([2 * np.sqrt(5.991 * x), 2 * np.sqrt(5.991 * y)])


def _rotation(q):
    x, y, z, w = (q[one] for one in "xyzw")
    v = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def test_who_publishes_never_waits(monkeypatch):
    with RosPublisher(field_team(), domain=DOMAIN) as publisher:
        monkeypatch.setattr(publisher._writers, "tf", lambda *_: time.sleep(0.2))
        began = time.monotonic()
        for _ in range(3 * ros_live.CAPACITY):
            publisher.publish_poses(1.0, {"A": np.eye(4)})
        assert time.monotonic() - began < 0.2 * ros_live.CAPACITY  # waiting would take three times as long
        assert publisher._waiting.qsize() <= ros_live.CAPACITY and publisher._dropped >= ros_live.CAPACITY
        monkeypatch.setattr(ros_live, "LAST_WAIT", 0.01)
        while not publisher._waiting.empty():
            publisher._waiting.get_nowait()


@pytest.mark.parametrize(
    ("address", "words"),
    [("somewhere", "is no address of an interface"), ("192.0.2.1", "DDS cannot use the interface 192.0.2.1")],
)
def test_an_interface_that_cannot_be_used_is_one_sentence(address, words):
    with pytest.raises(InputError, match=words) as why:
        RosPublisher(field_team(), address, domain=DOMAIN)
    assert "\n" not in str(why.value)


def test_a_missing_package_and_a_wrong_domain_are_one_sentence(tmp_path, monkeypatch, capsys):
    from coloc_graph.team import write_team

    write_team(field_team(), tmp_path / "team.toml")
    command = ["coordinate", str(tmp_path / "team.toml"), "--out", str(tmp_path / "out"), "--ros2"]
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    assert main(command) == 2
    assert capsys.readouterr().err == "coloc: ROS_DOMAIN_ID is `many`; set it to a number from 0 to 232\n"
    monkeypatch.delenv("ROS_DOMAIN_ID")
    monkeypatch.setitem(sys.modules, "coloc_graph.exchange.ros_writers", None)
    assert main(command) == 2
    assert capsys.readouterr().err == f"coloc: {ros_live.NOT_INSTALLED}\n"
    assert not (tmp_path / "out").exists()
