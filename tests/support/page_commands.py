"""Lines of a page's shell blocks, run as they stand in the current folder."""

import contextlib
import io
import runpy
import shlex
import sys
from pathlib import Path

from coloc_graph.cli import main


def run_line(command, done):
    """Run a line of a shell block, unless it has been run before."""
    words = tuple(shlex.split(command, comments=True))
    if not words or words in done:
        return
    if words[0] == "mkdir":
        Path(words[-1]).mkdir(parents=True, exist_ok=True)
    elif words[0] == "printf":
        into = words[-2]
        with Path(words[-1]).open("a" if into == ">>" else "w", encoding="utf-8") as file:
            file.write(words[1].encode().decode("unicode_escape"))
    elif words[0] == "python":
        run_script(words[1])
    else:
        assert words[0] == "coloc", command
        assert main(list(words[1:])) == 0, command
    done.add(words)


def run_script(path):
    """Run a Python script as a program, with a working `sys.argv`, and return what it prints."""
    printed, argv = io.StringIO(), sys.argv
    sys.argv = [str(path)]
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.argv = argv
    return printed.getvalue()
