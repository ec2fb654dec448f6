"""coloc calibrate camera IMAGES."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.calibration_arguments import locked_outputs, robot_of, say_written, seen_in

if TYPE_CHECKING:
    from coloc_graph.calibration import CameraCalibration


def run(args: argparse.Namespace) -> int:
    """Calibrate or read a camera, write it and print it."""
    with locked_outputs(args):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    from pathlib import Path

    from coloc_graph.calibration.team_file import write_camera
    from coloc_graph.cli.printing import print_json, warn
    from coloc_graph.errors import InputError
    from coloc_graph.exchange.camera_info import read_camera_info, write_camera_info
    from coloc_graph.run.atomic_file import require_writable

    robot = robot_of(args)
    for path, what in ((args.camera_info, "a YAML file"), (args.out_team, "a team.toml")):
        if path:
            require_writable(path, force=args.force, what=what)
    if args.from_camera_info:
        if args.images or args.out or args.board or args.charuco or args.distortion is not None:
            raise InputError("--from-camera-info is a calibration already: give no images, board or --out with it")
        if not (args.team or args.camera_info):
            raise InputError("--from-camera-info needs a destination: give --team and --robot, or --camera-info")
        camera, left_out = read_camera_info(args.from_camera_info, robot.camera if robot else None, args.chain_camera)
        warn(left_out, kept=False)
        figures = None
    else:
        from coloc_graph.calibration.summary import summarise_camera
        from coloc_graph.report.calibration import require_output_folder, write_camera_calibration

        if not args.images or not args.board or not args.square:
            raise InputError("give images, --board and --square, or a calibration with --from-camera-info")
        if args.out:
            require_output_folder(Path(args.out), force=args.force)
        calibration = _calibrated(args)
        camera, figures = calibration.camera, summarise_camera(calibration)
        if args.out:
            write_camera_calibration(calibration, Path(args.out))
        _warn_of_images(calibration)
    if robot is not None:
        if (robot.camera.width, robot.camera.height) != (camera.width, camera.height):
            said = f"{robot.camera.width}x{robot.camera.height}"
            size = f"{camera.width}x{camera.height}"
            warn([f"the images of {robot.name} have {said} px in {args.team}, and {size} px in this calibration"])
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
    say_written(args)
    return 0


def _calibrated(args: argparse.Namespace) -> "CameraCalibration":
    from coloc_graph.calibration import calibrate_camera
    from coloc_graph.cli.printing import progress

    seen, board = seen_in(args)
    with progress("lens models tried") as report:
        return calibrate_camera(seen, board, args.distortion, report, args.model)


def _warn_of_images(calibration: "CameraCalibration") -> None:
    from coloc_graph.cli.printing import counted, warn

    warn([f"{image.name} was rejected: {image.rejected}" for image in calibration.rejected], kept=False)
    missed = calibration.used.missed
    if missed:
        named = ", ".join(missed[:5]) + (", ..." if len(missed) > 5 else "")
        warn([f"the board was not found in {counted(len(missed), 'image')}: {named}"])


def _print_camera(calibration: "CameraCalibration") -> None:
    """Print parameters with their standard deviations, residuals, lens models tried, and the verdict."""
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
    print_table(["", "value", "sigma", "sigma for independent corners"], rows)
    used, camera = calibration.used, calibration.camera
    print(
        f"{calibration.bundle.rms:.3f} px RMS over {len(used.views)} of {len(calibration.images) + len(used.missed)} "
        f"images; noise_px {camera.noise_px:.3f}, bias_px {camera.bias_px:.3f}"
    )
    if len(calibration.trials) > 1:
        tried = ", ".join(f"{one.coefficients}: {one.held_out_rms:.4f}" for one in calibration.trials)
        print(f"{len(camera.distortion)} lens coefficients; RMS of held-out images [px] by their number: {tried}")
    print("verdict: " + "; ".join(verdict(calibration)))
