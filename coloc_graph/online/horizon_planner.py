"""Stances of a mission planned anew after each one, by the receding horizon; `HorizonPlanner`."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.online.leap_planner import Situation, StancePlan, StancePromise
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.planning.beam import Decision
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.mission import stance_there
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.roles import best_roles
from coloc_graph.planning.route import clear_way, polyline_length, route
from coloc_graph.planning.slip import WheelErrors
from coloc_graph.robot_io.create.odometry import ENCODER, SLIP, WHEELS
from coloc_graph.team import Team

Array = NDArray[np.float64]

MAX_OBSERVERS = 3  # of more, the hindmost one's way round the others is too long for its wheels
CREATE = WheelErrors.of_wheels(math.hypot(SLIP, ENCODER), WHEELS[2].base)  # of the narrower model
FIRST_NOISE = 0.1  # noise of a marker centre until a stance has shown it [px]
PASSING = 0.6  # robots that drive at the same time keep this distance between their ways [m]
RETRIES = 2  # attempts at a stance before another target is chosen
SWEEP = (0.35, -0.35, 0.7, -0.7)  # turns with which one that leapt and did not see the mover looks for it [rad]
OVERHEAD = 5.0  # time of a stance online beside its drive and leap: decision, mover's way, looks, estimate [s]
MAX_DELAY = 10.0  # a stance that takes this much longer than expected was halted, which costs the rest no time [s]
MAX_SHARE = 1.5  # a stance counts for at most this share of the information that was expected of it


def best_mover(team: Team, speed: float) -> str:
    """Return the robot that is to drive before the others' cameras at a `speed` [m/s]: they then promise most.

    Raises
    ------
    InputError
        If no robot can be the mover, or the cameras share no view of any.
    """
    return best_roles(_predictor(team, team.names, speed))[1]


def _predictor(team: Team, names: Sequence[str], speed: float, floor_map: FloorMap | None = None) -> Predictor:
    cameras = [team[name].camera_if_any for name in names]
    fps = min((camera.fps for camera in cameras if camera is not None), default=math.inf)
    return Predictor(team, fps, FIRST_NOISE, CREATE, speed, floor_map, OVERHEAD, anew=True)


class HorizonPlanner:
    """Plans stances from where the robots are and what is known of them; up to three observers and a mover.

    The covariance is that of the planner's own prediction, with the points and the noise that the stances brought.

    Parameters
    ----------
    team, mover, observers
        The team, and the roles of its robots.
    course
        Way of the middle of the observers.
    pace
        Seconds of the mission for each metre of the way, leaps included.
    speed
        Speed of the robots [m/s].
    floor_map, gait
        Walls, None where there are none; and the formation by which the mission is expected to go on, the best one by
        default.

    Raises
    ------
    InputError
        If there are too many observers, the goal is in a wall, or the cameras share no view in any formation.
    """

    def __init__(
        self,
        team: Team,
        mover: str,
        observers: tuple[str, ...],
        course: Course,
        *,
        pace: float,
        speed: float,
        floor_map: FloorMap | None = None,
        gait: Gait | None = None,
    ) -> None:
        self._team, self._mover, self._observers = team, mover, observers
        if len(observers) > MAX_OBSERVERS:
            raise InputError(
                f"{len(observers)} observers are to leap, and online plans are made for up to {MAX_OBSERVERS} and a "
                "mover: leave the others out of the team"
            )
        self._predictor = _predictor(team, observers, speed, floor_map)
        self._ended: float | None = None  # time of the end of the stance before [UTC s]
        self._left = pace * course.length
        self._horizon = Horizon(self._predictor, course, observers, mover, self._left, gait=gait, timed=True)
        self._belief: Belief | None = None
        self._decision: Decision | None = None
        self._plan: StancePlan | None = None
        self._leaper: str | None = None  # the observer that was sent off last
        self._stood: list[Mapping[str, Planar]] = []  # where the observers stood in each stance

    def plan(self, situation: Situation) -> StancePlan:
        """Plan the next stance.

        Another attempt at it begins in the middle of the drive and goes the other way round; after some, another target
        is chosen. One that leapt and did not see the mover turns to look for it.

        Raises
        ------
        InputError
            If no observer can leap, or the observers see too little of the floor together.
        """
        index, attempt, belief = situation.index, situation.attempt, self._believed(situation.poses)
        idle = self._horizon.require_progress(self._stood)
        before = self._decision if self._plan is not None and self._plan.index == index else None
        if before is not None and attempt < RETRIES and self._may_leap(before, situation):
            decision = before
        elif index == 0:
            decision = _watched(self._horizon.first(belief))
        elif len(situation.moved) == len(self._observers):
            decision = self._without_anchor(belief, situation, before)
        elif attempt < RETRIES and situation.moved:
            # one has set off already, under an earlier coordinator or in a failed attempt
            decision = self._where_they_stand(belief, situation.moved)
        else:
            failed = () if before is None or not before.ahead else (before.ahead[0][1],)
            leaper = self._leaper if self._leaper in situation.moved else next(iter(situation.moved), None)
            decision = self._horizon.next(belief, max(self._left, 0.0), (*failed, *idle), leaper, situation.moved)
        self._decision = decision
        leap = decision.ahead[0][:2] if decision.ahead else None
        self._leaper = self._leaper if leap is None else leap[0]
        if leap is not None and attempt and leap[0] in situation.missing:
            # it may have ended where it does not look at the views any more, and sees nothing that would correct it
            x, y, yaw = leap[1]
            leap = leap[0], (x, y, yaw + SWEEP[(attempt - 1) % len(SWEEP)])
        drive, approach = self._approach(decision, situation.poses, leap)
        # the middle comes last, which is where a mover that has left a view goes back to
        middle = drive.mean(axis=0, keepdims=True)
        drive = np.concatenate([drive[::-1] if attempt % 2 else drive, middle])
        if attempt:
            drive = np.concatenate([middle, drive])
        detour = self._detour(situation.poses, leap)
        promise, duration = self._promise(decision), decision.stance.duration
        watching = tuple(name for name in self._observers if name in decision.stance.watching)
        self._plan = StancePlan(index, leap, watching, drive, duration, PASSING, promise, approach, detour)
        return self._plan

    def take(self, entered: EnteredStance, poses: Mapping[str, Planar]) -> None:
        """Take in a stance that has entered the estimate, and where all robots then stood."""
        if self._decision is None or self._plan is None:
            return
        found = [pair.correspondences for pair in entered.pairs if pair.correspondences is not None]
        points = sum(map(len, found))
        if points:
            focal = self._team[self._observers[0]].camera.fx
            self._predictor.learn_noise(float(np.median([one.pairs.sigma for one in found])) * focal)
        stood = self._believed(poses if self._belief is None else self._belief.poses).poses
        belief = self._believed(poses)
        spent = seconds = entered.stance.end - entered.stance.start
        for name in self._observers:
            if name not in entered.stance.anchors and entered.stance.index:
                # the leap's odometry, about where the robot came to stand
                target = belief.poses[name]
                spent += self._predictor.leap_time(stood[name], target)
                belief = replace(belief, poses={**belief.poses, name: stood[name]}).after_leap(name, target, CREATE)
        anchors = tuple(name for name in self._observers if name in entered.stance.anchors)
        standing = {name: belief.poses[name] for name in (*anchors, *(o for o in self._observers if o not in anchors))}
        driven = tuple((float(x), float(y)) for x, y in self._plan.patrol)
        self._stood.append(standing)
        came = PlannedStance(standing, anchors, self._mover, driven, seconds, entered.stance.observers)
        information, expected = self._predictor.information(came)
        if expected > 0:
            share = min(points / expected, MAX_SHARE)
            belief = belief.after_stance(tuple(standing), self._mover, share * information)
        self._belief = belief
        if self._ended is not None:  # what it took, but for long halts
            spent = min(entered.stance.end - self._ended, spent + MAX_DELAY)
        self._ended = entered.stance.end
        self._left -= spent

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the observers have come to the goal."""
        return self._horizon.arrived(poses)

    @property
    def seconds_left(self) -> float:
        """Seconds that the rest of the mission may take."""
        return self._left

    @property
    def noise_px(self) -> float:
        """Noise of marker centres as the last stances have shown it [px]."""
        return self._predictor.noise_px or 0.0

    @property
    def belief(self) -> Belief | None:
        """Belief of the team after the last stance that was taken in; None before the first."""
        return self._belief

    def _believed(self, poses: Mapping[str, Planar]) -> Belief:
        """Belief of the team with its robots at `poses`."""
        if self._belief is None:
            self._belief = Belief.start(self._team, poses)
        return replace(self._belief, poses={name: poses[name] for name in self._belief.robots}, leapt={})

    def _detour(self, poses: Mapping[str, Planar], leap: tuple[str, Planar] | None) -> tuple[tuple[float, float], ...]:
        """Return the waypoints of an observer before its target."""
        if leap is None:
            return ()
        leaper, target = leap
        others = [poses[name][:2] for name in self._observers if name != leaper]
        return tuple(
            route(poses[leaper][:2], target[:2], others, self._predictor.free, rooms=self._predictor.rooms)[:-1]
        )

    def _approach(
        self, decision: Decision, poses: Mapping[str, Planar], leap: tuple[str, Planar] | None
    ) -> tuple[Array, tuple[tuple[float, float], ...]]:
        """Return the drive, from the end where the mover is sooner and out of a leap's way, and its way to there."""
        drive = np.array(decision.stance.waypoints)
        mover = poses[self._mover]
        standing = [poses[name][:2] for name in self._observers]
        found = []
        for one in (drive, drive[::-1]):
            with contextlib.suppress(InputError):
                way = route(mover[:2], one[0], standing, self._predictor.free, rooms=self._predictor.rooms)
                length = polyline_length([mover[:2], *way])
                crosses = leap is not None and not clear_way([poses[leap[0]][:2], leap[1][:2]], one[:1])
                found.append((crosses, length, one, tuple(way[:-1])))
        if not found:
            raise InputError(f"{self._mover} finds no way to where it is to drive: clear its way, or set it there")
        _, _, drive, approach = min(found, key=lambda each: each[:2])
        return drive, approach

    @staticmethod
    def _may_leap(decision: Decision, situation: Situation) -> bool:
        """Return whether the leap of a decision leaves an anchor."""
        leaper = decision.ahead[0][0] if decision.ahead else None
        return leaper is not None and set(situation.moved) <= {leaper}

    def _where_they_stand(self, belief: Belief, moved: Sequence[str]) -> Decision:
        anchors = tuple(name for name in self._observers if name not in moved)
        standing = {name: belief.poses[name] for name in (*anchors, *moved)}
        seconds = self._decision.stance.duration if self._decision is not None else max(0.1 * self._left, 8.0)
        stance, promise = stance_there(
            self._predictor, belief, standing, anchors, self._mover, seconds, self._horizon.goal
        )
        return _watched(Decision(stance, promise, (), reason="all stay where they stand"))

    def _without_anchor(self, belief: Belief, situation: Situation, before: Decision | None) -> Decision:
        """Let all stay where they stand, or where they share no view there the one that leapt last leap on.

        A stance is then tied to the one before by the wheel odometry of that one; one that was pushed stays.
        """
        if situation.attempt <= RETRIES:
            with contextlib.suppress(InputError):
                return self._where_they_stand(belief, situation.moved)
        failed = () if before is None or not before.ahead else (before.ahead[0][1],)
        leaper = self._leaper or situation.moved[0]
        return self._horizon.next(belief, max(self._left, 0.0), failed, leaper, situation.moved)

    def _promise(self, decision: Decision) -> StancePromise:
        belief, standing = decision.promise.belief, decision.stance.standing
        covariances = {name: belief.planar_covariance(name) for name in standing}
        return StancePromise(standing, covariances, decision.promise.points, decision.expected, decision.reason)


def _watched(decision: Decision) -> Decision:
    """Require that in a stance without anchors all observers see the whole drive.

    Raises
    ------
    InputError
        If they do not: nothing else says where those stand that do not.
    """
    if not decision.stance.watching:
        raise InputError(
            f"{', '.join(decision.stance.standing)} do not all see the same part of the floor where they stand: bring "
            "them nearer, or turn their cameras towards each other"
        )
    return decision
