"""A user's own tracks: what comes in is what was given, solves exactly, and every bad file has its sentence."""

import itertools
import re
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from coloc_graph.errors import ColocError, RunError, TeamError, TracksError
from coloc_graph.exchange.tracks import ImportSummary, import_tracks
from coloc_graph.geometry.lie import floor_pose, se3, se3_inverse, so3_exp, so3_log
from coloc_graph.pipeline import batch as pipeline
from coloc_graph.pipeline.inspection import inspect
from coloc_graph.run import Motion, Stance, open_run
from coloc_graph.team import Camera, Floor, Markers, Mount, Robot, Team, write_team
from coloc_graph.team.camera import LENS_TERMS

CAMERA = Camera(width=640, height=480, fx=500.0, fy=510.0, cx=320.0, cy=240.0, distortion=(-0.1, 0.02, 1e-3, -1e-3))
MOUNT = Mount(height=0.5, tilt_deg=25.0)
T0 = 1_700_000_000.0
HEADER = "stance,time,robot,marker,u,v\n"


def team(*, markers_on=("C",), noise_px=0.25, names=("A", "B", "C")):
    markers = Markers(height=0.1, positions=((0.0, 0.12), (0.0, -0.12)))
    robots = tuple(
        Robot(
            name=name,
            camera_if_any=msgspec.structs.replace(CAMERA, noise_px=noise_px),
            mount_if_any=MOUNT,
            markers=markers if name in markers_on else None,
        )
        for name in names
    )
    return Team(reference="A", robots=robots, floor=Floor())


def grid_on_floor():
    """Points of the marker plane that both observers below see, (n, 3) [m], world."""
    x, y = np.meshgrid(np.linspace(0.9, 1.7, 5), np.linspace(-0.3, 0.3, 5))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.1)], axis=1)


def seen(T_world_camera, points):
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    uv, inside = CAMERA.project((points - t) @ R)
    assert inside.all()
    return uv


def rows(stance, robot, uv, start, dt=0.1):
    """Rows of one marker that is at each point in turn."""
    return [f"{stance},{start + k * dt:.6f},{robot},led,{u:.12f},{v:.12f}\n" for k, (u, v) in enumerate(uv.tolist())]


@pytest.fixture
def files(tmp_path):
    """Writes team and CSVs, imports them, and gives the summary; `out` is where the run goes."""

    class Files:
        out = tmp_path / "run.mcap"

        def bring_in(self, tracks, *, planes=None, moves=None, of=None, progress=None):
            write_team(of or team(), tmp_path / "team.toml")
            paths = {}
            for name, content in (("tracks", tracks), ("planes", planes), ("moves", moves)):
                if content is not None:
                    paths[f"{name}_path"] = tmp_path / f"{name}.csv"
                    data = content.encode() if isinstance(content, str) else content
                    (tmp_path / f"{name}.csv").write_bytes(data)
            return import_tracks(tmp_path / "team.toml", paths.pop("tracks_path"), self.out, **paths, progress=progress)

    return Files()


T_WORLD_B = floor_pose(0.1, 0.6, -0.4)


def two_observers(stance=0, start=T0, T_world_a=None):
    T_world_a = np.eye(4) if T_world_a is None else T_world_a
    points = grid_on_floor()
    return [
        *rows(stance, "A", seen(T_world_a @ MOUNT.T_body_camera, points), start),
        *rows(stance, "B", seen(T_WORLD_B @ MOUNT.T_body_camera, points), start),
    ]


def test_points_without_noise_give_the_pose_exactly(files):
    summary = files.bring_in(HEADER + "".join(two_observers()))
    assert summary == ImportSummary(stances=1, rows=50, observers=("A", "B"), warnings=())
    for method in ("chain", "smooth"):
        solution = pipeline.solve(open_run(files.out), pipeline.SolveOptions(method=method))
        np.testing.assert_allclose(solution.estimate.pose("B", 0).matrix(), T_WORLD_B, atol=1e-6)
        # the points are no two markers of C, which is said where robots are sighted
        said = [] if method == "chain" else ["the names of its markers do not identify them"]
        warnings = [warning.split(": ")[-1].split(";")[0] for warning in solution.warnings]
        # and that the points have less noise than is stated
        assert [one for one in warnings if one != "predicted uncertainties are too large"] == said


def test_stated_planes_give_the_pose_of_cameras_off_the_floor_exactly(files):
    # a slanted plane that no mount knows of, and no robot that carries markers
    T_world_plane = se3(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([1.4, 0.0, 0.2]))
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 4), np.linspace(-0.25, 0.25, 4))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    points = flat @ T_world_plane[:3, :3].T + T_world_plane[:3, 3]
    T_world_c = MOUNT.T_body_camera
    N = T_world_c[:3, :3].T @ T_world_plane[:3, 2]
    d = N @ (T_world_c[:3, :3].T @ (T_world_plane[:3, 3] - T_world_c[:3, 3]))
    N, d = N * np.sign(d), abs(d)
    tracks = rows(0, "A", seen(T_world_c, points), T0) + rows(0, "B", seen(T_WORLD_B @ T_world_c, points), T0)
    planes = "stance,robot,nx,ny,nz,d\n0,A," + ",".join(f"{value:.15f}" for value in (*N, d)) + "\n"
    files.bring_in(HEADER + "".join(tracks), planes=planes, of=team(markers_on=()))

    run = open_run(files.out)
    assert run.planes[0].planes["A"] == pytest.approx((*N, d), abs=1e-12)
    solution = pipeline.solve(run, pipeline.SolveOptions(method="chain"))
    np.testing.assert_allclose(solution.estimate.pose("B", 0).matrix(), T_WORLD_B, atol=1e-6)


def boards(rng, normal_off_deg, d_off, normal_sigma_deg, d_sigma, noise_px=0.0, lenses=None):
    """Rows of tracks and planes of eight boards before two cameras that never moved.

    Stated planes are `..._off` from the true ones (one sigma; of d relative to d) and say `..._sigma`. `lenses` are
    coefficients of `Camera.lens_terms` by robot.
    """
    T_world_c = MOUNT.T_body_camera
    tracks, planes = [], "stance,robot,nx,ny,nz,d,normal_sigma_deg,d_sigma\n"
    for k in range(8):
        T_world_plane = se3(so3_exp(rng.normal((0.0, -0.3, 0.0), 0.25)), np.array([1.4, 0.0, 0.2]))
        x, y = np.meshgrid(np.linspace(-0.25, 0.25, 4), np.linspace(-0.25, 0.25, 4))
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        points = flat @ T_world_plane[:3, :3].T + T_world_plane[:3, 3]
        N = T_world_c[:3, :3].T @ T_world_plane[:3, 2]
        d = N @ (T_world_c[:3, :3].T @ (T_world_plane[:3, 3] - T_world_c[:3, 3]))
        off = so3_exp(np.deg2rad(normal_off_deg) * rng.normal(size=3)) @ (N * np.sign(d))
        stated = (*off, abs(d) * (1 + d_off * rng.normal()), normal_sigma_deg, d_sigma * abs(d))
        planes += f"{k},A," + ",".join(f"{value:.12f}" for value in stated) + "\n"
        for robot, T in (("A", T_world_c), ("B", T_WORLD_B @ T_world_c)):
            uv = seen(T, points)
            uv += noise_px * rng.normal(size=uv.shape)
            if lenses is not None:
                uv += CAMERA.lens_terms(uv) @ lenses[robot]
            tracks += rows(k, robot, uv, T0 + 10 * k)
    return tracks, planes


def test_planes_that_are_stated_with_sigmas_are_found_along_with_the_pose(files):
    """Eight boards before two cameras that never moved; each is stated 2 deg and 3 % off, and said to be."""
    tracks, planes = boards(
        np.random.default_rng(1), normal_off_deg=2.0, d_off=0.03, normal_sigma_deg=2.0, d_sigma=0.03
    )
    files.bring_in(HEADER + "".join(tracks), planes=planes, moves=MOVES, of=team(markers_on=()))
    run = open_run(files.out)
    normal_sigma, d_sigma = run.planes[3].sigmas["A"]
    assert normal_sigma == pytest.approx(np.deg2rad(2.0)) and 0.02 < d_sigma / run.planes[3].planes["A"][3] < 0.04

    estimate = pipeline.solve(run).estimate
    T = se3_inverse(T_WORLD_B) @ estimate.pose("B", 0).matrix()
    shift, turn = np.linalg.norm(T[:3, 3]), np.linalg.norm(so3_log(T[:3, :3]))
    # the tilts come out of the homographies by themselves, the scale from eight distances
    length = np.linalg.norm(T_WORLD_B[:3, 3])
    assert turn < 1e-3 and shift < 3 * 0.03 / np.sqrt(8) * length
    assert len(estimate.calibration.values) == 8 + 2  # planes, and what both lens models leave
    assert estimate.chi2 / estimate.dof < 2


def test_what_lenses_leave_in_all_stances_does_not_spoil_a_pose_by_loosely_stated_planes(files):
    nees = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        lenses = {robot: rng.normal(size=LENS_TERMS) for robot in "AB"}
        stated = boards(rng, 0.1, 0.001, normal_sigma_deg=0.4, d_sigma=0.004, noise_px=0.05, lenses=lenses)
        files.bring_in(
            HEADER + "".join(stated[0]), planes=stated[1], moves=MOVES, of=team(markers_on=(), noise_px=0.05)
        )
        estimate = pipeline.solve(open_run(files.out)).estimate
        T = se3_inverse(estimate.pose("B", 0).matrix()) @ T_WORLD_B
        xi = np.concatenate([so3_log(T[:3, :3]), T[:3, 3]])
        nees.append(xi @ np.linalg.solve(estimate.covariance("B", 0), xi) / 6)
    assert 0.1 < np.mean(nees) < 2.0  # above 3 with lenses as exact


def test_what_is_read_back_is_what_was_given(files):
    tracks = (
        "stance,time,robot,marker,u,v,sigma\n"
        "0,100.5,B,x,1.5,2.5,0.5\n0,100,A,x,10,20,0.1\n0,100,A,y,30,40,0.2\n0,100.5,A,x,11,21,0.3\n"
    )
    reported = []
    summary = files.bring_in(tracks, progress=lambda done, of: reported.append((done, of)))
    assert (summary.rows, summary.observers) == (4, ("A", "B"))
    assert reported == [(4, 4)]

    run = open_run(files.out)
    assert run.team == team()
    assert run.stances == (Stance(0, 100.0, 100.5, ("A", "B"), ("C",)),)
    first, second = run.detections("A")
    assert (first.time, first.markers, second.time, second.markers) == (100.0, ("x", "y"), 100.5, ("x",))
    np.testing.assert_array_equal(first.uv, [[10, 20], [30, 40]])
    np.testing.assert_allclose(first.covariance, [0.01 * np.eye(2), 0.04 * np.eye(2)])
    (only,) = run.detections("B")
    np.testing.assert_allclose(only.covariance, [0.25 * np.eye(2)])


def test_without_sigma_the_noise_is_the_cameras(files):
    files.bring_in(HEADER + "0,1,A,x,1,1\n0,1,B,x,1,1\n", of=team(noise_px=0.7))
    (one,) = open_run(files.out).detections("B")
    np.testing.assert_allclose(one.covariance, [0.49 * np.eye(2)])


def test_the_same_files_give_the_same_bytes(files):
    files.bring_in(HEADER + "".join(two_observers()))
    before = files.out.read_bytes()
    files.bring_in(HEADER + "".join(two_observers()))
    assert files.out.read_bytes() == before


@pytest.mark.parametrize("change", [lambda t: "\ufeff" + t, lambda t: t.replace("\n", "\r\n"), lambda t: t + "\n \n"])
def test_what_spreadsheets_write_is_accepted(files, change):
    assert files.bring_in(change(HEADER + "".join(two_observers()))).rows == 50


def stances(*observers):
    """Tracks with one row for each robot in each stance."""
    return HEADER + "".join(f"{k},{10 * k + 1},{r},x,9,9\n" for k, who in enumerate(observers) for r in who)


def test_without_moves_observers_stay_put_and_a_warning_says_so(files):
    summary = files.bring_in(stances("AB", "AB", "AB"))
    assert [stance.anchors for stance in open_run(files.out).stances] == [(), ("A", "B"), ("A", "B")]
    (warning,) = summary.warnings
    assert "3 stances" in warning and "stayed put" in warning and "--moves" in warning


def test_moves_name_who_is_no_anchor(files):
    summary = files.bring_in(stances("AB", "AB", "AB"), moves="stance,robot\n1,B\n2,A\n2,A\n")
    assert summary.warnings == ()
    run = open_run(files.out)
    assert [stance.anchors for stance in run.stances] == [(), ("A",), ("B",)]
    assert list(run.motions("B")) == [Motion("B", 1.0, True), Motion("B", 11.0, False)]
    assert list(run.motions("A")) == [Motion("A", 11.0, True), Motion("A", 21.0, False)]


def test_moves_without_rows_say_that_nobody_moved(files):
    assert files.bring_in(stances("AB", "AB"), moves="stance,robot\n").warnings == ()
    assert open_run(files.out).stances[1].anchors == ("A", "B")


def test_a_robot_that_was_the_mover_is_no_anchor_afterwards(files):
    files.bring_in(stances("AB", "BC", "ABC"), of=team(markers_on=("A", "B", "C")), moves="stance,robot\n")
    found = open_run(files.out).stances
    assert [stance.movers for stance in found] == [("C",), ("A",), ()]
    assert [stance.anchors for stance in found] == [(), ("B",), ("B", "C")]


def test_a_robot_that_sees_nothing_for_a_stance_still_stands(files):
    of = team(names=("A", "B", "C", "D"), markers_on=("D",))
    files.bring_in(stances("ABC", "AB", "ABC"), of=of, moves="stance,robot\n")
    assert [stance.anchors for stance in open_run(files.out).stances] == [(), ("A", "B", "C"), ("A", "B", "C")]


def test_a_moved_observer_is_found_where_it_went(files):
    T_world_a = floor_pose(-0.1, -0.1, 0.05)
    tracks = HEADER + "".join(two_observers() + two_observers(1, T0 + 10, T_world_a))
    files.bring_in(tracks, moves="stance,robot\n1,A\n")
    estimate = pipeline.solve(open_run(files.out)).estimate
    np.testing.assert_allclose(estimate.pose("A", 1).matrix(), T_world_a, atol=1e-6)
    np.testing.assert_allclose(estimate.pose("B", 1).matrix(), T_WORLD_B, atol=1e-6)


def test_rows_outside_of_the_image_are_warned_of(files):
    (warning,) = files.bring_in(HEADER + "0,1,A,x,640.4,-1.4\n0,1,B,x,700,5\n0,2,B,x,5,-9\n").warnings
    assert "2 of 3 rows" in warning and "line 3" in warning and "640 x 480" in warning


def test_a_row_far_outside_of_the_image_does_not_spoil_its_stance(files):
    far = [f"0,{T0 + 60},{robot},led,1e5,1e5\n" for robot in "AB"]
    assert np.isnan(CAMERA.normalise([[1e5, 1e5]])).all()  # or this tests nothing
    files.bring_in(HEADER + "".join(two_observers() + far))
    estimate = pipeline.solve(open_run(files.out)).estimate
    np.testing.assert_allclose(estimate.pose("B", 0).matrix(), T_WORLD_B, atol=1e-6)


def test_a_stance_with_one_observer_is_warned_of(files):
    (warning,) = files.bring_in(stances("AB", "B"), moves="stance,robot\n").warnings
    assert "1 of 2 stances" in warning and "stance 1, with `B`" in warning


OK = HEADER + "0,1,A,x,9,9\n0,1,B,x,9,9\n1,2,A,x,9,9\n1,2,B,x,9,9\n"
PLANES = "stance,robot,nx,ny,nz,d\n"
MOVES = "stance,robot\n"
BAD = {
    "wrong header": ({"tracks": "stance,t,robot,marker,u,v\n"}, "line 1: the header is `stance,t,robot,.*must be"),
    "no header": ({"tracks": "0,1,A,x,9,9\n"}, r"`0,1,A,x,9,9`; it must be `stance,time,robot,marker,u,v\[,sigma\]`"),
    "missing column": ({"tracks": HEADER + "0,1,A,x,9\n"}, "line 2: 5 columns, where the header has 6"),
    "extra column": ({"tracks": HEADER + "0,1,A,x,9,5,9,5\n"}, "line 2: 8 columns.*decimals take a point"),
    "no number": ({"tracks": HEADER + "0,1,A,x,9,9\n0,2,A,x,9,nine\n"}, "line 3: `v` is `nine`, not a number"),
    "empty cell": ({"tracks": HEADER + "0,1,A,x,,9\n"}, "line 2: `u` is ``, not a number; remove"),
    "blank lines count": ({"tracks": HEADER + "\n\n0,1,A,x,,9\n"}, "line 4: `u` is"),
    "no time": ({"tracks": HEADER + "0,noon,A,x,9,9\n"}, "line 2: `time` is `noon`, not a number"),
    "NaN pixel": ({"tracks": HEADER + "0,1,A,x,nan,9\n"}, "line 2: `u` is `nan`; remove"),
    "infinite pixel": ({"tracks": HEADER + "0,1,A,x,9,-inf\n"}, "line 2: `v` is `-inf`; remove"),
    "sigma zero": ({"tracks": HEADER[:-1] + ",sigma\n0,1,A,x,9,9,0\n"}, "line 2: `sigma` is 0; give the standard"),
    "sigma negative": ({"tracks": HEADER[:-1] + ",sigma\n0,1,A,x,9,9,-2\n"}, "line 2: `sigma` is -2"),
    "time backwards": (
        {"tracks": HEADER + "0,5,A,x,9,9\n0,1,B,x,9,9\n0,4,A,x,9,9\n"},
        r"line 4: the time of marker `x` in robot `A` at stance 0 runs backwards, from 5 s \(line 2\) to 4 s",
    ),
    "marker twice": (
        {"tracks": HEADER + "0,5,A,x,9,9\n0,5,B,x,9,9\n0,5,A,x,8,8\n"},
        r"line 4: marker `x` in robot `A` at stance 0 is there twice at 5 s \(also in line 2\)",
    ),
    "time negative": ({"tracks": HEADER + "0,-1,A,x,9,9\n"}, "line 2: `time` is -1; give UTC seconds"),
    "time in nanoseconds": ({"tracks": HEADER + "0,1.7e18,A,x,9,9\n"}, "line 2: `time` is 1.7e18; give UTC seconds"),
    "unknown robot": ({"tracks": HEADER + "0,1,A,x,9,9\n0,1,Z,x,9,9\n"}, r"line 3: robot `Z` .* team \(A, B, C\)"),
    "empty file": ({"tracks": ""}, "tracks.csv: is empty; begin it with the header stance,time"),
    "only a header": ({"tracks": HEADER}, "tracks.csv: has a header and no rows"),
    "one observer": ({"tracks": stances("A", "B")}, r"every stance has only one observer \(stance 0 has `A`\)"),
    "nameless marker": ({"tracks": HEADER + "0,1,A,,9,9\n"}, "line 2: `marker` is empty"),
    "stance negative": ({"tracks": HEADER + "-1,1,A,x,9,9\n"}, "line 2: `stance` is -1; number"),
    "stance fractional": ({"tracks": HEADER + "0.5,1,A,x,9,9\n"}, "line 2: `stance` is `0.5`, not a whole number"),
    "stance huge": ({"tracks": HEADER + "9" * 30 + ",1,A,x,9,9\n"}, "line 2: `stance` is 999"),
    "stances overlap": (
        {"tracks": HEADER + "0,1,A,x,9,9\n0,6,B,x,9,9\n1,6,A,x,9,9\n"},
        r"line 4: stance 1 begins at 6 s, not after stance 0 ends at 6 s \(line 3\)",
    ),
    "stances out of order": ({"tracks": HEADER + "1,1,A,x,9,9\n0,5,A,x,9,9\n"}, "stance 1 begins at 1 s, not after"),
    "not UTF-8": ({"tracks": HEADER.encode() + b"0,1,A,\xff,9,9\n"}, "line 2: is not UTF-8 text"),
    "UTF-16": ({"tracks": OK.encode("utf-16")}, "is text in UTF-16; save it as UTF-8"),
    "open quote": ({"tracks": HEADER + '0,1,A,"x,9,9\n'}, "line 2: is not CSV"),
    "planes header": ({"planes": "stance,robot,n\n"}, r"line 1: the header is .* `stance,robot,nx,ny,nz,d\[,normal"),
    "planes sigma": (
        {"planes": PLANES[:-1] + ",normal_sigma_deg,d_sigma\n0,A,0,0,1,1,-1,0\n"},
        "`normal_sigma_deg` is -1",
    ),
    "planes only a header": ({"planes": PLANES}, "planes.csv: has a header and no rows"),
    "normal not unit": (
        {"planes": PLANES + "0,A,0,0,1.002,1\n"},
        "planes.csv, line 2: .* has length 1.002; give a unit",
    ),
    "normal zero": ({"planes": PLANES + "0,A,0,0,0,1\n"}, "line 2: .* has length 0; give a unit normal$"),
    "normal turned": ({"planes": PLANES + "0,A,0,0,-1,1\n"}, "line 2: .* behind this normal.*turn its sign"),
    "d zero": ({"planes": PLANES + "0,A,0,0,1,0\n"}, "line 2: `d` is 0; give the distance"),
    "d negative": ({"planes": PLANES + "0,A,0,0,1,-2\n"}, "line 2: `d` is -2; give the distance"),
    "d NaN": ({"planes": PLANES + "0,A,0,0,1,nan\n"}, "line 2: `d` is `nan`"),
    "plane without a stance": ({"planes": PLANES + "7,A,0,0,1,1\n"}, "line 2: there is no stance 7 in .*tracks.csv"),
    "plane without rows": ({"planes": PLANES + "0,C,0,0,1,1\n"}, "line 2: robot `C` has no rows at stance 0"),
    "plane of a stranger": ({"planes": PLANES + "0,Z,0,0,1,1\n"}, "planes.csv, line 2: robot `Z` is not in the team"),
    "plane twice": (
        {"planes": PLANES + "0,A,0,0,1,1\n" * 2},
        "line 3: the plane of robot `A` at stance 0 is there twice",
    ),
    "plane stance negative": ({"planes": PLANES + "-1,A,0,0,1,1\n"}, "planes.csv, line 2: `stance` is -1"),
    "moves header": ({"moves": "robot,stance\n"}, "moves.csv, line 1: the header is `robot,stance`; it must be"),
    "moves empty": ({"moves": ""}, "moves.csv: is empty; begin it with the header stance,robot"),
    "moves of a stranger": ({"moves": MOVES + "1,Z\n"}, "moves.csv, line 2: robot `Z` is not in the team"),
    "moves at no stance": ({"moves": MOVES + "1,A\n2,A\n"}, "moves.csv, line 3: there is no stance 2 in"),
    "moves at the first stance": ({"moves": MOVES + "0,A\n"}, "line 2: stance 0 is the first, and nobody moved before"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_sentence_and_writes_nothing(files, name, tmp_path):
    contents, sentence = BAD[name]
    with pytest.raises(TracksError) as caught:
        files.bring_in(**({"tracks": OK} | contents))
    message = str(caught.value)
    assert re.search(sentence, message), message
    assert message.startswith(str(tmp_path)) and "\n" not in message
    assert {path.suffix for path in tmp_path.iterdir()} == {".toml", ".csv"}


def test_the_good_files_of_the_bad_ones_are_good(files):
    files.bring_in(OK, planes=PLANES + "0,A,0,0,1.0009,1\n1,B,0,0,1,2\n", moves=MOVES + "1,A\n")
    assert open_run(files.out).planes[0].planes["A"] == (0.0, 0.0, 1.0, 1.0)


@pytest.mark.parametrize("missing", ["tracks_path", "planes_path", "moves_path"])
@pytest.mark.parametrize(("path", "why"), [("nowhere.csv", "No such file"), ("", "Is a directory")])
def test_a_file_that_is_not_there_is_named(files, tmp_path, missing, path, why):
    files.bring_in(OK)
    files.out.unlink()
    paths = {"tracks_path": tmp_path / "tracks.csv"} | {missing: tmp_path / path}
    with pytest.raises(TracksError, match=f"{re.escape(str(tmp_path / path))}: cannot be read .*{why}"):
        import_tracks(tmp_path / "team.toml", paths.pop("tracks_path"), files.out, **paths)
    assert not files.out.exists()


def test_a_bad_team_is_a_team_error(files, tmp_path):
    files.bring_in(OK)
    files.out.unlink()
    (tmp_path / "team.toml").write_text("reference = 3")
    with pytest.raises(TeamError, match=r"team\.toml"):
        import_tracks(tmp_path / "team.toml", tmp_path / "tracks.csv", files.out)
    assert not files.out.exists()


def test_a_run_that_was_there_survives_a_failure(files):
    files.out.write_bytes(b"before")
    with pytest.raises(ColocError):
        files.bring_in(OK + "0,1\n")
    assert files.out.read_bytes() == b"before"


def test_a_failure_while_writing_leaves_nothing(files, tmp_path):
    def fail(done, of):
        raise RuntimeError("the progress bar fell over")

    with pytest.raises(RuntimeError):
        files.bring_in(OK, progress=fail)
    assert not list(tmp_path.glob("run.mcap*"))


def test_the_run_may_not_replace_what_it_is_made_of(files, tmp_path):
    files.bring_in(OK)
    with pytest.raises(TracksError, match="give the run a name of its own"):
        import_tracks(tmp_path / "team.toml", tmp_path / "tracks.csv", tmp_path / "tracks.csv")
    assert (tmp_path / "tracks.csv").read_text() == OK


def test_a_folder_as_the_run_is_refused(files, tmp_path):
    files.bring_in(OK)
    with pytest.raises(RunError, match="is a folder"):
        import_tracks(tmp_path / "team.toml", tmp_path / "tracks.csv", tmp_path)


def test_a_hundred_thousand_rows_take_seconds(files):
    tracks = HEADER + "".join(
        f"{k // 1000},{k / 100},{robot},m{m},{m + 1},{k % 400}\n"
        for k, robot, m in itertools.product(range(5_000), "AB", range(10))
    )
    started = time.process_time()
    assert files.bring_in(tracks).rows == 100_000
    assert time.process_time() - started < 15  # 2 s where it was written; slower machines may take their time


def test_the_examples_of_the_documentation_come_in_and_are_enough_to_solve(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "import-tracks.md").read_text(encoding="utf-8")
    names = ("TEAM.toml", "TRACKS.csv", "PLANES.csv", "MOVES.csv")
    examples = re.findall(r"```(?:toml|csv)\n(.*?)```", text, re.DOTALL)
    for name, example in zip(names, examples, strict=True):
        (tmp_path / name).write_text(example, encoding="utf-8")
    team, tracks, planes, moves = (tmp_path / name for name in names)
    summary = import_tracks(team, tracks, tmp_path / "run.mcap", planes_path=planes, moves_path=moves)
    assert (summary.stances, summary.observers, summary.warnings) == (2, ("A", "B"), ())
    run = open_run(tmp_path / "run.mcap")
    assert inspect(run) == []
    solution = pipeline.solve(run)
    assert solution.warnings == () and solution.estimate.disconnected == ()
    # B drove ahead by a step and the two stand 0.72 m apart
    assert np.linalg.norm(np.diff(solution.estimate.trajectories["B"].positions, axis=0)) == pytest.approx(
        0.35, abs=0.03
    )
    assert np.linalg.norm(solution.estimate.pose("B", 0).translation()) == pytest.approx(0.72, abs=0.03)


def test_a_mover_that_is_not_in_the_team_is_named_at_the_import_where_no_plane_is_stated(files):
    with pytest.raises(TracksError, match=r"tracks.csv: there is no marker plane.*add the robot .*--planes"):
        files.bring_in(stances("AB", "AB"), of=team(markers_on=()))
    assert not files.out.exists()


def test_a_gap_in_the_stances_is_told_of_the_tracks_and_not_of_the_moves(files):
    tracks = stances("AB", "AB").replace("\n1,", "\n2,")
    with pytest.raises(TracksError, match=r"tracks.csv: has no rows of stance 1 .*moves.csv, line 2.*without gaps"):
        files.bring_in(tracks, moves="stance,robot\n1,B\n")


def test_a_run_goes_into_a_folder_that_is_there_or_the_folder_is_named(files, tmp_path):
    files.out = tmp_path / "nowhere" / "run.mcap"
    with pytest.raises(RunError, match=r"run.mcap: cannot be written, since .*nowhere does not exist; make") as refusal:
        files.bring_in(OK)
    assert ".part" not in str(refusal.value)
