"""Graphs of simulated teams, for the tests of the back end."""

import numpy as np

from coloc_graph.backend import Estimator, PoseGraph
from coloc_graph.geometry.lie import se3_inverse, so3_log
from coloc_graph.simulation.measured import MeasuredTeam, measured_team
from coloc_graph.team import Floor

#: A floor that is as uneven as a good one is.
FLOOR = Floor(tilt_sigma_deg=0.1)


def team_of(robots: int, stances: int, seed: int = 0, **options) -> MeasuredTeam:
    return measured_team(robots, stances, np.random.default_rng(seed), **({"floor": FLOOR} | options))


def graph_of_team(team: MeasuredTeam, measurements=None) -> PoseGraph:
    made = team.measurements if measurements is None else tuple(measurements)
    return PoseGraph(team.robots[0], team.robots, team.stances, made, team.floor)


def fed(team: MeasuredTeam, measurements=None) -> Estimator:
    """An estimator that was given everything, stance by stance."""
    estimator = Estimator(team.robots[0], team.robots, team.floor)
    for stance in team.stances:
        estimator.add(stance, of_stance(team if measurements is None else measurements, stance.index))
    return estimator


def of_stance(team, index: int) -> list:
    """What comes in with a stance."""
    made = team.measurements if isinstance(team, MeasuredTeam) else team
    return [one for one in made if max(stance for _, stance in one.ends) == index]


def ate(estimate, team: MeasuredTeam) -> float:
    """RMS position error over all nodes [m]."""
    off = [estimate.pose(*node).translation() - T[:3, 3] for node, T in team.T_world_body.items()]
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))


def planar_nees(estimate, team: MeasuredTeam, node) -> float:
    """NEES of heading, x, y of one pose, with 3 degrees of freedom."""
    T = se3_inverse(estimate.pose(*node).matrix()) @ team.T_world_body[node]
    xi = np.concatenate([so3_log(T[:3, :3])[2:], T[:2, 3]])
    return float(xi @ np.linalg.solve(estimate.covariance(*node)[2:5, 2:5], xi))


def largest_difference(a, b, nodes) -> float:
    """Largest difference of any pose's matrix entries (m, rad)."""
    return max(float(np.abs(a.pose(*node).matrix() - b.pose(*node).matrix()).max()) for node in nodes)
