"""coloc team new ROBOT... --out TEAM.toml, and coloc team check TEAM.toml."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_force

if TYPE_CHECKING:
    from coloc_graph.team import Team

TEMPLATE_HEAD = """\
# Description of the team; docs/team.md explains every field. Lengths in metres, angles in degrees.
# Measure and correct the numbers; `coloc calibrate` finds cameras and mounts, `coloc team check` checks the file.
reference = "{reference}"            # its pose at the first stance is the world frame

[floor]                    # remove this table if the robots do not share one floor
tilt_sigma_deg = 0.1       # unevenness, 1 sigma
height_sigma = 0.0005
"""
TEMPLATE_ROBOT = '\n[[robots]]\nname = "{name}"\n'
TEMPLATE_CAMERA = """\

[robots.camera]
width = {width:<19}# px
height = {height}
fx = {focal:<22}# px; half the width divided by the tangent of half the horizontal angle of view
fy = {focal}
cx = {cx:<22}# px, the image's centre unless calibrated
cy = {cy}
fps = {fps}

[robots.mount]             # how the camera sits on the body
height = {camera_height}               # of the optical centre above the floor
tilt_deg = {tilt}            # looking down is positive
height_sigma = 0.005       # tolerances, 1 sigma; the values are estimated together with the poses
tilt_sigma_deg = 1.0
roll_sigma_deg = 1.0
"""
TEMPLATE_MARKERS = """\

[robots.markers]
height = {marker_height}              # of both lights above the floor
positions = [[0.0, {half}], [0.0, -{half}]]  # x ahead, y to the left, on the body
span_sigma = 0.0005        # uncertainty of the distance between them, 1 sigma
"""


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser("team", help="write a template of a team.toml, or check one")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="KIND")
    new = kinds.add_parser("new", help="write a team.toml to correct: robots with a camera and two lights each")
    new.add_argument("robots", nargs="+", metavar="ROBOT", help="names of the robots; the first is the reference")
    new.add_argument("--out", required=True, metavar="TEAM.toml", help="file to write")
    add_force(new)
    new.add_argument("--no-camera", action="append", default=[], metavar="ROBOT", help="robot without a camera")
    new.add_argument("--size", default="640x480", help="size of the images [px] (default: 640x480)")
    new.add_argument("--view-deg", type=float, default=60.0, help="horizontal angle of view [deg] (default: 60)")
    new.add_argument("--fps", type=float, default=30.0, help="images a second (default: 30)")
    new.add_argument("--camera-height", type=float, default=0.4, help="camera above the floor [m] (default: 0.4)")
    new.add_argument("--tilt-deg", type=float, default=20.0, help="tilt of the camera, down [deg] (default: 20)")
    new.add_argument("--marker-height", type=float, default=0.15, help="lights above the floor [m] (default: 0.15)")
    new.add_argument("--span", type=float, default=0.25, help="distance between two lights [m] (default: 0.25)")
    new.set_defaults(run=run_new)
    check = kinds.add_parser("check", help="check a team.toml for errors and implausible numbers")
    check.add_argument("team", metavar="TEAM.toml", help="file to check")
    check.set_defaults(run=run_check)


def run_new(args: argparse.Namespace) -> int:
    """Write a template."""
    import math
    from pathlib import Path

    import msgspec

    from coloc_graph.errors import InputError
    from coloc_graph.run.atomic_file import require_writable, write_atomically
    from coloc_graph.team import Team

    width, times, height = args.size.partition("x")
    if not (times and width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise InputError(f"--size is `{args.size}`; write it like 640x480")
    if not 0 < args.view_deg < 180:
        raise InputError(f"--view-deg is {args.view_deg:g}; give an angle between 0 and 180")
    stranger = next((name for name in args.no_camera if name not in args.robots), None)
    if stranger is not None:
        raise InputError(f"--no-camera names `{stranger}`, which is not one of the robots {', '.join(args.robots)}")
    require_writable(args.out, force=args.force, what="a team.toml")
    across, down = int(width), int(height)
    focal = round(across / 2 / math.tan(math.radians(args.view_deg) / 2), 1)
    camera = TEMPLATE_CAMERA.format(
        width=across,
        height=down,
        focal=focal,
        cx=(across - 1) / 2,
        cy=(down - 1) / 2,
        fps=args.fps,
        camera_height=args.camera_height,
        tilt=args.tilt_deg,
    )
    markers = TEMPLATE_MARKERS.format(marker_height=args.marker_height, half=args.span / 2)
    text = TEMPLATE_HEAD.format(reference=args.robots[0]) + "".join(
        TEMPLATE_ROBOT.format(name=name) + ("" if name in args.no_camera else camera) + markers for name in args.robots
    )
    try:
        team = msgspec.toml.decode(text, type=Team)
    except msgspec.DecodeError as error:
        raise InputError(f"that is no team: {error}") from error
    problems, _ = findings(team)
    if problems:
        raise InputError(f"that is no team to solve: {problems[0]}")
    write_atomically(Path(args.out), text)
    print(f"{args.out}: robots {', '.join(team.names)}; correct its numbers, then `coloc team check {args.out}`")
    return 0


def run_check(args: argparse.Namespace) -> int:
    """Print a team, its problems and its implausible numbers; return 1 if it has problems."""
    from coloc_graph.team import read_team

    team = read_team(args.team)
    for robot in team.robots:
        camera, mount = robot.camera_if_any, robot.mount_if_any
        parts = [
            f"camera {camera.width} x {camera.height}, {mount.height:g} m high, {mount.tilt_deg:g} deg down"
            if camera is not None and mount is not None
            else "no camera",
            f"{len(robot.markers.positions)} markers {robot.markers.height:g} m high"
            if robot.markers
            else "no markers",
        ]
        print(f"{robot.name}: {', '.join(parts)}")
    problems, implausible = findings(team)
    for one in problems:
        print(f"problem: {one}")
    for one in implausible:
        print(f"check: {one}")
    if not problems and not implausible:
        print("no problem found")
    return 1 if problems else 0


def findings(team: "Team") -> tuple[list[str], list[str]]:
    """Return problems that make a team unusable, and numbers that are implausible, in words."""
    import math

    watching = [robot for robot in team.robots if robot.camera_if_any is not None]
    marked = [robot for robot in team.robots if robot.markers is not None]
    problems, implausible = [], []
    if len(team.robots) == 1:
        implausible.append("one robot is enough to calibrate: add those that observe and move to solve a run")
    elif len(watching) < 2 and not any(robot.ranging for robot in team.robots):
        problems.append("fewer than two robots have a camera, but a stance needs two observers")
    if watching and not marked:
        problems.append("no robot carries markers to observe: give one [robots.markers]")
    if len(team.robots) == 2 and watching and not any(robot.ranging for robot in team.robots):
        implausible.append("there is no third robot to observe: add the one that moves, even without a camera")
    for robot in watching:
        camera, mount = robot.camera, robot.mount
        for other in marked:
            assert other.markers is not None
            if other is not robot and other.markers.height >= mount.height:
                problems.append(
                    f"the camera of {robot.name} ({mount.height:g} m) is not above the markers of {other.name} "
                    f"({other.markers.height:g} m): mount it higher, or the markers lower (metres?)"
                )
        if not 0.02 < mount.height < 5:
            implausible.append(f"the camera of {robot.name} is {mount.height:g} m high: metres?")
        across, down = map(math.degrees, camera.field_of_view)
        if not 15 < across < (240 if camera.model == "fisheye" else 150):
            implausible.append(
                f"the camera of {robot.name} sees {across:.0f} deg across: is fx ({camera.fx:g} px) of this size?"
            )
        if (
            abs(camera.cx - camera.width / 2) > 0.2 * camera.width
            or abs(camera.cy - camera.height / 2) > 0.2 * camera.height
        ):
            implausible.append(f"the principal point of {robot.name} is far from the middle: is it of this image size?")
        top, bottom = mount.tilt_deg - down / 2, mount.tilt_deg + down / 2
        if bottom <= 0 or top >= 90:
            implausible.append(f"the camera of {robot.name} does not see the floor at a tilt of {mount.tilt_deg:g} deg")
        if mount.tilt_sigma_deg == 0 and mount.roll_sigma_deg == 0 and mount.height_sigma == 0:
            implausible.append(f"the mount of {robot.name} has no tolerances: state them, and it is calibrated too")
    for robot in marked:
        assert robot.markers is not None
        if robot.markers.span is None:
            implausible.append(f"{robot.name} carries one marker, which does not tell its heading: give it two")
        elif not 0.01 < robot.markers.span < 3:
            implausible.append(f"the markers of {robot.name} are {robot.markers.span:g} m apart: metres?")
    return problems, implausible
