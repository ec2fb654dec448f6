"""Command line: one module for each command, with nothing but parsing and printing.

`main` is the only place that catches errors: one sentence on stderr and exit code 2, never a traceback. Results go to
stdout, everything else to stderr. Nothing heavy is imported before a command runs.
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
    fetch_example,
    import_,
    info,
    plan,
    replay,
    robot,
    simulate,
    solve,
    team,
    view,
)
from coloc_graph.cli.verbosity import add_verbosity, causes, verbosity
from coloc_graph.errors import ColocError


class _Parser(argparse.ArgumentParser):
    """Parser that reports wrong arguments in one sentence instead of a page of usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"coloc: {message}; see `{self.prog} --help`\n")


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    top = _Parser(prog="coloc", description="Localise a team of robots from cameras and LED markers.")
    top.add_argument("--version", action="version", version=f"coloc {__version__}", help="print the version")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in (
        *(demo, fetch_example, team, calibrate, simulate, import_, info, solve, evaluate, view, export, experiment),
        *(plan, coordinate, robot, replay, certificates),
    ):
        module.add(commands)
    add_verbosity(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    # small matrices: threads of BLAS would only wait for each other, and take the cores from other processes
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    args = parser().parse_args(arguments)
    try:
        with verbosity(args):
            code = int(args.run(args))
        sys.stdout.flush()  # so that a closed pipe is noticed here
        return code
    except ColocError as error:
        print(f"coloc: {error}", file=sys.stderr)
        for cause in causes(error) if args.verbose else ():
            print(cause, file=sys.stderr)
        return 2
    except BrokenPipeError:
        # the reader of the pipe has gone: discard what is buffered, without a message when the interpreter ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        path = f" {error.filename}" if error.filename else ""
        print(f"coloc: system error: {error.strerror}{path}; check path, permissions and disk", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("coloc: interrupted", file=sys.stderr)
        return 130
