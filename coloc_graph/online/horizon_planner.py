"""Stances of a mission planned anew after each one, by the receding horizon; `HorizonPlanner`."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.se2 import Planar
from coloc_graph.online.leap_planner import StancePlan
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.pipeline.incremental import EnteredStance
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.course import Course
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.horizon import Decision, Horizon
from coloc_graph.planning.mission import best_stance
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.run import Stance
from coloc_graph.team import Team

Array = NDArray[np.float64]

FIRST_NOISE = 0.1  # noise of a marker centre until a stance has shown it [px]
PASSING = 0.6  # robots that drive at the same time keep this distance between their ways [m]
RETRIES = 2  # attempts at a stance before another target is chosen


class HorizonPlanner:
    """Plans stances from where the robots are and what is known of them; two observers and a mover.

    The covariance is that of the planner's own prediction, with the points and the noise that the stances brought.

    Parameters
    ----------
    team, mover, observers
        The team, and the roles of its robots.
    course
        Way of the middle of the observers.
    registry
        States of the robots.
    pace
        Seconds of images for each metre of the way.
    speed
        Speed of the robots [m/s].
    floor_map, gait
        Walls, None where there are none; and the formation by which the mission is expected to go on, the best one by
        default.

    Raises
    ------
    InputError
        If there are more than two observers, the goal is in a wall, or the cameras share no view in any formation.
    """

    def __init__(
        self,
        team: Team,
        mover: str,
        observers: tuple[str, ...],
        course: Course,
        registry: RobotRegistry,
        *,
        pace: float,
        speed: float,
        floor_map: FloorMap | None = None,
        gait: Gait | None = None,
    ) -> None:
        self._team, self._mover, self._observers, self._registry = team, mover, observers, registry
        fps = min(team[name].camera.fps for name in observers)
        self._predictor = Predictor(team, fps, FIRST_NOISE, speed=speed, floor_map=floor_map)
        self._left = pace * course.length
        self._horizon = Horizon(self._predictor, course, observers, mover, self._left, gait=gait)
        self._belief: Belief | None = None
        self._decision: Decision | None = None
        self._plan: StancePlan | None = None

    def plan(self, index: int, before: Stance | None, attempt: int) -> StancePlan:
        """Plan a stance after the one `before` it.

        Another attempt at it begins in the middle of the drive and goes the other way round; after some, another target
        is chosen.

        Raises
        ------
        InputError
            If no observer can leap, or the observers see too little of the floor together.
        """
        belief = self._believed()
        again = self._plan is not None and self._plan.index == index and self._decision is not None
        if again and attempt < RETRIES:
            assert self._decision is not None
            decision, leap = self._decision, self._leap(self._decision)
        elif before is None:
            decision, leap = self._horizon.first(belief), None
        elif under_way := self._under_way(before):
            decision, leap = self._where_they_stand(belief, under_way), None
        else:
            failed = self._leap(self._decision) if again and self._decision is not None else None
            decision = self._horizon.next(belief, max(self._left, 0.0), () if failed is None else (failed[1],))
            leap = self._leap(decision)
        self._decision = decision
        drive = np.array(decision.stance.waypoints)
        # the middle comes last, which is where a mover that has left a view goes back to
        middle = drive.mean(axis=0, keepdims=True)
        drive = np.concatenate([drive[::-1] if attempt % 2 else drive, middle])
        if attempt:
            drive = np.concatenate([middle, drive])
        first = self._mover_first(leap, drive)
        self._plan = StancePlan(index, leap, drive, decision.stance.duration, first)
        return self._plan

    def drives(self, robot: str) -> bool:
        """Return whether a robot drives in the present plan."""
        leap = self._plan.leap if self._plan is not None else None
        return robot == self._mover or (leap is not None and leap[0] == robot)

    def take(self, entered: EnteredStance) -> None:
        """Take in a stance that has entered the estimate: where all stood, and the points and noise that it brought."""
        if self._decision is None or self._plan is None:
            return
        found = [pair.correspondences for pair in entered.pairs if pair.correspondences is not None]
        points = min((len(one) for one in found), default=0)
        if points:
            focal = self._team[self._observers[0]].camera.fx
            self._predictor.learn_noise(float(np.median([one.pairs.sigma for one in found])) * focal)
        belief = self._believed()
        for name in self._observers:
            if name not in entered.stance.anchors and entered.stance.index:
                # the leap's odometry, about where the robot came to stand
                target = belief.poses[name]
                before = {**belief.poses, name: self._stood[name]}
                belief = replace(belief, poses=before).after_leap(name, target)
        anchors = tuple(name for name in self._observers if name in entered.stance.anchors)
        standing = {name: belief.poses[name] for name in (*anchors, *(o for o in self._observers if o not in anchors))}
        seconds = entered.stance.end - entered.stance.start
        driven = tuple((float(x), float(y)) for x, y in self._plan.patrol)
        came = PlannedStance(standing, anchors, self._mover, driven, seconds)
        information, expected = self._predictor.information(came)
        if expected > 0:
            share = min(points / expected, 1.5)
            belief = belief.after_stance(tuple(standing), self._mover, share * information)
        self._belief = belief
        self._left -= seconds

    def at_goal(self, poses: Mapping[str, Planar]) -> bool:
        """Return whether the observers have come to the goal."""
        return self._horizon.arrived(poses)

    @property
    def seconds_left(self) -> float:
        """Seconds of images that the rest of the mission may take."""
        return self._left

    @property
    def noise_px(self) -> float:
        """Noise of marker centres as the last stances have shown it [px]."""
        return self._predictor.noise_px or 0.0

    @property
    def promised(self) -> Belief:
        """Belief of the team after the last stance."""
        return self._believed()

    @property
    def _stood(self) -> Mapping[str, Planar]:
        """Poses before the present stance's leap."""
        assert self._belief is not None
        return self._belief.poses

    def _believed(self) -> Belief:
        """Belief of the team at the current poses of its robots."""
        poses = self._registry.poses()
        if self._belief is None:
            self._belief = Belief.start(self._team, poses)
        return replace(self._belief, poses={name: poses[name] for name in self._belief.robots})

    def _under_way(self, before: Stance) -> str | None:
        """Return the observer that has set off already, under an earlier coordinator or in a failed attempt."""
        moved = (name for name in self._observers if self._registry[name].tracker.moved_since(before.end))
        return next(moved, None)

    def _where_they_stand(self, belief: Belief, leaper: str) -> Decision:
        anchors = tuple(name for name in self._observers if name != leaper)
        standing = {name: belief.poses[name] for name in (*anchors, leaper)}
        seconds = self._decision.stance.duration if self._decision is not None else max(0.1 * self._left, 8.0)
        stance, promise = best_stance(
            self._predictor, belief, standing, anchors, self._mover, seconds, self._horizon.goal, 0.0
        )
        return Decision(stance, promise, ())

    @staticmethod
    def _leap(decision: Decision) -> tuple[str, Planar] | None:
        return decision.ahead[0][:2] if decision.ahead else None

    def _mover_first(self, leap: tuple[str, Planar] | None, drive: Array) -> bool:
        """Return whether the mover must be where its drive begins before the observer leaps."""
        if leap is None:
            return False
        poses = self._registry.poses()
        along = np.linspace(0.0, 1.0, 30)[:, None]
        start, target = np.array(poses[leap[0]][:2]), np.array(leap[1][:2])
        mover = np.array(poses[self._mover][:2])
        leaps, moves = start + along * (target - start), mover + along * (drive[0] - mover)
        return float(np.hypot(*np.moveaxis(leaps[:, None] - moves, -1, 0)).min()) < PASSING
