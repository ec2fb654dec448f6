"""The best periodic formation of a team: `best_gait`, and the paper's for comparison."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar, between
from coloc_graph.planning.belief import Belief, leap_model, updated
from coloc_graph.planning.drive import effective_seconds
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.mission import Mission, leap_frog, leap_time, stances_of
from coloc_graph.planning.mover_path import cells
from coloc_graph.planning.prediction import Predictor
from coloc_graph.team import Robot, Team

Array = NDArray[np.float64]

LEAPS = (0.185, 0.3, 0.45, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5)  # [m]
ABREAST = (0.45, 0.5, 0.6, 0.72, 0.9, 1.1)  # [m]
TOE_INS = (-10.0, 0.0, 10.0, 17.0, 25.0, 35.0)  # [deg]
REFINED = 5  # number of gaits whose drives are planned
MIN_STANCE_DURATION = 4.0  # least duration of a stance [s]
PAPER_SECONDS = 5.0  # duration of a stance of the paper's gait, where nothing is asked for [s]
MAX_MISSION_DURATION = 3600.0  # time of a mission above which a wanted sigma is given up [s]


@dataclass(frozen=True)
class Candidate:
    """A gait, and the information of one second of its stances, evenly spread over the common view.

    Attributes
    ----------
    gait
        The formation.
    information
        Information (2, d, d) a second of a stance, by which of the pair is the anchor.
    leaps
        For each of the two, how a leap changes a pose's error, and the covariance that it adds, (6, 6) each.
    leap_time
        Time of a leap until all robots stand [s].
    """

    gait: Gait
    information: Array
    leaps: tuple[tuple[Array, Array], tuple[Array, Array]]
    leap_time: float


class GaitSearch:
    """Compares gaits of a pair of observers over a straight way.

    Parameters
    ----------
    predictor
        Predicts the stances.
    length
        Way of the pair [m].
    pair, mover
        Names of the observers, and of the mover.
    gaits
        The gaits to compare; a grid with the paper's by default.

    Raises
    ------
    InputError
        If the cameras share no view in any formation, or the length is none.
    """

    def __init__(
        self,
        predictor: Predictor,
        length: float,
        pair: tuple[str, str],
        mover: str,
        gaits: Sequence[Gait] | None = None,
    ) -> None:
        if not (math.isfinite(length) and length > 0):
            raise InputError(f"a way of {length} m is none: give a length above 0 m")
        self.predictor, self.length, self.pair, self.mover = predictor, length, pair, mover
        if gaits is None:
            # leaps with which the middle of the pair comes to the end in a whole number of stances
            leaps = sorted({length / (math.ceil(length / leap + 0.4) - 0.5) for leap in LEAPS if leap <= length})
            gaits = [PAPER, *(Gait(*one) for one in product(leaps, ABREAST, TOE_INS) if one[0] <= LEAPS[-1])]
        made = [self._candidate(gait) for gait in gaits]
        self.candidates = [one for one in made if one is not None]
        if not self.candidates:
            raise InputError(
                f"the cameras of {' and '.join(pair)} share no view of {mover}'s markers in any formation: check "
                "heights and tilts of the mounts, and that markers are lower than cameras"
            )

    def _candidate(self, gait: Gait) -> Candidate | None:
        information = []
        for k in (0, 1):
            standing = np.array([self._stop(gait, k), self._stop(gait, k + 1)])
            model = self.predictor.model((self.pair[k], self.pair[1 - k]), self.mover)
            found = cells(model, standing, self.predictor.margins(2 * gait.leap, (self.pair[k], self.pair[1 - k])))
            if len(found.places) < 3:
                return None
            information.append(self.predictor.fps * found.information.mean(axis=0))
        D = [between(self._stop(gait, k), self._stop(gait, k + 2)) for k in (0, 1)]
        belief = Belief.start(self.predictor.team, {self.pair[0]: self._stop(gait, 0)})
        leaps = [leap_model(one, belief.floor, self.predictor.wheels) for one in D]
        taken = leap_time(self._stop(gait, 0), self._stop(gait, 2), self.predictor.speed)
        return Candidate(gait, np.array(information), (leaps[0], leaps[1]), taken)

    def _stop(self, gait: Gait, k: int) -> Planar:
        return self.predictor.stop(gait, self.pair, k)

    def seconds(self, candidate: Candidate, time: float) -> float:
        """Return the duration of each stance in a mission of a whole `time` [s]; below 0 if its leaps take longer."""
        n = stances_of(candidate.gait, self.length)
        return (time - (n - 1) * candidate.leap_time) / n

    def end_sigma(self, candidate: Candidate, seconds: float) -> float:
        """Return the sigma of the last positions [m] that stances of this duration are expected to bring."""
        gait, names = candidate.gait, (*self.pair, self.mover)
        seconds = float(effective_seconds(seconds, self.predictor.speed))
        places = self._stop(gait, 0), self._stop(gait, 1), (1.5, 0.0, 0.0)
        belief = Belief.start(self.predictor.team, dict(zip(names, places, strict=True)))
        P = belief.covariance
        rows = [belief.rows((self.pair[k], self.pair[1 - k]), self.mover) for k in (0, 1)]
        n = stances_of(gait, self.length)
        for k in range(n):
            if k:
                F, Q = candidate.leaps[(k + 1) % 2]
                at = belief.index(self.pair[(k + 1) % 2])
                pose = slice(at, at + 6)
                P[pose] = F @ P[pose]
                P[:, pose] = P[:, pose] @ F.T
                P[pose, pose] += Q
            P = updated(P, rows[k % 2], seconds * candidate.information[k % 2])
        poses = {self.pair[k % 2]: self._stop(gait, k) for k in (n - 1, n)} | {self.mover: (0.0, 0.0, 0.0)}
        poses = {name: poses[name] for name in names}
        return replace(belief, poses=poses, covariance=P).position_sigma(self.pair)

    def ranked(self, time: float | None = None, capture: float | None = None) -> list[tuple[Candidate, float]]:
        """Return candidates with the duration of their stances [s], the best first.

        Missions take a whole `time` [s], or the same `capture` time [s] in which images are taken.
        """
        found = []
        for one in self.candidates:
            if capture is not None:
                seconds = capture / stances_of(one.gait, self.length)
            else:
                assert time is not None
                seconds = self.seconds(one, time)
            if seconds >= MIN_STANCE_DURATION or capture is not None:
                found.append((self.end_sigma(one, seconds), one, seconds))
        found.sort(key=lambda each: each[0])
        return [(one, seconds) for _, one, seconds in found]

    def best(self, seconds: float, *, timed: bool) -> Candidate:
        """Return the best gait of a mission with these `seconds` of images, or, if `timed`, of the whole mission.

        Raises
        ------
        InputError
            If the time is too short for any gait.
        """
        ranked = self.ranked(time=seconds) if timed else self.ranked(capture=seconds)
        if not ranked:
            raise InputError(f"{seconds:.0f} s are too short for {self.length:.1f} m: give a longer time")
        return ranked[0][0]

    def planned(self, ranked: Sequence[tuple[Candidate, float]]) -> tuple[Gait, Mission]:
        """Plan the drives of the best candidates, and return the best gait with its mission.

        Raises
        ------
        InputError
            If no candidate is left.
        """
        if not ranked:
            raise InputError("the time is too short for any gait: give a longer time")
        made = []
        for one, seconds in ranked[:REFINED]:
            mission = leap_frog(self.predictor, one.gait, self.length, seconds, self.pair, self.mover)
            made.append((mission.end_sigma, one.gait, mission))
        _, gait, mission = min(made, key=lambda each: each[0])
        return gait, mission

    def of_paper(self, time: float | None = None, capture: float | None = None) -> Mission | None:
        """Plan the paper's gait with its patrol; None if the `time` is too short for it."""
        own = next((one for one in self.candidates if one.gait is PAPER), None)
        if own is None:
            return None
        if capture is None:
            assert time is not None
            seconds = self.seconds(own, time)
        else:
            seconds = capture / stances_of(PAPER, self.length)
        if seconds <= 0.5:
            return None
        return leap_frog(self.predictor, PAPER, self.length, seconds, self.pair, self.mover, designed=False)

    def shortest(self, sigma: float) -> float:
        """Return the time [s] in which some gait promises a sigma of its end [m].

        Raises
        ------
        InputError
            If none does within an hour; the message says what the best one is, and what would help.
        """
        self.candidates = [one for one, _ in self.ranked(time=MAX_MISSION_DURATION)][:40]
        low, high = 10.0, MAX_MISSION_DURATION
        if not self._reaches(sigma, high):
            best, seconds = self.ranked(time=high)[0]
            reached = self.end_sigma(best, seconds)
            raise InputError(
                f"no plan reaches {1e3 * sigma:g} mm at the end of {self.length:g} m: the best one promises "
                f"{1e3 * reached:.1f} mm in {MAX_MISSION_DURATION / 60:.0f} min (leaps of {best.gait.leap:g} m); "
                f"{self._remedy(best, seconds)} would help most"
            )
        while high / low > 1.03:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if self._reaches(sigma, middle) else (middle, high)
        return high

    def _reaches(self, sigma: float, time: float) -> bool:
        ranked = self.ranked(time=time)
        return bool(ranked) and self.end_sigma(*ranked[0]) <= sigma

    def _remedy(self, candidate: Candidate, seconds: float) -> str:
        """Return which tolerance of the team costs most at the end."""
        found = {}
        for what, team in _better(self.predictor.team).items():
            predictor = replace(self.predictor, team=team, _models={})
            search = GaitSearch(predictor, self.length, self.pair, self.mover, gaits=(candidate.gait,))
            found[what] = search.end_sigma(search.candidates[0], seconds)
        return min(found, key=lambda what: found[what])


def _better(team: Team) -> dict[str, Team]:
    """The team with one kind of tolerance a quarter of what it is, by what one has to do for it."""
    new = msgspec.structs.replace

    def span(robot: Robot) -> Robot:
        return new(robot, markers=robot.markers and new(robot.markers, span_sigma=robot.markers.span_sigma / 4))

    def pixels(robot: Robot) -> Robot:
        c = robot.camera_if_any
        return new(robot, camera_if_any=c and new(c, noise_px=c.noise_px / 4, bias_px=c.bias_px / 4))

    f = team.floor
    flat = f and new(f, tilt_sigma_deg=f.tilt_sigma_deg / 4, height_sigma=f.height_sigma / 4)
    return {
        "a span of the markers known four times better (calipers)": new(team, robots=tuple(map(span, team.robots))),
        "centres with a quarter of the noise (exposure, lens)": new(team, robots=tuple(map(pixels, team.robots))),
        "a floor four times as level": new(team, floor=flat),
    }
