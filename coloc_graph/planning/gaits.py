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
from coloc_graph.planning.belief import OBSERVER, POSE, Belief, leap_model, updated
from coloc_graph.planning.course import MAX_LENGTH
from coloc_graph.planning.drive import effective_seconds
from coloc_graph.planning.formation import PAPER, Gait
from coloc_graph.planning.mission import Mission, leap_frog, stances_of
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
_FIRST = np.arange(OBSERVER)
_SECOND = OBSERVER + _FIRST
_MARKERS = 2 * OBSERVER + np.arange(2)
#: Variables of a pair in the order of `StanceModel`, by which of the pair is the anchor.
ANCHOR_FIRST = np.concatenate([_FIRST, _SECOND, _MARKERS]), np.concatenate([_SECOND, _FIRST, _MARKERS])


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
        if length > MAX_LENGTH:
            raise InputError(f"a way of {length:g} m is too long for one plan: give up to {MAX_LENGTH:g} m")
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
            evenly = found.seen.total(np.full(len(found.places), self.predictor.fps / len(found.places)))
            information.append(model.of_stance(evenly))
        D = [between(self._stop(gait, k), self._stop(gait, k + 2)) for k in (0, 1)]
        belief = Belief.start(self.predictor.team, {self.pair[0]: self._stop(gait, 0)})
        leaps = [leap_model(one, belief.floor, self.predictor.wheels) for one in D]
        taken = self.predictor.leap_time(self._stop(gait, 0), self._stop(gait, 2))
        return Candidate(gait, np.array(information), (leaps[0], leaps[1]), taken)

    def _stop(self, gait: Gait, k: int) -> Planar:
        return self.predictor.stop(gait, self.pair, k)

    def seconds(self, candidate: Candidate, time: float) -> float:
        """Return the duration of each stance in a mission of a whole `time` [s]; below 0 if its leaps take longer."""
        n = stances_of(candidate.gait, self.length)
        return (time - (n - 1) * candidate.leap_time) / n

    def end_sigma(self, candidate: Candidate, seconds: float) -> float:
        """Return the sigma of the last positions [m] that stances of this duration are expected to bring."""
        return float(self.end_sigmas([candidate], np.array([seconds]))[0])

    def end_sigmas(self, candidates: Sequence[Candidate], seconds: Array) -> Array:
        """Return the sigmas (n,) of the last positions [m] of candidates with stances of `seconds` (n,)."""
        belief = Belief.start(self.predictor.team, dict.fromkeys((*self.pair, self.mover), (0.0, 0.0, 0.0)))
        rows = belief.rows(self.pair, self.mover)
        start = belief.covariance[rows[:, None], rows]
        seconds = effective_seconds(seconds, self.predictor.speed)
        stances = np.array([stances_of(one.gait, self.length) for one in candidates], int)
        found = np.empty(len(candidates))
        for number in np.unique(stances).tolist():
            some = np.flatnonzero(stances == number).tolist()
            P = np.repeat(start[None], len(some), axis=0)
            information = np.array([candidates[n].information for n in some]) * seconds[some][:, None, None, None]
            F, Q = (np.array([[leap[i] for leap in candidates[n].leaps] for n in some]) for i in (0, 1))
            for k in range(number):
                anchor, leaper = k % 2, (k + 1) % 2
                if k:
                    pose = slice(OBSERVER * leaper, OBSERVER * leaper + POSE)
                    P[:, pose] = F[:, leaper] @ P[:, pose]
                    P[:, :, pose] = P[:, :, pose] @ F[:, leaper].mT
                    P[:, pose, pose] += Q[:, leaper]
                P = updated(P, ANCHOR_FIRST[anchor], information[:, anchor])
            numbers = np.array([3, 4, OBSERVER + 3, OBSERVER + 4])
            found[some] = np.sqrt(P[:, numbers, numbers].sum(axis=1) / 2)
        return found

    def ranked(self, time: float | None = None, capture: float | None = None) -> list[tuple[Candidate, float]]:
        """Return candidates with the duration of their stances [s], the best first.

        Missions take a whole `time` [s], or the same `capture` time [s] in which images are taken.
        """
        if capture is not None:
            seconds = capture / np.array([stances_of(one.gait, self.length) for one in self.candidates])
            some = np.arange(len(seconds))
        else:
            assert time is not None
            seconds = np.array([self.seconds(one, time) for one in self.candidates])
            some = np.flatnonzero(seconds >= MIN_STANCE_DURATION)
        sigmas = self.end_sigmas([self.candidates[n] for n in some.tolist()], seconds[some])
        return [(self.candidates[n], float(seconds[n])) for n in some[np.argsort(sigmas, kind="stable")].tolist()]

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
        """Return the time [s] in which some gait is expected to bring a sigma of its end [m].

        Raises
        ------
        InputError
            If none does within an hour; the message says what the best one is, and what would help.
        """
        low, high = 10.0, MAX_MISSION_DURATION
        left = self._reaching(sigma, high, self.candidates)
        if not left:
            best, seconds = self.ranked(time=high)[0]
            raise self.unreached(sigma, self.end_sigma(best, seconds), high, best.gait)
        while high / low > 1.03:
            middle = math.sqrt(low * high)
            if found := self._reaching(sigma, middle, left):
                left, high = found, middle
            else:
                low = middle
        return high

    def _reaching(self, sigma: float, time: float, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Candidates that bring a sigma [m] in a whole `time` [s]."""
        seconds = np.array([self.seconds(one, time) for one in candidates])
        some = np.flatnonzero(seconds >= MIN_STANCE_DURATION)
        sigmas = self.end_sigmas([candidates[n] for n in some.tolist()], seconds[some])
        return [candidates[n] for n in some[sigmas <= sigma].tolist()]

    def unreached(self, sigma: float, reached: float, time: float, gait: Gait) -> InputError:
        """Return the error of a sigma [m] that no plan reaches: what a `gait` reached in `time` [s], and a remedy."""
        own = GaitSearch(self.predictor, self.length, self.pair, self.mover, gaits=(gait,)).candidates[0]
        return InputError(
            f"no plan reaches {1e3 * sigma:g} mm at the end of {self.length:.3g} m: the best one promises "
            f"{1e3 * reached:.1f} mm in {time / 60:.0f} min (leaps of {gait.leap:.2f} m); "
            f"{self._remedy(own, max(self.seconds(own, time), MIN_STANCE_DURATION))} would help most"
        )

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
        quarter = c and new(c, noise_px=c.typical_noise_px / 4, bias_px=c.bias_px / 4, centre_noise=None)
        return new(robot, camera_if_any=quarter)

    f = team.floor
    flat = f and new(f, tilt_sigma_deg=f.tilt_sigma_deg / 4, height_sigma=f.height_sigma / 4)
    return {
        "a span of the markers known four times better (calipers)": new(team, robots=tuple(map(span, team.robots))),
        "centres with a quarter of the noise (exposure, lens)": new(team, robots=tuple(map(pixels, team.robots))),
        "a floor four times as level": new(team, floor=flat),
    }
