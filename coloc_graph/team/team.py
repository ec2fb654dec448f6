"""Description of a team: `Robot`, `Floor` and `Team`."""

from collections.abc import Iterable

import msgspec

from coloc_graph.errors import TeamError
from coloc_graph.team.blink import Blink, require_distinguishable
from coloc_graph.team.body import Devices, Markers, Mount, Slip
from coloc_graph.team.camera import Camera
from coloc_graph.team.checks import require_finite, require_not_negative
from coloc_graph.team.landmark import Landmark, require_name
from coloc_graph.team.sensors import Ranging, Wheels
from coloc_graph.team.tracking import Tracking


class Robot(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A robot: its sensors, their extrinsics, and its markers.

    Parameters
    ----------
    name : str
        Its name.
    camera_if_any, mount_if_any : Camera and Mount, or None
        `camera` and `mount` in team.toml; both or neither. `camera` and `mount` raise where there is none.
    markers : Markers or None
        Markers that others see; None on a robot that is never watched.
    blink : Blink or None
        Blink code of the markers; None: they are always on.
    slip : Slip or None
        Tolerance of its pose as an anchor; None: it stays put exactly.
    devices : Devices or None
        Devices of its own program.
    ranging : Ranging or None
        Range and bearing sensor.
    wheels : Wheels or None
        Calibration of its wheel odometry.
    """

    name: str
    camera_if_any: Camera | None = msgspec.field(default=None, name="camera")
    mount_if_any: Mount | None = msgspec.field(default=None, name="mount")
    markers: Markers | None = None
    blink: Blink | None = None
    slip: Slip | None = None
    devices: Devices | None = None
    ranging: Ranging | None = None
    wheels: Wheels | None = None

    def __post_init__(self) -> None:
        require_name(self.name)
        if (self.camera_if_any is None) != (self.mount_if_any is None):
            there, missing = ("camera", "mount") if self.mount_if_any is None else ("mount", "camera")
            raise ValueError(f"robot {self.name} has a `{there}` but no `{missing}`; give both, or neither")
        if self.camera_if_any is None and self.ranging is None and self.markers is None:
            raise ValueError(
                f"robot {self.name} has no `camera` with its `mount`, no `ranging`, and no `markers` to be watched by; "
                "give it one of them"
            )
        if self.blink is not None and self.markers is None:
            raise ValueError(f"robot {self.name} has a `blink` but no markers; give it [robots.markers], or no `blink`")

    @property
    def camera(self) -> Camera:
        """The camera; `TeamError` where the robot has none."""
        if self.camera_if_any is None:
            raise TeamError(f"robot {self.name} has no camera in the team; give it one under [robots.camera]")
        return self.camera_if_any

    @property
    def mount(self) -> Mount:
        """Extrinsics of the camera; `TeamError` if the robot has none."""
        if self.mount_if_any is None:
            raise TeamError(f"robot {self.name} has no camera in the team; give it one under [robots.camera]")
        return self.mount_if_any


class Floor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Floor that the team stands on.

    Parameters
    ----------
    tilt_sigma_deg : float
        Standard deviation of its roll and pitch from level, wherever a robot stands [deg].
    height_sigma : float
        Standard deviation of its height from flat [m].
    """

    tilt_sigma_deg: float = 0.0
    height_sigma: float = 0.0

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("tilt_sigma_deg", "height_sigma"))


class Team(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A team of robots.

    Parameters
    ----------
    reference : str
        Robot whose body at stance 0 is the world frame.
    robots : tuple of Robot
        The robots: one is enough to calibrate, two and more to solve.
    floor : Floor or None
        Floor that they stand on; None: no common one.
    clock_sigma : float
        Standard deviation of the offset between the clocks of any two robots [s]; 0: they agree, and no offset is
        estimated.
    landmarks : tuple of Landmark
        Landmarks, by which robots recognise places.
    tracking : Tracking or None
        Options of the tracking of markers; None: as usual.
    """

    reference: str
    robots: tuple[Robot, ...]
    floor: Floor | None = None
    clock_sigma: float = 0.0
    landmarks: tuple[Landmark, ...] = ()
    tracking: Tracking | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        require_not_negative(self, ("clock_sigma",))
        names = [robot.name for robot in self.robots]
        everything = [*names, *(landmark.name for landmark in self.landmarks)]
        twice = sorted({name for name in everything if everything.count(name) > 1})
        if twice:
            what = "robots" if names.count(twice[0]) > 1 else "robots or landmarks"
            raise ValueError(f"two {what} are called `{twice[0]}`; give each a name of its own")
        require_distinguishable(
            [(one.name, one.markers.hue_deg, one.blink) for one in self.robots if one.blink and one.markers],
            [(one.name, one.camera_if_any.fps) for one in self.robots if one.camera_if_any],
        )
        tags: dict[tuple[str, int], str] = {}
        for landmark in self.landmarks:
            if landmark.tag is not None:
                other = tags.setdefault((landmark.tag.family, landmark.tag.id), landmark.name)
                if other != landmark.name:
                    raise ValueError(
                        f"landmarks {other} and {landmark.name} have the same tag {landmark.tag.id}; "
                        "give each a number of its own"
                    )
        if not names:
            raise ValueError("a team has at least one robot; add one under [[robots]]")
        if self.reference not in names:
            raise ValueError(f"`reference` is `{self.reference}`, which is not one of the robots {', '.join(names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """The robots' names, in the team's order."""
        return tuple(robot.name for robot in self.robots)

    def __getitem__(self, name: str) -> Robot:
        for robot in self.robots:
            if robot.name == name:
                return robot
        raise TeamError(f"robot `{name}` is not in the team ({', '.join(self.names)}); add it under [[robots]]")

    def marker_height(self, movers: Iterable[str] = ()) -> float | None:
        """Return the height of the marker plane of `movers` (of all robots where none is named) [m]; None if mixed."""
        wanted = tuple(movers) or self.names
        heights = {robot.markers.height for robot in self.robots if robot.markers and robot.name in wanted}
        return heights.pop() if len(heights) == 1 else None
