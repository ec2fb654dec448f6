"""A run that ends the process it is solved in; a module of its own, since each of these processes imports it."""

import os
import signal
from pathlib import Path

from coloc_graph.results import many_runs

solve_one = many_runs.solve_one


def kills_its_process(run, out, options):
    """As `solve_one`, but for runs that kill the process they are in: `a` the first time, `always` always."""
    flag = Path(out).parent / "killed"
    if run.stem == "always" or (run.stem == "a" and not flag.exists()):
        if run.stem == "a":
            flag.parent.mkdir(parents=True, exist_ok=True)
            flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return solve_one(run, out, options)
