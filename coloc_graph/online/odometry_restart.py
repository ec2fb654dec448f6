"""Odometry joined across restarts of a program or of its serial line; `JoinedOdometry`."""

from dataclasses import replace

import numpy as np

from coloc_graph.geometry.se2 import Planar, compose, inverse, wrap
from coloc_graph.online.pose_tracker import CARRIED
from coloc_graph.run import OdometrySample

STOOD = (1e-3, 1e-3, 2e-3)  # sigmas of the motion of a robot that stood while nobody counted [m], [m], [rad]
DROVE = (0.15, 0.15, 0.5)  # the same of one that may have driven [m], [m], [rad]


class JoinedOdometry:
    """Odometry samples in one frame that goes on, whichever frame they come in."""

    def __init__(self) -> None:
        self._T: Planar = (0.0, 0.0, 0.0)  # the frame that goes on, and in it the one that samples come in
        self._last: Planar | None = None
        self._unsure: tuple[float, float, float] | None = None

    def align(self, pose: Planar) -> None:
        """Align the incoming frame by a sample that is recorded already: the joined frame goes on from there."""
        if self._last is not None:
            self._T, self._unsure = compose(self._last, inverse(pose)), None

    def restart(self, *, moving: bool) -> None:
        """Begin a new incoming frame; `moving` says that the robot may have driven in between."""
        if self._last is not None:
            self._unsure = DROVE if moving or self._unsure == DROVE else STOOD

    def carried(self) -> None:
        """Note that the robot was moved otherwise than by its wheels before the next sample."""
        self._unsure = CARRIED

    def go_on(self, pose: Planar, unsure: tuple[float, float, float]) -> None:
        """Begin a new incoming frame at a pose known to sigmas `unsure` [m], [m], [rad]."""
        self._last, self._unsure = pose, unsure

    def take(self, sample: OdometrySample) -> OdometrySample:
        """Convert a sample to the joined frame."""
        x, y, yaw = map(float, sample.pose)
        if self._unsure is not None and self._last is not None:
            self._T = compose(self._last, inverse((x, y, yaw)))
            sample = replace(sample, covariance=np.diag(np.square(self._unsure)))
            self._unsure = None
        self._last = compose(self._T, (x, y, yaw))
        turned = wrap(self._last[2])
        return replace(sample, pose=np.array([*self._last[:2], turned]))
