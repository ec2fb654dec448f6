"""The team file: what is written reads back, and what is wrong is named by its path."""

import contextlib
import time

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.errors import TeamError
from coloc_graph.simulation import reference_team
from coloc_graph.team import Blink, Camera, Floor, Markers, Mount, Robot, Slip, Team, Tracking, read_team, write_team

LENSES = [
    (),
    (-0.1, 0.02, 5e-4, -3e-4),
    (-0.3, 0.1, 1e-3, -1e-3, -0.02),
    (0.3, 0.05, -1e-3, 5e-4, 0.01, 0.25, 0.03, 0.002),
]
TOML = """
reference = "A"

[[robots]]
name = "A"
[robots.camera]
width = 320
height = 240
fx = 301.0
fy = 301.0
cx = 159.5
cy = 119.5
[robots.mount]
height = 0.4
tilt_deg = 20.0

[[robots]]
name = "C"
[robots.camera]
width = 320
height = 240
fx = 301.0
fy = 301.0
cx = 159.5
cy = 119.5
[robots.mount]
height = 0.4
"""
MARKERS = "[robots.markers]\nheight = 0.15\npositions = [[0.0, 0.125], [0.0, -0.125]]\n"
BLINK = '[robots.blink]\ncode = "110"\n'
TOML += MARKERS + BLINK


def camera(distortion=(), **changes):
    return Camera(**{"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 310.0, "cy": 250.0} | changes,
                  distortion=distortion)  # fmt: skip


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        path = tmp_path / "team.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_team(path)

    return read_text


@pytest.mark.parametrize("hue", [None, 120.0])
@pytest.mark.parametrize("floor", [None, Floor(tilt_sigma_deg=0.1, height_sigma=1e-3)])
def test_a_team_reads_back_as_it_was_written(tmp_path, hue, floor):
    markers = Markers(height=0.15, positions=((0.1, 0.2), (-1 / 3, 0.0)), hue_deg=hue, span_sigma=1e-4)
    mount = Mount(height=0.4, tilt_deg=20.1, roll_deg=-0.3, yaw_deg=5.0, x=0.01, y=-0.02, tilt_sigma_deg=0.3)
    robots = (
        Robot(name="A", camera_if_any=camera(LENSES[1], noise_px=0.1 + 0.2), mount_if_any=mount),
        Robot(name="b-2_c", camera_if_any=camera(LENSES[3]), mount_if_any=mount, markers=markers),
    )
    team = Team(reference="b-2_c", robots=robots, floor=floor)
    write_team(team, tmp_path / "team.toml")
    assert read_team(tmp_path / "team.toml") == team


def test_the_example_is_sound(read):
    team = read(TOML)
    assert team.names == ("A", "C")
    assert team.floor is None
    assert team["C"].markers.span == 0.25


WRONG = {
    "an unknown field": ("tilt_deg = 20.0", "tilt = 20.0", ["`tilt`", "$.robots[0].mount"]),
    "an unknown field at the top": ('reference = "A"', 'reference = "A"\ncolour = 1', ["`colour`"]),
    "a missing field": ("fx = 301.0\n", "", ["`fx`", "$.robots[0].camera"]),
    "a wrong type": ("height = 0.15", 'height = "low"', ["float", "$.robots[1].markers.height"]),
    "a broken number of pixels": ("width = 320", "width = 320.5", ["int", "$.robots[0].camera.width"]),
    "not a number": ("fx = 301.0", "fx = nan", ["`fx` is nan", "$.robots[0].camera"]),
    "an infinite number": ("tilt_deg = 20.0", "tilt_deg = inf", ["`tilt_deg` is inf", "$.robots[0].mount"]),
    "a marker at nan": ("0.125]", "nan]", ["`positions`", "$.robots[1].markers"]),
    "a focal length of 0": ("fy = 301.0", "fy = 0.0", ["`fy` is 0", "$.robots[0].camera"]),
    "distortion of 3": ("cy = 119.5", "cy = 119.5\ndistortion = [0.1, 0.2, 0.3]", ["3 numbers", "$.robots[0].camera"]),
    "distortion with nan": (
        "cy = 119.5",
        "cy = 119.5\ndistortion = [0.1, nan, 0.0, 0.0]",
        ["`distortion`", "$.robots[0].camera"],
    ),
    "a camera below the floor": (
        "height = 0.4\ntilt",
        "height = -0.4\ntilt",
        ["`height` is -0.4", "$.robots[0].mount"],
    ),
    "markers below the floor": ("height = 0.15", "height = -0.15", ["`height` is -0.15", "$.robots[1].markers"]),
    "no marker": ("[[0.0, 0.125], [0.0, -0.125]]", "[]", ["`positions` is empty", "$.robots[1].markers"]),
    "a marker in space": ("[0.0, 0.125]", "[0.0, 0.125, 0.15]", ["$.robots[1].markers.positions[0]"]),
    "a hue beyond the circle": (
        "height = 0.15",
        "height = 0.15\nhue_deg = 360.0",
        ["`hue_deg`", "$.robots[1].markers"],
    ),
    "two 0s in a row": ('"110"', '"0110"', ["`code` is `0110`", "two 0s in a row", "$.robots[1].blink"]),
    "no 0": ('"110"', '"111"', ["`code` is `111`", "both in it"]),
    "a bit that is too long": (BLINK, BLINK + "bit = 0.5\n", ["`bit` is 0.5", "from 0.02 to 0.25"]),
    "a camera that is too slow": (
        "cy = 119.5",
        "cy = 119.5\nfps = 10.0",
        ["the camera of robot A takes 10 images per second", "at least 0.2 s"],
    ),
    "nothing to blink": (MARKERS, "", ["robot C has a `blink` but no markers"]),
    "a robot twice": ('name = "C"', 'name = "A"', ["two robots are called `A`"]),
    "a name with a slash": ('name = "C"', 'name = "a/b"', ["`a/b`", "$.robots[1]"]),
    "an unknown reference": ('reference = "A"', 'reference = "D"', ["`reference` is `D`", "A, C"]),
    "no robots": (TOML, 'reference = "A"\nrobots = []', ["at least one robot"]),
    "not TOML": ("[[robots]]", "[[robots]", ["line"]),
    "nothing": (TOML, "", ["`reference`"]),
}


@pytest.mark.parametrize(("old", "new", "wanted"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_with_a_team_is_named(read, old, new, wanted):
    assert old in TOML
    with pytest.raises(TeamError) as caught:
        read(TOML.replace(old, new, 1))
    message = str(caught.value)
    assert "team.toml" in message
    assert "\n" not in message
    for words in wanted:
        assert words in message


@pytest.mark.parametrize(
    ("first", "other", "hue", "words"),
    [
        ("11011110", "11110110", None, "robots A and B blink alike"),
        ("110", "101101", None, "robots A and B blink alike"),
        ("110", "110", 120.0, ""),
        ("110", "1110", None, ""),
    ],
)
def test_codes_differ_wherever_they_begin(first, other, hue, words):
    robots = tuple(
        replace(one, markers=replace(one.markers, hue_deg=of), blink=Blink(code=code))
        for one, code, of in zip(reference_team().robots, (first, other), (None, hue), strict=False)
    )
    with pytest.raises(ValueError, match=words) if words else contextlib.nullcontext():
        Team(reference="A", robots=robots)


def test_all_bits_are_as_long():
    a, b, _ = reference_team().robots
    robots = (replace(a, blink=Blink(code="110")), replace(b, blink=Blink(code="1110", bit=0.2)))
    with pytest.raises(
        ValueError, match=r"robot A takes 0.1 s and one of robot B 0.2 s; give all robots the same `bit`"
    ):
        Team(reference="A", robots=robots)


def test_bytes_that_are_not_utf8_are_an_error_in_words(read):
    with pytest.raises(TeamError, match=r"team\.toml"):
        read(TOML.encode() + b"# \xff\xfe\n")


def test_a_missing_file_and_a_folder_are_errors_in_words(tmp_path):
    with pytest.raises(TeamError, match=r"nowhere\.toml: cannot be read"):
        read_team(tmp_path / "nowhere.toml")
    with pytest.raises(TeamError, match="cannot be read"):
        read_team(tmp_path)


def test_a_robot_that_is_not_in_the_team_is_an_error_that_lists_those_who_are(read):
    with pytest.raises(TeamError, match=r"`D` is not in the team \(A, C\)"):
        read(TOML)["D"]


def test_marker_height_is_none_where_the_robots_differ(read):
    team = read(TOML)
    assert team.marker_height() == 0.15
    higher = replace(team["C"], name="D", markers=replace(team["C"].markers, height=0.2), blink=None)
    team = replace(team, robots=(*team.robots, higher))
    assert team.marker_height() is None
    assert team.marker_height(["D"]) == 0.2


@pytest.mark.parametrize("distortion", LENSES, ids=len)
def test_projection_is_opencvs(distortion):
    points = np.random.default_rng(0).uniform((-0.6, -0.5, 0.8), (0.6, 0.5, 3.0), (200, 3))
    lens = camera(distortion)
    uv, _ = lens.project(points)
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, np.array(distortion or [0.0] * 4))
    assert uv == pytest.approx(wanted[:, 0], abs=1e-9)


@pytest.mark.parametrize("distortion", LENSES, ids=len)
def test_normalise_is_the_inverse_of_project(distortion):
    lens = camera(distortion)
    x = np.random.default_rng(1).uniform((-0.6, -0.45), (0.6, 0.45), (300, 2))
    uv, inside = lens.project(np.column_stack([x, np.ones(300)]) * 1.7)
    assert inside.sum() > 100
    assert lens.normalise(uv[inside]) == pytest.approx(x[inside], abs=1e-9)


def test_points_behind_the_camera_are_nan_and_not_inside():
    uv, inside = camera(LENSES[1]).project([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(uv[:2]).all()
    assert uv[2] == pytest.approx((310.0, 250.0))
    assert inside.tolist() == [False, False, True]


def test_the_border_of_the_image_is_half_a_pixel_beyond_the_centres_of_the_outer_pixels():
    lens = camera()
    uv = np.array([[-0.4, 10], [-0.6, 10], [639.4, 10], [639.6, 10], [10, -0.4], [10, -0.6], [10, 479.4], [10, 479.6]])
    _, inside = lens.project(np.column_stack([lens.normalise(uv), np.ones(8)]))
    assert inside.tolist() == [True, False] * 4


def test_a_point_that_a_barrel_lens_folds_back_is_not_inside():
    lens = camera((-0.3, 0.0, 0.0, 0.0))
    uv, inside = lens.project([[0.0, 1.75, 1.0]])
    assert 0 < uv[0, 1] < 480
    assert not inside[0]


def test_a_rational_lens_that_does_not_fold_loses_no_point():
    lens = camera((-0.6, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0), fy=250.0)
    y = np.linspace(0, 0.9, 50)
    uv, inside = lens.project(np.column_stack([np.zeros(50), y, np.full(50, 1.0)]))
    assert (np.diff(uv[:, 1]) > 0).all()
    assert uv[-1, 1] > 440
    assert inside.all()


def test_normalise_says_nan_where_the_lens_cannot_be_inverted():
    x = camera((-0.3, 0.0, 0.0, 0.0)).normalise([[320.0, 240.0], [320.0, 5000.0]])
    assert np.isfinite(x[0]).all()
    assert np.isnan(x[1]).all()


def test_a_camera_looks_along_the_bodys_x_with_its_y_down():
    T = Mount(height=0.4, x=0.1, y=-0.2).T_body_camera
    assert T[:3, 3] == pytest.approx((0.1, -0.2, 0.4))
    right, down, ahead = T[:3, :3].T
    assert ahead == pytest.approx((1, 0, 0))
    assert right == pytest.approx((0, -1, 0))
    assert down == pytest.approx((0, 0, -1))


def test_tilt_looks_down_yaw_looks_left_and_roll_lowers_the_right():
    c, s = np.cos(np.deg2rad(20)), np.sin(np.deg2rad(20))
    assert Mount(height=0.4, tilt_deg=20).R_body_camera[:, 2] == pytest.approx((c, 0, -s))
    assert Mount(height=0.4, yaw_deg=20).R_body_camera[:, 2] == pytest.approx((c, s, 0))
    rolled = Mount(height=0.4, roll_deg=20).R_body_camera
    assert rolled[:, 2] == pytest.approx((1, 0, 0))
    assert rolled[:, 0] == pytest.approx((0, -c, -s))


def test_yaw_comes_before_tilt_so_that_a_turned_camera_keeps_its_horizon():
    R = Mount(height=0.4, yaw_deg=70, tilt_deg=20).R_body_camera
    assert R[2, 0] == pytest.approx(0, abs=1e-15)
    assert R[2, 2] == pytest.approx(-np.sin(np.deg2rad(20)))


@pytest.mark.parametrize(("sigma", "degrees"), [(0.0005, 0.2), (0.0, 0.2), (0.01, 0.0), (float("nan"), 1.0)])
def test_a_slip_that_is_too_tight_to_be_solved_is_refused(tmp_path, sigma, degrees):
    path = tmp_path / "team.toml"
    team = reference_team()
    slipping = replace(team.robots[0], slip=Slip(sigma=0.002, sigma_deg=0.3))
    write_team(replace(team, robots=(slipping, *team.robots[1:])), path)
    assert read_team(path).robots[0].slip == Slip(sigma=0.002, sigma_deg=0.3)
    assert read_team(path).robots[1].slip is None
    text = path.read_text().replace("sigma = 0.002", f"sigma = {sigma}")
    text = text.replace("sigma_deg = 0.3", f"sigma_deg = {degrees}")
    path.write_text(text)
    with pytest.raises(TeamError, match=r"slip|sigma.*finite"):
        read_team(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = " + "[" * 5000, "is nested too deep"),
        ("x = " + "1" * 5000, "is not TOML: Exceeds the limit"),
        ("x = " + "1" * 400, "`x` is a number of"),
        ("a." * 40 + "b = 1", "line 1: a key has more than 32 parts"),
        ("\n[" + "a.  " * 100_000 + "b]", "line 2: a key has more than 32 parts"),
        ("reference = 2001-13-45", "is not TOML"),
        ("reference = 2001-01-01", "Expected `str`"),
        ('reference = "A"\nx = 1', "see docs/team.md"),
    ],
)
def test_hostile_toml_is_one_sentence_at_once(tmp_path, text, says):
    path = tmp_path / "team.toml"
    path.write_text(text)
    began = time.process_time()
    with pytest.raises(TeamError) as refusal:
        read_team(path)
    assert says in str(refusal.value) and str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 1000
    assert time.process_time() - began < 10


def test_a_team_with_a_byte_order_mark_is_read_and_utf_16_is_named(tmp_path):
    path = tmp_path / "team.toml"
    write_team(reference_team(), path)
    text = path.read_text()
    path.write_text(text, encoding="utf-8-sig")
    assert read_team(path) == reference_team()
    path.write_text(text, encoding="utf-16")
    with pytest.raises(TeamError, match="is text in UTF-16; save it as UTF-8"):
        read_team(path)


def test_a_camera_of_an_impossible_size_is_refused():
    with pytest.raises(ValueError, match="`width` is 70000; give pixels, 65535 at most"):
        Camera(width=70_000, height=10, fx=1.0, fy=1.0, cx=0.0, cy=0.0)


@pytest.mark.parametrize("k1", [-0.3, -0.5, -1.5])
def test_a_lens_that_folds_within_the_image_is_found_where_it_folds(k1):
    camera = Camera(width=1280, height=800, fx=600.0, fy=600.0, cx=640.0, cy=400.0, distortion=(k1, 0.0, 0.0, 0.0))
    r = np.sqrt(1 / (-3 * k1))  # where r (1 + k1 r^2) no longer grows
    assert camera.fold_radius() == pytest.approx(600 * r * (1 + k1 * r**2), rel=1e-3)
    mild = Camera(width=1280, height=800, fx=600.0, fy=600.0, cx=640.0, cy=400.0, distortion=(-0.1, 0.01, 0.0, 0.0))
    assert mild.fold_radius() is None


def test_tracking_options_are_stated_and_refused_in_words(tmp_path, capsys):
    stated = replace(reference_team(), tracking=Tracking(speed=400.0, clutter=1e-4))
    write_team(stated, tmp_path / "team.toml")
    assert read_team(tmp_path / "team.toml") == stated
    for wrong, words in (("speed = 0.0", "`speed` is 0.0; give a positive"), ("detected = 1.0", "probability below 1")):
        text = (tmp_path / "team.toml").read_text().replace("speed = 400.0", wrong)
        (tmp_path / "wrong.toml").write_text(text)
        with pytest.raises(TeamError, match=words):
            read_team(tmp_path / "wrong.toml")
