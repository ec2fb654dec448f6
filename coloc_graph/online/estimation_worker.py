"""The estimator's thread, beside the mission's main loop; `EstimationWorker`."""

import gc
import logging
from collections.abc import Sequence
from concurrent.futures import Future
from typing import TypeVar

from coloc_graph.backend import Bump
from coloc_graph.backend.batch import faults_of
from coloc_graph.backend.blame import bumps_of
from coloc_graph.backend.cause import to_check
from coloc_graph.errors import ColocError, RobotError
from coloc_graph.frontend import FrontendOptions, PairMeasurement, StanceTracks
from coloc_graph.machine import machine
from coloc_graph.online.record import Record
from coloc_graph.online.visibility import Precision, precision
from coloc_graph.pipeline.incremental import EnteredStance, IncrementalSolver, measure_stance
from coloc_graph.run import Recorded, Stance
from coloc_graph.run.recorded import Restated

CONTRADICTED = 1e-4  # a new stance less probable than this contradicts the estimate

log = logging.getLogger(__name__)
T = TypeVar("T")


class EstimationWorker:
    """Thread that judges the precision of the stance under way, and enters one that is over into the graph.

    Only that thread uses `solver` meanwhile. Each result is returned once, as soon as it is there. A failure of
    whatever kind is a `RobotError`: it voids a stance, not a mission.
    """

    def __init__(self, record: Recorded, solver: IncrementalSolver) -> None:
        self._record, self._solver = record, solver
        self._worker = machine.new_worker("measuring")
        self._judging: Future[Precision] | None = None
        self._tracks: tuple[float, StanceTracks] | None = None
        self._entering: Future[EnteredStance | list[Bump]] | None = None

    def end(self) -> None:
        """Wait for the present task, and do no more."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    @property
    def judging(self) -> bool:
        """True while a judgement is under way, or its result has not been taken."""
        return self._judging is not None

    def judge(self, stance: Stance) -> None:
        """Judge how precisely a stance, as it is so far, measures its pairs."""
        self._judging = self._worker.submit(self._judge, stance)

    def forget(self) -> None:
        """Drop the present judgement."""
        self._judging = None

    def judged(self) -> Precision | None:
        """Return the result of the judgement; None while there is none."""
        done = self._judging
        if done is None or not done.done():
            return None
        self._judging = None
        return _result(done, "judging the stance")

    def enter(self, stance: Stance, *, retake: bool = False) -> None:
        """Measure a stance and enter it into the estimate, from what is recorded now; `retake` as of `enter_stance`."""
        record = self._record.now() if isinstance(self._record, Record) else self._record
        self._entering = self._worker.submit(self._enter, stance, record, retake)

    def entered(self) -> EnteredStance | list[Bump] | None:
        """Return the entered stance, None while it is not; or bumps of its anchors: then it has not entered."""
        done = self._entering
        if done is None or not done.done():
            return None
        self._entering = None
        return _result(done, "the estimate")

    def _judge(self, stance: Stance) -> Precision:
        return precision(self._record, stance, self._solver.options.frontend, self._tracks_of(stance))

    def _tracks_of(self, stance: Stance) -> StanceTracks:
        """Return the tracks of a stance, which are continued while it goes on."""
        if self._tracks is None or self._tracks[0] != stance.start:
            frontend = self._solver.options.frontend or FrontendOptions()
            self._tracks = stance.start, StanceTracks(self._record, stance, frontend.tracker)
        return self._tracks[1]

    def _enter(self, stance: Stance, record: Recorded, retake: bool) -> EnteredStance | list[Bump]:
        one = enter_stance(self._solver, record, stance, self._tracks_of(stance), retake=retake)
        gc.freeze()  # the record and the estimate stay: looking through them for garbage would hold up later stances
        return one


def enter_stance(
    solver: IncrementalSolver,
    record: Recorded,
    stance: Stance,
    tracks: StanceTracks | None = None,
    *,
    retake: bool = False,
) -> EnteredStance | list[Bump]:
    """Measure a stance and enter it into the estimate.

    Parameters
    ----------
    solver, record, stance, tracks
        Estimator, record, the stance, and its tracks where they exist already.
    retake
        The stance can be taken again: it does not enter if what its cameras measured may be wrong. A clock or wheels
        that are wrong would be as wrong again.

    Returns
    -------
    EnteredStance or list of Bump
        The entered stance; or bumps of its anchors, by which the estimate is contradicted: then it has not entered.

    Raises
    ------
    ColocError
        If it measures nothing, cannot enter, or is to be taken again.
    """
    noisy = Restated(record, solver.noise.used(record.team))  # as a logged run is measured
    pairs = solver.measure(record, stance, tuple(measure_stance(noisy, stance, solver.options, tracks)))
    _require_measured(stance, pairs)
    try:
        one = solver.enter(record, stance, pairs)
    except ColocError as error:
        raise RobotError(f"stance {stance.index} cannot enter the estimate: {error}") from error
    if not one.estimate.rejected and one.estimate.agreement.p_value() > CONTRADICTED:
        return one
    faults = faults_of(solver.estimator.method, solver.estimator.graph)
    seen = [fault for fault in faults if any(cause.is_seen_in(stance.index) for cause in fault.causes)]
    bumped = [bump for bump in bumps_of(faults, solver.estimator.graph) if bump.stay_put.after == stance.index]
    if retake and seen:
        solver.withdraw()
        causes = seen[0].causes
        raise RobotError(f"{' or else '.join(map(str, causes))}: the stance is taken again; check {to_check(*causes)}")
    if bumped:
        solver.withdraw()
    return bumped or one


def _require_measured(stance: Stance, pairs: Sequence[PairMeasurement]) -> None:
    """Require that a stance measures an observer that did not stay; of the first one, all.

    Raises
    ------
    RobotError
        If it does not: wheels alone would say where it stands.
    """
    unusable: dict[str, list[str | None]] = {}
    for pair in pairs:
        for name in (pair.homography.robot_i, pair.homography.robot_j):
            unusable.setdefault(name, []).append(pair.homography.unusable)
    moved = [name for name in stance.observers if name not in stance.anchors]
    lost = [name for name in moved or stance.observers if all(unusable.get(name, ["no pair"]))]
    if lost and (not stance.index or len(lost) == len(moved or stance.observers)):
        raise RobotError(f"stance {stance.index} measures nothing of {' and '.join(lost)}: {unusable[lost[0]][0]}")


def _result(done: "Future[T]", what: str) -> T:
    try:
        return done.result()
    except ColocError:
        raise
    except Exception as error:
        log.exception("%s failed", what)
        raise RobotError(f"{what} failed ({error!r})") from error
