"""Interpret the arguments that `coloc calibrate camera` and `mount` share: robot, board, images and outputs."""

import argparse
from contextlib import ExitStack
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coloc_graph.calibration import Board, Views
    from coloc_graph.team import Robot


def robot_of(args: argparse.Namespace) -> "Robot | None":
    """Return the named robot, None without a team; wrong names are errors before any work."""
    from coloc_graph.errors import InputError
    from coloc_graph.team import read_team

    if bool(args.team) != bool(args.robot):
        raise InputError("--team and --robot belong together: give both, or neither")
    if args.out_team and not args.team:
        raise InputError("--out-team writes a copy of a team: give it with --team and --robot")
    return read_team(args.team)[args.robot] if args.team else None


def locked_outputs(args: argparse.Namespace) -> ExitStack:
    """Lock all that the command writes, until the context ends; `InputError` if another command writes one of them."""
    from pathlib import Path

    from coloc_graph.run.output_lock import locked_output

    with ExitStack() as locks:
        for path in (getattr(args, "out", None), getattr(args, "camera_info", None), args.out_team or args.team):
            if path and Path(path).absolute().parent.is_dir():
                locks.enter_context(locked_output(path))
        return locks.pop_all()


def seen_in(args: argparse.Namespace) -> "tuple[Views, Board]":
    """Return the boards found in the images, and the board."""
    from coloc_graph.calibration import find_boards, image_paths, make_board
    from coloc_graph.cli.printing import progress
    from coloc_graph.frontend import detect_leds

    board = make_board(args.board, args.square, args.charuco, args.marker, leds=args.leds)
    paths = image_paths(args.images)
    with progress("images searched") as report:
        return find_boards(paths, board, report, lambda image: detect_leds(image).uv)


def say_written(args: argparse.Namespace) -> None:
    """Print the written paths to stderr."""
    from coloc_graph.cli.printing import note

    for path in (getattr(args, "out", None), args.out_team or args.team, getattr(args, "camera_info", None)):
        if path:
            note(f"wrote {path}")
