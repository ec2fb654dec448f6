"""The command line: one module a command, nothing but parsing and printing.

`main` is the only place where errors are caught: one sentence on stderr and exit code 2, never a traceback.
Results go to stdout, everything else to stderr. Nothing heavy is imported before a command runs.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from coloc_graph._version import __version__
from coloc_graph.cli import (
    calibrate,
    certificates,
    coordinate,
    demo,
    evaluate,
    experiment,
    export,
    import_,
    info,
    plan,
    robot,
    simulate,
    solve,
    team,
    view,
)
from coloc_graph.errors import ColocError


class _Parser(argparse.ArgumentParser):
    """Wrong arguments are one sentence as any other bad input, not a page of usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"coloc: {message}; see `{self.prog} --help`\n")


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = _Parser(prog="coloc", description="Where each robot of a team is, from cameras and LED markers alone.")
    top.add_argument("--version", action="version", version=f"coloc {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in (
        *(demo, team, calibrate, simulate, import_, info, solve, evaluate, view, export, experiment),
        *(plan, coordinate, robot, certificates),
    ):
        module.add(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    # our matrices are small: threads of BLAS would only wait for each other, and take the cores from those who work
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    args = parser().parse_args(arguments)
    try:
        code = int(args.run(args))
        sys.stdout.flush()  # here, so that a reader who has gone is noticed here
        return code
    except ColocError as error:
        print(f"coloc: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # whoever read us has gone: what is still buffered goes nowhere, without a word at the interpreter's end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        place = f" {error.filename}" if error.filename else ""
        print(f"coloc: the system says: {error.strerror}{place}; check the path, its rights, the disk", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("coloc: interrupted", file=sys.stderr)
        return 130
