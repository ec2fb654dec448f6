"""Stances of an earlier coordinator, entered again; `restore`."""

import logging
import threading

from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.pipeline.incremental import StanceSolver
from coloc_graph.run import Run, Stance

log = logging.getLogger(__name__)


def restore(before: Run, solver: StanceSolver, registry: RobotRegistry, stop: threading.Event) -> list[Stance]:
    """Enter the stances of an earlier run, and set the robots' poses; return the stances.

    Ends early when `stop` is set.
    """
    registry.restore()
    stances: list[Stance] = []
    for stance in before.stances:
        if stop.is_set():
            return stances
        registry.follow(solver.enter(before, stance))
        stances.append(stance)
    log.info("continues after %d stances", len(stances))
    return stances
