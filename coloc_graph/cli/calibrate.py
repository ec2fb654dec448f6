"""coloc calibrate camera|mount IMAGES."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coloc_graph.calibration import Board, CameraCalibration, MountCalibration, Views
    from coloc_graph.team import Robot


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
    camera.set_defaults(run=run_camera)
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
    mount.set_defaults(run=run_mount)


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


def run_camera(args: argparse.Namespace) -> int:
    """Calibrate or read, write, print."""
    from pathlib import Path

    from coloc_graph.calibration.team_file import write_camera
    from coloc_graph.cli.printing import print_json, warn
    from coloc_graph.errors import InputError
    from coloc_graph.exchange.camera_info import read_camera_info, write_camera_info
    from coloc_graph.whole_file import require_writable

    robot = _robot(args)
    for path, what in ((args.camera_info, "a YAML file"), (args.out_team, "a team.toml")):
        if path:
            require_writable(path, force=args.force, what=what)
    if args.from_camera_info:
        if args.images or args.out or args.board or args.charuco or args.distortion is not None:
            raise InputError("--from-camera-info is a calibration already; leave images, the board and --out out")
        if not (args.team or args.camera_info):
            raise InputError("--from-camera-info is read to be written: give --team and --robot, or --camera-info")
        camera, left_out = read_camera_info(args.from_camera_info, robot.camera if robot else None)
        warn(left_out)
        figures = None
    else:
        from coloc_graph.calibration.summary import summarise_camera
        from coloc_graph.report.calibration import require_place, write_camera_calibration

        if not args.images or not args.board or not args.square:
            raise InputError("give images, --board and --square, or a calibration with --from-camera-info")
        if args.out:
            require_place(Path(args.out), force=args.force)
        calibration = _calibrated(args)
        camera, figures = calibration.camera, summarise_camera(calibration)
        if args.out:
            write_camera_calibration(calibration, Path(args.out))
        _warn_of_images(calibration)
    if robot is not None:
        if (robot.camera.width, robot.camera.height) != (camera.width, camera.height):
            said = f"{robot.camera.width}x{robot.camera.height}"
            warn([f"{args.team} said {said} px of {robot.name}, and the camera has {camera.width}x{camera.height}"])
        write_camera(args.team, robot.name, camera, args.out_team)
    if args.camera_info:
        write_camera_info(camera, args.robot or "camera", Path(args.camera_info))
    if args.json:
        from msgspec import to_builtins

        print_json(figures if figures is not None else {"camera": to_builtins(camera)})
    elif figures is None:
        print(f"fx {camera.fx!r}, fy {camera.fy!r}, cx {camera.cx!r}, cy {camera.cy!r} px of {args.from_camera_info}")
    else:
        _print_camera(calibration)
    _say_written(args)
    return 0


def run_mount(args: argparse.Namespace) -> int:
    """Calibrate, write, print."""
    from coloc_graph.calibration import calibrate_mount, write_mount
    from coloc_graph.calibration.summary import read_covariance, summarise_mount
    from coloc_graph.cli.printing import print_json, warn
    from coloc_graph.errors import InputError
    from coloc_graph.team import read_team
    from coloc_graph.whole_file import require_writable

    robot = _robot(args)
    if robot is None:
        raise InputError("give --team TEAM.toml and --robot NAME, whose camera took the images")
    if args.out_team:
        require_writable(args.out_team, force=args.force, what="a team.toml")
    known = read_covariance(args.calibration, robot.camera) if args.calibration else None
    seen, board = _seen(args)
    if (seen.width, seen.height) != (robot.camera.width, robot.camera.height):
        raise InputError(
            f"the images have {seen.width}x{seen.height} pixels and robot {robot.name}'s camera in {args.team} "
            f"{robot.camera.width}x{robot.camera.height}; give images as it takes them, or calibrate the camera first"
        )
    if known is None and robot.camera.bias_px == 0:
        warn(["the camera is taken for exact; give --calibration DIR of `coloc calibrate camera --out DIR`"])
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
    warn([f"{image.name} was left out: {image.refused}" for image in calibration.refused])
    warn([f"{name}: the board was not found" for name in seen.missed])
    if args.json:
        print_json(summarise_mount(calibration, seen.missed))
    else:
        _print_mount(calibration)
    _say_written(args)
    return 0


def _robot(args: argparse.Namespace) -> "Robot | None":
    """The robot that is named, None where no team is given; wrong names are errors before any work."""
    from coloc_graph.errors import InputError
    from coloc_graph.team import read_team

    if bool(args.team) != bool(args.robot):
        raise InputError("--team and --robot belong together; give both, or neither")
    if args.out_team and not args.team:
        raise InputError("--out-team is a copy of a team; give it with --team and --robot")
    return read_team(args.team)[args.robot] if args.team else None


def _seen(args: argparse.Namespace) -> "tuple[Views, Board]":
    from coloc_graph.calibration import find_boards, image_paths, make_board
    from coloc_graph.cli.printing import progress

    board = make_board(args.board, args.square, args.charuco, args.marker)
    paths = image_paths(args.images)
    with progress("images searched") as report:
        return find_boards(paths, board, report)


def _calibrated(args: argparse.Namespace) -> "CameraCalibration":
    from coloc_graph.calibration import calibrate_camera
    from coloc_graph.cli.printing import progress

    seen, board = _seen(args)
    with progress("parts held out") as report:
        return calibrate_camera(seen, board, args.distortion, report)


def _warn_of_images(calibration: "CameraCalibration") -> None:
    from coloc_graph.cli.printing import counted, warn

    warn([f"{image.name} was left out: {image.refused}" for image in calibration.refused])
    missed = calibration.used.missed
    if missed:
        named = ", ".join(missed[:5]) + (", ..." if len(missed) > 5 else "")
        warn([f"the board was not found in {counted(len(missed), 'image')}: {named}"])


def _print_camera(calibration: "CameraCalibration") -> None:
    """Parameters with their sigmas, residuals, what was tried, the verdict."""
    import numpy as np

    from coloc_graph.calibration import verdict
    from coloc_graph.cli.printing import print_table

    independent = np.sqrt(np.diag(calibration.independent_covariance))
    rows = []
    for index, name in enumerate(calibration.names):
        digits, unit = (2, " px") if index < 4 else (5, "")
        value = calibration.bundle.intrinsics[index]
        sigmas = [f"{one[index]:.{digits}f}{unit}" for one in (calibration.sigmas, independent)]
        rows.append([name, f"{value:.{digits}f}{unit}", *sigmas])
    print_table(["", "value", "sigma", "if corners were independent"], rows)
    used, camera = calibration.used, calibration.camera
    print(
        f"{calibration.bundle.rms:.3f} px RMS over {len(used.views)} of {len(calibration.images) + len(used.missed)} "
        f"images; noise_px {camera.noise_px:.3f}, bias_px {camera.bias_px:.3f}"
    )
    if len(calibration.trials) > 1:
        tried = ", ".join(f"{one.coefficients}: {one.held_out_rms:.4f}" for one in calibration.trials)
        print(
            f"{len(camera.distortion)} lens coefficients; RMS px of images that were held out, by their number: {tried}"
        )
    print("verdict: " + "; ".join(verdict(calibration)))


def _print_mount(calibration: "MountCalibration") -> None:
    """Height, tilt and roll with their sigmas, and what each image says."""
    from pathlib import Path

    from coloc_graph.cli.printing import print_table

    rows = [
        [Path(one.name).name, f"{one.height:.4f} m", f"{one.tilt_deg:.3f} deg", f"{one.roll_deg:.3f} deg",
         f"{one.rms:.3f} px", "left out" if one.refused else ""]
        for one in calibration.images
    ]  # fmt: skip
    print_table(["image", "height", "tilt", "roll", "corners off", ""], rows)
    mount = calibration.mount
    print(
        f"height {mount.height:.4f} +- {mount.height_sigma:.4f} m, tilt {mount.tilt_deg:.3f} +- "
        f"{mount.tilt_sigma_deg:.3f} deg, roll {mount.roll_deg:.3f} +- {mount.roll_sigma_deg:.3f} deg"
    )
    if calibration.dof:
        agreement = f"the images agree with chi2/dof {calibration.chi2 / calibration.dof:.2f}"
        more = f"; sigmas of each are {calibration.scale**0.5:.1f} times larger for it" if calibration.scale > 1 else ""
        print(agreement + more)


def _say_written(args: argparse.Namespace) -> None:
    import sys

    for path in (getattr(args, "out", None), args.out_team or args.team, getattr(args, "camera_info", None)):
        if path:
            print(f"wrote {path}", file=sys.stderr)
