"""Calibration variables of a team: mounts, markers, clocks, planes and lenses that are stated with a tolerance."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from msgspec.structs import replace as with_fields
from numpy.typing import NDArray

from coloc_graph.backend.calibration_row import Row
from coloc_graph.backend.sensor_calibration import CalibratedSensors, SensorErrors
from coloc_graph.backend.sensor_model import RANGING as RANGING_SIZE
from coloc_graph.backend.sensor_model import Sensors
from coloc_graph.measurements import RelativePose
from coloc_graph.team import Landmark, Markers, Mount, Robot, Team
from coloc_graph.team.camera import LENS_TERMS

Array = NDArray[np.float64]

MIN_SIGMA = 1e-6  # sigma of a number stated as exact in a group that has tolerances [m, rad, relative]
ANCHOR_TILT_SIGMA = float(np.deg2rad(0.25))  # rad, tilt sigma below which spans are linearised at the estimate
FAR_SIGMAS = 3.0  # sigmas from the stated value above which a calibration is warned of

# characters of the variables' GTSAM keys
MOUNT = ord("m")  # height [m], tilt, roll, yaw [rad], x, y [m]
MARKERS = ord("k")  # span (relative), height [m]
CLOCKS = ord("o")  # offset of the clocks of a pair [s]
PLANE = ord("p")  # normal in two directions [rad], distance (relative)
LENS = ord("l")  # terms that the lens model leaves, in units of their standard deviation
RANGING = ord("r")  # offset [m], scale, bearing [rad], x, y [m], depth, offset of robots [m]
# dimension of each
SIZES = {MOUNT: 6, MARKERS: 2, CLOCKS: 1, PLANE: 3, LENS: LENS_TERMS, RANGING: RANGING_SIZE}
TILTS = slice(1, 3)  # tilt and roll among the errors of a mount
YAW = "camera yaw"
UNOBSERVABLE = 0.8  # part of a stated tolerance that is left of what nothing measures


class Variables:
    """Calibration variables of a team: their keys and prior standard deviations.

    Each is an error (n,) of the stated value. A value that is stated without a tolerance is exact, and no variable.
    """

    def __init__(
        self,
        robots: tuple[str, ...],
        robot_models: Mapping[str, Robot],
        landmarks: Mapping[str, Landmark] | None = None,
    ) -> None:
        self.robot_models = robot_models
        self._numbers = {robot: number for number, robot in enumerate(robots, start=1)}
        self._names = {number: robot for robot, number in self._numbers.items()}
        self._landmarks = dict(landmarks or {})
        self._order = list(self._landmarks)  # their keys have the number 0 and their index in this list
        self.sigmas: dict[int, Array] = {}
        self.anchors: dict[int, Array] = {}

    def mount(self, robot: str) -> int | None:
        """Return the key of a robot's mount; None where it is exact."""
        m = self.robot_models[robot].mount
        angles = np.deg2rad([m.tilt_sigma_deg, m.roll_sigma_deg, m.yaw_sigma_deg])
        return self._key(MOUNT, robot, 0, [m.height_sigma, *angles, m.position_sigma, m.position_sigma])

    def anchor(self, robot: str) -> tuple[Array, float]:
        """Return the mount error (3,) at which spans are linearised, and the sigma of its tilts there [rad].

        From `anchors` where these have the robot's mount; otherwise as stated.
        """
        m = self.robot_models[robot].mount
        key = self.mount(robot)
        if key in self.anchors:
            return self.anchors[key], ANCHOR_TILT_SIGMA
        return np.zeros(SIZES[MOUNT]), float(np.deg2rad(max(m.tilt_sigma_deg, m.roll_sigma_deg)))

    def is_anchored(self, values: Mapping[int, Array]) -> bool:
        """Return whether the mounts in `values` are close enough to those at which spans are linearised."""
        return all(
            np.abs((found - self.anchors.get(key, np.zeros(SIZES[MOUNT])))[TILTS]).max() < ANCHOR_TILT_SIGMA
            for key, found in values.items()
            if self.is_mount(key)
        )

    def markers_of(self, name: str) -> Markers:
        """Return the markers of a robot or a landmark."""
        markers = self._landmarks[name].seen_as if name in self._landmarks else self.robot_models[name].markers
        assert markers is not None
        return markers

    def markers(self, name: str) -> int | None:
        """Return the key of the markers of a robot or landmark; None where they are exact."""
        markers = self.markers_of(name)
        relative = markers.span_sigma / markers.span if markers.span else 0.0
        index = self._order.index(name) if name in self._landmarks else 0
        return self._key(MARKERS, name, index, [relative, markers.height_sigma])

    def clocks(self, robot_i: str, robot_j: str, sigma: float) -> tuple[int | None, float]:
        """Return the key of the residual offset of two clocks, and its sign for this order of them."""
        first, second = sorted((robot_i, robot_j), key=self._numbers.__getitem__)
        return self._key(CLOCKS, first, self._numbers[second], [sigma]), 1.0 if first == robot_i else -1.0

    def plane(self, robot: str, stance: int, sigmas: Array) -> int | None:
        """Return the key of a plane that was stated for a stance."""
        return self._key(PLANE, robot, stance, sigmas.tolist())

    def lens(self, robot: str) -> int | None:
        """Return the key of what the lens model of a robot's camera leaves; None where it is exact."""
        exact = self.robot_models[robot].camera.lens_px == 0
        return self._key(LENS, robot, 0, [0.0 if exact else 1.0] * LENS_TERMS)

    def ranging(self, robot: str) -> int | None:
        """Return the key of a robot's range sensor; None where it is exact, or the robot has none."""
        sensor = self.robot_models[robot].ranging
        return None if sensor is None else self._key(RANGING, robot, 0, Sensors([sensor]).tolerances[0].tolist())

    def _key(self, kind: int, name: str, index: int, sigmas: list[float]) -> int | None:
        if not any(sigmas):
            return None
        key = int(gtsam.mrsymbol(kind, self._numbers.get(name, 0), index))
        self.sigmas[key] = np.maximum(sigmas, MIN_SIGMA)
        return key

    def prior(self, key: int) -> gtsam.NonlinearFactor:
        """Return the prior factor of a variable."""
        sigmas = self.sigmas[key]
        return gtsam.PriorFactorVector(key, np.zeros(len(sigmas)), gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    def start(self, key: int) -> Array:
        """Return the initial value of a variable: no error."""
        return np.zeros(len(self.sigmas[key]))

    def is_mount(self, key: int) -> bool:
        """Return whether a key is a mount's."""
        return bool(gtsam.mrsymbolChr(key) == MOUNT)

    def owner(self, key: int) -> str:
        """Name of the robot or landmark that a key of a mount or of markers belongs to."""
        number = int(gtsam.mrsymbolLabel(key))
        return self._names[number] if number else self._order[gtsam.mrsymbolIndex(key)]


def is_calibration(key: int) -> bool:
    """Return whether a key is that of a calibration variable, not of a pose."""
    return gtsam.mrsymbolChr(key) in SIZES


def size_of(key: int) -> int:
    """Return the dimension of a variable: 6 of a pose."""
    return SIZES.get(key >> 56, 6)


@dataclass(frozen=True, eq=False)
class CalibratedMount:
    """A calibrated mount.

    Parameters
    ----------
    key : int
        Its GTSAM key.
    robot : str
        The robot.
    stated : Mount
        The mount as stated.
    errors : (6,) float
        Estimated errors of height [m], tilt, roll, yaw [rad], x and y [m].
    covariance : (6, 6) float
        Their covariance.
    """

    key: int
    robot: str
    stated: Mount
    errors: Array
    covariance: Array

    @property
    def mount(self) -> Mount:
        """The calibrated mount, with the remaining tolerances."""
        sigmas = np.sqrt(self.covariance.diagonal())
        height, tilt, roll, yaw, x, y = self.errors.tolist()
        d_height, d_tilt, d_roll, d_yaw, d_x, d_y = sigmas.tolist()
        return with_fields(
            self.stated,
            height=self.stated.height + height,
            tilt_deg=self.stated.tilt_deg + float(np.rad2deg(tilt)),
            roll_deg=self.stated.roll_deg + float(np.rad2deg(roll)),
            height_sigma=d_height,
            tilt_sigma_deg=float(np.rad2deg(d_tilt)),
            roll_sigma_deg=float(np.rad2deg(d_roll)),
            yaw_deg=self.stated.yaw_deg + float(np.rad2deg(yaw)),
            x=self.stated.x + x,
            y=self.stated.y + y,
            yaw_sigma_deg=float(np.rad2deg(d_yaw)) if self.stated.yaw_sigma_deg else 0.0,
            position_sigma=max(d_x, d_y) if self.stated.position_sigma else 0.0,
        )

    @property
    def rows(self) -> tuple[Row, ...]:
        """Height, tilt, roll, yaw, x and y, one after the other."""
        stated, found = self.stated, self.mount
        d_x, d_y = np.sqrt(self.covariance.diagonal())[4:].tolist()
        return (
            Row(self.robot, YAW, "deg", stated.yaw_deg, stated.yaw_sigma_deg, found.yaw_deg, found.yaw_sigma_deg),
            Row(self.robot, "camera x", "m", stated.x, stated.position_sigma, found.x, d_x),
            Row(self.robot, "camera y", "m", stated.y, stated.position_sigma, found.y, d_y),
            Row(self.robot, "height", "m", stated.height, stated.height_sigma, found.height, found.height_sigma),
            Row(
                self.robot, "tilt", "deg", stated.tilt_deg, stated.tilt_sigma_deg, found.tilt_deg, found.tilt_sigma_deg
            ),
            Row(
                self.robot, "roll", "deg", stated.roll_deg, stated.roll_sigma_deg, found.roll_deg, found.roll_sigma_deg
            ),
        )


@dataclass(frozen=True, eq=False)
class CalibratedMarkers:
    """Calibrated markers.

    Parameters
    ----------
    key : int
        Their GTSAM key.
    robot : str
        The robot or landmark.
    stated : Markers
        The markers as stated.
    errors : (2,) float
        Estimated errors of span (relative) and height [m].
    covariance : (2, 2) float
        Their covariance.
    """

    key: int
    robot: str
    stated: Markers
    errors: Array
    covariance: Array

    @property
    def markers(self) -> Markers:
        """The calibrated markers, with the remaining tolerances."""
        longer, higher = self.errors.tolist()
        d_span, d_height = np.sqrt(self.covariance.diagonal()).tolist()
        s = self.stated
        return with_fields(
            s,
            height=s.height + higher,
            positions=tuple((x * (1 + longer), y * (1 + longer)) for x, y in s.positions),
            span_sigma=(s.span or 0.0) * d_span,
            height_sigma=d_height,
        )

    @property
    def rows(self) -> tuple[Row, ...]:
        """Span, where there is one, and height."""
        s, f = self.stated, self.markers
        rows = [Row(self.robot, "markers' height", "m", s.height, s.height_sigma, f.height, f.height_sigma)]
        if s.span and f.span:
            rows.insert(0, Row(self.robot, "span", "m", s.span, s.span_sigma, f.span, f.span_sigma))
        return tuple(rows)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration estimated together with the poses.

    Parameters
    ----------
    variables, values, covariances
        Of a joint estimate: its calibration variables, their estimates and covariances, by key.
    driven : mapping of str to CalibratedSensors
        Of a ranging run: wheels and range sensors by robot.
    landmarks : mapping of str to Landmark
        Of a ranging run: estimated landmarks whose positions the team does not state.
    """

    variables: Variables | None = None
    values: Mapping[int, Array] = field(default_factory=dict)
    covariances: Mapping[int, Array] = field(default_factory=dict)
    driven: Mapping[str, CalibratedSensors] = field(default_factory=dict)
    landmarks: Mapping[str, Landmark] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Return whether anything was calibrated."""
        return bool(self.rows or self.landmarks)

    @cached_property
    def mounts(self) -> dict[str, CalibratedMount]:
        """Mounts that were stated with a tolerance, by robot."""
        return {
            name: CalibratedMount(
                key, name, variables.robot_models[name].mount, self.values[key], self.covariances[key]
            )
            for key, name, variables in self._of(MOUNT)
        }

    @cached_property
    def markers(self) -> dict[str, CalibratedMarkers]:
        """Markers that were stated with a tolerance, by robot or landmark."""
        return {
            name: CalibratedMarkers(key, name, variables.markers_of(name), self.values[key], self.covariances[key])
            for key, name, variables in self._of(MARKERS)
        }

    @cached_property
    def sensors(self) -> dict[str, CalibratedSensors]:
        """Wheels and range sensors that were stated with a tolerance, by robot."""
        return {**self.driven} | {
            name: CalibratedSensors(
                variables.robot_models[name], SensorErrors(None, (self.values[key], self.covariances[key]))
            )
            for key, name, variables in self._of(RANGING)
        }

    def _of(self, kind: int) -> Iterable[tuple[int, str, Variables]]:
        for key in sorted(self.values):
            if self.variables is not None and gtsam.mrsymbolChr(key) == kind:
                yield key, self.variables.owner(key), self.variables

    @property
    def rows(self) -> tuple[Row, ...]:
        """Every number that was stated with a tolerance."""
        rows = [row for mount in self.mounts.values() for row in mount.rows]
        rows += [row for markers in self.markers.values() for row in markers.rows]
        rows += [row for sensors in self.sensors.values() for row in sensors.rows]
        return tuple(row for row in rows if row.stated_sigma > 0)

    def of_team(self, team: Team) -> Team:
        """Return the calibrated team, with the remaining tolerances."""
        robots = []
        for robot in team.robots:
            mount, markers = self.mounts.get(robot.name), self.markers.get(robot.name)
            sensors = self.sensors.get(robot.name)
            if mount is not None:
                robot = with_fields(robot, mount_if_any=mount.mount)
            if markers is not None:
                robot = with_fields(robot, markers=markers.markers)
            robots.append(robot if sensors is None else sensors.of_robot(robot))
        landmarks = []
        for landmark in team.landmarks:
            if landmark.name in self.markers:
                landmark = with_fields(landmark, markers=self.markers[landmark.name].markers)
            landmarks.append(self.landmarks.get(landmark.name, landmark))
        return with_fields(team, robots=tuple(robots), landmarks=tuple(landmarks))

    @property
    def unobservable(self) -> tuple[Row, ...]:
        """Yaws and positions of mounts, and numbers of other sensors, of which the measurements say next to nothing."""
        mounts = (row for mount in self.mounts.values() for row in mount.rows[:3])
        sensors = (row for one in self.sensors.values() for row in one.rows)
        return tuple(
            row
            for row in (*mounts, *sensors)
            if row.stated_sigma > 0 and row.found_sigma > UNOBSERVABLE * row.stated_sigma
        )

    @property
    def far(self) -> tuple[Row, ...]:
        """Numbers that are further from their stated values than their tolerances explain."""
        return tuple(row for row in self.rows if row.sigmas > FAR_SIGMAS)


def sigmas_of_plane(measured: RelativePose) -> Array:
    """Standard deviations (3,) of a stated plane: normal in two directions [rad], distance (relative)."""
    assert measured.plane is not None
    turn = measured.plane.normal_sigma
    return np.array([turn, turn, measured.plane.d_sigma / measured.plane.d])


def with_height_sigma(robot_models: Mapping[str, Robot], height_sigma: float) -> dict[str, Robot]:
    """Return the robots with mounts whose heights have at least this standard deviation [m]."""
    return {
        name: with_fields(
            robot, mount_if_any=with_fields(robot.mount, height_sigma=max(robot.mount.height_sigma, height_sigma))
        )
        for name, robot in robot_models.items()
    }
