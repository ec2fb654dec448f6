"""`Landmark`: what does not move, by which robots know where they are again."""

import math
import re

import msgspec

from coloc_graph.team.body import Markers
from coloc_graph.team.checks import require_finite, require_not_negative


class Tag(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An upright AprilTag: its number, the side of its black square [m], and how high its centre is [m].

    `family` is one of OpenCV's: 16h5, 25h9, 36h10, 36h11.
    """

    id: int
    size: float
    height: float
    family: str = "36h11"

    def __post_init__(self) -> None:
        require_finite(self)
        if self.size <= 0:
            raise ValueError(f"`size` is {self.size}; give a number above 0")
        if self.family not in ("16h5", "25h9", "36h10", "36h11"):
            raise ValueError(f"`family` is `{self.family}`; give 16h5, 25h9, 36h10 or 36h11")


class Landmark(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What does not move: `markers` on a body of its own, a `tag`, or a bare point for sensors of range and bearing.

    `position` (x, y) [m] and `yaw_deg` are on a map of all landmarks, known to `position_sigma` [m] and
    `yaw_sigma_deg`; where they are left out, they are found along with the robots' poses.
    """

    name: str
    markers: Markers | None = None
    tag: Tag | None = None
    position: tuple[float, float] | None = None
    yaw_deg: float | None = None
    position_sigma: float = 0.0
    yaw_sigma_deg: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("position_sigma", "yaw_sigma_deg"))
        require_name(self.name)
        if self.position is not None and not all(map(math.isfinite, self.position)):
            raise ValueError("`position` holds a number that is not finite")
        if self.markers is not None and self.tag is not None:
            raise ValueError(f"landmark {self.name} has markers and a tag; make two landmarks of it")


def require_name(name: str) -> None:
    """Raise ValueError for what cannot be a part of a topic or of a marker's name."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name):
        raise ValueError(
            f"the name `{name}` is not usable in a topic; use letters, digits, - and _, beginning with a letter"
        )
