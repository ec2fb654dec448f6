"""The road from a run of robots that drive all the time, with ranges and bearings, to an estimate: `solve_drive`."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace as with_fields

from coloc_graph.backend.planar import DriveEstimate, IncrementalDrive, optimise_drive
from coloc_graph.backend.planar.incremental import EVERY
from coloc_graph.errors import EstimationError
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.contents import unused_in
from coloc_graph.run import Run
from coloc_graph.team import Landmark, Robot, Team

#: Called with the seconds of the run that are done, and of how many.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class DriveOptions:
    """How to solve it: all at once, or as it happened; with or without what robots measured of each other."""

    incremental: bool = False
    between_robots: bool = True


@dataclass(frozen=True, eq=False)
class DriveSolution:
    """A result: the estimate, and, of an incremental one, what was thought of each pose at its time (`online`)."""

    run: Run
    options: DriveOptions
    estimate: DriveEstimate
    warnings: tuple[str, ...]
    seconds_frontend: float
    seconds_backend: float
    online: Mapping[str, Trajectory] = field(default_factory=dict)


def solve_drive(run: Run, options: DriveOptions | None = None, progress: Progress | None = None) -> DriveSolution:
    """Localise a team that measured ranges and bearings while it drove, and the landmarks it saw.

    The world is the landmarks' map where the team states it, and else where the reference robot was first. Raises
    `InputError` where the run holds nothing to solve, and `EstimationError` where no measurement places any robot.
    """
    options = options or DriveOptions()
    started = time.perf_counter()
    drive = keyframes_of(run, between_robots=options.between_robots)
    made = time.perf_counter()
    online: Mapping[str, Trajectory] = {}
    if options.incremental:
        incremental = IncrementalDrive(run.team, drive)
        first, last = (float(pick([pick(t) for t in drive.times if len(t)])) for pick in (np.min, np.max))
        count = math.ceil((last - first) / EVERY) + 1
        for n in range(1, count + 1):
            incremental.advance(first + n * EVERY)
            if progress is not None:
                progress(round(n * EVERY), round(count * EVERY))
        estimate, online = incremental.finish()
    else:
        estimate = optimise_drive(run.team, drive)
    if not estimate.trajectories:
        raise EstimationError(
            f"{run.path}: no robot's measurements say where it is: let one see two landmarks of known positions"
        )
    return DriveSolution(
        run=run,
        options=options,
        estimate=estimate,
        warnings=(*run.warnings, *map(str, unused_in(run)), *drive.warnings, *_warnings(estimate)),
        seconds_frontend=made - started,
        seconds_backend=time.perf_counter() - made,
        online=online,
    )


def _warnings(estimate: DriveEstimate) -> list[str]:
    warnings = [
        f"robot {name} has no place: it was never measured together with two things whose places are known"
        for name in estimate.unplaced
    ]
    drive, m = estimate.drive, estimate.drive.measured
    names = (*drive.robots, *drive.landmarks)
    pairs: dict[tuple[int, int], int] = {}
    for index in np.flatnonzero(estimate.doubted).tolist():
        pair = int(m.robot[index]), int(m.target[index])
        pairs[pair] = pairs.get(pair, 0) + 1
    if pairs:
        (robot, target), most = max(pairs.items(), key=lambda one: one[1])
        warnings.append(
            f"{sum(pairs.values())} of {len(m)} measurements are contradicted by all others and weigh next to nothing, "
            f"{most} of them of {names[target]} by {names[robot]}"
        )
    return warnings


def calibrated(team: Team, estimate: DriveEstimate) -> Team:
    """The team as it turned out: wheels, sensors and landmarks, with what is left of their tolerances."""
    robots = tuple(_calibrated_robot(robot, estimate) for robot in team.robots)
    placed = {one.name: one for one in estimate.landmarks}
    landmarks = []
    for landmark in team.landmarks:
        found = placed.get(landmark.name)
        if found is not None and not found.stated:
            x, y = found.position.tolist()
            sigma = float(np.sqrt(np.trace(found.covariance) / 2))
            landmark = Landmark(name=landmark.name, position=(x, y), position_sigma=sigma)
        landmarks.append(landmark)
    return with_fields(team, robots=robots, landmarks=tuple(landmarks))


def _calibrated_robot(robot: Robot, estimate: DriveEstimate) -> Robot:
    errors = estimate.errors.get(robot.name)
    if errors is None:
        return robot
    if errors.wheels is not None and robot.wheels is not None:
        (scale, turn, delay), sigmas = errors.wheels[0].tolist(), np.sqrt(np.diagonal(errors.wheels[1])).tolist()
        w = robot.wheels
        robot = with_fields(
            robot,
            wheels=with_fields(
                w,
                scale=w.scale + scale,
                turn_scale=w.turn_scale + turn,
                delay=w.delay + delay,
                scale_sigma=sigmas[0],
                turn_scale_sigma=sigmas[1],
                delay_sigma=sigmas[2],
            ),
        )
    if errors.ranging is not None and robot.ranging is not None:
        offset, scale, bearing, x, y, depth, robot_offset = errors.ranging[0].tolist()
        sigmas = np.sqrt(np.diagonal(errors.ranging[1])).tolist()
        r = robot.ranging
        times = estimate.noise[estimate.drive.robots.index(robot.name)].tolist()
        robot = with_fields(
            robot,
            ranging=with_fields(
                r,
                range_sigma=r.range_sigma * times[0],
                range_sigma_per_m2=r.range_sigma_per_m2 * times[0],
                bearing_sigma_deg=r.bearing_sigma_deg * times[1],
                across_sigma=r.across_sigma * times[1],
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
            ),
        )
    return robot
