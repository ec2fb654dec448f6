"""coloc calibrate camera|mount IMAGES."""

import argparse

from coloc_graph.cli import calibrate_camera, calibrate_mount


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("calibrate", help="a robot's camera, or how it sits on the robot, from images")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="camera|mount")
    camera = kinds.add_parser(
        "camera",
        help="intrinsics and distortion, from images of a board",
        description="Finds a board in images, calibrates the camera, says how far to trust it and what to do about it, "
        "and writes it into a team.toml, into a camera_info YAML, or both.",
    )
    _add_images(camera, needed=False)
    camera.add_argument(
        "--distortion",
        type=int,
        choices=(0, 4, 5, 8),
        metavar="4|5|8|0",
        help="how many coefficients (default: as few as predict held-out images as well)",
    )
    camera.add_argument("--from-camera-info", metavar="YAML", help="take the camera from this file, without images")
    camera.add_argument("--camera-info", metavar="YAML", help="write the camera for ROS")
    camera.add_argument("--out", metavar="DIR", help="folder for calibration.json, coverage.png, residuals.png")
    _add_team(camera)
    camera.set_defaults(run=calibrate_camera.run)
    mount = kinds.add_parser(
        "mount",
        help="height, tilt and roll of a camera, from a board on the floor",
        description="The board lies flat on the floor in front of the robot, which stands still; an image of each of "
        "several places is best. Writes height, tilt and roll with their sigmas into the team.toml.",
    )
    _add_images(mount, needed=True)
    mount.add_argument("--thickness", type=float, default=0.0, metavar="M", help="of the board [m] (0)")
    mount.add_argument(
        "--calibration", metavar="DIR", help="what `coloc calibrate camera --out` wrote: how well the camera is known"
    )
    _add_team(mount)
    mount.set_defaults(run=calibrate_mount.run)


def _add_images(command: argparse.ArgumentParser, *, needed: bool) -> None:
    command.add_argument("images", nargs="+" if needed else "*", metavar="IMAGES", help="files, or folders of them")
    command.add_argument(
        "--board",
        required=needed,
        metavar="9x6",
        help="inner corners in a row x in a column; of a ChArUco board its squares",
    )
    command.add_argument("--square", type=float, required=needed, metavar="M", help="side of a square [m]")
    command.add_argument("--charuco", metavar="DICT", help="the dictionary of a ChArUco board, such as 4X4_50")
    command.add_argument("--marker", type=float, metavar="M", help="side of a marker of a ChArUco board [m]")


def _add_team(command: argparse.ArgumentParser) -> None:
    command.add_argument("--team", metavar="TEAM.toml", help="the team to write into; the rest of it stays as it is")
    command.add_argument("--robot", metavar="NAME", help="whose camera it is")
    command.add_argument("--out-team", metavar="TOML", help="write the team to this file, and leave --team as it is")
    command.add_argument("--force", action="store_true", help="replace what is at --out, --camera-info or --out-team")
    command.add_argument("--json", action="store_true", help="print the figures as JSON")
