"""TUM and g2o: to the bit and back, as others read them, and files that are wrong."""

import dataclasses
import re

import gtsam
import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.landmarks import read_landmarks
from coloc_graph.exchange.tum import COVARIANCE_HEADER, read_tum, write_tum
from coloc_graph.geometry.lie import se3, so3_exp
from coloc_graph.geometry.trajectory import Trajectory


def wild(rng, n=200):
    """Poses and covariances with digits to the last bit, all the way around the rotations."""
    R = so3_exp(rng.normal(0, 2, (n, 3)))
    A = rng.normal(size=(n, 6, 6))
    times = 1_700_000_000.0 + np.sort(rng.uniform(0, 1e4, n))
    return Trajectory("B", times, se3(R, rng.normal(0, 1e3, (n, 3))), np.arange(n) * 3, A @ A.transpose(0, 2, 1))


def test_tum_reads_back_to_the_bit(rng, tmp_path):
    written = wild(rng)
    write_tum(written, tmp_path / "B.tum")
    read = read_tum(tmp_path / "B.tum")
    assert read.robot == "B"
    for name in ("times", "stances", "covariances", "positions"):
        assert np.array_equal(getattr(read, name), getattr(written, name)), name
    # a rotation goes through a quaternion, which costs a last bit or two
    np.testing.assert_allclose(read.T_world_body, written.T_world_body, rtol=0, atol=2e-15)


def test_tum_of_poses_that_belong_to_no_stances_keeps_their_covariances(rng, tmp_path):
    written = dataclasses.replace(wild(rng), stances=None)
    write_tum(written, tmp_path / "B.tum")
    read = read_tum(tmp_path / "B.tum")
    assert read.stances is None and np.array_equal(read.covariances, written.covariances)


def test_tum_of_an_estimate_reads_back(solutions, tmp_path):
    for robot, trajectory in solutions["smooth"].estimate.trajectories.items():
        write_tum(trajectory, tmp_path / f"{robot}.tum")
        read = read_tum(tmp_path / f"{robot}.tum")
        assert np.array_equal(read.covariances, trajectory.covariances)
        np.testing.assert_allclose(read.T_world_body, trajectory.T_world_body, rtol=0, atol=2e-15)
        # held poses are held in the file too
        same = (np.diff(trajectory.T_world_body, axis=0) == 0).all(axis=(1, 2))
        assert same.any() == (robot != "C")  # who drives in every stance holds no pose
        assert np.array_equal(same, (np.diff(read.T_world_body, axis=0) == 0).all(axis=(1, 2)))


def test_tum_is_what_other_tools_read(tmp_path):
    T = se3(so3_exp([0, 0, np.pi / 2]), [1, 2, 3])
    write_tum(Trajectory("A", np.array([12.5]), T[None]), tmp_path / "A.tum")
    numbers = np.loadtxt(tmp_path / "A.tum")
    np.testing.assert_allclose(numbers, [12.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    assert not (tmp_path / "A.cov.csv").exists()
    assert read_tum(tmp_path / "A.tum").covariances is None


def test_tum_of_other_tools_is_read(tmp_path):
    (tmp_path / "x.tum").write_text("# timestamp tx ty tz qx qy qz qw\n\n1 0 0 0 0 0 0 1\n2.5 1 2 3 0 0 0 1.0005\n")
    read = read_tum(tmp_path / "x.tum")
    assert read.times.tolist() == [1.0, 2.5] and read.positions[1].tolist() == [1, 2, 3]
    # a quaternion of few digits is still a rotation
    R = se3(so3_exp([0, 0, 0.3]), [0, 0, 0])[:3, :3]
    (tmp_path / "y.tum").write_text("1 0 0 0 0 0 0.1495 0.9888\n")
    read = read_tum(tmp_path / "y.tum").T_world_body[0, :3, :3]
    np.testing.assert_allclose(read @ read.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(read, R, atol=1e-3)


NANOSECONDS = "1403636579763555584"
HALF = np.sqrt(0.5)


@pytest.mark.parametrize(
    "text",
    [
        f"timestamp tx ty tz qx qy qz qw\n{NANOSECONDS} 1 2 3 0 0 {HALF} {HALF}\n",
        f"timestamp,tx,ty,tz,qx,qy,qz,qw\n{NANOSECONDS},1,2,3,0,0,{HALF},{HALF}\n",
        f"1403636579.763555584,1,2,3,0,0,{HALF},{HALF}\n",
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
        f"{NANOSECONDS},1,2,3,{HALF},0,0,{HALF}\n",
        f"{NANOSECONDS},1,2,3,{HALF},0,0,{HALF},0,0,0,0,0,0,0,0,0\n",
        "1403636579.763555584 0 -1 0 1 1 0 0 2 0 0 1 3\n",
    ],
    ids=["header", "commas", "seconds and commas", "EuRoC", "EuRoC without header", "KITTI with times"],
)
def test_trajectories_of_other_formats_are_read(tmp_path, text):
    (tmp_path / "x.tum").write_text(text)
    read = read_tum(tmp_path / "x.tum")
    assert read.times[0] == pytest.approx(1403636579.763555584, abs=1e-6)
    np.testing.assert_allclose(read.T_world_body[0], se3(so3_exp([0, 0, np.pi / 2]), [1, 2, 3]), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0 0 0 0 0\n", "x.tum, line 1: 8 finite numbers are expected"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1 9\n", "x.tum, line 2: 8 finite"),
        ("# one\n1 0 0 zero 0 0 0 1\n", "x.tum, line 2: 8 finite"),
        ("1 0 0 nan 0 0 0 1\n", "x.tum, line 1: 8 finite"),
        ("inf 0 0 0 0 0 0 1\n", "x.tum, line 1: 8 finite"),
        ("1 0 0 0 0 0 0 0\n", "x.tum, line 1: the quaternion is not of unit length"),
        ("1 0 0 0 1 1 1 1\n", "x.tum, line 1: the quaternion is not of unit length"),
        (
            "1 0 0 0 0 0 0 1\n3 0 0 0 0 0 0 1\n\n2 0 0 0 0 0 0 1\n",
            "x.tum, line 4: the time 2.0 does not come after 3.0",
        ),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "x.tum, line 2: the time 1.0 does not come after 1.0; sort the poses"),
        ("1 0 0 0 1 0 0 0 1 0 0 0\n", "x.tum, line 1: is KITTI's format .* has no times"),
        ("1 2 0 0 0 1 0 0 0 1 0 0 0\n", "x.tum, line 1: .* are not a rotation matrix"),
        ("1403636579763555584,1,2,3,1,0,0,0\n", "x.tum, line 1: may be EuRoC's CSV"),
        ("1403636579763 0 0 0 0 0 0 1\n", "x.tum, line 1: the time .* neither in seconds nor in nanoseconds"),
        ("time x\ny z\n", "x.tum, line 1: 8 finite"),
    ],
)
def test_a_bad_tum_file_is_one_sentence_with_its_line(tmp_path, text, words):
    (tmp_path / "x.tum").write_text(text)
    with pytest.raises(InputError, match=words) as refusal:
        read_tum(tmp_path / "x.tum")
    assert str(refusal.value).startswith(str(tmp_path)) and "\n" not in str(refusal.value)


def test_a_tum_file_that_is_not_there_or_no_text_is_named(tmp_path):
    (tmp_path / "x.tum").write_bytes(b"\xff\xfe\x00")
    for name in ("nowhere.tum", "x.tum"):
        with pytest.raises(InputError, match=rf"{name}: (cannot be read|is text in UTF-16; save it as UTF-8)"):
            read_tum(tmp_path / name)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda lines: lines[:-1], r"B.cov.csv has 2 rows and B.tum 3 poses"),
        (lambda lines: [*lines[:2], "1,2,3", lines[3]], r"B.cov.csv, line 3: 23 finite numbers"),
        (lambda lines: [*lines[:3], re.sub(r",[^,]*$", ",nan", lines[3])], r"B.cov.csv, line 4: 23 finite numbers"),
    ],
)
def test_bad_covariances_are_named(rng, tmp_path, spoil, words):
    write_tum(wild(rng, 3), tmp_path / "B.tum")
    beside = tmp_path / "B.cov.csv"
    lines = beside.read_text().splitlines()
    assert lines[0] == COVARIANCE_HEADER and len(COVARIANCE_HEADER.split(",")) == 23
    beside.write_text("\n".join(spoil(lines)) + "\n")
    with pytest.raises(InputError, match=words):
        read_tum(tmp_path / "B.tum")


@pytest.fixture(scope="module")
def g2o(solutions, tmp_path_factory):
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(solutions["smooth"].estimate, path)
    return path


def test_g2o_is_what_gtsam_reads(g2o, solutions):
    estimate = solutions["smooth"].estimate
    factors, values = gtsam.readG2o(str(g2o), True)
    keys = {estimate.graph.key(robot, stance) for robot, stance in estimate.graph.nodes}
    assert values.size() == len(keys) == 17  # 8 stances of a leap-frog: 9 places, and 8 of the mover
    assert len(estimate.graph.relative_poses) == 8
    assert factors.size() == len(estimate.graph.measurements) == 8 + 8 + 14
    for at, measured in enumerate(estimate.graph.relative_poses):
        factor = factors.at(at)
        # the floor adds what it knows of height, roll and pitch; heading, x and y given these are as measured
        known = factor.noiseModel().information()
        added = known - np.linalg.inv(measured.covariance)
        assert np.abs(added[2:5]).max() < 1e-6 * np.abs(known[2:5]).max()
        assert np.linalg.eigvalsh(added).min() > -1e-6 * np.abs(added).max()
        a, b = (values.atPose3(key) for key in factor.keys())  # noqa: SIM118
        assert a.equals(estimate.pose(measured.robot_i, measured.stance), 1e-12)
        assert b.equals(estimate.pose(measured.robot_j, measured.stance), 1e-12)


def test_g2o_has_plain_ids_and_says_who_stayed_put(g2o, solutions):
    lines = g2o.read_text().splitlines()
    ids = [line.split()[1] for line in lines if line.startswith("VERTEX_SE3:QUAT")]
    assert ids == [str(k) for k in range(17)]
    edges = [line.split() for line in lines if line.startswith("EDGE_SE3:QUAT")]
    assert len(edges) == 8 + 8 + 14 and {word for edge in edges for word in edge[1:3]} <= set(ids)
    assert all(len(edge) == 3 + 7 + 21 for edge in edges)
    stays = [line for line in lines if line.startswith("# STAY_PUT")]
    assert stays == [f"# STAY_PUT {s.robot} {s.before} {s.after}" for s in solutions["smooth"].estimate.graph.stay_puts]
    assert len(stays) == 7
    assert "# 0 is A@0" in lines and "FIX 0" in lines
    assert any(re.fullmatch(r"# \d+ is B@0 = B@1", line) for line in lines)


@pytest.mark.parametrize(
    ("data", "says"),
    [(b"name,x\n\xa4,1\n", "line 2: is not UTF-8 text"), (b"name,x\nL,1\n", "line 2: is damaged"),
     (b"name,x\n" + b"9" * 200_000, "is damaged")],
)  # fmt: skip
def test_landmarks_that_are_damaged_are_one_sentence(tmp_path, data, says):
    (tmp_path / "landmarks.csv").write_bytes(data)
    with pytest.raises(InputError, match=says) as refusal:
        read_landmarks(tmp_path / "landmarks.csv")
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 1000
