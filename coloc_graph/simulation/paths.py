"""Movement of a robot: `Path`, its pose at any instant, and the driving that makes one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

#: An iRobot Create as it is driven here: metres a second, radians a second.
SPEED = 0.2
TURN_RATE = 1.0

#: How far apart along a path the floor's unevenness is drawn anew [m].
FLOOR_GRAIN = 0.1


@dataclass(frozen=True, eq=False)
class Leg:
    """Driving from rest to rest: `knots` (n, 3) of x, y [m], yaw [rad, unwrapped] at `times` (n,) [s]."""

    times: Array
    knots: Array

    @property
    def distance(self) -> Array:
        """Distance driven up to each knot, (n,) [m]."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.knots[:, :2], axis=0).T))])

    def cut(self, duration: float) -> "Leg":
        """First `duration` [s] of the leg, which must last as long."""
        end = self.times[0] + duration
        keep = self.times < end
        last = [np.interp(end, self.times, column) for column in self.knots.T]
        return Leg(np.append(self.times[keep], end), np.vstack([self.knots[keep], last]))


@dataclass(frozen=True, eq=False)
class Path:
    """The true movement of one robot on the floor z = 0.

    `knots` (n, 3) of x, y [m], yaw [rad] at `times` (n,) [UTC s]; `tilts` (m, 2) of roll, pitch [rad] of the
    body, as the floor has it, at `tilt_times` (m,). Both are interpolated linearly; else it stands.
    """

    times: Array
    knots: Array
    tilt_times: Array
    tilts: Array

    def planar_at(self, t: ArrayLike) -> Array:
        """x, y [m], yaw [rad, unwrapped] at instants (n,), (n, 3)."""
        return np.stack([np.interp(np.asarray(t, float), self.times, column) for column in self.knots.T], axis=-1)

    def pose_at(self, t: ArrayLike) -> Array:
        """T_world_body (n, 4, 4) at instants (n,) [UTC s]."""
        t = np.atleast_1d(np.asarray(t, float))
        T_world_body = floor_pose(*self.planar_at(t).T)
        roll, pitch = (np.interp(t, self.tilt_times, column) for column in self.tilts.T)
        T_world_body[:, :3, :3] = T_world_body[:, :3, :3] @ tilt_rotation(roll, pitch)
        return T_world_body


def tilt_rotation(roll: ArrayLike, pitch: ArrayLike) -> Array:
    """Rotations (..., 3, 3) about the body's y by pitch, then its x by roll [rad]."""
    roll, pitch = np.asarray(roll, float), np.asarray(pitch, float)
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    zero = np.zeros_like(cr)
    rows = [[cp, sp * sr, sp * cr], [zero, cr, -sr], [-sp, cp * sr, cp * cr]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def drive(poses: ArrayLike, start: float, reverse: bool = False) -> tuple[Leg, NDArray[np.int64]]:
    """Drive through `poses` (n, 3) of x, y, yaw: turn on the spot, go straight, turn to the yaw wanted.

    With `reverse` it goes backwards where that means less turning. Returns the leg and the knot (n,) at which
    each pose is reached.
    """
    poses = np.asarray(poses, float)
    step = np.diff(poses[:, :2], axis=0)
    distance = np.hypot(*step.T)
    heading = np.where(distance > 1e-9, np.arctan2(step[:, 1], step[:, 0]), poses[:-1, 2])
    first = wrap(heading - poses[:-1, 2], np.pi if reverse else 2 * np.pi)
    second = wrap(poses[1:, 2] - poses[:-1, 2] - first)
    turned = np.stack([first, np.zeros_like(first), second], axis=1).ravel()
    taken = np.stack([np.abs(first) / TURN_RATE, distance / SPEED, np.abs(second) / TURN_RATE], axis=1).ravel()
    knots = np.empty((1 + 3 * len(step), 3))
    knots[0] = poses[0]
    knots[1::3, :2], knots[2::3, :2], knots[3::3, :2] = poses[:-1, :2], poses[1:, :2], poses[1:, :2]
    knots[1:, 2] = poses[0, 2] + np.cumsum(turned)
    times = start + np.concatenate([[0.0], np.cumsum(taken)])
    return Leg(times, knots), 3 * np.arange(len(poses))


def stop_and_go(leg: Leg, go: float = 1.5, stand: float = 0.5, ramp: float = 0.3) -> Leg:
    """The same way driven in spells of `go` [s], with rests of `stand` [s] between them.

    In each spell it gathers speed for `ramp` [s] and loses it as long. Knots are 10 ms apart.
    """
    period, gain = go + stand, go - ramp  # what a spell brings the leg forward [s]
    spells = int(np.ceil((leg.times[-1] - leg.times[0]) / gain))
    t = np.arange(0.0, spells * period, 0.01)
    rate = np.clip(np.minimum(t % period, go - t % period) / ramp, 0.0, 1.0)
    progress = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * 0.01)])
    knots = np.stack([np.interp(leg.times[0] + progress, leg.times, column) for column in leg.knots.T], axis=1)
    return Leg(leg.times[0] + t, knots)


def travel(waypoints: ArrayLike, start: float) -> Leg:
    """Drive through `waypoints` (n, 2), n > 1, in straight lines, backwards where that means less turning."""
    waypoints = np.asarray(waypoints, float)
    steps = np.diff(waypoints, axis=0)
    yaw = float(np.arctan2(steps[0, 1], steps[0, 0]))
    poses = [(*waypoints[0], yaw)]
    for step, to in zip(steps, waypoints[1:], strict=True):
        yaw += float(wrap(np.arctan2(step[1], step[0]) - yaw, np.pi))
        poses.append((*to, yaw))
    return drive(np.array(poses), start, reverse=True)[0]


class PathBuilder:
    """Joins legs and rests to one robot's `Path`, over a floor uneven by `sigma` [rad] in roll and pitch."""

    def __init__(
        self,
        start: float,
        pose: ArrayLike,
        sigma: float,
        rng: np.random.Generator,
        tilt: ArrayLike | None = None,
    ) -> None:
        self._sigma, self._rng = sigma, rng
        self._times, self._knots = [np.array([start])], [np.asarray(pose, float)[None]]
        first = self._draw(1) if tilt is None else np.asarray(tilt, float)[None]
        self._tilt_times, self._tilts = [np.array([start])], [first]

    def _draw(self, n: int) -> Array:
        return self._sigma * self._rng.standard_normal((n, 2))

    @property
    def pose(self) -> Array:
        """Current x, y [m], yaw [rad], (3,)."""
        return np.asarray(self._knots[-1][-1])

    def follow(self, leg: Leg, tilt: ArrayLike | None = None) -> None:
        """Rest until the leg begins, then drive it; at its end roll and pitch are `tilt` (2,), if given."""
        whole_turns = wrap(leg.knots[0, 2] - self.pose[2]) - (leg.knots[0, 2] - self.pose[2])
        self._times.append(leg.times)
        self._knots.append(leg.knots + np.array([0.0, 0.0, float(whole_turns)]))
        distance = leg.distance
        # never on the ends of the leg: where a robot rests, its tilt does not change
        inner = np.arange(FLOOR_GRAIN, distance[-1], FLOOR_GRAIN)
        times = np.concatenate([leg.times[:1], np.interp(inner, distance, leg.times), leg.times[-1:]])
        self._tilt_times.append(times)
        tilts = np.vstack([self._tilts[-1][-1:], self._draw(len(inner) + 1)])
        if tilt is not None:
            tilts[-1] = tilt
        self._tilts.append(tilts)

    def path(self) -> Path:
        """The whole path so far."""
        return Path(
            np.concatenate(self._times),
            np.concatenate(self._knots),
            np.concatenate(self._tilt_times),
            np.concatenate(self._tilts),
        )
