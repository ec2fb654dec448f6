"""Landmarks before cameras: tags and coloured lights in images, named detections, and what is refused in words."""

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.cli import main
from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend import StanceTracks, sight_landmarks
from coloc_graph.frontend.images.apriltags import find_tags, measure_tag
from coloc_graph.frontend.landmarks import LandmarkWatch, SeenLandmarks, UnusedSighting, describe_unused, still
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.geometry.lie import floor_pose, se3_inverse
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.pipeline.inspection import inspect, landmarks_seen
from coloc_graph.results.folder import LANDMARKS, read_result
from coloc_graph.results.writer import write_result
from coloc_graph.run import Image, Motion, OdometrySample, Stance, open_run, read_true_team
from coloc_graph.simulation import Sensor, reference_team, simulate
from coloc_graph.simulation.rendering import expose
from coloc_graph.simulation.rig import MILD_LENS
from coloc_graph.simulation.tags import paint_tag
from coloc_graph.team import Floor, Landmark, Markers, Tag
from coloc_graph.viewer import LiveStance, empty_scene
from coloc_graph.viewer.live import LiveScene
from coloc_graph.viewer.sources import scene_of_estimate, scene_of_result

TAG = Tag(id=11, size=0.2, height=0.15)
LENS = (-0.30, 0.09, 1e-3, -8e-4)  # far from a pinhole
STANCE = Stance(0, 0.0, 20.0, ("A", "B"), ("C",))


def team_with(*landmarks, lens=MILD_LENS):
    return replace(reference_team(lens), floor=Floor(), landmarks=landmarks)


def seen_by(team, T_observer_landmark, rng=None, tag=TAG):
    """The image of a tag before robot A, which stands at the origin."""
    robot = team["A"]
    field = np.full((240, 320), 20.0, np.float32)
    paint_tag(field, robot.camera, robot.mount.T_body_camera, T_observer_landmark, tag)
    return expose(field, Sensor(), None if rng is None else rng.standard_normal(field.shape, dtype=np.float32))


def edges_of(team, T_observer_landmark, tag=TAG):
    """Where the middles of its right and left edge are in the image, by projection."""
    robot = team["A"]
    p = np.array([[0.0, tag.size / 2, tag.height], [0.0, -tag.size / 2, tag.height]])
    T = se3_inverse(robot.mount.T_body_camera) @ T_observer_landmark
    return robot.camera.project(p @ T[:3, :3].T + T[:3, 3])[0]


class Run:
    """The little of a run that sighting asks for."""

    def __init__(self, team):
        self.team, self.planes = team, {}


def watched(team, images):
    watch = LandmarkWatch(team["A"], team, ("C",))
    for n, pixels in enumerate(images):
        watch.look(Image("A", 2.5 * n, pixels))
    return watch.seen()


@pytest.mark.parametrize("lens", [(), MILD_LENS, LENS], ids=["pinhole", "mild", "strong"])
@pytest.mark.parametrize("distance", [1.0, 2.4])
def test_the_edges_of_a_rendered_tag_are_found_where_they_are_projected(lens, distance):
    team, rng = team_with(lens=lens), np.random.default_rng(3)
    for bearing, turned in ((0.0, 0.0), (0.3, 0.5), (-0.25, -0.6)):
        x, y = distance * np.cos(bearing), distance * np.sin(bearing)
        T = floor_pose(x, y, bearing + np.pi + turned)
        true, found = edges_of(team, T), []
        for _ in range(3):
            tags = find_tags(seen_by(team, T, rng), team["A"].camera, ["36h11"])
            found += [tag for tag in tags if tag.id == TAG.id]
        assert found, (bearing, turned)
        off = np.mean([tag.uv for tag in found], axis=0) - true
        assert np.abs(off).max() < 0.15 and true[0, 0] > true[1, 0]  # its left is to the right of who sees it
        sigma = np.sqrt(found[0].covariance.diagonal(axis1=1, axis2=2))
        assert (sigma > 0.005).all() and (sigma < 0.15).all()


def test_a_tag_s_middles_scatter_as_their_covariances_say_along_the_edges_too():
    team, rng, T = team_with(lens=()), np.random.default_rng(1), floor_pose(1.6, 0.1, np.pi + 0.3)
    tags = [tag for _ in range(25) for tag in find_tags(seen_by(team, T, rng), team["A"].camera, ["36h11"])]
    scatter = np.var([tag.uv for tag in tags if tag.id == TAG.id], axis=0, ddof=1)
    ratios = scatter / np.mean([tag.covariance.diagonal(axis1=1, axis2=2) for tag in tags], axis=0)
    assert (ratios > 0.4).all() and (ratios < 4).all()  # with edges that do not turn, v would be off by 10


def test_the_middles_are_those_of_the_edges_in_space_and_not_in_the_image():
    """A tag seen from aside: the middle of an edge is not half way between its corners in the image."""
    team = team_with(lens=())
    camera, big = team["A"].camera, Tag(id=3, size=0.4, height=0.15)
    T = floor_pose(1.2, 0.0, np.pi + 0.9)
    near = seen_by(team, T, tag=big)
    half = big.size / 2
    p = np.array([[0.0, y, big.height + z] for y, z in ((-half, half), (half, half), (half, -half), (-half, -half))])
    T_camera = se3_inverse(team["A"].mount.T_body_camera) @ T
    corners = camera.project(p @ T_camera[:3, :3].T + T_camera[:3, 3])[0]
    uv, _ = measure_tag(near, camera, corners, 8)
    naive = np.stack([corners[1] + corners[2], corners[0] + corners[3]]) / 2
    true = edges_of(team, T, big)
    assert np.abs(naive - true).max() > 0.5 and np.abs(uv - true).max() < 0.2


def test_a_tag_is_sighted_where_it_stands_as_surely_as_it_says():
    team = team_with(Landmark(name="L1", tag=TAG))
    rng, sigmas = np.random.default_rng(5), []
    for distance, bearing, turned in ((1.2, 0.2, 0.4), (1.7, -0.2, -0.3), (2.2, 0.1, 0.2), (1.5, 0.0, 0.0)):
        x, y = distance * np.cos(bearing), distance * np.sin(bearing)
        T = floor_pose(x, y, bearing + np.pi + turned)
        seen = watched(team, [seen_by(team, T, rng) for _ in range(4)])
        (made,), unused = sight_landmarks(Run(team), STANCE, [("A", seen)])
        assert not unused and (made.observer, made.seen) == ("A", "L1")
        off = se3_inverse(made.T_observer_seen) @ T
        xi = np.array([np.arctan2(off[1, 0], off[0, 0]), *off[:2, 3]])
        assert np.abs(xi[1:]).max() < 0.02 and abs(xi[0]) < np.deg2rad(4)
        sigmas.append(xi @ np.linalg.solve(made.covariance, xi))
        # what all its images share is not averaged away
        assert np.sqrt(made.x_covariance[0, 0]) > 0.04 / 301
    assert np.mean(sigmas) < 3 * 2.0


def test_edges_that_are_exchanged_are_found():
    team = team_with(Landmark(name="L1", tag=TAG))
    T = floor_pose(1.5, 0.1, np.pi + 0.2)
    seen = watched(team, [seen_by(team, T)])
    right, left = seen.tracks
    swapped = [Track("A", "L1/0", left.times, left.uv, left.covariance, left.peak),
               Track("A", "L1/1", right.times, right.uv, right.covariance, right.peak)]  # fmt: skip
    made, (doubt,) = sight_landmarks(Run(team), STANCE, [("A", SeenLandmarks(swapped))])
    assert not made and "behind its tag: left and right edge are exchanged" in doubt.why


def test_a_tag_on_its_side_one_that_is_hidden_in_part_and_a_faint_one_are_no_tags():
    team = team_with(lens=())
    camera, T = team["A"].camera, floor_pose(1.3, 0.0, np.pi)
    upright = seen_by(team, T)
    (found,) = find_tags(upright, camera, ["36h11"])
    assert found.id == TAG.id
    aside = cv2.warpAffine(upright, cv2.getRotationMatrix2D(found.uv.mean(axis=0).tolist(), 90, 1), (320, 240))
    assert not find_tags(aside, camera, ["36h11"])
    (u, v), width = found.uv[1], found.uv[0, 0] - found.uv[1, 0]
    corners = np.array([[u, v - width / 2], [u + width, v - width / 2], [u + width, v + width / 2], [u, v + width / 2]])
    measure_tag(upright, camera, corners, 8)
    hidden = upright.copy()
    hidden[int(v - width / 3) : int(v + width), int(u) - 9 : int(u) + 4] = 12
    with pytest.raises(DegenerateGeometry, match=r"faint|hidden|in front|straight"):
        measure_tag(hidden, camera, corners, 8)
    vs, us = np.mgrid[0:240, 0:320].astype(np.float32)
    wave = 1.8 * np.sin(6 * np.pi * (vs - v) / width)
    bent = cv2.remap(upright, us + wave.astype(np.float32), vs, cv2.INTER_LINEAR)
    with pytest.raises(DegenerateGeometry, match="not straight"):
        measure_tag(bent, camera, corners, 8)
    cut = int(u) - 2  # what is white beside it ends with the image
    with pytest.raises(DegenerateGeometry, match="beyond the border"):
        measure_tag(upright[:, cut:], camera, corners - [cut, 0], 8)
    with pytest.raises(DegenerateGeometry, match="white margin, and light"):
        measure_tag((upright // 12).astype(np.uint8), camera, corners, 8)
    with pytest.raises(DegenerateGeometry, match="upright"):
        measure_tag(upright, camera, np.roll(corners, 1, axis=0), 8)


def bright(team, T_observer_landmark, markers, colour, extra=()):
    """A colour image of a landmark's two lights, and of others at pixels."""
    robot, image = team["A"], np.full((240, 320, 3), 12, np.uint8)
    T = se3_inverse(robot.mount.T_body_camera) @ T_observer_landmark
    uv = robot.camera.project(markers.p_body @ T[:3, :3].T + T[:3, 3])[0]
    for u, v in [*uv.tolist(), *extra]:
        cv2.circle(image, (round(16 * u), round(16 * v)), 16 * 3, colour, -1, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 0.8), uv


GREEN = (30, 220, 30)


def test_coloured_lights_are_a_landmark_and_which_is_which_is_by_the_side_it_faces():
    lights = Markers(height=0.15, positions=((0.0, 0.2), (0.0, -0.2)), hue_deg=120.0)
    team = team_with(Landmark(name="L1", markers=lights), lens=())
    T = floor_pose(1.6, 0.2, np.pi + 0.3)
    image, uv = bright(team, T, lights, GREEN)
    seen = watched(team, [image, image])
    assert [track.marker for track in seen.tracks] == ["L1/0", "L1/1"] and not seen.unused
    assert np.abs(np.concatenate([track.uv for track in seen.tracks]) - uv).max() < 0.3
    (made,), _ = sight_landmarks(Run(team), STANCE, [("A", seen)])
    assert np.abs((made.T_observer_seen - T)[:2]).max() < 0.05


def test_lights_that_may_be_others_are_refused_in_words_and_never_guessed():
    lights = Markers(height=0.15, positions=((0.0, 0.2), (0.0, -0.2)), hue_deg=120.0)
    T = floor_pose(1.6, 0.2, np.pi + 0.3)
    team = team_with(Landmark(name="L1", markers=lights), lens=())
    three, _ = bright(team, T, lights, GREEN, extra=[(60.0, 180.0)])
    one = bright(team, floor_pose(1.6, 0.2, np.pi + 0.3), Markers(height=0.15, positions=((0.0, 0.2),)), GREEN)[0]
    wide, _ = bright(team, T, Markers(height=0.15, positions=((0.0, 0.4), (0.0, -0.4))), GREEN)
    edge_on, _ = bright(team, floor_pose(1.6, 0.0, np.pi / 2), lights, GREEN)
    assert "3 lights of its colour are in view" in watched(team, [three]).unused["L1"]
    assert not watched(team, [one]).tracks
    assert "another light is taken for it" in watched(team, [wide]).unused["L1"]
    assert "seen along the line of its two lights" in watched(team, [edge_on]).unused["L1"]
    white = team_with(Landmark(name="L1", markers=replace(lights, hue_deg=None)), lens=())
    assert "its white lights cannot be told from lamps" in watched(white, [three]).unused["L1"]
    both = team_with(*(Landmark(name=name, markers=lights) for name in ("L1", "L2")), lens=())
    unused = watched(both, [bright(team, T, lights, GREEN)[0]]).unused
    assert set(unused) == {"L1", "L2"} and all("lights of the same colour" in why for why in unused.values())
    for mover, doubted in (("C", True), ("B", False)):  # who stands is not seen in other places
        robots = [replace(r, markers=replace(r.markers, hue_deg=120.0)) if r.name == mover else r for r in team.robots]
        seen = watched(replace(team, robots=tuple(robots)), [bright(team, T, lights, GREEN)[0]])
        assert ("others have lights of the same colour" in seen.unused.get("L1", "")) is doubted
        assert bool(seen.tracks) is not doubted


def test_a_camera_that_stands_looks_every_other_second_and_more_images_make_it_no_surer():
    lights = Markers(height=0.15, positions=((0.0, 0.2), (0.0, -0.2)), hue_deg=120.0)
    team = team_with(Landmark(name="L1", markers=lights), lens=())
    image, _ = bright(team, floor_pose(1.6, 0.2, np.pi + 0.3), lights, GREEN)
    sigmas = []
    for times in ((0.0,), (0.0, 0.5, 1.0, 1.9), (0.0, 2.0, 4.0, 6.0)):
        watch = LandmarkWatch(team["A"], team, ("C",))
        for time in times:
            watch.look(Image("A", time, image))
        sigmas.append(watch.seen().tracks[0].covariance[0, 0, 0] ** 0.5)
    assert sigmas[1] == sigmas[0] and sigmas[2] < 0.8 * sigmas[0]


def test_what_is_not_used_is_told_once_and_counted():
    L1, L2 = ([UnusedSighting(name, "A", k, f"it is {px} px off") for k, px in places] for name, places in
              (("L1", ((3, 4), (5, 7), (8, 9))), ("L2", ((4, 4),))))  # fmt: skip
    assert describe_unused([*L1, *L2]) == [
        "stance 3 (and 2 more): landmark L1 is not used as A sees it: it is 4 px off",
        "stance 4: landmark L2 is not used as A sees it: it is 4 px off",
    ]


def test_one_false_sample_moves_no_landmark_and_a_plane_that_is_stated_leaves_them_out():
    team = team_with(Landmark(name="L1", tag=TAG), lens=())
    T = floor_pose(1.5, 0.1, np.pi + 0.2)
    uv, rng = edges_of(team, T), np.random.default_rng(2)
    tracks = []
    for n in range(2):
        seen = uv[n] + 0.05 * rng.standard_normal((9, 2))
        seen[4] += 30.0
        tracks.append(Track("A", f"L1/{n}", np.arange(9.0), seen, np.tile(0.0025 * np.eye(2), (9, 1, 1)), np.zeros(9)))
    run = Run(team)
    (made,), unused = sight_landmarks(run, STANCE, [("A", SeenLandmarks(tracks))])
    assert not unused and np.abs((made.T_observer_seen - T)[:2]).max() < 0.01
    assert sight_landmarks(run, STANCE, [("A", SeenLandmarks(tracks))], {("A", "L1")}) == ([], [])
    run.planes = {STANCE.index: None}
    assert sight_landmarks(run, STANCE, [("A", SeenLandmarks(tracks))]) == ([], [])


def test_a_light_that_moves_is_no_landmark_and_one_false_sample_is_left_out():
    rng, n = np.random.default_rng(0), 30
    uv = 100 + 0.3 * rng.standard_normal((n, 2))
    C = np.broadcast_to(0.09 * np.eye(2), (n, 2, 2))
    uv[7] += 40.0
    uv[11] += 2.0
    track = Track("A", "L1/0", np.arange(n, dtype=float), uv, C, np.zeros(n))
    assert set(track.times) - set(still(track).times) == {7.0, 11.0}
    moving = Track("A", "L1/0", track.times, uv + np.arange(n)[:, None], C, track.peak)
    with pytest.raises(DegenerateGeometry, match="L1/0 is not at rest"):
        still(moving)


@pytest.fixture(scope="module")
def lap(tmp_path_factory):
    """A short lap with two landmarks on a map, as tracks."""
    path = tmp_path_factory.mktemp("landmarks") / "run.mcap"
    simulate("landmarks", path, length=9.0, laps=1, landmark_every=4.5, points=16, known=True, seed=1)
    return path


@pytest.fixture(scope="module")
def solved(lap):
    return solve(open_run(lap), SolveOptions())


def test_a_run_with_landmarks_is_solved_and_they_are_where_they_truly_are(lap, solved):
    estimate = solved.estimate
    assert len(estimate.landmarks) == 2 and not estimate.rejected and not solved.warnings
    true = {one.name: floor_pose(*one.position, np.deg2rad(one.yaw_deg)) for one in read_true_team(lap).landmarks}
    # in the map's frame, which is the true floor's but for the survey
    for name, placed in estimate.landmarks.items():
        T = estimate.map.T_world_body.inverse().compose(placed.T_world_body).matrix()
        assert np.abs((T - true[name])[:2, 3]).max() < 0.02
    assert all(len(seen) >= 2 for seen in estimate.graph.sighted.values())
    # who has stayed put counts a landmark once, though it saw it in both stances
    seen = [(one.observer, one.stance, one.seen) for s in estimate.graph.sighted.values() for one in s]
    assert not [one for one in seen if (one[0], one[1] + 1, one[2]) in seen]


def test_a_result_tells_where_landmarks_are_and_the_viewer_shows_them(lap, solved, tmp_path, capsys):
    write_result(solved, tmp_path / "result")
    summary = read_result(tmp_path / "result").summary
    assert [row["name"] for row in summary["landmarks"]] == ["L1", "L2"]
    assert summary["map"]["x_sigma"] > 0
    rows = (tmp_path / "result" / LANDMARKS).read_text().splitlines()
    assert rows[0].startswith("name,x,y,yaw_deg,x_sigma") and len(rows) == 3
    report = (tmp_path / "result" / "report.html").read_text()
    assert "<h2>Landmarks</h2>" in report and "The map's origin" in report
    on_disk, in_memory = (
        scene.landmarks
        for scene in (scene_of_result(tmp_path / "result"), scene_of_estimate(solved.estimate, run=solved.run))
    )
    assert on_disk.names == in_memory.names == ("L1", "L2")
    np.testing.assert_allclose(on_disk.xy, in_memory.xy)
    np.testing.assert_allclose(on_disk.covariance, in_memory.covariance, rtol=1e-9)
    assert len(on_disk.sightings) == len(in_memory.sightings) == sum(map(len, solved.estimate.graph.sighted.values()))
    (tmp_path / "result" / LANDMARKS).write_text(rows[0] + "\nL1,one,2,3,4,5,6,7,8\n")
    with pytest.raises(InputError, match=r"landmarks.csv, line 2"):
        scene_of_result(tmp_path / "result")


def test_landmarks_come_in_stance_by_stance_as_they_do_at_once(lap, solved):
    """With pixels and mounts, too: what is far off when it comes is led in by poses."""
    live = LiveScene(empty_scene(open_run(lap), "joint"))
    counts = []

    def told(one):
        live.add(LiveStance(one.stance, one.estimate, one.measurements, one.pairs))
        counts.append(len(live.scene().landmarks))

    by_stance = solve(open_run(lap), SolveOptions(incremental=True), on_update=told)
    # a viewer that looks on shows them as they come
    assert counts == sorted(counts) and counts[0] < counts[-1] == 2
    shown = live.scene().landmarks
    assert len(shown.sightings) == sum(map(len, solved.estimate.graph.sighted.values()))
    for name, place in zip(shown.names, shown.xy, strict=True):
        np.testing.assert_allclose(place, solved.estimate.landmarks[name].planar[:2], atol=0.02)
    for name, placed in solved.estimate.landmarks.items():
        # but for the noise of pixels, of which the first stances knew less
        off = placed.T_world_body.localCoordinates(by_stance.estimate.landmarks[name].T_world_body)
        assert (np.abs(off) < 0.3 * np.sqrt(np.diag(placed.covariance))).all(), (off, placed.covariance)
    assert not by_stance.estimate.rejected


def test_info_counts_where_landmarks_are_seen(lap, capsys):
    run = open_run(lap)
    seen = landmarks_seen(run)
    assert [one.landmark.name for one in seen] == ["L1", "L2"] and all(one.stances for one in seen)
    assert main(["info", str(lap), "--json"]) == 0
    assert '"what": "two lights"' in capsys.readouterr().out


def test_detections_of_a_landmark_that_the_team_does_not_have_say_so(lap, tmp_path, copied):
    run = open_run(lap)
    there = landmarks_seen(run)[1].stances
    team = replace(run.team, landmarks=run.team.landmarks[:1])
    copy = copied(
        lap, tmp_path / "run.mcap", team=team, stances=[s for s in run.stances if s.index in there],
        change=lambda record: None if isinstance(record, OdometrySample | Motion) else record,
    )  # fmt: skip
    words = "name `L2/0`, but the team has no robot or landmark `L2`"
    with pytest.raises(InputError, match=words):
        solve(open_run(copy), SolveOptions())
    assert any(words in finding.what for finding in inspect(open_run(copy)))


def test_a_landmark_is_never_taken_for_a_mover(lap):
    run = open_run(lap)
    first = landmarks_seen(run)[0].stances[0]
    stance = next(s for s in run.stances if s.index == first)
    tracks = StanceTracks(run, stance)
    for robot in stance.observers:
        assert {track.marker[0] for track in tracks.of(robot)} == {"C"}
    assert any(tracks.landmarks(robot).tracks for robot in stance.observers)


def test_wrong_lengths_are_told(tmp_path):
    for options, words in (
        ({"length": 10.0, "laps": 4}, "no room for four corners"),
        ({"landmark_every": 0.0}, "`landmark_every` is 0"),
        ({"laps": 0}, "`laps` is 0"),
        ({"stances": 7}, "give that instead of `stances`"),
    ):
        with pytest.raises(InputError, match=words):
            simulate("landmarks", tmp_path / "run.mcap", **options)
    with pytest.raises(InputError, match="`known` belongs to landmarks"):
        simulate("hallway", tmp_path / "run.mcap", known=True)
    with pytest.raises(InputError, match="belong to landmarks, not to hallway"):
        simulate("hallway", tmp_path / "run.mcap", laps=2)
    assert not list(tmp_path.iterdir())
