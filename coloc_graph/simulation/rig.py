"""The reference rig, and how far the truth may lie from what is said: `reference_team`, `Imperfections`."""

import math
from dataclasses import dataclass, fields

import numpy as np
from msgspec.structs import replace

from coloc_graph.errors import InputError
from coloc_graph.team import Camera, Floor, Markers, Mount, Ranging, Robot, Team, fisheye

#: A mild lens, OpenCV's (k1, k2, p1, p2): what the images are rendered through.
MILD_LENS = (-0.10, 0.02, 5e-4, -3e-4)

ANTENNA_X = -0.08  # m, place of a UWB antenna on the body: behind the camera
FISHEYE_BIAS_PX = 0.03  # px, shared error of centres in rendered images: spots are small, and dark bodies near them
MIN_ACROSS_DEG = 20.0  # deg, narrowest fisheye that is simulated
MAX_ACROSS_DEG = 220.0  # deg, widest fisheye that is simulated
FISHEYE = (-0.012, 0.003, -0.0012, 0.0001)  # k1 to k4 of the fisheye through which wide images are rendered


@dataclass(frozen=True)
class Imperfections:
    """Standard deviations from which a truth is drawn, and the clocks' faults. Zero by default but the noise.

    `mount_sigma_deg` holds for tilt and for roll of each mount, `mount_yaw_sigma_deg` for its yaw, `floor_sigma_deg`
    for roll and for pitch of a body wherever it stands; heights and spans are in metres. A robot other than the
    reference stamps an instant t with t + `clock_offset` [s]. `time_jitter` [s] moves the true instant of each capture;
    the stamp moves with it. `noise_px` is that of a marker centre per axis (tracks depth only: images bring their own).
    With a `uwb_sigma` [m] robots range each other, by sensors with offsets of `uwb_offset_sigma` [m]; a share
    `uwb_nlos` of the ranges has no line of sight, and is too long.
    """

    mount_sigma_deg: float = 0.0
    mount_yaw_sigma_deg: float = 0.0
    height_sigma: float = 0.0
    span_sigma: float = 0.0
    floor_sigma_deg: float = 0.0
    clock_offset: float = 0.0
    time_jitter: float = 0.0
    noise_px: float = 0.3
    uwb_sigma: float = 0.0
    uwb_offset_sigma: float = 0.0
    uwb_nlos: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise InputError(f"`{field.name}` is {value}; give a finite number")
            if value < 0 and field.name != "clock_offset":
                raise InputError(f"`{field.name}` is {value}; give a number that is not negative")
        if self.uwb_nlos > 1:
            raise InputError(f"`uwb_nlos` is {self.uwb_nlos}; give a share of all ranges, 0 to 1")
        if self.uwb_sigma == 0 and (self.uwb_offset_sigma or self.uwb_nlos):
            raise InputError("there are no ranges to be wrong: give `uwb_sigma` too")

    @property
    def clocks_differ(self) -> bool:
        """Return whether two robots can stamp one instant differently, or capture at different instants."""
        return self.clock_offset != 0 or self.time_jitter > 0


def reference_team(
    distortion: tuple[float, ...] = (), bias_px: float = 0.0, names: tuple[str, ...] = ("A", "B", "C")
) -> Team:
    """Three robots A (the reference), B and C, or more, as in the design: PS3 Eye, 0.40 m up, tilted 20 deg, two LEDs.

    `distortion` is OpenCV's, none by default; images are rendered through `MILD_LENS`. `bias_px` is what their
    detected centres share as an error.
    """
    camera = Camera(
        width=320, height=240, fx=301.0, fy=301.0, cx=159.5, cy=119.5, distortion=distortion, bias_px=bias_px
    )
    mount = Mount(height=0.40, tilt_deg=20.0)
    markers = Markers(height=0.15, positions=((0.0, 0.125), (0.0, -0.125)))
    robots = tuple(Robot(name=name, camera_if_any=camera, mount_if_any=mount, markers=markers) for name in names)
    return Team(reference=names[0], robots=robots, floor=Floor())


def wide_team(across_deg: float, bias_px: float = 0.0) -> Team:
    """Return the reference team with fisheyes of 640x480 that see `across_deg` [deg] across; `bias_px` as in it."""
    if not MIN_ACROSS_DEG <= across_deg <= MAX_ACROSS_DEG:
        raise InputError(
            f"a fisheye of {across_deg:g} deg is not simulated; give {MIN_ACROSS_DEG:g} to {MAX_ACROSS_DEG:g} deg"
        )
    team = reference_team()
    width, height = 640, 480
    focal = width / 2 / float(fisheye.radius(FISHEYE, np.deg2rad(np.array(across_deg / 2))))
    camera = replace(
        team.robots[0].camera,
        model="fisheye",
        bias_px=bias_px,
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        distortion=FISHEYE,
    )
    return replace(team, robots=tuple(replace(robot, camera_if_any=camera) for robot in team.robots))


def stated_team(team: Team, imperfections: Imperfections) -> Team:
    """Stated team of a run: nominal values, with the tolerances filled in."""

    def stated(robot: Robot) -> Robot:
        # a camera's noise must be above 0 for a detection to have a covariance
        camera = robot.camera_if_any and replace(robot.camera, noise_px=detection_sigma(imperfections))
        mount = robot.mount_if_any and replace(
            robot.mount,
            height_sigma=imperfections.height_sigma,
            tilt_sigma_deg=imperfections.mount_sigma_deg,
            roll_sigma_deg=imperfections.mount_sigma_deg,
            yaw_sigma_deg=imperfections.mount_yaw_sigma_deg,
        )
        markers = robot.markers and replace(robot.markers, span_sigma=imperfections.span_sigma)
        ranging = robot.ranging
        if imperfections.uwb_sigma:
            ranging = Ranging(
                range_sigma=imperfections.uwb_sigma,
                offset_sigma=imperfections.uwb_offset_sigma,
                x=ANTENNA_X,
                two_way=True,
            )
        return replace(robot, camera_if_any=camera, mount_if_any=mount, markers=markers, ranging=ranging)

    floor = Floor(tilt_sigma_deg=imperfections.floor_sigma_deg)
    robots = tuple(map(stated, team.robots))
    return replace(team, robots=robots, floor=floor, clock_sigma=abs(imperfections.clock_offset))


def true_team(stated: Team, rng: np.random.Generator) -> Team:
    """True team: drawn from the tolerances of the stated one, which are zero in the outcome."""

    def drawn(robot: Robot) -> Robot:
        height, tilt, roll, span = rng.standard_normal(4).tolist()
        m = robot.mount_if_any
        # drawn last and if wanted only: the other draws of a seed stay
        yaw = float(rng.standard_normal()) if m is not None and m.yaw_sigma_deg else 0.0
        mount = m and replace(
            m,
            height=m.height + height * m.height_sigma,
            tilt_deg=m.tilt_deg + tilt * m.tilt_sigma_deg,
            roll_deg=m.roll_deg + roll * m.roll_sigma_deg,
            yaw_deg=m.yaw_deg + yaw * m.yaw_sigma_deg,
            height_sigma=0.0,
            tilt_sigma_deg=0.0,
            roll_sigma_deg=0.0,
            yaw_sigma_deg=0.0,
        )
        markers = robot.markers
        if markers is not None and markers.span:
            scale = 1 + span * markers.span_sigma / markers.span
            positions = tuple((x * scale, y * scale) for x, y in markers.positions)
            markers = replace(markers, positions=positions, span_sigma=0.0)
        ranging = robot.ranging
        if ranging is not None and ranging.offset_sigma:
            offset = ranging.offset + float(rng.standard_normal()) * ranging.offset_sigma
            ranging = replace(ranging, offset=offset, offset_sigma=0.0)
        return replace(robot, mount_if_any=mount, markers=markers, ranging=ranging)

    return replace(stated, robots=tuple(map(drawn, stated.robots)), clock_sigma=0.0)


def detection_sigma(imperfections: Imperfections) -> float:
    """Standard deviation a detection is given [px]: the noise, or next to nothing where there is none."""
    return max(imperfections.noise_px, 1e-3)
