"""A result for Foxglove: every message is decoded from the schemas in the file alone, and says what we estimated."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from coloc_graph.cli import main
from coloc_graph.exchange.foxglove_export import write_foxglove
from coloc_graph.exchange.landmarks import LandmarkRow
from coloc_graph.exchange.tum import read_tum
from coloc_graph.results.folder import read_result
from coloc_graph.run import open_run, read_truth
from coloc_graph.run.schemas import to_ns


@pytest.fixture(scope="module")
def exported(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("foxglove") / "result.mcap"
    assert main(["export", "foxglove", str(result), "--out", str(path), "--layout"]) == 0
    return path


def decoded(path):
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(schema.name, channel.topic, message.log_time, content)
                for schema, channel, message, content in reader.iter_decoded_messages()]  # fmt: skip


@pytest.fixture(scope="module")
def messages(exported):
    return decoded(exported)


def of(messages, schema):
    return [one for one in messages if one[0] == f"foxglove.{schema}"]


def test_poses_frames_and_covariances_are_the_estimate(messages, result):
    estimate = read_result(result)
    for robot, trajectory in estimate.trajectories.items():
        poses = [one for one in of(messages, "Odometry") if one[1] == f"/{robot}/pose"]
        assert len(poses) == len(trajectory)
        for (_, _, ns, pose), time, T, C in zip(
            poses, trajectory.times, trajectory.T_world_body, trajectory.covariances, strict=True
        ):
            assert ns == pytest.approx(time * 1e9, abs=1000)
            p = pose.pose.position
            np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3], atol=1e-12)
            around = np.reshape(pose.pose_covariance, (6, 6))
            np.testing.assert_allclose(around[:3, :3], T[:3, :3] @ C[3:, 3:] @ T[:3, :3].T, atol=1e-15)
    frames = {
        one.child_frame_id: one.parent_frame_id for m in of(messages, "FrameTransforms") for one in m[3].transforms
    }
    robots = set(estimate.trajectories)
    assert frames == {"truth": "world"} | {
        f"{root}{robot}/{frame}": parent if frame == "base_link" else f"{root}{robot}/base_link"
        for robot in robots
        for root, parent in (("", "world"), ("truth/", "truth"))
        for frame in ("base_link", "camera")
    }


def test_truth_is_in_the_world_of_the_estimate(messages, result):
    at = {
        (m[2], one.child_frame_id): one.translation for m in of(messages, "FrameTransforms") for one in m[3].transforms
    }
    off = [
        np.hypot(p.x - at[ns, f"truth/{frame}"].x, p.y - at[ns, f"truth/{frame}"].y)
        for (ns, frame), p in at.items()
        if frame.endswith("base_link") and not frame.startswith("truth/")
    ]
    assert 1e-6 < max(off) < 0.1  # m: it is no copy, and it is near


def test_the_scene_has_robots_markers_edges_by_residual_and_ellipses(messages, result):
    entities = {one.id: one for m in of(messages, "SceneUpdate") for one in m[3].entities}
    team = read_result(result).team
    for robot in team.robots:
        body = entities[f"robot {robot.name}"]
        assert body.frame_id == f"{robot.name}/base_link" and len(body.cubes) == 1
        assert [(s.pose.position.x, s.pose.position.y) for s in body.spheres] == list(robot.markers.positions)
        assert len(entities[f"ellipse {robot.name}"].lines[0].points) == 48
    (lines,) = entities["measurements"].lines
    rows = [line for line in (result / "measurements.csv").read_text().splitlines()[1:] if ",yes," in line]
    assert len(lines.points) == len(lines.colors) == 2 * len(rows)
    assert len({(color.r, color.g) for color in lines.colors}) > 3


def test_cameras_and_annotations(messages, result):
    estimate = read_result(result)
    cameras = {one[1]: one[3] for one in of(messages, "CameraCalibration")}
    for robot in estimate.team.robots:
        camera = cameras[f"/{robot.name}/calibration"]
        assert list(camera.K) == [robot.camera.fx, 0, robot.camera.cx, 0, robot.camera.fy, robot.camera.cy, 0, 0, 1]
        assert (camera.width, camera.height, len(camera.P)) == (robot.camera.width, robot.camera.height, 12)
    run = open_run(estimate.run_path)
    annotations = [one for one in of(messages, "ImageAnnotations") if one[1] == "/A/annotations"]
    for seen, (_, _, _, drawn) in zip(run.detections("A"), annotations, strict=True):
        assert [(c.position.x, c.position.y) for c in drawn.circles] == [tuple(uv) for uv in seen.uv.tolist()]


def test_tracks_annotate_the_images_of_stances(result, tmp_path, capsys):
    path = tmp_path / "tracks.mcap"
    assert main(["export", "foxglove", str(result), "--out", str(path), "--tracks"]) == 0
    assert "stances tracked: " in capsys.readouterr().err
    run = open_run(read_result(result).run_path)
    drawn = {one[2]: one[3] for one in of(decoded(path), "ImageAnnotations") if one[1] == "/A/annotations"}
    for stance in run.stances:
        for seen in run.detections("A", stance.start, stance.end):
            if len(seen.markers):
                found = drawn[to_ns(seen.time)]
                assert {(c.position.x, c.position.y) for c in found.circles} == {tuple(uv) for uv in seen.uv.tolist()}
                assert {one.text for one in found.texts} == set(seen.markers)


def test_landmarks_are_in_the_scene(result, tmp_path):
    estimate = read_result(result)
    row = LandmarkRow("L1", 1.0, 2.0, 0.0, 0.1, 0.2, 0.5, 1.0, False, 3)
    write_foxglove(estimate.trajectories, estimate.team, tmp_path / "x.mcap", landmarks=[row])
    entities = {one.id: one for m in of(decoded(tmp_path / "x.mcap"), "SceneUpdate") for one in m[3].entities}
    points = np.array([(p.x, p.y) for p in entities["landmark L1"].lines[0].points]) - (1, 2)
    C = np.array([[0.01, 0.01], [0.01, 0.04]])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", points, np.linalg.inv(C), points), 5.991, rtol=1e-3)


def test_the_layout_is_written_beside_it_and_nothing_is_overwritten(exported, result, capsys):
    layout = json.loads(exported.with_suffix(".json").read_text())
    assert layout["layout"] and all(key in json.dumps(layout["layout"]) for key in layout["configById"])
    capsys.readouterr()
    assert main(["export", "foxglove", str(result), "--out", str(exported)]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["export", "g2o", str(result), "--out", str(exported) + "x", "--layout"]) == 2
    assert "--layout applies to foxglove" in capsys.readouterr().err
    assert main(["export", "g2o", str(result), "--out", str(exported) + "x", "--truth"]) == 2
    assert "--truth applies to tum and ros2" in capsys.readouterr().err


def test_truth_is_exported_as_tum(result, tmp_path, capsys):
    assert main(["export", "tum", str(result), "--out", str(tmp_path / "truth"), "--truth"]) == 0
    for robot, true in read_truth(read_result(result).run_path).items():
        read = read_tum(tmp_path / "truth" / f"{robot}.tum")
        np.testing.assert_allclose(read.T_world_body, true.T_world_body, atol=1e-12)
        assert np.array_equal(read.times, true.times)
