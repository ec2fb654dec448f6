"""Turn of an observer that leapt astray, as another one sees it, towards the mover's drive; `turn_to_drive`."""

import math
from dataclasses import dataclass

import numpy as np

from coloc_graph.geometry.se2 import Planar, wrap
from coloc_graph.online.leap_planner import StancePlan
from coloc_graph.online.visibility import InView
from coloc_graph.team import Team

MIN_TURN = math.radians(3.0)  # an observer turns by no less than this [rad]


@dataclass(frozen=True)
class TurnToDrive:
    """A turn of an observer that leapt astray.

    Attributes
    ----------
    robot
        Name of the observer.
    place
        Its pose in the world (x [m], y [m], yaw [rad]).
    yaw
        Heading at which it has the drive where it was planned in its view [rad].
    far, turned
        Distance of its pose from the target of its leap [m], and difference of the headings [rad].
    """

    robot: str
    place: Planar
    yaw: float
    far: float
    turned: float

    def __str__(self) -> str:
        astray = f"{100 * self.far:.0f} cm and {math.degrees(self.turned):.0f} deg astray"
        return f"{self.robot}, which leapt {astray}, turns to the drive"


def turn_to_drive(team: Team, view: InView, plan: StancePlan | None, mover: Planar) -> TurnToDrive | None:
    """Find out whether an observer that leapt looks past the drive.

    Its wheels are some degrees off after a leap, and what it does not see cannot correct them; another observer, which
    stands where the stance before has it, sees both it and the mover.

    Parameters
    ----------
    team, view
        The team, and the newest images of its observers.
    plan
        Plan of the stance.
    mover
        Tracked pose of the mover.

    Returns
    -------
    TurnToDrive or None
        None if it has the drive in view, or no other sees where it stands.
    """
    markers = None if plan is None or plan.leap is None else team[plan.leap[0]].markers
    if plan is None or plan.leap is None or markers is None:
        return None
    leaper, (x, y, yaw) = plan.leap
    place = view.locate(leaper, markers.p_body, mover)
    if place is None or view.covers(leaper, place, plan.patrol):
        return None
    planned, found = (np.arctan2(*(plan.patrol.mean(axis=0) - at)[::-1]) for at in ((x, y), place[:2]))
    to = yaw + float(found - planned)
    if abs(wrap(to - place[2])) < MIN_TURN:
        return None
    return TurnToDrive(leaper, place, to, math.dist(place[:2], (x, y)), abs(wrap(place[2] - yaw)))
