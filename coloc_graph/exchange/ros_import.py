"""Import a ROS bag as a run: `import_ros`, explained in docs/ros.md."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import BagError
from coloc_graph.exchange.ros_bag import Bag, open_bag
from coloc_graph.exchange.ros_images import image_of
from coloc_graph.exchange.ros_map import RosMap, read_map
from coloc_graph.exchange.ros_order import MAX_HELD, InOrder
from coloc_graph.exchange.ros_read import Recording, read_recording, require_topics
from coloc_graph.exchange.ros_robots import (
    movements_of,
    odometry_of,
    of_motion,
    of_team,
    ranges_of,
    seconds,
    truth_of,
    with_cameras,
)
from coloc_graph.exchange.stances import Movements, derive_stances
from coloc_graph.run import Clocks, EncodedImage, Image, Motion, OdometrySample, Ranges, RunWriter, Stance, atomic_run
from coloc_graph.run.encode import ImageFormat
from coloc_graph.run.schemas import to_seconds
from coloc_graph.team import Team

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class RosSummary:
    """Summary of an import.

    Attributes
    ----------
    counts
        Numbers of images, odometry samples, ranges and true poses.
    stances, observers
        Number of stances, and robots that observe in any of them.
    stood
        For each robot the duration at rest, and the duration in which that is known [s].
    warnings
        Sentences on assumptions and oddities.
    """

    stances: int
    counts: dict[str, int]
    stood: dict[str, tuple[float, float]]
    observers: tuple[str, ...]
    warnings: tuple[str, ...]


def import_ros(
    bag_path: str | Path,
    map_path: str | Path,
    out: str | Path,
    *,
    image_format: ImageFormat = "jpeg",
    progress: Progress | None = None,
) -> RosSummary:
    """Write a run from a ROS bag and a map of its topics.

    Parameters
    ----------
    bag_path
        ROS 1 .bag, ROS 2 folder, or .mcap.
    map_path
        MAP.toml with the topics of each robot.
    out
        Run to write.
    image_format
        Format for images that are neither JPEG nor PNG, which are kept.
    progress
        Called with (messages read, their number).

    Raises
    ------
    BagError, TeamError
        In one sentence that names file, topic and time. Nothing is written, and an existing file is kept.
    RunError
        The run cannot be written.
    """
    bag_path, map_path, out = Path(bag_path), Path(map_path), Path(out)
    for path in (bag_path, map_path):
        if out.resolve() == path.resolve():
            raise BagError(f"{out}: is to be read and to be replaced by the run; give the run a name of its own")
    the_map, team = read_map(map_path)
    with open_bag(bag_path) as bag:
        require_topics(bag, the_map)
        images = {robot.image: robot.name for robot in the_map.robots if robot.image is not None}
        count = sum(bag.topics[name].count for robot in the_map.robots for name in robot.topics.values())
        total = count + sum(bag.topics[name].count for name in images)

        def told(done: int) -> None:
            if progress is not None:
                progress(min(done, total), total)

        recording = read_recording(bag, the_map, told)
        team, warnings = with_cameras(bag, the_map, recording, team)
        if recording.clocks.sigma > team.clock_sigma:
            team = msgspec.structs.replace(team, clock_sigma=recording.clocks.sigma)
            warnings.append(
                f"{bag.path}: observers' clocks may still differ by {1e3 * recording.clocks.sigma:.0f} ms (1 sigma): "
                "the run's team states that as `clock_sigma`, and a solve finds the offset where the motion shows it"
            )
        odometry, ranges = {}, list[Ranges]()
        for robot in the_map.robots:
            found, said = ranges_of(bag, robot, recording)
            ranges, warnings = [*ranges, *found], [*warnings, *said]
            if robot.odometry:
                odometry[robot.name], said = odometry_of(bag, robot, recording)
                warnings += said
        truth = {robot.name: true for robot in the_map.robots if (true := truth_of(bag, robot, recording))}
        moves = movements_of(the_map, recording, odometry)
        stances = _stances(bag, map_path, the_map, team, recording, moves)
        with atomic_run(out, team, image_format=image_format) as writer:
            if records := recording.clocks.records():
                begin = min(one.start for one in moves) if not stances else stances[0].start
                writer.write(Clocks(begin, records))
            events = _Events(writer, stances, odometry, ranges, moves, truth)
            _write_images(bag, images, recording, team, events, lambda done: told(count + done))
            events.write_until(np.inf)
        told(total)
    counts = {
        "images": sum(len(recording.orders[topic].ns) for topic in images),
        "odometry samples": sum(map(len, odometry.values())),
        "ranges": len(ranges),
        "true poses": sum(map(len, truth.values())),
    }
    warnings = [
        *bag.notes,
        *recording.notes,
        *warnings,
        *of_motion(bag, the_map, recording, moves),
        *of_team(bag, the_map, team, recording),
    ]
    observers = tuple(name for name in team.names if any(name in stance.observers for stance in stances))
    stood = {one.robot: (sum(end - begin for begin, end in one.standing()), one.end - one.start) for one in moves}
    return RosSummary(len(stances), counts, stood, observers, tuple(warnings))


def _stances(
    bag: Bag, map_path: Path, the_map: RosMap, team: Team, recording: Recording, moves: list[Movements]
) -> list[Stance]:
    """Return the stances, at least one unless robots measured ranges."""
    cameras = {robot.name: seconds(recording.orders[robot.image].ns) for robot in the_map.robots if robot.image}
    marked = {robot.name for robot in team.robots if robot.markers is not None}
    found = derive_stances(moves, cameras, marked, the_map.motion)
    if found or any(robot.ranges for robot in the_map.robots):
        return found
    if len(cameras) < 2:
        raise BagError(f"{map_path}: {len(cameras)} of its robots have an `image`; a stance needs two that watch")
    if not marked & {one.robot for one in moves}:
        raise BagError(f"{map_path}: no robot in it carries markers by {the_map.team}; give those of who is watched")
    stood = ", ".join(
        f"{one.robot} stood {sum(end - begin for begin, end in one.standing()):.1f} of {one.end - one.start:.1f} s"
        for one in moves
    )
    raise BagError(
        f"{bag.path}: never do two robots with images stand while another one with markers moves, so that there is no "
        f"stance: {stood}; say what counts as moving under [motion] in {map_path}"
    )


class _Events:
    """All records except images, in order of time."""

    def __init__(
        self,
        writer: RunWriter,
        stances: list[Stance],
        odometry: Mapping[str, list[OdometrySample]],
        ranges: list[Ranges],
        moves: list[Movements],
        truth: Mapping[str, list[tuple[float, Array]]],
    ) -> None:
        self._writer = writer
        records: list[tuple[float, Stance | Motion | OdometrySample | Ranges | tuple[str, Array]]] = [
            *((stance.start, stance) for stance in stances),
            *((motion.time, motion) for one in moves for motion in one.motions()),
            *((sample.time, sample) for samples in odometry.values() for sample in samples),
            *((one.time, one) for one in ranges),
            *((time, (robot, T)) for robot, poses in truth.items() for time, T in poses),
        ]
        self._rest = sorted(records, key=lambda one: one[0], reverse=True)

    def write_until(self, time: float) -> None:
        """Write the records up to a time [UTC s]."""
        while self._rest and self._rest[-1][0] <= time:
            at, record = self._rest.pop()
            if isinstance(record, tuple):
                self._writer.write_truth(record[0], at, record[1])
            else:
                self._writer.write(record)

    def write_image(self, image: Image | EncodedImage) -> None:
        """Write an image after all records up to its time."""
        self.write_until(image.time)
        self._writer.write(image)


def _write_images(
    bag: Bag, images: Mapping[str, str], recording: Recording, team: Team, events: _Events, told: Callable[[int], None]
) -> None:
    waiting = {topic: InOrder[Image | EncodedImage](recording.orders[topic].ns) for topic in images}
    for number, message in enumerate(bag.messages(set(images)), start=1):
        robot, ns = images[message.topic], recording.time(bag, message)
        image = image_of(bag, message, robot, to_seconds(ns), team[robot].camera)
        try:
            for _, due in waiting[message.topic].take(ns, image):
                events.write_image(due)
        except OverflowError:
            raise bag.error(
                message, f"comes more than {MAX_HELD} images before one that is earlier; record the topic in order"
            ) from None
        told(number)
