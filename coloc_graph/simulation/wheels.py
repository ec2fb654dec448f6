"""Wheel odometry of a true path: `odometry`."""

from dataclasses import dataclass

import numpy as np

from coloc_graph.geometry.se2 import wrap
from coloc_graph.run.messages import OdometrySample
from coloc_graph.simulation.paths import Array, Path

#: Samples and true poses a second while a robot moves.
RATE = 10.0

#: Encoder noise: 1 % of a metre driven or of a radian turned, growing with the root of the way as the sum
#: of independent slips does; turning goes wrong while driving, too, and nothing is better than a floor.
ALONG = 0.01
TURNED = 0.01
VEER = 0.005
FLOOR_METRES = 2e-5
FLOOR_RADIANS = 1e-4


@dataclass(frozen=True, eq=False)
class Odometry:
    """Odometry of one robot over a run.

    `poses` (n, 3) of x, y [m], yaw [rad] and `covariances` (n, 3, 3) of the increments at true `times` (n,) [UTC s].
    """

    times: Array
    poses: Array
    covariances: Array

    def records(self, robot: str, start: float, end: float, late: float) -> list[OdometrySample]:
        """Samples from `start` (included) to `end` (true time), stamped by a clock that is `late` [s]."""
        first, last = np.searchsorted(self.times, [start, end])
        return [
            OdometrySample(robot, float(self.times[i]) + late, self.poses[i], self.covariances[i])
            for i in range(first, last)
        ]


def move_times(start: float, end: float) -> Array:
    """True instants [s] of a movement's samples: at `RATE`, and at its end."""
    return np.append(np.arange(start, end - 1e-6, 1 / RATE), end)


def odometry(path: Path, moves: list[tuple[float, float]], rng: np.random.Generator) -> Odometry:
    """Odometry of a robot that makes these moves (start, end) [UTC s]; its frame is the body at the start.

    The covariance of each increment, in the previous sample's body, is what its noise was drawn from.
    """
    if not moves:
        return Odometry(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    times = np.concatenate([move_times(start, end) for start, end in moves])
    true = path.planar_at(times)
    step = np.diff(true, axis=0, prepend=true[:1])
    before = np.concatenate([true[:1, 2], true[:-1, 2]])
    # turned by the yaw before: the increment in the previous sample's body
    c, s = np.cos(before), np.sin(before)
    increment = np.stack([c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1], step[:, 2]], axis=1)
    distance, turned = np.hypot(increment[:, 0], increment[:, 1]), np.abs(increment[:, 2])
    variance = np.stack(
        [
            ALONG**2 * distance + FLOOR_METRES**2,
            np.full(len(times), FLOOR_METRES**2),
            TURNED**2 * turned + VEER**2 * distance + FLOOR_RADIANS**2,
        ],
        axis=1,
    )
    noisy = increment + np.sqrt(variance) * rng.standard_normal(increment.shape)
    noisy[0] = 0.0
    yaw = np.cumsum(noisy[:, 2])
    at = np.concatenate([[0.0], yaw[:-1]])
    c, s = np.cos(at), np.sin(at)
    x = np.cumsum(c * noisy[:, 0] - s * noisy[:, 1])
    y = np.cumsum(s * noisy[:, 0] + c * noisy[:, 1])
    return Odometry(times, np.stack([x, y, wrap(yaw)], axis=1), variance[:, :, None] * np.eye(3))
