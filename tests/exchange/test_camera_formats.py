"""Calibrations of OpenCV, written by OpenCV itself, and of Kalibr; what is not read is refused by its name."""

import cv2
import numpy as np
import pytest

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.camera_info import read_camera_info

K = np.array([[430.2, 0, 306.7], [0, 430.5, 227.2], [0, 0, 1]])
FIVE = [-0.34, 0.11, 7e-05, -6e-04, 0.01]
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.0004]
  distortion_model: equidistant
  intrinsics: [461.6, 460.1, 362.6, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
"""


def opencv_file(path, D, names=("image_width", "image_height", "camera_matrix", "distortion_coefficients"), **more):
    """A file as OpenCV's calibration sample writes it; OpenCV 5 has another tag for arrays of one dimension."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Sun 29 Nov 2026")
    for name, value in zip(names, (640, 480, K, np.asarray(D)), strict=True):
        storage.write(name, value)
    for name, value in more.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml"])
@pytest.mark.parametrize(
    ("D", "distortion"),
    [
        (FIVE, tuple(FIVE)),
        ([*FIVE, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0], tuple(FIVE)),
        ([1.2, 0.3, 0, 0, 0.1, 1.5, 0.4, 0.2], (1.2, 0.3, 0.0, 0.0, 0.1, 1.5, 0.4, 0.2)),
    ],
)
def test_an_opencv_calibration_is_read_to_the_bit(tmp_path, suffix, D, distortion):
    for shape in ((-1,), (-1, 1), (1, -1)):
        written = opencv_file(tmp_path / f"a.{suffix}", np.reshape(np.array(D, float), shape))
        camera, warnings = read_camera_info(written)
        assert (camera.K == K).all() and (camera.width, camera.height) == (640, 480)
        assert camera.distortion == distortion and camera.model == "pinhole" and warnings == ()


def test_opencv_s_fisheye_and_its_older_names_are_read(tmp_path):
    D = [0.01, -0.02, 0.003, 0.0004]
    fisheye, _ = read_camera_info(opencv_file(tmp_path / "a.yml", np.array(D), fisheye_model=1))
    assert fisheye.model == "fisheye" and fisheye.distortion == tuple(D)
    names = ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients")
    assert read_camera_info(opencv_file(tmp_path / "b.xml", np.array(FIVE), names))[0].distortion == tuple(FIVE)


@pytest.mark.parametrize(
    ("D", "more", "words"),
    [
        ([*FIVE, 0, 0, 0, 0.1, 0, 0, 0], {}, "has OpenCV's 9 coefficients, those of a thin prism among them"),
        ([*FIVE, 0, 0, 0, 0, 0, 0, 0, 0, 0.1], {}, "those of a tilted sensor among them"),
        (FIVE, {"M1": K}, "is OpenCV's calibration of a stereo pair"),
        (FIVE, {"fisheye_model": 1}, "has 4 coefficients"),
        ([-1.5, 0, 0, 0, 0.0], {}, "its lens model folds"),
    ],
)
def test_what_of_opencv_is_not_read_is_named(tmp_path, D, more, words):
    with pytest.raises(InputError, match=words):
        read_camera_info(opencv_file(tmp_path / "a.yml", np.array(D, float), **more))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<?xml version='1.0'?>\n<opencv_storage><a>", "is not XML that is read"),
        ("<opencv_storage></opencv_storage>", "without `image_width`"),
        ("<opencv_storage><!DOCTYPE a></opencv_storage>", "declares entities"),
        ("%YAML:1.0\n---\nK: !!python/object:os.system []\n", "is not YAML that is read"),
        ("%YAML:1.0\n---\nimage_width: 3\n", "without `image_height`"),
    ],
)
def test_damaged_files_are_one_sentence(tmp_path, text, words):
    (tmp_path / "a.yml").write_text(text)
    with pytest.raises(InputError, match=words) as why:
        read_camera_info(tmp_path / "a.yml")
    assert "\n" not in str(why.value)


def test_a_camera_of_a_chain_is_asked_of_a_chain_only(tmp_path):
    with pytest.raises(InputError, match="is not a Kalibr camera chain: leave out --chain-camera"):
        read_camera_info(opencv_file(tmp_path / "a.yml", np.array(FIVE)), chain_camera="cam0")


def test_a_kalibr_chain_is_read_camera_by_camera(tmp_path, capsys):
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    wide, _ = read_camera_info(tmp_path / "camchain.yaml", chain_camera="cam0")
    assert wide.model == "fisheye" and wide.distortion == (-0.01, 0.02, -0.003, 0.0004)
    assert (wide.fx, wide.fy, wide.cx, wide.cy, wide.width) == (461.6, 460.1, 362.6, 248.1, 752)
    command = ["calibrate", "camera", "--from-camera-info", str(tmp_path / "camchain.yaml")]
    command += ["--camera-info", str(tmp_path / "out.yaml")]
    assert (
        main(command) == 2 and "a Kalibr chain of cam0, cam1; choose one with --chain-camera" in capsys.readouterr().err
    )
    assert main([*command, "--chain-camera", "cam1"]) == 0
    assert read_camera_info(tmp_path / "out.yaml")[0].distortion == (-0.28, 0.07, 0.0002, 1e-05)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "camera_model: pinhole",
            "camera_model: omni",
            "`camera_model` is `omni`, Mei's unified omnidirectional",
        ),
        ("distortion_model: equidistant", "distortion_model: fov", "`distortion_model` is `fov`, the FOV model"),
        ("[461.6, ", "[", "`intrinsics` are fu, fv, pu, pv"),
        ("resolution: [752, 480]", "resolution: 752", "`resolution` is width and height"),
        ("cam0", "cam7", "has no camera `cam0`; it has cam1, cam7"),
        ("[-0.01, 0.02, -0.003, 0.0004]", "[0.1]", "has 4 coefficients"),
    ],
)
def test_what_of_kalibr_is_not_read_is_named(tmp_path, old, new, words):
    (tmp_path / "camchain.yaml").write_text(KALIBR.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_camera_info(tmp_path / "camchain.yaml", chain_camera="cam0")
