"""One attempt to measure a stance: images of it, their precision, and the mover in view; `StanceAttempt`."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, between, compose
from coloc_graph.machine import machine
from coloc_graph.online.pose_tracker import PoseTracker
from coloc_graph.online.visibility import InView, Precision
from coloc_graph.run import Detections, Stance

FOLLOWED = 0.1  # share by which each image moves the mover's tracked pose towards where it is seen
JUDGED = 0.7  # time between two judgements of the precision [s]
OUT_OF_VIEW = 0.6  # the mover turns back after this time outside a view [s]


class StanceAttempt:
    """State of a stance while it is captured; `to_middle` once the mover is sent where all should see it.

    Parameters
    ----------
    stance
        The stance; its start and end are set on the way.
    view
        The observers' views.
    capture
        Number of this attempt, unique across coordinators.
    patrol
        Waypoints (n, 2) [m] of the mover.
    mover
        Tracker of the mover's pose, before the attempt's images have moved it.
    """

    def __init__(
        self, stance: Stance, view: InView, capture: int, patrol: NDArray[np.float64], mover: PoseTracker
    ) -> None:
        self.stance, self.view, self.capture = stance, view, capture
        self._begun = mover.pose(), mover.odometry_at(math.inf) if mover.known else None
        self.precision: Precision | None = None
        self.set_off = self.to_middle = False
        self._patrol, self._rounds = patrol, 0
        self._samples = dict.fromkeys(stance.observers, 0)
        self._expected: dict[str, int] = {}
        self._newest = -math.inf
        self._out_since: float | None = None
        self._judged = machine.monotonic()

    def take(self, capture: int, seen: Detections, tracker: PoseTracker) -> None:
        """Take in an image of an observer; the mover's tracked pose follows it: its wheels drift within a minute."""
        if capture != self.capture:
            return
        self._samples[seen.robot] = self._samples.get(seen.robot, 0) + 1
        self._newest = max(self._newest, seen.time)
        pose = tracker.pose(seen.time)
        found = self.view.find(seen, pose)
        if found is not None:
            off = [FOLLOWED * (a - b) for a, b in zip(found, pose, strict=True)]
            pose = pose[0] + off[0], pose[1] + off[1], pose[2] + off[2]
            tracker.fix(seen.time, pose)
        self.view.take(seen, pose)

    def by_wheels(self, mover: PoseTracker) -> Planar:
        """Return the pose of the mover by its pose when the attempt began and its wheels since."""
        pose, odometry = self._begun
        return pose if odometry is None else compose(pose, between(odometry, mover.odometry_at(math.inf)))

    @property
    def last_image(self) -> float:
        """Time of the newest image [UTC s]."""
        return self._newest

    def begin(self, now: float) -> None:
        """Let the stance start `now` [UTC s]."""
        self.stance = replace(self.stance, start=now)

    def out_of_view(self, missing: bool) -> float:
        """Note whether the mover is missing in a view now; return for how long it has been [s]."""
        if not missing:
            self._out_since = None
            return 0.0
        now = machine.monotonic()
        self._out_since = now if self._out_since is None else self._out_since
        return now - self._out_since

    def to_judge(self, left: float) -> Stance | None:
        """Return the stance so far if its precision is to be judged now; `left` [s] of its time are left."""
        now = machine.monotonic()
        if not now - self._judged > JUDGED < left:  # shortly before its end it would hold up the estimate
            return None
        self._judged = now
        return replace(self.stance, end=self.last_image)

    def first_round(self) -> NDArray[np.float64]:
        """Return the waypoints of the mover from its first one on."""
        return self._patrol[1:]

    def whole_round(self) -> NDArray[np.float64]:
        """Return all waypoints, for a mover that comes back into view."""
        return self._patrol

    def way_back(self) -> NDArray[np.float64]:
        """Return the waypoint in the middle of all views."""
        return self._patrol[-1:]

    def next_round(self) -> NDArray[np.float64]:
        """Return the waypoints of the next round, in turn backwards and forwards."""
        self._rounds += 1
        return self._patrol[::-1] if self._rounds % 2 else self._patrol

    def expect(self, answers: Mapping[str, str]) -> None:
        """Take in the observers' answers: how many samples each has sent in all."""
        self._expected = {name: int(answers[name] or 0) for name in self.stance.observers}

    @property
    def complete(self) -> bool:
        """True if all samples that were sent have come."""
        return all(self._samples.get(name, 0) >= expected for name, expected in self._expected.items())
