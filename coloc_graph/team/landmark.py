"""Landmarks, which do not move and let robots recognise a place: `Landmark`."""

import math
import re

import msgspec

from coloc_graph.team.body import Markers
from coloc_graph.team.checks import require_finite, require_not_negative

MAX_YAW_SIGMA_DEG = 45.0  # deg, tolerance of a stated yaw; beyond, a linearisation at the yaw is meaningless


class Tag(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An upright AprilTag.

    Parameters
    ----------
    id : int
        Its number.
    size : float
        Side of its black square [m].
    height : float
        Height of its centre [m].
    family : {"16h5", "25h9", "36h10", "36h11"}
        Family, as of OpenCV.
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
    """Landmark: `markers` on a body of its own, a `tag`, or a bare point for range and bearing sensors.

    Parameters
    ----------
    name : str
        Its name.
    markers : Markers or None
        Two markers that cameras see.
    tag : Tag or None
        A tag that cameras see.
    position : (float, float) or None
        x, y on the map [m]; None: estimated. A landmark that cameras see has a yaw as well.
    yaw_deg : float or None
        Yaw on the map; None: estimated.
    position_sigma, yaw_sigma_deg : float
        Tolerances.

    Notes
    -----
    Its frame is a body's: x is the direction it faces (out of a tag), y to its left, z up, on the floor.
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
        if self.markers is not None and len(self.markers.positions) < 2:
            raise ValueError(f"landmark {self.name} has one marker, which does not give its yaw; give it two")
        if self.yaw_deg is not None and self.position is None:
            raise ValueError(f"landmark {self.name} has a `yaw_deg` and no `position`; give both, or neither")
        if self.seen_as is not None and self.position is not None and self.yaw_deg is None:
            raise ValueError(
                f"landmark {self.name} has a `position` and no `yaw_deg`; give its yaw on the map, with a "
                f"`yaw_sigma_deg` of up to {MAX_YAW_SIGMA_DEG:g}, or leave the position out"
            )
        if self.yaw_sigma_deg > MAX_YAW_SIGMA_DEG:
            raise ValueError(
                f"landmark {self.name} has a `yaw_sigma_deg` of {self.yaw_sigma_deg:g}; measure its yaw to "
                f"{MAX_YAW_SIGMA_DEG:g} deg or better, or leave its position out"
            )

    @property
    def seen_as(self) -> Markers | None:
        """Markers that a camera sees: its own, or the middles of its tag's left and right edge; None of a point."""
        if self.tag is None:
            return self.markers
        half = self.tag.size / 2
        return Markers(height=self.tag.height, positions=((0.0, half), (0.0, -half)))

    @property
    def on_map(self) -> bool:
        """True if the team states both its position and its yaw on the map."""
        return self.position is not None and self.yaw_deg is not None


def require_name(name: str) -> None:
    """Raise ValueError for a name that cannot be a part of a topic or of a marker's name."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name):
        raise ValueError(
            f"the name `{name}` cannot be part of a topic; use letters, digits, - and _, beginning with a letter"
        )
