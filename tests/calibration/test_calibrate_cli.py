"""`coloc calibrate` on rendered images: the whole road, and bad input in one sentence."""

import json
import re
import stat
import tomllib

import cv2
import numpy as np
import pytest

from coloc_graph.calibration import make_board
from coloc_graph.cli import main
from coloc_graph.simulation.boards import floor_poses, held_poses, render_boards
from coloc_graph.team import Camera, Mount, read_team

CHESS = make_board("7x5", 0.03)
CHARUCO = make_board("8x6", 0.03, "4X4_50", 0.022)
CAMERA = Camera(width=320, height=240, fx=301.0, fy=300.0, cx=157.0, cy=121.5, distortion=(-0.11, 0.03, 5e-4, -3e-4))
MOUNT = Mount(height=0.40, tilt_deg=25.0, roll_deg=1.2)
BOARD = ("--board", "7x5", "--square", 0.03)
TEAM = """# our robots
reference = "A"

[[robots]]
name = "A"          # the one with the red lid
[robots.camera]
width = 320
height = 240
fx = 290.0          # from the data sheet
fy = 290.0
cx = 159.5
cy = 119.5
fps = 60.0
[robots.mount]
height = 0.38       # measured with a ruler
tilt_deg = 20.0
yaw_deg = 2.5

[[robots]]
name = "B"
camera = { width = 320, height = 240, fx = 301.0, fy = 301.0, cx = 159.5, cy = 119.5 }
mount = { height = 0.4 }
"""


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Folders of rendered images: `held` and `floor` of a chessboard, `charuco` of a ChArUco board."""
    rng = np.random.default_rng(4)
    folder = tmp_path_factory.mktemp("images")
    for name, board, poses in (
        ("held", CHESS, held_poses(rng, CAMERA, CHESS, 10)),
        ("floor", CHESS, floor_poses(rng, CAMERA, MOUNT, CHESS, 3, farthest=0.7)),
        ("charuco", CHARUCO, held_poses(rng, CAMERA, CHARUCO, 8, tilt_deg=30.0)),
    ):
        (folder / name).mkdir()
        for index, image in enumerate(render_boards(rng, CAMERA, board, poses, noise=1.5)):
            cv2.imwrite(str(folder / name / f"{index + 1}.png"), image)
    return folder


@pytest.fixture
def team(tmp_path):
    path = tmp_path / "team.toml"
    path.write_text(TEAM)
    return path


@pytest.fixture
def call(capsys):
    def run(*arguments):
        try:
            code = main(["calibrate", *map(str, arguments)])
        except SystemExit as ended:
            code = ended.code
        out, err = capsys.readouterr()
        return code, out, err

    return run


def refused(call, *arguments):
    """What a command says that ends with exit code 2: one sentence, the last line of stderr."""
    code, out, err = call(*arguments)
    assert (code, out) == (2, "") and err.splitlines()[-1].startswith("coloc: ") and "Traceback" not in err
    return err.splitlines()[-1]


def test_from_images_to_a_team_with_a_camera_and_a_mount(call, images, team, tmp_path):
    out, info = tmp_path / "out", tmp_path / "camera.yaml"
    code, text, err = call("camera", images / "held", *BOARD, "--distortion", 4, "--team", team, "--robot", "A",
                           "--out", out, "--camera-info", info, "--json")  # fmt: skip
    assert code == 0, err
    figures = json.loads(text)
    truth = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.distortion])
    camera = read_team(team)["A"].camera
    off = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]) - truth
    assert np.abs(off / figures["sigmas"]).max() < 5 and np.abs(off[:4]).max() < 2.5
    assert figures["rms_px"] < 0.12 and len(figures["images"]) == 10 and figures["not_found"] == []
    assert camera.noise_px == figures["noise_px"] and camera.bias_px == figures["camera"]["bias_px"]
    assert json.loads((out / "calibration.json").read_text()) == figures
    assert (out / "coverage.png").stat().st_size > 10_000 and (out / "residuals.png").stat().st_size > 10_000
    assert f"wrote {team}" in err

    code, text, err = call("mount", images / "floor", *BOARD, "--thickness", 0.0, "--team", team, "--robot", "A",
                           "--calibration", out, "--json")  # fmt: skip
    assert code == 0, err
    told = err
    mount = read_team(team)["A"].mount
    for name, sigma in (("height", mount.height_sigma), ("tilt_deg", mount.tilt_sigma_deg),
                        ("roll_deg", mount.roll_sigma_deg)):  # fmt: skip
        assert 0 < abs(getattr(mount, name) - getattr(MOUNT, name)) < 4 * sigma, name
    assert mount.height_sigma < 0.005 and mount.tilt_sigma_deg < 0.5 and mount.yaw_deg == 2.5
    assert json.loads(text)["mount"]["height"] == mount.height and json.loads(text)["dof"] == 6

    # without the camera's covariance a mount seems surer; that the camera is taken as exact is said if it has no bias
    exact = tmp_path / "exact.toml"
    for bias, said in ((camera.bias_px, False), (0.0, True)):
        exact.write_text(re.sub("bias_px = .*", f"bias_px = {bias}", team.read_text()))
        code, _, err = call("mount", images / "floor", *BOARD, "--team", exact, "--robot", "A", "--json")
        assert code == 0 and ("the camera is taken as exact; give --calibration" in err) == said
    assert "taken as exact" not in told and read_team(exact)["A"].mount.height_sigma < 0.9 * mount.height_sigma

    kept = team.read_text()
    for comment in ("# our robots", "# the one with the red lid", "# measured with a ruler", "fps = 60.0"):
        assert comment in kept
    assert kept[kept.index('name = "B"') :] == TEAM[TEAM.index('name = "B"') :]


def test_a_charuco_board_is_found_and_figures_are_printed_for_people(call, images):
    board = ("--board", "8x6", "--square", 0.03, "--charuco", "DICT_4X4_50", "--marker", 0.022)
    code, text, err = call("camera", images / "charuco", *board)
    assert code == 0, err
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line[:2] in ("fx", "cx")}
    assert abs(float(rows["fx"][1]) - CAMERA.fx) < 10 and float(rows["fx"][3]) > 0
    assert "verdict: " in text and " of 8 images" in text and "lens coefficients; RMS of held-out images" in text
    said = refused(call, "camera", images / "charuco", "--board", "6x8", *board[2:])
    assert "squares, columns first: give --board 8x6" in said


def test_a_board_given_the_other_way_round_is_the_same_board(call, images):
    wide, high = (
        json.loads(call("camera", images / "held", "--board", size, *BOARD[2:], "--distortion", 4, "--json")[1])
        for size in ("7x5", "5x7")
    )
    np.testing.assert_allclose(wide["camera"]["fx"], high["camera"]["fx"], rtol=1e-4)


def test_an_image_without_the_board_is_named_and_an_inline_team_and_another_file_are_written(
    call, images, team, tmp_path
):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((240, 320), 90, np.uint8))
    new = tmp_path / "new.toml"
    code, _, err = call("camera", images / "held", blank, *BOARD, "--distortion", 4, "--team", team, "--robot", "B",
                        "--out-team", new)  # fmt: skip
    assert code == 0 and f"the board was not found in 1 image: {blank}" in err
    assert team.read_text() == TEAM and read_team(new)["B"].camera.fx != 301.0
    assert read_team(new)["A"] == read_team(team)["A"] and "# our robots" in new.read_text()
    assert "new.toml exists; replace it with --force" in refused(
        call, "camera", images / "held", *BOARD, "--team", team, "--robot", "B", "--out-team", new
    )


def test_a_board_that_does_not_lie_is_refused_by_name(call, images, team, tmp_path):
    floor = sorted((images / "floor").glob("*.png"))
    rng = np.random.default_rng(9)
    tilted = floor_poses(rng, CAMERA, Mount(height=0.4, tilt_deg=29.0, roll_deg=-2.0), CHESS, 1, farthest=0.7)
    cv2.imwrite(str(tmp_path / "leaning.png"), render_boards(rng, CAMERA, CHESS, tilted)[0])
    values = "width = 320, height = 240, fx = 301.0, fy = 300.0, cx = 157.0, cy = 121.5, bias_px = 0.1"
    camera = f"camera = {{ {values}, distortion = [-0.11, 0.03, 5e-4, -3e-4] }}"
    team.write_text(TEAM[: TEAM.index("camera = {")] + camera + "\nmount = { height = 0.3 }\n")
    code, text, err = call("mount", *floor, tmp_path / "leaning.png", *BOARD, "--team", team, "--robot", "B")
    assert code == 0 and "leaning.png was rejected: its board is not in the plane of the others" in err
    assert "height 0.4" in text and "rejected" in text and "agreement of the images: chi2/dof" in text
    assert read_team(team)["B"].mount.tilt_deg == pytest.approx(25.0, abs=0.3)


# --- bad input


def test_images_that_cannot_be_used_are_named(call, images, tmp_path):
    one = images / "held" / "1.png"
    large, text, empty = tmp_path / "large.png", tmp_path / "text.png", tmp_path / "empty"
    cv2.imwrite(str(large), np.zeros((480, 640), np.uint8))
    text.write_text("no image")
    empty.mkdir()
    assert f"{large} has 640x480 pixels and {one} 320x240" in refused(call, "camera", one, large, *BOARD)
    assert f"{text}: cannot be read as an image" in refused(call, "camera", one, text, *BOARD)
    assert f"{empty} holds no images" in refused(call, "camera", empty, *BOARD)
    assert "nowhere.png: there is no such image" in refused(call, "camera", "nowhere.png", *BOARD)
    assert f"{one} is given twice" in refused(call, "camera", images / "held", one, *BOARD)


def test_a_board_that_is_not_found_says_what_was_sought_and_what_to_try(call, images, tmp_path):
    few = sorted((images / "held").glob("[1-3].png"))
    said = refused(call, "camera", *few, "--board", "8x6", "--square", 0.03)
    assert "a chessboard of 8x6 inner corners is in none of 3 images" in said
    assert "--board counts inner corners, not squares: give --board 7x5" in said
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((240, 320), 90, np.uint8))
    assert "count the inner corners" in refused(call, "camera", blank, *BOARD)
    charuco = ("--square", 0.03, "--charuco", "4X4_50", "--marker", 0.022)
    assert "check --charuco" in refused(call, "camera", blank, "--board", "8x6", *charuco)
    shown = images / "charuco" / "1.png"
    said = refused(call, "camera", shown, "--board", "11x9", *charuco)
    assert "markers of its dictionary are seen, up to id " in said
    assert "is in 3 of 3 images, but at least 6 are needed" in refused(call, "camera", *few, *BOARD)


@pytest.mark.parametrize(("arguments", "says"), [
    (("--board", "9by6", "--square", 0.03), "--board 9by6 is not a size"),
    (("--board", "1x6", "--square", 0.03), "3 to 100 corners or squares in a row"),
    (("--board", "7x5", "--square", 24.23), "--square 24.23 is not the side of a square in metres"),
    (("--board", "7x5", "--square", "nan"), "--square nan is not the side"),
    (("--board", "7x5"), "give images, --board and --square"),
    ((*BOARD, "--marker", 0.02), "--marker applies to a ChArUco board"),
    ((*BOARD, "--charuco", "4X4_50"), "a ChArUco board needs --marker"),
    ((*BOARD, "--charuco", "4X4_50", "--marker", 0.04), "shorter than that of a square"),
    ((*BOARD, "--charuco", "9Y9", "--marker", 0.02), "--charuco 9Y9 is not a dictionary of OpenCV, which has 4X4_100"),
    ((*BOARD, "--robot", "A"), "--team and --robot belong together"),
    ((*BOARD, "--out-team", "x.toml"), "--out-team writes a copy of a team"),
    ((*BOARD, "--from-camera-info", "x.yaml"), "is a calibration already"),
    ((*BOARD, "--distortion", "6"), "invalid choice: 6"),
])  # fmt: skip
def test_bad_arguments_are_one_sentence(call, images, arguments, says):
    assert says in refused(call, "camera", images / "held", *arguments)


def test_wrong_robots_and_places_are_refused_before_the_work(call, images, team, tmp_path):
    one = images / "held" / "1.png"
    assert "robot `Z` is not in the team (A, B)" in refused(call, "camera", one, *BOARD, "--team", team, "--robot", "Z")
    assert "give --team TEAM.toml and --robot NAME" in refused(call, "mount", one, *BOARD)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    assert "holds files that are not a calibration" in refused(call, "camera", one, *BOARD, "--out", tmp_path / "full")
    (tmp_path / "earlier").mkdir()
    (tmp_path / "earlier" / "calibration.json").write_text("{}")
    assert "holds an earlier calibration" in refused(call, "camera", one, *BOARD, "--out", tmp_path / "earlier")
    large = tmp_path / "large.png"
    cv2.imwrite(str(large), cv2.resize(cv2.imread(str(one)), (640, 480)))
    assert "the images have 640x480 pixels, but the camera of A" in refused(
        call, "mount", large, *BOARD, "--team", team, "--robot", "A"
    )
    assert "not the calibration of a camera" in refused(
        call, "mount", one, *BOARD, "--team", team, "--robot", "A", "--calibration", tmp_path / "earlier"
    )
    assert team.read_text() == TEAM


# --- camera_info, and what is written


def test_a_camera_info_goes_into_a_team_and_out_again_unchanged(call, team, tmp_path):
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: head\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [501.123456789, 0, 319.1, 0, 502.2, 238.3, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 1e-05, -2.5e-4, 0]}\n"
    )
    code, _, err = call("camera", "--from-camera-info", first, "--team", team, "--robot", "A",
                        "--camera-info", second)  # fmt: skip
    assert code == 0 and "the images of A have 320x240 px" in err
    camera = read_team(team)["A"].camera
    assert (camera.fx, camera.distortion) == (501.123456789, (-0.1, 0.02, 1e-05, -2.5e-4, 0.0)) and camera.fps == 60.0
    assert tomllib.loads(team.read_text())["robots"][0]["camera"]["cx"] == 319.1
    assert "501.123456789" in second.read_text()
    again = call("camera", "--from-camera-info", second, "--team", team, "--robot", "A")
    assert again[0] == 0 and "warning" not in again[2] and read_team(team)["A"].camera == camera
    assert "give --team and --robot, or --camera-info" in refused(call, "camera", "--from-camera-info", first)


def test_a_team_that_is_a_link_and_not_for_all_stays_so(call, team, tmp_path):
    team.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(team)
    info = tmp_path / "camera.yaml"
    info.write_text(
        "width: 320\nheight: 240\ndistortion_model: plumb_bob\nd: []\nk: [300, 0, 160, 0, 300, 120, 0, 0, 1]\n"
    )
    code, _, err = call("camera", "--from-camera-info", info, "--team", link, "--robot", "A")
    assert code == 0, err
    assert link.is_symlink() and stat.S_IMODE(team.stat().st_mode) == 0o640 and read_team(team)["A"].camera.fx == 300.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["camera.yaml", "link.toml", "team.toml"]
