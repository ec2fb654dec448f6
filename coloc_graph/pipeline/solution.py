"""Result of a solve: `Solution`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from coloc_graph.backend import Estimate
from coloc_graph.backend.graph import Link
from coloc_graph.frontend import PairMeasurement
from coloc_graph.frontend.learnt_noise import NoiseBelief
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import Odometry, Range, RelativePose, Sighting
from coloc_graph.pipeline.contents import Unused
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.run import Run
from coloc_graph.team import Team

#: Kinds in measurements.csv of the links of a graph.
LINK_KINDS: dict[type, str] = {Sighting: "sighting", Odometry: "odometry", Range: "range"}


@dataclass(frozen=True)
class Count:
    """Number of measurements of a kind that an estimate uses, and of those that it does not."""

    used: int
    rejected: int


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """A solved run: the estimate, its measurements, and the time that it took.

    Parameters
    ----------
    run : Run
        The run.
    options : SolveOptions
        Options of the solve.
    estimate : Estimate
        Poses, outliers and calibration.
    measurements : tuple of PairMeasurement
        Of a run with stances: every pair of observers of every stance, unusable ones too.
    warnings : tuple of str
        Sentences on data that was left out, and on what looks wrong.
    seconds_frontend, seconds_backend : float
        Time it took [s].
    seconds_updates : tuple of float
        Time of each update of an incremental estimate [s]; () in batch.
    unused : tuple of Unused
        Recorded data that the estimate does not use.
    online : mapping of str to Trajectory
        Of an incremental estimate of a ranging run: each pose as it was estimated at its time.
    without_pose : mapping of str to str
        By robot of the team that has no pose: the reason.
    noise : NoiseBelief or None
        Of a run with stances: the noise of marker centres as it was learnt.
    """

    run: Run
    options: SolveOptions
    estimate: Estimate
    measurements: tuple[PairMeasurement, ...]
    warnings: tuple[str, ...]
    seconds_frontend: float
    seconds_backend: float
    seconds_updates: tuple[float, ...] = ()
    unused: tuple[Unused, ...] = ()
    online: Mapping[str, Trajectory] = field(default_factory=dict)
    without_pose: Mapping[str, str] = field(default_factory=dict)
    noise: NoiseBelief | None = None

    def reason(self, measured: PairMeasurement | Link) -> str | None:
        """Return the reason for which a measurement is not in the estimate; None where it is."""
        if isinstance(measured, PairMeasurement):
            if measured.homography.unusable is not None or measured.relative_pose is None:
                return measured.homography.unusable
            measured = measured.relative_pose
        if id(measured) in self._rejected:
            return self._rejected[id(measured)]
        return "not tied to the reference" if not self._disconnected.isdisjoint(measured.ends) else None

    @property
    def calibrated_team(self) -> Team | None:
        """The team with what was calibrated and learnt, to start the next run from; None if nothing was."""
        team = self.run.team
        if self.estimate.calibration:
            team = self.estimate.calibration.of_team(team)
        if self.noise is not None:
            team = self.noise.learnt(team)
        return None if team is self.run.team or team == self.run.team else team

    @cached_property
    def _rejected(self) -> dict[int, str]:
        return {id(one.measurement): one.reason for one in self.estimate.rejected}

    @cached_property
    def _disconnected(self) -> frozenset[tuple[str, int]]:
        return frozenset(self.estimate.disconnected)

    @property
    def links(self) -> Iterator[tuple[str, Sighting | Odometry | Range, str | None]]:
        """Sightings, odometry and ranges of the graph: kind, measurement, and the reason where it is not used."""
        for one in self.estimate.graph.measurements:
            if not isinstance(one, RelativePose):
                yield LINK_KINDS[type(one)], one, self.reason(one)

    @cached_property
    def counts(self) -> dict[str, Count]:
        """Number of measurements by kind: `homography`, `sighting`, `odometry` and `range`, or `range` alone."""
        if self.estimate.is_ranging:
            used = self.estimate.ranging.used
            return {"range": Count(int(np.count_nonzero(used)), int(np.count_nonzero(~used)))}
        reasons: dict[str, list[str | None]] = {"homography": [self.reason(one) for one in self.measurements]}
        for kind, _, reason in self.links:
            reasons.setdefault(kind, []).append(reason)
        return {kind: Count(found.count(None), len(found) - found.count(None)) for kind, found in reasons.items()}

    @property
    def count(self) -> Count:
        """Number of homographies, or of ranges."""
        return next(iter(self.counts.values()))

    def __repr__(self) -> str:
        count = self.count
        return (
            f"Solution({self.run!r}, {self.estimate.method}, {count.used} of {count.used + count.rejected} "
            f"measurements used, {len(self.warnings)} warnings)"
        )
