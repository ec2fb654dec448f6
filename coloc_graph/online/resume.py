"""Stances of an earlier coordinator, entered again; `restore`."""

import logging
import threading
from pathlib import Path

from coloc_graph.online.journal import Journal, read_attempts
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.pipeline.incremental import IncrementalSolver
from coloc_graph.run import Run, Stance

log = logging.getLogger(__name__)


def restore(
    before: Run, log_path: Path, solver: IncrementalSolver, registry: RobotRegistry, stop: threading.Event
) -> list[Stance]:
    """Enter the stances of an earlier run as they entered then, and set the robots' poses; return the stances.

    Ends early when `stop` is set.
    """
    registry.restore()
    stances: list[Stance] = []
    for _, one in Journal(before, read_attempts(log_path)).enter(solver):
        if stop.is_set():
            return stances
        registry.follow(one)
        stances.append(one.stance)
    log.info("continues after %d stances", len(stances))
    return stances
