"""What is worked out while robots drive and while they wait, in a thread of its own; `Measuring`."""

import gc
import logging
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from coloc_graph.backend import Bump
from coloc_graph.errors import ColocError, RobotError
from coloc_graph.frontend import FrontendOptions, StanceTracks
from coloc_graph.online.visibility import Precision, precision
from coloc_graph.pipeline.incremental import EnteredStance, StanceSolver, measure_stance
from coloc_graph.run import Recorded, Stance

#: What noise alone puts this far off less often contradicts what is known.
CONTRADICTED = 1e-4

log = logging.getLogger(__name__)
T = TypeVar("T")


class Measuring:
    """Judges stances that go on, and enters those that are over; `solver` is its thread's alone meanwhile.

    What was asked for is given once, when it is there. A failure, of whatever kind, is a `RobotError`: it voids a
    stance, not a mission.
    """

    def __init__(self, record: Recorded, solver: StanceSolver) -> None:
        self._record, self._solver = record, solver
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="measuring")
        self._judging: Future[Precision] | None = None
        self._tracks: tuple[float, StanceTracks] | None = None
        self._entering: Future[EnteredStance | list[Bump]] | None = None

    def end(self) -> None:
        """Wait for what is under way, and do no more."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    @property
    def judging(self) -> bool:
        """Whether a judgement is under way, or has not been taken yet."""
        return self._judging is not None

    def judge(self, stance: Stance) -> None:
        """Find how well a stance, as it is so far, measures its pairs."""
        self._judging = self._worker.submit(self._judge, stance)

    def forget(self) -> None:
        """What is judged just now is not wanted any more."""
        self._judging = None

    def judged(self) -> Precision | None:
        """What was found; None while it is not."""
        done = self._judging
        if done is None or not done.done():
            return None
        self._judging = None
        return _result(done, "judging the stance")

    def enter(self, stance: Stance) -> None:
        """Measure a stance and enter it."""
        self._entering = self._worker.submit(self._enter, stance)

    def entered(self) -> EnteredStance | list[Bump] | None:
        """The stance that is in; None while it is not; or the bumps of its anchors, and then it is not in."""
        done = self._entering
        if done is None or not done.done():
            return None
        self._entering = None
        return _result(done, "the estimate")

    def _judge(self, stance: Stance) -> Precision:
        return precision(self._record, stance, self._solver.options.frontend, self._tracks_of(stance))

    def _tracks_of(self, stance: Stance) -> StanceTracks:
        """The tracks of a stance, which go on while it does."""
        if self._tracks is None or self._tracks[0] != stance.start:
            frontend = self._solver.options.frontend or FrontendOptions()
            self._tracks = stance.start, StanceTracks(self._record, stance, frontend.tracker)
        return self._tracks[1]

    def _enter(self, stance: Stance) -> EnteredStance | list[Bump]:
        made = measure_stance(self._record, stance, self._solver.options, self._tracks_of(stance))
        pairs = self._solver.measure(self._record, stance, made)
        unusable = [pair.homography.unusable for pair in pairs if pair.homography.unusable]
        if len(unusable) == len(pairs):
            raise RobotError(f"stance {stance.index} measures nothing: {unusable[0]}")
        try:
            one = self._solver.enter(self._record, stance, pairs)
        except ColocError as error:
            raise RobotError(f"stance {stance.index} cannot enter the estimate: {error}") from error
        gc.freeze()  # what is recorded and known stays: to look through it for garbage would hold up later stances
        if not one.estimate.refused and one.estimate.agreement.chance() > CONTRADICTED:
            return one
        # contradicted: was an anchor pushed on the way to here?
        bumped = [bump for bump in self._solver.estimator.bumps() if bump.stay_put.after == stance.index]
        if bumped:
            self._solver.withdraw()
        return bumped or one


def _result(done: "Future[T]", what: str) -> T:
    try:
        return done.result()
    except ColocError:
        raise
    except Exception as error:
        log.exception("%s failed", what)
        raise RobotError(f"{what} failed ({error!r})") from error
