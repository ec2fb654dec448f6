"""The rest of a mission by a periodic gait: the covariance at its end, as a function of that now; `Rollout`."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar, between
from coloc_graph.planning.belief import OBSERVER, POSE, Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.drive import effective_seconds
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.gaits import GaitSearch
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.steps import Steps

Array = NDArray[np.float64]

HEADING_ARM = 4.0  # a last heading counts as what it displaces at this distance [m]
RATIO = 1.3  # between durations of a stance for which the rest is computed
SECONDS = tuple(0.5 * RATIO**n for n in range(20))  # these durations [s]


def end_weights(observers: int) -> Array:
    """Return the weights (12 n + 2,) of the variances of observers and markers in the variance at a mission's end."""
    one = np.zeros(OBSERVER)
    one[2:5] = HEADING_ARM**2, 1.0, 1.0
    return np.concatenate([*[one / observers] * observers, [0.0, 0.0]])


def what_costs(P: Array, variance: Callable[[Array], Array]) -> str:
    """Return which of what is not known after a stance costs most at the end of a mission, in one line.

    Each kind of variable is taken to be known exactly, and the rest of the mission is computed again.

    Parameters
    ----------
    P
        Covariance (12 n + 2, 12 n + 2) of observers and markers.
    variance
        Variances (b,) at the end of the mission of covariances (b, d, d) [m^2].
    """
    each = OBSERVER * np.arange(len(P) // OBSERVER)[:, None]
    kinds = {
        "headings": np.ravel(each + 2),
        "positions": np.ravel(each + np.arange(3, 5)),
        "mounts": np.ravel(each + np.arange(POSE, OBSERVER)),
        "markers": np.array([len(P) - 2, len(P) - 1]),
    }
    exact = [P - P[:, of] @ np.linalg.pinv(P[np.ix_(of, of)], hermitian=True) @ P[of] for of in kinds.values()]
    now, *without = variance(np.array([P, *exact, 0 * P])).tolist()
    inherited = max(now - without[-1], 1e-30)
    shares = {what: (now - value) / inherited for what, value in zip(kinds, without, strict=False)}
    later = without[-1] / now
    first, second = sorted(shares, key=lambda what: -shares[what])[:2]
    return (
        f"{1e3 * math.sqrt(now):.1f} mm expected at the goal, {100 * later:.0f} % of the variance by later "
        f"stances; of the rest, exact {first} would take off {100 * shares[first]:.0f} %, "
        f"{second} {100 * shares[second]:.0f} %"
    )


class Rollout:
    """The rest of a mission of two observers, as the best gait at the mission's pace would do it.

    Parameters
    ----------
    predictor
        Predicts the stances.
    course
        Way of the middle of the observers.
    pair, mover
        Names of the observers and of the mover.
    seconds
        Seconds of images of the mission.
    gait
        The gait; the best one by default.
    timed
        True if `seconds` are those of the mission, leaps included.

    Raises
    ------
    InputError
        If the cameras share no view in any formation.
    """

    def __init__(
        self,
        predictor: Predictor,
        course: Course,
        pair: tuple[str, str],
        mover: str,
        seconds: float,
        gait: Gait | None = None,
        *,
        timed: bool = False,
    ) -> None:
        search = GaitSearch(predictor, course.length, pair, mover, None if gait is None else (gait,))
        best = search.best(seconds, timed=timed)
        self.gait: Gait = best.gait
        self._leap_time = best.leap_time if timed else 0.0
        self.pair, self.mover, self._course, self._speed = pair, mover, course, predictor.speed
        self._yaws = [predictor.camera_yaw(name) for name in pair]
        most = max(math.ceil(course.length / self.gait.leap), 1) + 2
        size = 2 * OBSERVER + 2
        eye = np.broadcast_to(np.eye(size), (len(SECONDS), size, size))
        nothing = Steps(eye, 0 * eye, 0 * eye)
        one = [self._stance(best.information, best.leaps, anchor) for anchor in (0, 1)]
        # of n stances, the first of which robot `anchor` stands still in
        many = [[nothing], [nothing]]
        for _ in range(most):
            longer = [one[anchor].then(many[1 - anchor][-1]) for anchor in (0, 1)]
            for anchor in (0, 1):
                many[anchor].append(longer[anchor])
        self._A, self._B, self._C = (
            np.array([[getattr(steps, name) for steps in of] for of in many]) for name in ("A", "B", "C")
        )

    def _stance(self, information: Array, leaps: tuple[tuple[Array, Array], tuple[Array, Array]], anchor: int) -> Steps:
        """The leap of the other observer to beside the anchor, and the stance, at each of `SECONDS`."""
        size, leaper = 2 * OBSERVER + 2, 1 - anchor
        # the leap k of a gait is to its pose k + 1; information is in the order anchor, leaper, markers
        F, Q = leaps[leaper]
        A, C = np.eye(size), np.zeros((size, size))
        at = slice(OBSERVER * leaper, OBSERVER * leaper + POSE)
        A[at, at], C[at, at] = F, Q
        order = np.concatenate([OBSERVER * n + np.arange(OBSERVER) for n in (anchor, leaper)] + [[size - 2, size - 1]])
        own = np.zeros((size, size))
        own[np.ix_(order, order)] = information[anchor]
        B = effective_seconds(SECONDS, self._speed)[:, None, None] * own
        eye = np.broadcast_to(np.eye(size), B.shape)
        leap = Steps(np.broadcast_to(A, B.shape), 0 * B, np.broadcast_to(C, B.shape))
        return leap.then(Steps(eye, B, 0 * B))

    def rows(self, belief: Belief) -> NDArray[np.int64]:
        """Return the rows of a belief's covariance that the rest depends on."""
        blocks = [belief.index(name) + np.arange(OBSERVER) for name in self.pair]
        return np.concatenate([*blocks, belief.index(self.mover) + np.array([OBSERVER, OBSERVER + 1])])

    def end_variance(self, P: Array, poses: dict[str, Array], front: str, seconds: Array) -> Array:
        """Return the mean variance of the observers' last poses [m^2] at the end of the mission.

        This is that of their positions, and that of their headings times the square of `HEADING_ARM`.

        Parameters
        ----------
        P
            Covariances (b, d, d) of `rows` now.
        poses
            Poses (b, 3) of both observers.
        front
            The observer in front, which stands still next.
        seconds
            Seconds (b,) that are left.
        """
        ways = np.array([self._course.way_of(pose) for pose in poses[front]])
        P = self._in_formation(P, poses, front, ways)
        anchor = self.pair.index(front)
        # the gait brings the other one to a leap ahead of the front, wherever it is now
        stances = np.maximum((self._course.length - ways) / self.gait.leap + 0.5, 0.0)
        fewer = np.minimum(np.floor(stances).astype(int), self._A.shape[1] - 2)
        each = np.maximum(seconds, 0.0) / np.maximum(stances, 0.5) - self._leap_time
        # between the durations of `SECONDS` on either side: rounded to one, some time would be free to spend
        pace = np.clip(np.log(np.maximum(each, 1e-3) / SECONDS[0]) / math.log(RATIO), 0.0, len(SECONDS) - 1.0)
        slower = np.minimum(pace.astype(int), len(SECONDS) - 2)
        shares = np.clip(stances - fewer, 0.0, 1.0), pace - slower
        total = np.zeros(len(P))
        for more, longer in np.ndindex(2, 2):
            weight = np.abs(1 - more - shares[0]) * np.abs(1 - longer - shares[1])
            total += weight * self._after(P, anchor, fewer + more, slower + longer)
        return total

    def stance_seconds(self, seconds: float) -> float:
        """Return the duration of each stance [s] of a mission of these `seconds`, from its first stance on."""
        stances = max(self._course.length / self.gait.leap + 0.5, 1.0)
        return seconds / stances - self._leap_time

    def reason(self, belief: Belief, front: str, seconds: float) -> str:
        """Return which of what is not known after a stance costs most at the end, in one line."""

        def variance(P: Array) -> Array:
            many = {name: np.repeat([belief.poses[name]], len(P), axis=0) for name in self.pair}
            return self.end_variance(P, many, front, np.full(len(P), seconds))

        rows = self.rows(belief)
        return what_costs(belief.covariance[np.ix_(rows, rows)], variance)

    def _after(self, P: Array, anchor: int, stances: NDArray[np.int64], pace: NDArray[np.int64]) -> Array:
        steps = Steps(*(M[anchor, stances, pace] for M in (self._A, self._B, self._C)))
        return steps.variance(P, end_weights(len(self.pair)))

    def _in_formation(self, P: Array, poses: dict[str, Array], front: str, ways: Array) -> Array:
        """Move the errors of robots to where the gait would have them stand: it goes on from there."""
        M = np.broadcast_to(np.eye(P.shape[-1]), P.shape).copy()
        for n, name in enumerate(self.pair):
            side = 1.0 if n == 0 else -1.0
            for b, way in enumerate(ways - (0.0 if name == front else self.gait.leap)):
                x, y, heading = self._course.at(float(way))
                left, turn = side * self.gait.abreast / 2, -side * math.radians(self.gait.toe_in_deg)
                aim = x - left * math.sin(heading), y + left * math.cos(heading), heading + turn - self._yaws[n]
                here: Planar = tuple(poses[name][b].tolist())
                M[b, OBSERVER * n : OBSERVER * n + POSE, OBSERVER * n : OBSERVER * n + POSE] = _moved(
                    between(here, aim)
                )
        return M @ P @ M.mT


def _moved(D: Planar) -> Array:
    """Adjoint (6, 6) that takes an error of a pose T to that of T D."""
    c, s = math.cos(D[2]), math.sin(D[2])
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    cross = np.array([[0.0, 0.0, -D[1]], [0.0, 0.0, D[0]], [D[1], -D[0], 0.0]])  # w x d by w, d on the floor
    out = np.zeros((POSE, POSE))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = R @ cross
    return out
