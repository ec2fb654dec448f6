"""coloc calibrate camera|mount IMAGES."""

import argparse

from coloc_graph.cli import calibrate_camera, calibrate_mount
from coloc_graph.cli.place import add_force


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser("calibrate", help="calibrate a robot's camera or its mount from images")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="camera|mount")
    camera = kinds.add_parser(
        "camera",
        help="calibrate intrinsics and lens distortion from images of a board",
        description="Find a board in images, calibrate the camera with its uncertainty, judge the result, and write it "
        "into a team.toml, into a camera_info YAML, or both.",
    )
    _add_images(camera, needed=False)
    camera.add_argument(
        "--distortion",
        type=int,
        choices=(0, 4, 5, 8),
        metavar="4|5|8|0",
        help="number of lens coefficients (default: the fewest that predict held-out images as well as more)",
    )
    camera.add_argument(
        "--model", choices=("pinhole", "fisheye"), default="pinhole",
        help="lens model; fisheye is OpenCV's, ROS's equidistant, for wide lenses (default: pinhole)",
    )  # fmt: skip
    camera.add_argument(
        "--from-camera-info",
        metavar="FILE",
        help="take the camera from a file, not from images: ROS camera_info, OpenCV's YAML or XML, Kalibr's camchain",
    )
    camera.add_argument("--chain-camera", metavar="CAM", help="camera of a Kalibr camchain, as cam1")
    camera.add_argument("--camera-info", metavar="YAML", help="write the camera as ROS camera_info")
    camera.add_argument("--out", metavar="DIR", help="folder for calibration.json, coverage.png, residuals.png")
    _add_team(camera)
    camera.set_defaults(run=calibrate_camera.run)
    mount = kinds.add_parser(
        "mount",
        help="calibrate height, tilt and roll of a camera from a board on the floor",
        description="Estimate height, tilt and roll of a camera with their standard deviations and write them into the "
        "team.toml. The robot stands still; the board lies flat on the floor in front of it. Several images with the "
        "board in different places are best.",
    )
    _add_images(mount, needed=True)
    mount.add_argument("--thickness", type=float, default=0.0, metavar="M", help="its thickness [m] (default: 0)")
    mount.add_argument(
        "--calibration", metavar="DIR", help="folder of `coloc calibrate camera --out`, for the camera's covariance"
    )
    _add_team(mount)
    mount.set_defaults(run=calibrate_mount.run)


def _add_images(command: argparse.ArgumentParser, *, needed: bool) -> None:
    command.add_argument("images", nargs="+" if needed else "*", metavar="IMAGES", help="image files, or folders")
    command.add_argument(
        "--board",
        required=needed,
        metavar="9x6",
        help="number of inner corners in a row x in a column; for a ChArUco board number of squares",
    )
    command.add_argument("--square", type=float, required=needed, metavar="M", help="side of a square [m]")
    command.add_argument("--charuco", metavar="DICT", help="dictionary of a ChArUco board, such as 4X4_50")
    command.add_argument(
        "--leds",
        action="store_true",
        help="the board is a plane of LEDs; --board counts LEDs, --square is their distance",
    )
    command.add_argument("--marker", type=float, metavar="M", help="side of a marker of a ChArUco board [m]")


def _add_team(command: argparse.ArgumentParser) -> None:
    command.add_argument("--team", metavar="TEAM.toml", help="team to write into; all else in it stays unchanged")
    command.add_argument("--robot", metavar="NAME", help="robot that carries the camera")
    command.add_argument("--out-team", metavar="TOML", help="write the team to this file instead of into --team")
    add_force(command)
    command.add_argument("--json", action="store_true", help="print the figures as JSON")
