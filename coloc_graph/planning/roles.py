"""Roles of a team's robots in a plan: two observers and a mover; `pair_of`."""

from coloc_graph.errors import InputError
from coloc_graph.team import Team


def pair_of(team: Team, mover: str | None = None) -> tuple[tuple[str, str], str, tuple[str, ...]]:
    """Return the two observers, the reference first, the mover, and the robots that have no role.

    Parameters
    ----------
    team
        The robots.
    mover
        Name of the mover; the last robot with markers by default.

    Raises
    ------
    InputError
        If there is no such robot, it has fewer than two markers, or fewer than two others carry a camera.
    """
    marked = [robot.name for robot in team.robots if robot.markers is not None and len(robot.markers.positions) > 1]
    if mover is not None and mover not in team.names:
        raise InputError(f"there is no robot {mover} in the team: name one of {', '.join(team.names)}")
    if not marked or (mover is not None and mover not in marked):
        raise InputError(f"{mover or 'no robot'} carries two markers to be watched by: give the mover two")
    mover = mover or marked[-1]
    cameras = [robot.name for robot in team.robots if robot.camera_if_any is not None and robot.name != mover]
    cameras.sort(key=lambda name: name != team.reference)
    if len(cameras) < 2 or cameras[0] != team.reference:
        raise InputError(
            f"a plan needs two robots with cameras besides the mover {mover}, and the reference {team.reference} "
            "among them: add a robot, or name another --mover"
        )
    left = tuple(name for name in team.names if name not in (*cameras[:2], mover))
    return (cameras[0], cameras[1]), mover, left
