"""The next stances, chosen from where a team really is: `Horizon`."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.beam import CORNER_BEAM, Decision, Node, beam_width, different, first_leaps
from coloc_graph.planning.belief import Belief, updated
from coloc_graph.planning.course import Course
from coloc_graph.planning.drive import effective_seconds
from coloc_graph.planning.durations import MAX_STANCE_DURATION, SHARES, durations
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.gaits import MIN_STANCE_DURATION
from coloc_graph.planning.leaps import Leaps, leaps_beside, possible_leaps, steps_aside
from coloc_graph.planning.mission import Mission, best_stance, stance_there
from coloc_graph.planning.mover_path import evenly_seen
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.prediction import Predictor, Promise
from coloc_graph.planning.progress import ARRIVED, STRAGGLE, leading_on, require_progress
from coloc_graph.planning.refinement import Refinement
from coloc_graph.planning.rollout import Rollout
from coloc_graph.planning.ways_out import NARROW, in_the_way, require_way, stuck

Array = NDArray[np.float64]

DEPTH = 2  # stances that are looked ahead
FINALISTS = 3  # first leaps whose stances are planned to be compared, with the gait's own
PREFERRED = 1.03  # the gait's own leap is left for one that promises a variance this much smaller
ROW = 0.6  # distance between rows of observers at the beginning [m]
MIN_CELLS = 3  # cells of the common view without which a stance is not planned
MAX_STANCES = 2000

#: What decides between stances: the variance at the goal with the cost to go, the information gained, the size of the
#: common view, or nothing.
Objective = Literal["goal", "information", "view", "random"]


class Horizon:
    """Plans the next stances of observers along a course, with a budget of seconds in which images are taken.

    Parameters
    ----------
    predictor
        Predicts the stances; its map, if any, keeps robots off walls.
    course
        Way of the middle of the observers.
    observers, mover
        Names of the robots that leap, the reference among them, and of the one that drives before their cameras.
    seconds
        Seconds of images of the whole mission; with `timed` of the mission, leaps included.
    objective, depth
        What decides, and the number of stances that are looked ahead.
    gait
        Formation by which the rest of the mission is expected to go; the best one by default.
    rng
        Random numbers of the objective "random".
    timed
        True to count the time of leaps, too.

    Raises
    ------
    InputError
        If the goal is in a wall, or the cameras share no view in any formation.
    """

    def __init__(
        self,
        predictor: Predictor,
        course: Course,
        observers: Sequence[str],
        mover: str,
        seconds: float,
        *,
        objective: Objective = "goal",
        depth: int = DEPTH,
        gait: Gait | None = None,
        rng: np.random.Generator | None = None,
        timed: bool = False,
    ) -> None:
        self.predictor, self.course, self.mover, self.timed = predictor, course, mover, timed
        self.observers, self.seconds, self.objective, self.depth = tuple(observers), seconds, objective, depth
        self._rng = np.random.default_rng(0) if rng is None else rng
        self._roomy = not predictor.anew
        if predictor.floor_map is not None:
            for n, (x, y) in enumerate(course.points):
                if not predictor.floor_map.clear(np.array([x, y]), 0.2):
                    what = "the goal" if n else "the start"
                    raise InputError(f"{what} at {x:.2f}, {y:.2f} is in a wall or beyond the map: give another one")
        first, *others = combinations(self.observers, 2)
        rollout = Rollout(predictor, course, first, mover, seconds, gait, timed=timed)
        self.gait = rollout.gait
        self._rollouts = {frozenset(first): rollout}
        for pair in others:
            one = Rollout(predictor, course, pair, mover, seconds, self.gait, timed=timed)
            self._rollouts[frozenset(pair)] = one

    def mission(self, belief: Belief) -> Mission:
        """Plan the whole mission of a team from where it stands: stance by stance, then all of them refined.

        Raises
        ------
        InputError
            If the team cannot come to the goal.
        """
        try:
            draft = self.draft(belief)
        except InputError:  # nearer to each other, which refining mends where it can
            self._roomy = False
            draft = self.draft(belief)
        return self.refined(draft) if self.objective == "goal" else draft

    def draft(self, belief: Belief) -> Mission:
        """Plan a mission stance by stance, each as `next` does, as if all went as planned.

        Raises
        ------
        InputError
            If the team cannot come to the goal.
        """
        stances: list[PlannedStance] = []
        promises: list[Promise] = []
        times: list[float] = []
        reasons: list[str] = []
        start = belief
        left, decision = self.seconds, self.first(belief)
        while True:
            before, stance = belief.poses, decision.stance
            times.append(
                max(
                    (self.predictor.leap_time(before[one], stance.standing[one]) for one in stance.leapers),
                    default=0.0,
                )
                if stances
                else 0.0
            )
            stances.append(stance)
            promises.append(decision.promise)
            reasons.append(decision.reason)
            belief, left = decision.promise.belief, left - stance.duration - self.timed * times[-1]
            if self.arrived(stance.standing):
                return Mission(Plan(tuple(stances)), tuple(promises), tuple(times), start, tuple(reasons))
            self.require_progress([one.standing for one in stances])
            if len(stances) > MAX_STANCES:
                raise InputError(f"the goal is not reached in {MAX_STANCES} stances: give a nearer one, or more goals")
            decision = self.next(belief, left)

    def refined(self, mission: Mission) -> Mission:
        """Return a mission with stops, waypoints and durations moved to a lower variance at its end."""
        start, one = mission.start, Refinement(self.predictor, self.observers, self.mover, self.arrived, self.timed)
        seconds = min(mission.duration if self.timed else mission.capture_time, self.seconds)
        stances, _ = one.refined(start, mission.plan.stances, seconds)
        plan = Plan(tuple(stances))
        promises = tuple(self.predictor.of_plan(start, plan))
        return Mission(plan, promises, one.leap_times(start.poses, stances), start, tuple(one.reasons(start, stances)))

    def starts(self) -> dict[str, Planar]:
        """Return poses from which the observers can begin, their middle at the origin: two and two abreast."""
        rows = [k // 2 * max(ROW, self.gait.leap) for k in range(len(self.observers))]
        poses = {}
        for k, (name, row) in enumerate(zip(self.observers, rows, strict=True)):
            _, y, yaw = self.gait.stop(k % 2)
            poses[name] = float(np.mean(rows)) - row, y, yaw - self.predictor.camera_yaw(name)
        return poses

    def remaining(self, standing: Mapping[str, Planar]) -> float:
        """Return the way that is left from the middle of the observers to the goal [m].

        One that is beyond it makes up for another by half a leap at most.
        """
        last = self.course.length + 0.5 * self.gait.leap
        ways = [min(self.course.way_of(standing[name]), last) for name in self.observers]
        return self.course.length - float(np.mean(ways))

    def arrived(self, standing: Mapping[str, Planar]) -> bool:
        """Return whether the middle of the observers has reached the goal."""
        return self.remaining(standing) < ARRIVED

    def first(self, belief: Belief) -> Decision:
        """Plan the first stance, in which all stand where they are.

        Raises
        ------
        InputError
            If the observers have no common view there.
        """
        standing = {name: belief.poses[name] for name in self.observers}
        each = self._rollout_of(belief.poses).stance_seconds(self.seconds)
        seconds = min(max(each, MIN_STANCE_DURATION), MAX_STANCE_DURATION, max(self.seconds, 1.0))
        stance, promise = stance_there(self.predictor, belief, standing, (), self.mover, seconds, self.goal)
        return Decision(stance, promise, (), reason="the first stance is where the team stands")

    def next(
        self,
        belief: Belief,
        seconds: float,
        avoid: Sequence[Planar] = (),
        leaper: str | None = None,
        moved: Sequence[str] = (),
    ) -> Decision:
        """Plan the next stance of a team that stands where `belief` has it.

        Parameters
        ----------
        belief
            The team after the stance before.
        seconds
            Seconds that are left.
        avoid
            Targets at which this stance failed.
        leaper
            The observer that has to leap; None to choose it.
        moved
            Observers that are no anchors of the next stance, whether they leap or not.

        Raises
        ------
        InputError
            If no observer can leap anywhere from where it shares a view with the others, not even after another makes
            way.
        """
        problem: InputError | None = None
        given = belief, seconds, avoid, leaper
        plans: Iterator[list[Node]] = (nodes for _ in self.predictor.ever_nearer() for nodes in self._ahead(*given))
        plans = chain(plans, () if self._roomy else self._otherwise(*given))
        if self.predictor.anew:  # those that only change places come last
            expand = partial(self._expand, avoid=(), in_lane=False)
            plans = chain(leading_on(plans, belief, self.course, self.arrived, expand), self._ahead(*given))
        for nodes in plans:
            if self.objective != "goal":
                stance, promise = self._planned(belief, nodes[0].choices[0], moved)
                return Decision(stance, promise, nodes[0].choices)
            try:
                return self._decided(belief, seconds, nodes, moved)
            except InputError as error:
                problem = error
        why = in_the_way(belief, self.course, self.gait, self.observers, self.predictor)
        if problem is not None and why == NARROW:
            raise problem
        raise stuck(self._stuck_at(belief.poses), why) from problem

    def _decided(self, belief: Belief, seconds: float, nodes: Sequence[Node], moved: Sequence[str] = ()) -> Decision:
        """Choose among plans, the best first.

        Raises
        ------
        InputError
            If the mover cannot drive in the first stance of any.
        """
        variance, node, stance, promise = self._finalist(belief, seconds, nodes, moved)
        leaper, target, duration = node.choices[0]
        reason = self.predictor.narrow + self._rollout_of(promise.belief.poses, leaper).reason(
            promise.belief, leaper, seconds - self._spent(duration, belief, leaper, target)
        )
        if node.aside:
            reason += f"; {leaper} makes way for {node.choices[1][0]}"
        elif not node.by_gait:
            reason += "; this leap promises less than the gait's own"
        return Decision(stance, promise, node.choices, math.sqrt(variance), reason)

    def _ahead(
        self, belief: Belief, seconds: float, avoid: Sequence[Planar], leaper: str | None
    ) -> Iterator[list[Node]]:
        """Yield plans of the next stances along the course, the best first; then those of the next stance alone."""
        standing = {name: belief.poses[name] for name in self.observers}
        many = beam_width(self.course, tuple(standing.values()))
        beam, first = [Node(belief, standing, seconds, 0.0)], list[Node]()
        for depth in range(self.depth):
            grown = [
                child
                for node in beam
                for child in self._expand(
                    node, () if depth else avoid, in_lane=depth > 0, leaper=None if depth else leaper
                )
            ]
            if not grown:
                break
            grown.sort(key=lambda node: node.score)
            first = first or grown
            beam = different(grown, many)
            if self.objective != "goal" or self.arrived(beam[0].standing):
                break
        if first:
            yield beam
            yield different(first, CORNER_BEAM)

    def _otherwise(
        self, belief: Belief, seconds: float, avoid: Sequence[Planar], leaper: str | None
    ) -> Iterator[list[Node]]:
        """Yield plans for where no leap along the course is possible, the best first of each kind.

        A robot makes way, and one leaps on after that; or a robot comes beside another to look where that one looks.
        """
        node = Node(belief, {name: belief.poses[name] for name in self.observers}, seconds, 0.0)

        def grown(kind: Callable[..., Leaps]) -> list[Node]:
            given = self.course, self.gait, self.observers, self.predictor, avoid
            names = self.observers if leaper is None else (leaper,)
            found = [one for name in names for one in self._grown(node, kind(belief, name, *given))]
            return sorted(found, key=lambda one: one.score)

        steps = [replace(one, aside=True) for one in different(grown(steps_aside), CORNER_BEAM)]
        after = [one for step in steps for one in self._expand(step, (), in_lane=False)]
        yield from filter(None, (sorted(after, key=lambda one: one.score), grown(leaps_beside)))

    def require_progress(self, before: Sequence[Mapping[str, Planar]]) -> tuple[Planar, ...]:
        """Require that of the stances before, each with where the observers stood, one of the last brought them on.

        Return where they stood in the last ones if these did not: to be avoided in the next.

        Raises
        ------
        InputError
            If robots only change their places: none can pass another.
        """
        return require_progress(before, [self.remaining(standing) for standing in before], self.course.length)

    def _stuck_at(self, standing: Mapping[str, Planar]) -> float:
        """Return the way along the course at which a team is [m]."""
        return self.course.length - self.remaining(standing)

    def _planned(
        self, belief: Belief, choice: tuple[str, Planar, float], moved: Sequence[str]
    ) -> tuple[PlannedStance, Promise]:
        """Plan the mover's drive of a stance after a leap."""
        leaper, target, duration = choice
        after = belief.after_leap(leaper, target, self.predictor.wheels)
        others = self.foremost_first(belief.poses, leaper)
        anchors = tuple(name for name in others if name not in moved) or others
        placed = {name: after.poses[name] for name in (*anchors, *(o for o in others if o not in anchors), leaper)}
        leapt = math.dist(belief.poses[leaper][:2], target[:2])
        return best_stance(self.predictor, after, placed, anchors, self.mover, duration, self.goal, leapt)

    def _finalist(
        self, belief: Belief, seconds: float, nodes: Sequence[Node], moved: Sequence[str] = ()
    ) -> tuple[float, Node, PlannedStance, Promise]:
        """Choose among the best first leaps by what their stances promise with planned drives.

        Evenly spread images are not what a drive brings, and the best of many such guesses looks better than it is: a
        leap that is not the gait's own has to promise a variance less by `PREFERRED`.
        """
        found: list[tuple[float, float, Node, PlannedStance, Promise]] = []
        problem: InputError | None = None
        for node in first_leaps(nodes):
            if len(found) >= FINALISTS and not node.by_gait:
                continue
            leaper, target, duration = node.choices[0]
            try:
                stance, promise = self._planned(belief, node.choices[0], moved)
                if self.predictor.anew:  # else it is not known where the mover will be
                    require_way(belief, stance, self.observers, self.predictor)
            except InputError as error:
                problem = error
                continue
            left = seconds - self._spent(duration, belief, leaper, target)
            now = Node(promise.belief, {name: promise.belief.poses[name] for name in self.observers}, left, 0.0)
            ahead = [] if self.arrived(now.standing) else self._expand(now, (), in_lane=True)
            variance = min((one.score for one in ahead), default=self._variance(now, leaper))
            found.append((variance * (1.0 if node.by_gait else PREFERRED), variance, node, stance, promise))
        if not found:
            assert problem is not None
            raise problem
        return min(found, key=lambda each: each[0])[1:]

    def _variance(self, node: Node, front: str) -> float:
        """Variance at the end of the mission of a team whose `front` stands still next [m^2]."""
        rollout = self._rollout_of(node.belief.poses, front)
        used = rollout.rows(node.belief)
        poses = {name: np.array([node.belief.poses[name]]) for name in self.observers}
        P = node.belief.covariance[None][:, used[:, None], used]
        return float(rollout.end_variance(P, poses, front, np.array([node.seconds]))[0])

    def _spent(self, duration: Any, belief: Belief, leaper: str, target: Planar) -> Any:
        """Return the seconds of the budget that a stance of a `duration` (...) [s] costs."""
        return duration + (self.predictor.leap_time(belief.poses[leaper], target) if self.timed else 0.0)

    @property
    def goal(self) -> tuple[float, float]:
        """The last point of the course, x, y [m]."""
        return self.course.at(self.course.length)[:2]

    def foremost_first(self, poses: Mapping[str, Planar], leaper: str) -> tuple[str, ...]:
        """Return the observers but the one that leaps, the foremost first."""
        others = (name for name in self.observers if name != leaper)
        return tuple(sorted(others, key=lambda name: -self.course.way_of(poses[name])))

    def _rollout_of(self, poses: Mapping[str, Planar], leaper: str | None = None) -> Rollout:
        """Return the rest of the mission as the pair in front does it: the one that leaps, and the foremost anchor."""
        by_way = sorted(self.observers, key=lambda name: -self.course.way_of(poses[name]))
        leaper = by_way[0] if leaper is None else leaper
        partner = next(name for name in by_way if name != leaper)
        return self._rollouts[frozenset((leaper, partner))]

    def _expand(self, node: Node, avoid: Sequence[Planar], *, in_lane: bool, leaper: str | None = None) -> list[Node]:
        """Find the possible next stances of a team, each with its score: the least is the best.

        The one furthest behind leaps, or of larger teams one of the two; if it cannot, another. The rest goes by the
        gait;
        `in_lane` restricts them to where the gait goes on exactly.
        """
        by_way = sorted(self.observers, key=lambda name: self.course.way_of(node.standing[name]))
        ways = [self.course.way_of(node.standing[name]) for name in by_way]
        straggles = ways[-1] - ways[0] > STRAGGLE
        by_way = by_way[:1] if in_lane else by_way
        grown: list[Node] = []
        for number, name in enumerate(by_way if leaper is None else (leaper,)):
            # before a straggler is left behind it leaps nearer to others
            nearer = straggles and number and self.predictor.may_come_nearer
            if nearer or (grown and (number > 1 or straggles or len(self.observers) == 2)):
                break
            grown += self._leaps_of(node, name, avoid, in_lane=in_lane)
            if not grown and number == 0:
                grown += self._leaps_of(node, name, avoid, come_up=True)
        return grown

    def _leaps_of(
        self, node: Node, leaper: str, avoid: Sequence[Planar], *, in_lane: bool = False, come_up: bool = False
    ) -> list[Node]:
        leaps = possible_leaps(
            node.belief, leaper, self.course, self.gait, self.observers, self.predictor, avoid,
            in_lane=in_lane, roomy=self._roomy, come_up=come_up,
        )  # fmt: skip
        return self._grown(node, leaps)

    def _grown(self, node: Node, leaps: Leaps) -> list[Node]:
        """Return the next stances of a team after leaps, each with its score."""
        if not len(leaps.targets):
            return []
        observers = (*leaps.anchors, leaps.leaper)
        standing = np.array([[node.standing[name] for name in leaps.anchors]] * len(leaps.targets))
        standing = np.concatenate([standing, leaps.targets[:, None]], axis=1)
        predictor, model = self.predictor, self.predictor.model(observers, self.mover)
        information, count = evenly_seen(model, standing, leaps.margins, predictor.free, by_last=predictor.anew)
        seen = np.flatnonzero(count >= MIN_CELLS)
        if not len(seen):
            return []
        if self.objective in ("view", "random"):
            value = -count[seen] if self.objective == "view" else self._rng.random(len(seen))
            return [
                self._child(node, leaps, int(n), float(self._durations(node, leaps, int(n))[1]), float(v))
                for n, v in zip(seen, value, strict=True)
            ]
        return self._scored(node, leaps, seen, observers, self.predictor.fps * information[seen])

    def _durations(self, node: Node, leaps: Leaps, n: int) -> Array:
        """Durations of a stance that are compared, (3,) [s]."""
        leapt, left = self.timed * float(leaps.times[n]), max(self.remaining(node.standing), ARRIVED)
        return durations(node.seconds, float(leaps.gains[n]), left, leapt, self.gait.leap, last=ARRIVED)

    def _scored(
        self, node: Node, leaps: Leaps, seen: NDArray[np.int64], observers: tuple[str, ...], information: Array
    ) -> list[Node]:
        belief, P = node.belief, leaps.covariances(node.belief, seen)
        each = np.array([self._durations(node, leaps, int(n)) for n in seen])
        rows = belief.rows(observers, self.mover)
        spread = effective_seconds(each, self.predictor.speed)
        after = updated(P[:, None], rows, spread[:, :, None, None] * information[:, None])
        if self.objective == "information":
            value = -np.linalg.slogdet(np.eye(len(rows)) + information @ P[:, rows[:, None], rows])[1]
            return [
                self._child(node, leaps, int(n), float(t[1]), float(v), C[1])
                for n, t, v, C in zip(seen, each, value, after, strict=True)
            ]
        rollout, targets = self._rollout_of(belief.poses, leaps.leaper), leaps.targets[seen]
        used = rollout.rows(belief)
        poses = {name: np.broadcast_to(belief.poses[name], targets.shape) for name in leaps.anchors}
        poses[leaps.leaper] = targets
        value = np.stack([
            rollout.end_variance(
                after[:, k][:, used[:, None], used],
                poses,
                leaps.leaper,
                node.seconds - each[:, k] - self.timed * leaps.times[seen],
            )
            for k in range(len(SHARES))
        ], axis=1)  # fmt: skip
        best = value.argmin(axis=1)
        return [
            self._child(node, leaps, int(n), float(each[k, b]), float(value[k, b]), after[k, b])
            for k, (n, b) in enumerate(zip(seen, best, strict=True))
        ]

    def _child(
        self, node: Node, leaps: Leaps, n: int, seconds: float, score: float, covariance: Array | None = None
    ) -> Node:
        left = node.seconds - seconds - self.timed * float(leaps.times[n])
        x, y, yaw = leaps.targets[n].tolist()
        by_gait = node.by_gait if node.choices else bool(leaps.by_gait[n])
        return node.after(leaps.leaper, (x, y, yaw), seconds, left, score, covariance, by_gait=by_gait)
