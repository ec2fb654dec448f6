"""The scene of a plan: where the robots stand, and what is promised of them; `scene_of_plan`."""

from collections.abc import Sequence

import numpy as np

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.planning.belief import POSE
from coloc_graph.planning.plan import Plan
from coloc_graph.planning.prediction import Promise
from coloc_graph.run import Stance
from coloc_graph.team import Team
from coloc_graph.viewer.plans import PLANNED
from coloc_graph.viewer.scene import Scene, ShownPlan, layer_of
from coloc_graph.viewer.sources import stayed

GAP = 5.0  # time between two stances, in which robots leap [s]


def scene_of_plan(
    team: Team, plan: Plan, promises: Sequence[Promise], notes: Sequence[str] = (), reasons: Sequence[str] = ()
) -> Scene:
    """Make the scene of a plan, with the promised covariances.

    Parameters
    ----------
    team, plan, promises
        The team, its plan, and what each stance promises.
    notes
        Sentences that are shown with it.
    reasons
        One line for each stance on what decided; none without any.
    """
    stances, start = [], 0.0
    for k, one in enumerate(plan.stances):
        stances.append(Stance(k, start, start + one.duration, tuple(one.standing), (one.mover,), one.anchors))
        start += one.duration + GAP
    trajectories = {}
    for name in team.names:
        rows = [k for k, one in enumerate(plan.stances) if name in one.standing or name == one.mover]
        poses, covariances = [], []
        for k in rows:
            one, belief = plan.stances[k], promises[k].belief
            stands = name in one.standing
            (x, y), yaw = one.waypoints[0], 0.0
            if stands:
                x, y, yaw = one.standing[name]
            poses.append(floor_pose(x, y, yaw))
            at = belief.index(name)
            C = belief.covariance[at : at + POSE, at : at + POSE]
            covariances.append(C if stands else np.full((POSE, POSE), np.nan))
        if rows:
            times = np.array([(stances[k].start + stances[k].end) / 2 for k in rows])
            trajectories[name] = Trajectory(name, times, np.array(poses), np.array(rows), np.array(covariances))
    held = [(name, k) for k, one in enumerate(plan.stances) for name in one.anchors]
    shown = tuple(
        ShownPlan(
            k,
            {name: np.array(pose) for name, pose in one.standing.items()},
            {name: promises[k].belief.planar_covariance(name) for name in one.standing},
            np.array(one.waypoints),
            one.leapers[0] if k and one.leapers else None,
            reasons[k] if k < len(reasons) else f"{promises[k].points:.0f} points in {one.duration:.1f} s",
        )
        for k, one in enumerate(plan.stances)
    )
    return Scene(
        robots=team.names,
        stances=tuple(stances),
        layers=(layer_of(PLANNED, team.names, stances, trajectories),),
        stayed=stayed(team.names, stances, held),
        team=team,
        title="a plan",
        notes=tuple(notes),
        plans=shown,
    )
