"""Options of a solve: `SolveOptions`."""

import math
from dataclasses import dataclass, replace
from typing import get_args

from coloc_graph.backend import Method, with_height_sigma
from coloc_graph.errors import InputError
from coloc_graph.frontend import FrontendOptions
from coloc_graph.team import Robot, Team

METHODS: tuple[Method, ...] = get_args(Method)

UNKNOWN_HEIGHT_SIGMA = 0.1  # m: sigma of camera heights where the scale comes from the markers' span alone


@dataclass(frozen=True)
class SolveOptions:
    """Options of a solve: all that a result depends on besides the run.

    Parameters
    ----------
    method : {"joint", "smooth", "chain"}, optional
        Of a run with stances. `chain` is the paper: homographies by least squares in one image, eq. (2), composition.
        `smooth` takes maximum-likelihood homographies and relative poses into a pose graph, with odometry and
        sightings of the movers. `joint` (the default) takes the homographies themselves, and calibrates mounts,
        markers and clocks along with the poses.
    frontend : FrontendOptions, optional
        Of a run with stances: measurement of images. The default depends on the method.
    odometry : bool
        Use wheel odometry. A run with ranges alone needs it.
    incremental : bool
        Estimate in the order of time, as a team in the field would.
    between_robots : bool
        Of a run with ranges: use ranges between robots too, not only those to landmarks.
    lag : float, optional
        Of an incremental estimate: number of last stances, or seconds of a ranging run, whose poses stay variables; so
        an update costs as much in a run of any length. The default is 50 stances, or 40 s.
    """

    method: Method | None = None
    frontend: FrontendOptions | None = None
    odometry: bool = True
    incremental: bool = False
    between_robots: bool = True
    lag: float | None = None

    def __post_init__(self) -> None:
        if self.method is not None and self.method not in METHODS:
            raise InputError(f"there is no method `{self.method}`: choose one of {', '.join(METHODS)}")
        if self.incremental and self.method == "chain":
            raise InputError("method `chain` cannot be incremental: leave out `incremental`, or use `joint`")
        if self.lag is not None and not self.incremental:
            raise InputError("a lag applies to incremental estimates only: give `incremental` too, or leave it out")
        if self.lag is not None and not 1 <= self.lag < math.inf:
            raise InputError(f"a lag of {self.lag:g} leaves no pose to estimate: give 1 (stance or second) or more")

    def resolved(self) -> "SolveOptions":
        """Return the options of a run with stances, with the default method and front end where none is chosen."""
        method = self.method or "joint"
        paper = FrontendOptions(criterion="transfer", pose="eq2")
        return replace(
            self, method=method, frontend=self.frontend or (paper if method == "chain" else FrontendOptions())
        )

    @property
    def by_span(self) -> bool:
        """Return whether the scale comes from the markers' span alone."""
        return self.frontend is not None and self.frontend.scale == "span"

    def robot_models(self, team: Team) -> dict[str, Robot]:
        """Return the robots that a joint estimate calibrates; none of another method."""
        if self.method != "joint":
            return {}
        robot_models = {robot.name: robot for robot in team.robots}
        return with_height_sigma(robot_models, UNKNOWN_HEIGHT_SIGMA) if self.by_span else robot_models
