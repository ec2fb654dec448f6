"""Odometry that begins anew, after a restart or on a new line, joined to what was before."""

from dataclasses import replace

import numpy as np

from coloc_graph.geometry.se2 import Planar, compose, inverse, wrap
from coloc_graph.online.pose_tracker import CARRIED
from coloc_graph.run import OdometrySample

#: Where a robot may have gone while nobody counted: one that stood, one that drove [m], [m], [rad].
STOOD = (1e-3, 1e-3, 2e-3)
DROVE = (0.15, 0.15, 0.5)


class JoinedOdometry:
    """Samples in one odometry frame, whatever frame they come in."""

    def __init__(self) -> None:
        self._T: Planar = (0.0, 0.0, 0.0)  # the frame that goes on, and in it the one that samples come in
        self._last: Planar | None = None
        self._unsure: tuple[float, float, float] | None = None

    def align(self, pose: Planar) -> None:
        """A sample that was recorded before came again: it is where this goes on, in the frame that it comes in."""
        if self._last is not None:
            self._T, self._unsure = compose(self._last, inverse(pose)), None

    def restart(self, *, moving: bool) -> None:
        """What comes next is in a new frame; `moving` says whether the robot may have driven in between."""
        if self._last is not None:
            self._unsure = DROVE if moving or self._unsure == DROVE else STOOD

    def carried(self) -> None:
        """It was moved by what its wheels do not know: of the way to what comes next they know nothing."""
        self._unsure = CARRIED

    def go_on(self, pose: Planar, unsure: tuple[float, float, float]) -> None:
        """What comes next, in a new frame, is at a pose that is known to these sigmas [m], [m], [rad]."""
        self._last, self._unsure = pose, unsure

    def take(self, sample: OdometrySample) -> OdometrySample:
        """A sample in the frame that goes on."""
        x, y, yaw = map(float, sample.pose)
        if self._unsure is not None and self._last is not None:
            self._T = compose(self._last, inverse((x, y, yaw)))
            sample = replace(sample, covariance=np.diag(np.square(self._unsure)))
            self._unsure = None
        self._last = compose(self._T, (x, y, yaw))
        turned = wrap(self._last[2])
        return replace(sample, pose=np.array([*self._last[:2], turned]))
