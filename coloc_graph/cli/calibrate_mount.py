"""coloc calibrate mount IMAGES."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.calibration_arguments import locked_outputs, robot_of, say_written, seen_in

if TYPE_CHECKING:
    from coloc_graph.calibration import MountCalibration


def run(args: argparse.Namespace) -> int:
    """Calibrate a mount, write it and print it."""
    with locked_outputs(args):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    from coloc_graph.calibration import calibrate_mount, write_mount
    from coloc_graph.calibration.summary import read_covariance, summarise_mount
    from coloc_graph.cli.printing import print_json, warn
    from coloc_graph.errors import InputError
    from coloc_graph.run.atomic_file import require_writable
    from coloc_graph.team import read_team

    robot = robot_of(args)
    if robot is None:
        raise InputError("give --team TEAM.toml and --robot NAME, whose camera took the images")
    if args.out_team:
        require_writable(args.out_team, force=args.force, what="a team.toml")
    known = read_covariance(args.calibration, robot.camera) if args.calibration else None
    seen, board = seen_in(args)
    if (seen.width, seen.height) != (robot.camera.width, robot.camera.height):
        raise InputError(
            f"the images have {seen.width}x{seen.height} pixels, but the camera of {robot.name} in {args.team} has "
            f"{robot.camera.width}x{robot.camera.height}: give images of that size, or calibrate the camera first"
        )
    if known is None and robot.camera.bias_px == 0:
        warn(["the camera is taken as exact; give --calibration DIR of `coloc calibrate camera --out DIR`"])
    calibration = calibrate_mount(
        seen.views,
        robot.camera,
        robot.mount,
        board.square,
        thickness=args.thickness,
        floor=read_team(args.team).floor,
        intrinsics_covariance=known,
    )
    write_mount(args.team, robot.name, calibration.mount, args.out_team)
    warn([f"{image.name} was rejected: {image.rejected}" for image in calibration.rejected], kept=False)
    warn([f"{name}: the board was not found" for name in seen.missed], kept=False)
    if args.json:
        print_json(summarise_mount(calibration, seen.missed))
    else:
        _print_mount(calibration)
    say_written(args)
    return 0


def _print_mount(calibration: "MountCalibration") -> None:
    """Print height, tilt and roll with their standard deviations, and the values of each image."""
    from pathlib import Path

    from coloc_graph.cli.printing import print_table

    rows = [
        [Path(one.name).name, f"{one.height:.4f} m", f"{one.tilt_deg:.3f} deg", f"{one.roll_deg:.3f} deg",
         f"{one.rms:.3f} px", "rejected" if one.rejected else ""]
        for one in calibration.images
    ]  # fmt: skip
    print_table(["image", "height", "tilt", "roll", "RMS of corners", ""], rows)
    mount = calibration.mount
    print(
        f"height {mount.height:.4f} +- {mount.height_sigma:.4f} m, tilt {mount.tilt_deg:.3f} +- "
        f"{mount.tilt_sigma_deg:.3f} deg, roll {mount.roll_deg:.3f} +- {mount.roll_sigma_deg:.3f} deg"
    )
    if calibration.dof:
        agreement = f"agreement of the images: chi2/dof {calibration.chi2 / calibration.dof:.2f}"
        more = f"; their sigmas are scaled by {calibration.scale**0.5:.1f}" if calibration.scale > 1 else ""
        print(agreement + more)
