"""Prediction of the covariance of a team after planned stances; `Predictor`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.belief import WHEELS, Belief
from coloc_graph.planning.drive import SPEED, drive_through, leap_time, there_and_back
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.room import SAFE, SIGMAS, Room
from coloc_graph.planning.route import Free
from coloc_graph.planning.slip import WheelErrors, view_margins
from coloc_graph.planning.stance_information import StanceModel
from coloc_graph.team import Team

Array = NDArray[np.float64]

INSTANTS = 48  # instants of a drive at which its pixels are linearised; each stands for several images
NOTABLE = 0.1  # relative change of the noise for which models are made anew
MOMENT = 0.01  # time over which the mover's velocity is taken [s]
MIN_POINTS = 6  # correspondences without which a stance has no homography


@dataclass(frozen=True, eq=False)
class Promise:
    """Prediction of a planned stance: the expected number of correspondences, and the team's covariance after it."""

    points: float
    belief: Belief


@dataclass
class Predictor:
    """Predicts stances of a team.

    Attributes
    ----------
    team
        The robots.
    fps
        Images a second.
    noise_px
        Standard deviation of a marker centre per axis [px]; None for what was learnt or is stated of each camera.
    wheels
        Errors of wheel odometry; None to predict without it.
    speed
        Speed of the mover and of leaps [m/s].
    floor_map
        Walls; None where there are none.
    overhead
        Time that a stance takes beside its drive and its leap [s].
    anew
        True if each stance is planned once it is known where those stand that stay; distances then allow for `wheels`.
    sigmas
        Number of standard deviations of slips for which distances allow.
    """

    team: Team
    fps: float = 30.0
    noise_px: float | None = None
    wheels: WheelErrors | None = WHEELS
    speed: float = SPEED
    floor_map: FloorMap | None = None
    overhead: float = 0.0
    anew: bool = False
    sigmas: float = SAFE
    _models: dict[tuple[tuple[str, ...], str], StanceModel] = field(default_factory=dict)

    @property
    def free(self) -> Free | None:
        """Returns which places (..., 2) [m] are free of walls by a distance [m]; None without a map."""
        return None if self.floor_map is None else self.floor_map.clear

    @property
    def room(self) -> Room:
        """Distances that robots keep."""
        return Room((self.wheels or WHEELS) if self.anew else None, self.sigmas)

    @property
    def may_come_nearer(self) -> bool:
        """Return whether distances may shrink further where a way is too narrow."""
        return self.anew and self.sigmas > SIGMAS[-1]

    @property
    def narrow(self) -> str:
        """For how few sigmas distances allow, in words; empty if for all."""
        return f"a narrow way: distances allow for {self.sigmas:g} sigmas of slips; " if self.sigmas < SAFE else ""

    @property
    def rooms(self) -> list[Room]:
        """Distances that robots keep on their ways, the first that leave one: of ever fewer sigmas."""
        return [replace(self.room, sigmas=sigmas) for sigmas in SIGMAS] if self.anew else []

    @property
    def known_slip(self) -> float | None:
        """Leap after which robots that stay are taken to stand [m]; None to keep no more from them than the least."""
        return 0.0 if self.anew else None

    def ever_nearer(self) -> Iterator[float]:
        """Let distances allow for ever fewer sigmas of slips, the most first; for all of them again in the end."""
        if self.anew:
            for self.sigmas in SIGMAS:
                yield self.sigmas
            self.sigmas = SAFE
        else:
            yield self.sigmas

    def camera_yaw(self, robot: str) -> float:
        """Return the heading of a robot's camera in its body [rad]."""
        return math.radians(self.team[robot].mount.yaw_deg)

    def stop(self, gait: Gait, pair: Sequence[str], k: int) -> Planar:
        """Return standing pose number k of a gait, at which the camera, not the body, looks where the gait has it."""
        x, y, yaw = gait.stop(k)
        return x, y, yaw - self.camera_yaw(pair[k % 2])

    def leap_time(self, start: Planar, target: Planar) -> float:
        """Return the time from the end of a stance to the next one whose leaper drives from start to target [s]."""
        return leap_time(start, target, self.speed) + self.overhead

    def model(self, observers: Sequence[str], mover: str) -> StanceModel:
        """Return the model of a stance of these robots."""
        key = tuple(observers), mover
        if key not in self._models:
            self._models[key] = StanceModel(
                self.team, observers, mover, self.noise_px, None, self.floor_map, self.fps / self.speed
            )
        return self._models[key]

    def margins(self, leapt: ArrayLike, observers: Sequence[str]) -> Array:
        """Return the distances (..., r, 2) of markers from the borders of images at which no view misses them [px].

        The last observer comes from leaps (...) [m].
        """
        fx, wheels = self.team[observers[-1]].camera.fx, self.wheels or WHEELS
        return view_margins(leapt, fx, wheels, len(observers), known=self.anew)

    def learn_noise(self, noise_px: float) -> None:
        """Set the noise of marker centres [px] to what stances have shown, if it has changed by a tenth."""
        if self.noise_px is None or abs(noise_px / self.noise_px - 1) > NOTABLE:
            self.noise_px = noise_px
            self._models.clear()

    def of_stance(self, before: Belief, stance: PlannedStance) -> Promise:
        """Predict one stance, after the leaps to it."""
        belief = before
        for name, target in stance.standing.items():
            if name not in stance.anchors and belief.poses[name] != target:
                belief = belief.after_leap(name, target, self.wheels)
        observers = tuple(stance.standing)
        information, points = self.information(stance)
        if points < MIN_POINTS:
            return Promise(points, belief)
        return Promise(points, belief.after_stance(observers, stance.mover, information))

    def information(self, stance: PlannedStance) -> tuple[Array, float]:
        """Return the information (d, d) of a stance on its variables, and the expected number of correspondences."""
        information, points = self.informations([stance])
        return information[0], float(points[0])

    def informations(self, stances: Sequence[PlannedStance], instants: int = INSTANTS) -> tuple[Array, Array]:
        """Return the information (n, d, d) of stances of the same robots, and the correspondences (n,) expected.

        `instants` is the number of instants of each drive at which its pixels are linearised.
        """
        standing = np.array([list(stance.standing.values()) for stance in stances])
        at, velocity = [], []
        for stance in stances:
            drive = drive_through(there_and_back(stance.waypoints, stance.duration, self.speed), self.speed)
            times = (np.arange(instants) + 0.5) * stance.duration / instants
            at.append(drive.at(times))
            velocity.append((drive.at(times + MOMENT) - at[-1]) / MOMENT)
        seconds = np.array([stance.duration for stance in stances]) / instants
        model = self.model(tuple(stances[0].standing), stances[0].mover)
        watching = np.array([[not one.watching or name in one.watching for name in one.standing] for one in stances])
        return model.total(standing, np.array(at), self.fps * seconds, np.array(velocity), seconds, watching)

    def sees(self, stance: PlannedStance, instants: int = INSTANTS) -> NDArray[np.bool_]:
        """Return which observers see all markers of the mover at instants of its drive, (r, instants)."""
        drive = drive_through(there_and_back(stance.waypoints, stance.duration, self.speed), self.speed)
        at = drive.at((np.arange(instants) + 0.5) * stance.duration / instants)
        standing = np.array(list(stance.standing.values()))
        return self.model(tuple(stance.standing), stance.mover).sees(standing, at)

    def of_plan(self, before: Belief, plan: Plan) -> list[Promise]:
        """Predict all stances of a plan in turn."""
        promises, belief = [], before
        for stance in plan.stances:
            promise = self.of_stance(belief, stance)
            promises.append(promise)
            belief = promise.belief
        return promises
