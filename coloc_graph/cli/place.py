"""One rule of outputs for all commands: what exists is replaced only with --force, and never anything else.

A result that the same run, options and version make again is no other result, and needs no --force. Recordings of
missions and robots are never replaced.
"""

import argparse


def add_out(command: argparse.ArgumentParser) -> None:
    """Add the arguments --out and --force of a command that writes a run."""
    command.add_argument("--out", required=True, metavar="RUN", help="run to write (.mcap)")
    add_force(command)


def add_force(command: argparse.ArgumentParser) -> None:
    """Add the argument --force."""
    command.add_argument("--force", action="store_true", help="replace outputs that exist (default: refuse)")


def require_run_place(out: str, *, force: bool) -> None:
    """Raise `InputError`, before any work, if a run must not be written to `out`."""
    from pathlib import Path

    from coloc_graph.cli.printing import warn
    from coloc_graph.errors import InputError
    from coloc_graph.run import is_mcap
    from coloc_graph.run.atomic_file import parts_left
    from coloc_graph.run.output_lock import locked_output

    path = Path(out)
    if path.absolute().parent.is_dir():
        with locked_output(path):  # a command that still runs is refused here, before any work
            left = parts_left(path)
        warn([f"{part} was left by a killed command: read it with `coloc info`, rename or remove it" for part in left])
    if not path.is_file():
        return  # a folder, or a missing one, is refused when the run is written
    if not is_mcap(path):
        raise InputError(f"{out} exists and is not a run; give another name, or remove it")
    if not force:
        raise InputError(f"{out} is an earlier run; replace it with --force, or give another name")
