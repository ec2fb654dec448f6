"""Stances that entered the estimate, or were tried, as a mission's log has them, and entering them again; `Journal`.

A row "entering" of mission.jsonl has the stance and how much of each robot's record there was, so that the same code
can be given the same data again: `coloc replay`, and a coordinator that continues a mission.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec

from coloc_graph.backend import StanceEstimate
from coloc_graph.errors import ColocError, RunError
from coloc_graph.online.estimation_worker import enter_stance
from coloc_graph.online.record import Excerpt
from coloc_graph.pipeline.incremental import EnteredStance, IncrementalSolver
from coloc_graph.run import Run, Stance

Counts = Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Attempt:
    """A stance that was measured and given to the estimate.

    Attributes
    ----------
    stance
        The stance.
    recorded
        Number of detections and of odometry samples of each robot that were recorded then, of the whole run.
    retake
        True if it could be taken again.
    digest
        Digest of the estimate after it; "" if it did not enter, or the coordinator ended before.
    """

    stance: Stance
    recorded: dict[str, tuple[int, int]]
    retake: bool = False
    digest: str = ""


def row_of(stance: Stance, recorded: Counts, retake: bool) -> dict[str, Any]:
    """Return the row of a stance that is about to enter."""
    return {"stance": stance.index, "begun": asdict(stance), "recorded": dict(recorded), "retake": retake}


def row_of_entered(one: EnteredStance) -> dict[str, Any]:
    """Return the row of a stance that has entered."""
    return {
        "stance": one.stance.index,
        "anchors": one.stance.anchors,
        "points": min((len(pair.correspondences) for pair in one.pairs if pair.correspondences is not None), default=0),
        "poses": {name: pose.matrix().tolist() for name, pose in one.estimate.poses.items()},
        "digest": digest_of(one.estimate),
        "rejected": [str(refusal.measurement) for refusal in one.estimate.rejected],
    }


def digest_of(estimate: StanceEstimate) -> str:
    """Return a digest of all bits of an estimate's poses and covariances."""
    digest = hashlib.sha256()
    for name in sorted(estimate.poses):
        digest.update(name.encode() + estimate.poses[name].matrix().tobytes())
        digest.update(estimate.covariances[name].tobytes())
    return digest.hexdigest()[:16]


def read_attempts(path: Path) -> list[Attempt]:
    """Read the attempts of a mission's log, in order; none if it is of a version without them.

    Raises
    ------
    RunError
        If the log is not valid.
    """
    attempts: list[Attempt] = []
    with suppress(FileNotFoundError):
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                continue  # the last line of a coordinator that was killed
            try:
                if row["what"] == "entering":
                    stance = msgspec.convert(row["begun"], Stance)
                    recorded = msgspec.convert(row["recorded"], dict[str, tuple[int, int]])
                    attempts.append(Attempt(stance, recorded, row.get("retake") is True))
                elif row["what"] == "resumed" and attempts and attempts[-1].stance.index >= row["stances"]:
                    attempts.pop()  # the coordinator ended before this one was decided
                elif row["what"] == "entered" and attempts and attempts[-1].stance.index == row["stance"]:
                    attempts[-1] = replace(attempts[-1], digest=str(row.get("digest", "")))
            except (KeyError, TypeError, msgspec.ValidationError) as error:
                raise RunError(f"{path}: is not the log of a mission ({error})") from error
    return attempts


class Journal:
    """Enters the stances of a mission's record again, each with the data that were there at the time.

    Parameters
    ----------
    run
        Record of the mission.
    attempts
        Attempts of its log. Stances of the record that have none are entered with all data.
    """

    def __init__(self, run: Run, attempts: Sequence[Attempt]) -> None:
        self._run = run
        entered = {stance.index: stance for stance in run.stances}
        known = {one.stance.index for one in attempts}
        whole = [Attempt(stance, {}) for index, stance in entered.items() if index not in known]
        last = len(attempts) - 1
        # the last one, if it did not enter, is tried again; so is one of which the record lost a part
        kept = [one for n, one in enumerate(attempts) if one.stance.index in entered or n < last]
        self.attempts = sorted([*whole, *kept], key=lambda one: one.stance.index)
        self._detections = {name: list(run.detections(name)) for name in run.team.names}
        self._odometry = {name: list(run.odometry(name)) for name in run.team.names}

    def enter(self, solver: IncrementalSolver) -> Iterator[tuple[Attempt, EnteredStance]]:
        """Enter all stances; yield each that has entered, as the estimate was then."""
        for attempt in self.attempts:
            if not attempt.recorded:
                yield attempt, solver.enter(self._run, attempt.stance)
                continue
            record = self._then(attempt)
            if record is None:
                continue
            with suppress(ColocError):
                one = enter_stance(solver, record, attempt.stance, retake=attempt.retake)
                if isinstance(one, EnteredStance):
                    yield attempt, one

    def _then(self, attempt: Attempt) -> Excerpt | None:
        """Return the record as it was at an attempt; None if a part of it is lost."""
        counts = {name: attempt.recorded.get(name, (0, 0)) for name in self._run.team.names}
        detections = {name: list(islice(self._detections[name], n)) for name, (n, _) in counts.items()}
        odometry = {name: list(islice(self._odometry[name], n)) for name, (_, n) in counts.items()}
        if any((len(detections[name]), len(odometry[name])) != n for name, n in counts.items()):
            return None
        return Excerpt(self._run.path, self._run.team, detections, odometry)
