"""Robots that moved between stances: inferred where nothing states it, and what their wheels say of a bump."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coloc_graph.backend import Bump
from coloc_graph.frontend import PairMeasurement, WheelTrack
from coloc_graph.geometry.lie import se3_inverse, se3_log
from coloc_graph.measurements import RelativePose
from coloc_graph.run import Recorded, Run, Stance

MOVED_SIGMAS = 8.0  # observers whose relative pose changed by more sigmas moved against each other
MIN_WAY = 0.01  # shortest way by wheels of a robot that moved [m]
MIN_TURN = 0.02  # smallest turn by wheels of a robot that moved [rad]
REMEDY = "list who moved in a CSV for `coloc import tracks --moves`, or record motion events or wheel odometry"


@dataclass(frozen=True)
class InferredMoves:
    """Stances with the anchors that stayed put by what the cameras measured.

    `moved` lists robots and the stance before which they moved; `unknown` lists pairs of which one or both moved.
    """

    stances: tuple[Stance, ...]
    moved: tuple[tuple[str, int], ...]
    unknown: tuple[tuple[str, str, int], ...]

    def applied(self, run: Any) -> Any:
        """Return the run with these stances."""
        return _WithStances(run, self.stances)

    def sentence(self) -> str:
        """Description of what was inferred, and what to give."""
        said = [f"{robot} moved before stance {stance}" for robot, stance in self.moved]
        unknown: dict[tuple[str, str], list[str]] = {}
        for i, j, stance in self.unknown:
            unknown.setdefault((i, j), []).append(str(stance))
        said += [
            f"{i} or {j} moved before stance {', '.join(stances)} (not known which, so that neither is an anchor)"
            for (i, j), stances in unknown.items()
        ]
        return (
            "nothing in the run states who moved between stances; by what the cameras measured, "
            f"{'; '.join(said)}: {REMEDY}"
        )


class _WithStances:
    """A run with other anchors; all else is as it is recorded."""

    def __init__(self, run: Any, stances: tuple[Stance, ...]) -> None:
        self._run, self.stances = run, stances

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)


def moves_unstated(run: Run) -> bool:
    """Return whether nothing in a run of several stances states which robots moved between them."""
    kinds = {topic.rpartition("/")[2] for topic, count in run.topics.items() if count}
    return len(run.stances) > 1 and bool(kinds) and not kinds & {"motion", "odometry"}


def infer_moves(stances: Sequence[Stance], measured: Sequence[PairMeasurement]) -> InferredMoves | None:
    """Infer who moved between stances; None where all anchors stayed put.

    Those whose relative poses did not change stayed, if they are more than any others; of two observers that moved
    against each other neither is an anchor.
    """
    poses: dict[int, list[RelativePose]] = {}
    for one in measured:
        if one.relative_pose is not None:
            poses.setdefault(one.homography.stance, []).append(one.relative_pose)
    last: dict[tuple[str, str], RelativePose] = {}
    made, moved, unknown = list[Stance](), list[tuple[str, int]](), list[tuple[str, str, int]]()
    for stance in stances:
        now = {_pair(one): one for one in poses.get(stance.index, [])}
        both = {pair for pair in now.keys() & last.keys() if set(pair) <= set(stance.anchors)}
        changed = {pair for pair in both if _moved(last[pair], now[pair])}
        doubted = {robot for pair in changed for robot in pair}
        stayed = _largest_group(both - changed) if changed else set()
        gone = doubted - stayed
        if stayed:
            moved += [(robot, stance.index) for robot in sorted(gone)]
        else:
            unknown += [(*pair, stance.index) for pair in sorted(changed)]
        made.append(replace(stance, anchors=tuple(robot for robot in stance.anchors if robot not in gone)))
        last = {pair: one for pair, one in last.items() if not gone & set(pair) and not set(pair) & set(stance.movers)}
        last |= now
    return InferredMoves(tuple(made), tuple(moved), tuple(unknown)) if moved or unknown else None


def _pair(one: RelativePose) -> tuple[str, str]:
    return min(one.robot_i, one.robot_j), max(one.robot_i, one.robot_j)


def _moved(before: RelativePose, now: RelativePose) -> bool:
    """Return whether two robots moved against each other between two of their relative poses."""
    was = before.T_i_j if before.robot_i == now.robot_i else se3_inverse(before.T_i_j)
    off = se3_log(se3_inverse(was) @ now.T_i_j)
    return bool(np.abs(off / np.sqrt(np.diag(now.covariance + before.covariance))).max() > MOVED_SIGMAS)


def _largest_group(unchanged: set[tuple[str, str]]) -> set[str]:
    """The most robots that did not move against each other; none where two groups have as many."""
    groups: list[set[str]] = []
    for pair in sorted(unchanged):
        joined = set(pair)
        for group in [one for one in groups if one & joined]:
            groups.remove(group)
            joined |= group
        groups.append(joined)
    groups.sort(key=len, reverse=True)
    return groups[0] if groups and (len(groups) == 1 or len(groups[0]) > len(groups[1])) else set()


def described_bumps(run: Recorded, stances: Mapping[int, Stance], bumps: Sequence[Bump]) -> Iterator[str]:
    """Describe bumped anchors, with what their wheels say of it."""
    for bump in bumps:
        yield str(bump) + _by_wheels(run, stances, bump)


def _by_wheels(run: Recorded, stances: Mapping[int, Stance], bump: Bump) -> str:
    """Movement of a bumped anchor by its wheels in the time between the two stances; empty where they say nothing."""
    stay = bump.stay_put
    wheels = WheelTrack(stay.robot, list(run.odometry(stay.robot)))
    if len(wheels) < 2:
        return ""
    begin, end = stances[stay.before].end, stances[stay.after].start
    between = wheels.times[(wheels.times > begin) & (wheels.times < end)]
    x, y, yaw = wheels.pose_at(np.concatenate([[begin], between, [end]])).T
    way, turned = float(np.hypot(np.ptp(x), np.ptp(y))), float(np.rad2deg(np.ptp(yaw)))
    if way > MIN_WAY or np.deg2rad(turned) > MIN_TURN:
        return (
            f"; by its wheels it drove {100 * way:.0f} cm and turned by {turned:.0f} deg then: who stayed put is "
            "stated wrongly"
        )
    if not np.ptp(wheels.pose_at(wheels.times), axis=0).any():
        return "; its odometry never changes: if it drove, check its wheel driver"
    return "; its wheels did not turn then"
