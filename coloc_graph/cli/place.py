"""Where a command may write a run: nothing that is not a run is replaced, and a run only with --force."""

import argparse


def add_out(command: argparse.ArgumentParser) -> None:
    """The arguments --out and --force of a command that writes a run."""
    command.add_argument("--out", required=True, metavar="RUN", help="the run to write (.mcap)")
    command.add_argument("--force", action="store_true", help="replace a run that is already at --out")


def require_run_place(out: str, *, force: bool) -> None:
    """Raise `InputError` where a run may not be written to `out`, before any work."""
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
        warn([f"{part} is left of a killed command; read it with `coloc info`, rename or remove it" for part in left])
    if not path.is_file():
        return  # a folder, and one that is missing, is refused by who writes the run
    if not is_mcap(path):
        raise InputError(f"{out} exists and is not a run; give another name, or remove it")
    if not force:
        raise InputError(f"{out} is an earlier run; replace it with --force, or give another name")
