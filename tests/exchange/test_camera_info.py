"""camera_info YAML: to the bit there and back; what our camera cannot say is refused, or a warning."""

import re

import numpy as np
import pytest
import yaml
from msgspec.structs import replace

from coloc_graph.errors import InputError
from coloc_graph.exchange.camera_info import camera_info_text, read_camera_info, write_camera_info
from coloc_graph.team import Camera

FILE = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix: {rows: 3, cols: 3, data: [430.2, 0.0, 306.7, 0.0, 430.5, 227.2, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.34, 0.11, 7e-05, -6e-04, 0.0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
#: As a topic prints it; K is `k` in ROS 2 and `K` in ROS 1.
MESSAGE = """
header: {stamp: {sec: 12, nanosec: 34}, frame_id: camera}
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0]
k: [430.2, 0.0, 306.7, 0.0, 430.5, 227.2, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [430.2, 0.0, 306.7, 0.0, 0.0, 430.5, 227.2, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
height: 480
"""


@pytest.fixture
def read(tmp_path):
    def from_text(text, base=None):
        path = tmp_path / "camera.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_camera_info(path, base)

    return from_text


@pytest.mark.parametrize("coefficients", [0, 4, 5, 8])
def test_a_camera_comes_back_to_the_bit(tmp_path, coefficients):
    rng = np.random.default_rng(coefficients)
    for scale in (1e-3, 1e-7, 1e-300):
        lens = tuple((scale * rng.normal(size=coefficients)).tolist())
        fx, fy, cx, cy = (300 * rng.uniform(0.9, 2, 4)).tolist()
        camera = Camera(width=321, height=239, fx=fx, fy=fy, cx=cx, cy=cy, distortion=lens, fps=30.0, noise_px=0.17)
        write_camera_info(camera, "A", tmp_path / "a.yaml")
        assert read_camera_info(tmp_path / "a.yaml", camera) == (camera, ())
        assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]
    fields = yaml.safe_load(camera_info_text(camera, "A"))
    assert fields["distortion_model"] == ("rational_polynomial" if coefficients == 8 else "plumb_bob")
    assert fields["distortion_coefficients"]["cols"] == coefficients and fields["camera_name"] == "A"


def test_a_fisheye_is_written_as_equidistant_and_read_by_both_of_its_names(read, tmp_path):
    for lens in ((), (0.02, -0.01, 0.003, -0.0005)):
        camera = Camera(width=320, height=240, fx=115.0, fy=115.5, cx=159.0, cy=120.0, model="fisheye", distortion=lens)
        write_camera_info(camera, "A", tmp_path / "a.yaml")
        text = (tmp_path / "a.yaml").read_text()
        assert yaml.safe_load(text)["distortion_model"] == "equidistant"
        found, warnings = read_camera_info(tmp_path / "a.yaml")
        assert found == replace(camera, distortion=lens or (0.0,) * 4) and warnings == ()
        assert read(text.replace("equidistant", "fisheye")) == (found, ())


def test_a_calibrators_file_and_a_printed_topic_are_the_same_camera(read):
    camera, warnings = read(FILE)
    assert warnings == () and camera.distortion == (-0.34, 0.11, 7e-05, -6e-04, 0.0)
    assert (camera.width, camera.height, camera.fx, camera.cy) == (640, 480, 430.2, 227.2)
    assert read(MESSAGE) == read(MESSAGE.replace("\nk:", "\nK:").replace("\nd:", "\nD:")) == (camera, ())


def test_what_is_of_rectified_images_is_left_out_with_a_warning(read):
    _, (said,) = read(FILE.replace("data: [1, 0, 0, 0, 1, 0", "data: [1, 0, 0.001, 0, 1, 0"))
    assert "`rectification_matrix` is ignored" in said
    _, (said,) = read(MESSAGE.replace("p: [430.2, 0.0, 306.7, 0.0,", "p: [430.2, 0.0, 306.7, -38.7,"))
    assert "`projection_matrix` is ignored" in said
    assert read(MESSAGE.replace("p: [430.2, 0.0, 306.7, 0.0, 0.0, 430.5, 227.2, 0.0, 0.0, 0.0, 1.0, 0.0]",
                                "p: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]"))[1] == ()  # fmt: skip


@pytest.mark.parametrize(("old", "new", "says"), [
    ("plumb_bob", "kannala_brandt", "`distortion_model` is `kannala_brandt`, and the lens models here are plumb_bob,"),
    ("plumb_bob\nd: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0]", "equidistant\nd: [0.1, 0.2, 0.3]", "has 4 coefficients"),
    ("plumb_bob", "division", "`distortion_model` is `division`, and the lens models here are plumb_bob, rational"),
    ("plumb_bob", "rational_polynomial", "`rational_polynomial` has 8 coefficients (zeros behind"),
    ("d: [-0.34, ", "d: [0.1, -0.34, 0.1, ", "`plumb_bob` has 0 or 4 or 5 coefficients (zeros"),
    ("plumb_bob", "''", "`` has 0 coefficients"),
    ("d: [-0.34, 0.11,", "d: [-1.5, 0.0,", "its lens model folds 135 px from the middle of the image"),
    ("binning_x: 0", "binning_x: 641", "bins 641 x 1 px to one, and its images are 640 x 480"),
    ("height: 0, width: 0", "height: 481, width: 20", "`roi` of 20 x 481 px at (0, 0), and the full image is"),
    ("x_offset: 0", "x_offset: 9", "`roi` of 0 x 0 px at (9, 0)"),
    ("x_offset: 0", "x_offset: -9", "`roi.x_offset` -9; give a whole number from 0 to 65535"),
    ("k: [430.2, 0.0,", "k: [430.2, 1.5,", "without skew"),
    ("k: [430.2,", "k: [0.0,", "is not calibrated"),
    ("k: [430.2,", "k: [-430.2,", "`fx` is -430.2"),
    ("k: [430.2,", "k: [.nan,", "`k` holds a number that is not finite"),
    ("k: [430.2,", "k: [wide,", "`k` is not a list of numbers"),
    ("k: [430.2,", "k: [430.2, 0,", "`k` has 10 numbers where 3x3 are needed"),
    ("width: 640", "width: wide", "`image_width` is `wide`; give a whole number"),
    ("\nwidth: 640", "", "has no `image_width`"),
    ("\nd: [", "\nd: {rows: 1, cols: 4}\ne: [", "`d` is not a list of numbers"),
    ("\nd: [", "\nd: {rows: 1, cols: 4, data: [1, 2, 3, 4, 5]}\ne: [", "`d` has 5 numbers where 1x4 are needed"),
    ("roi: {", "roi: [", "line"),
    ("width: 640", f"width: {'1' * 400}", "`image_width` is a number of 1326 bits; give a whole number"),
    ("width: 640", f"width: {'1' * 5000}", "what is no number"),
    ("width: 640", "width: 70000", "`image_width` is 70000; give a whole number of pixels, 65535 at most"),
    ("width: 640", "width: 2001-13-45", "`image_width` is `2001-13-45`"),
    ("width: 640", "a: &a [1]\nwidth: *a", "line 5: is not YAML that is read (`it has an alias, which is not read`)"),
    ("width: 640", f"width: {'[' * 20_000}", "is nested too deep"),
    ("k: [430.2,", f"k: [{'1' * 400},", "not a list of numbers"),
    ("binning_x: 0", "binning_x: [1, 2]", "has `binning_x` a list of 2"),
])  # fmt: skip
def test_what_our_camera_cannot_say_is_refused(read, old, new, says):
    assert old in MESSAGE
    with pytest.raises(InputError) as error:
        read(MESSAGE.replace(old, new))
    assert says in str(error.value) and "camera.yaml" in str(error.value) and "\n" not in str(error.value)


def test_a_region_of_interest_that_is_binned_is_the_camera_of_its_images(read):
    """A spot of the full image, its region cut out and each two by three px averaged, is where the camera has it."""
    full, _ = read(MESSAGE)
    region = "roi: {x_offset: 100, y_offset: 60, height: 301, width: 400}"
    text = MESSAGE.replace("binning_x: 0\nbinning_y: 0", "binning_x: 2\nbinning_y: 3")
    binned, (said,) = read(re.sub("roi: .*", region, text))
    assert (binned.width, binned.height) == (200, 100) and binned.distortion == full.distortion
    # by hand: (306.7 - 100 - 0.5) / 2 and (227.2 - 60 - 1) / 3
    assert np.allclose((binned.fx, binned.fy, binned.cx, binned.cy), (215.1, 143.5, 103.1, 55.4))
    assert "the images, which show 400 x 301 px at (100, 60), binned to 200 x 100, of 640 x 480 px" in said
    u, v = full.project((0.1, 0.05, 1.0))[0]
    y, x = np.mgrid[:480, :640]
    image = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 50)[60:360, 100:500].reshape(100, 3, 200, 2).mean(axis=(1, 3))
    y, x = np.mgrid[:100, :200]
    centre = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    assert np.allclose(binned.project((0.1, 0.05, 1.0))[0], centre, atol=1e-3)


@pytest.mark.parametrize(("old", "new", "distortion"), [
    ("d: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0]", "d: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0, 0, 0, 0]",
     (-0.34, 0.11, 7e-05, -6e-04, 0.0)),
    ("plumb_bob\nd: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0]",
     "rational_polynomial\nd: [1.2, 0.3, 0, 0, 0.1, 1.5, 0.4, 0.2, 0, 0, 0, 0, 0, 0]",
     (1.2, 0.3, 0.0, 0.0, 0.1, 1.5, 0.4, 0.2)),
    ("plumb_bob\nd: [-0.34, 0.11, 7.0e-05, -0.0006, 0.0]", "''\nd: []", ()),
])  # fmt: skip
def test_zeros_behind_the_coefficients_and_no_model_are_read(read, old, new, distortion):
    assert old in MESSAGE
    camera, warnings = read(MESSAGE.replace(old, new))
    assert camera.distortion == distortion and warnings == ()


def test_a_byte_order_mark_is_nothing_and_of_a_long_topic_the_first_message_is_read(read):
    camera, _ = read(MESSAGE)
    assert read(b"\xef\xbb\xbf" + MESSAGE.encode())[0] == camera
    assert read(MESSAGE + 200 * MESSAGE)[0] == camera


@pytest.mark.parametrize(("text", "says"), [
    (b"\xff\xfe\x00", "is text in UTF-16; save it as UTF-8"),
    (b"image_width: 3\nname: \xe4", "line 2: is not UTF-8 text"),
    ("a: 1\n" * 20_000, "larger than 64 KiB"),
    ("just words", "holds no fields"),
    ("", "holds no fields"),
    ("a: [1, 2", "is not YAML"),
    ("!!python/object/apply:os.system ['true']", "is not YAML"),
])  # fmt: skip
def test_files_that_are_none_are_refused(read, text, says):
    with pytest.raises(InputError, match=says):
        read(text)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_camera_info(tmp_path / "nowhere.yaml")
