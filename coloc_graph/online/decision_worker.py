"""The planner's thread, beside the mission's main loop; `DecisionWorker`."""

import logging
from collections.abc import Mapping
from concurrent.futures import Future

from coloc_graph.errors import ColocError, RobotError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.machine import machine
from coloc_graph.online.leap_planner import Situation, StancePlan, StancePlanner
from coloc_graph.pipeline.incremental import EnteredStance

log = logging.getLogger(__name__)


class DecisionWorker:
    """Decides on stances on a thread of its own: robots are told to hold or to go on while a decision takes seconds.

    Only that thread uses `planner` for decisions. Each plan is returned once, as soon as it is there.
    """

    def __init__(self, planner: StancePlanner) -> None:
        self._planner = planner
        self._thread = machine.new_worker("planning")
        self._deciding: Future[StancePlan] | None = None
        self._entered: list[tuple[EnteredStance, Mapping[str, Planar]]] = []

    def end(self) -> None:
        """Wait for the present decision, and make no more."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def take(self, entered: EnteredStance, poses: Mapping[str, Planar]) -> None:
        """Have the next decision take in a stance that has entered the estimate, and where all robots then stood."""
        self._entered.append((entered, poses))

    def decide(self, situation: Situation) -> None:
        """Begin to plan the next stance; an earlier decision that was not taken is dropped."""
        entered, self._entered = self._entered, []
        self._deciding = self._thread.submit(self._decide, entered, situation)

    def forget(self) -> None:
        """Drop the present decision."""
        self._deciding = None

    def decided(self) -> StancePlan | None:
        """Return the plan; None while there is none.

        Raises
        ------
        ColocError
            If no stance can be planned.
        """
        done = self._deciding
        if done is None or not done.done():
            return None
        self._deciding = None
        try:
            return done.result()
        except ColocError:
            raise
        except Exception as error:
            log.exception("planning failed")
            raise RobotError(f"planning failed ({error!r})") from error

    def _decide(self, entered: list[tuple[EnteredStance, Mapping[str, Planar]]], situation: Situation) -> StancePlan:
        for one, poses in entered:
            self._planner.take(one, poses)
        return self._planner.plan(situation)
