"""What a team measured that drives all the time: keyframes, the steps between them, and ranges and bearings.

A keyframe is a robot at an instant at which it measured, or was measured. All is on the floor: (x, y, heading).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Keyframes of a robot are no further apart [s]: a long step with turns in it is no arc.
LONGEST_STEP = 1.0


@dataclass(frozen=True, eq=False)
class Steps:
    """One robot's way from each of its n keyframes to the next, by its odometry.

    `twists` (delays, n - 1, 3) are the SE(2) logarithms (x [m], y [m], heading [rad]) of the steps that odometry says,
    at each of some `delays` (d,) [s] of it, ascending; `covariances` (n - 1, 3, 3) are of the second pose in the first.
    """

    delays: Array
    twists: Array
    covariances: Array


@dataclass(frozen=True, eq=False)
class RangeBearings:
    """Measurements of range and bearing as columns, in the order of time [UTC s].

    `robot` and `keyframe` say who measured where, `target` whom: a robot's number, with its keyframe in
    `target_keyframe`, or the number of robots plus a landmark's, with -1 there. `share` (n, 2) is the part of a range's
    and of a bearing's information that is new: the errors of the same target's next measurement are much alike.
    """

    time: Array
    robot: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    target: NDArray[np.int64]
    target_keyframe: NDArray[np.int64]
    range: Array
    bearing: Array
    share: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, eq=False)
class Drive:
    """All of a team's keyframes: `times` [UTC s] of each robot's, ascending, its `steps`, and the `measured`.

    `warnings` are sentences on what was left out.
    """

    robots: tuple[str, ...]
    landmarks: tuple[str, ...]
    times: tuple[Array, ...]
    steps: tuple[Steps, ...]
    measured: RangeBearings
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        counts = f"{sum(map(len, self.times))} keyframes, {len(self.measured)} measurements"
        return f"Drive({len(self.robots)} robots, {len(self.landmarks)} landmarks, {counts})"
