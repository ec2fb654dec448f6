"""Roles of a team's robots in a plan: observers and a mover; `roles_of`, `best_roles`."""

from itertools import combinations

from coloc_graph.errors import InputError
from coloc_graph.planning.formation import Gait
from coloc_graph.planning.gaits import GaitSearch
from coloc_graph.planning.prediction import Predictor
from coloc_graph.team import Team

GAITS = (Gait(0.9, 0.5, 25.0), Gait(0.6, 0.6, 10.0), Gait(0.8, 0.6, 0.0))  # by which movers are compared
MAX_OBSERVERS = 5  # of a plan
WAY = 5.0  # length of the way by which movers are compared [m]


def roles_of(team: Team, mover: str | None = None) -> tuple[tuple[str, ...], str, tuple[str, ...]]:
    """Return the observers, the reference first, the mover, and the robots that have no role.

    Parameters
    ----------
    team
        The robots.
    mover
        Name of the mover; the last robot with markers by default.

    Raises
    ------
    InputError
        If there is no such robot, it has fewer than two markers, fewer than two others carry a camera, or too many do.
    """
    marked = _marked(team)
    if mover is not None and mover not in team.names:
        raise InputError(f"there is no robot {mover} in the team: name one of {', '.join(team.names)}")
    if not marked or (mover is not None and mover not in marked):
        if mover is None:
            raise InputError("no robot carries two markers: give the mover two")
        raise InputError(f"the mover {mover} carries fewer than two markers: give it two, or name another with --mover")
    mover = mover or marked[-1]
    cameras = [robot.name for robot in team.robots if robot.camera_if_any is not None and robot.name != mover]
    cameras.sort(key=lambda name: name != team.reference)
    if len(cameras) < 2 or cameras[0] != team.reference:
        raise InputError(
            f"a plan needs two robots with cameras besides the mover {mover}, and the reference {team.reference} "
            "among them: add a robot, or name another --mover"
        )
    observers = tuple(cameras[:MAX_OBSERVERS])
    return observers, mover, tuple(name for name in team.names if name not in (*observers, mover))


def best_roles(predictor: Predictor) -> tuple[tuple[str, ...], str, tuple[str, ...]]:
    """Return the roles as `roles_of` does, with the mover of which the others promise most; of equals the last one.

    Raises
    ------
    InputError
        If no robot can be the mover, or the cameras share no view of any.
    """
    team, found, problem = predictor.team, [], None
    for number, mover in enumerate(reversed(_marked(team))):
        try:
            roles = roles_of(team, mover)
            # the pair that sees it best
            sigma = min(_sigma(predictor, pair, mover) for pair in combinations(roles[0], 2))
        except InputError as error:
            problem = problem or error
            continue
        found.append((round(sigma, 6), number, roles))
    if not found:
        raise problem or InputError("no robot carries two markers: give the mover two")
    return min(found, key=lambda each: each[:2])[2]


def _sigma(predictor: Predictor, pair: tuple[str, str], mover: str) -> float:
    search = GaitSearch(predictor, WAY, pair, mover, GAITS)
    (best, seconds), *_ = search.ranked(capture=50.0)
    return search.end_sigma(best, seconds)


def _marked(team: Team) -> list[str]:
    return [robot.name for robot in team.robots if robot.markers is not None and len(robot.markers.positions) > 1]
