"""Wheels and range sensors as stated and as estimated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace as with_fields
from numpy.typing import NDArray

from coloc_graph.backend.calibration_row import Row
from coloc_graph.team import Ranging, Robot, Wheels

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Estimated errors of a robot's wheels and range sensor, each with its covariance; None where stated as exact.

    Parameters
    ----------
    wheels : (Array, Array) or None
        Scale, turn scale, delay [s], (3,), and their covariance (3, 3).
    ranging : (Array, Array) or None
        Offset [m], scale, bearing [rad], x, y [m], depth, offset of ranges to robots [m], (7,), and their covariance.
    """

    wheels: tuple[Array, Array] | None
    ranging: tuple[Array, Array] | None


@dataclass(frozen=True, eq=False)
class CalibratedSensors:
    """Wheels and range sensor of a robot as stated, with their estimated errors.

    Parameters
    ----------
    robot : Robot
        The robot as stated.
    errors : SensorErrors
        Its estimated errors.
    noise : sequence of float
        Factors on the stated standard deviations of ranges and of bearings.
    """

    robot: Robot
    errors: SensorErrors
    noise: Sequence[float] = (1.0, 1.0)

    @property
    def wheels(self) -> Wheels | None:
        """The calibrated wheels with the remaining tolerances; None where nothing was estimated."""
        w, found = self.robot.wheels, self.errors.wheels
        if w is None or found is None:
            return None
        (scale, turn, delay), sigmas = found[0].tolist(), np.sqrt(np.diagonal(found[1])).tolist()
        return with_fields(
            w,
            scale=w.scale + scale,
            turn_scale=w.turn_scale + turn,
            delay=w.delay + delay,
            scale_sigma=sigmas[0],
            turn_scale_sigma=sigmas[1],
            delay_sigma=sigmas[2],
        )

    @property
    def ranging(self) -> Ranging | None:
        """The calibrated range sensor with the remaining tolerances; None where nothing was estimated."""
        r, found = self.robot.ranging, self.errors.ranging
        if r is None or found is None:
            return None
        offset, scale, bearing, x, y, depth, robot_offset = found[0].tolist()
        sigmas = np.sqrt(np.diagonal(found[1])).tolist()
        of_range, of_bearing = self.noise
        return with_fields(
            r,
            range_sigma=r.range_sigma * of_range,
            range_sigma_per_m2=r.range_sigma_per_m2 * of_range,
            bearing_sigma_deg=r.bearing_sigma_deg * of_bearing,
            across_sigma=r.across_sigma * of_bearing,
            offset=r.offset + offset,
            scale=r.scale + scale,
            bearing_offset_deg=r.bearing_offset_deg + math.degrees(bearing),
            x=r.x + x,
            y=r.y + y,
            offset_sigma=sigmas[0],
            scale_sigma=sigmas[1],
            depth=r.depth + depth,
            robot_offset=r.robot_offset + robot_offset,
            bearing_offset_sigma_deg=math.degrees(sigmas[2]),
            place_sigma=max(sigmas[3:5]),
            depth_sigma=sigmas[5],
            robot_offset_sigma=sigmas[6],
        )

    @property
    def rows(self) -> tuple[Row, ...]:
        """Every number of wheels and range sensor that was stated with a tolerance."""
        name, rows = self.robot.name, []
        w, wheels = self.robot.wheels, self.wheels
        if w is not None and wheels is not None:
            rows += [
                Row(name, "odometry scale", "", w.scale, w.scale_sigma, wheels.scale, wheels.scale_sigma),
                Row(
                    name, "odometry turn scale", "", w.turn_scale, w.turn_scale_sigma, wheels.turn_scale,
                    wheels.turn_scale_sigma,
                ),
                Row(name, "odometry delay", "s", w.delay, w.delay_sigma, wheels.delay, wheels.delay_sigma),
            ]  # fmt: skip
        r, ranging = self.robot.ranging, self.ranging
        if r is not None and ranging is not None:
            found, was, now = self.errors.ranging, r, ranging
            assert found is not None
            at = np.sqrt(np.diagonal(found[1])[3:5]).tolist()
            rows += [
                Row(name, "range offset", "m", was.offset, was.offset_sigma, now.offset, now.offset_sigma),
                Row(name, "range scale", "", was.scale, was.scale_sigma, now.scale, now.scale_sigma),
                Row(
                    name, "bearing offset", "deg", was.bearing_offset_deg, was.bearing_offset_sigma_deg,
                    now.bearing_offset_deg, now.bearing_offset_sigma_deg,
                ),
                Row(name, "sensor x", "m", was.x, was.place_sigma, now.x, at[0]),
                Row(name, "sensor y", "m", was.y, was.place_sigma, now.y, at[1]),
                Row(name, "range depth", "", was.depth, was.depth_sigma, now.depth, now.depth_sigma),
                Row(
                    name, "range to robots", "m", was.robot_offset, was.robot_offset_sigma, now.robot_offset,
                    now.robot_offset_sigma,
                ),
            ]  # fmt: skip
        return tuple(row for row in rows if row.stated_sigma > 0)

    def of_robot(self, robot: Robot) -> Robot:
        """Return a robot with the estimated wheels and range sensor."""
        return with_fields(robot, wheels=self.wheels or robot.wheels, ranging=self.ranging or robot.ranging)
