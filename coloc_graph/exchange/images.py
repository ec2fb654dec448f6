"""Import a team's own recording: one folder, glob or video of images for each robot."""

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.csv_table import Table, read_table
from coloc_graph.exchange.image_sources import ImageSource, open_sources
from coloc_graph.exchange.recording_offsets import OFFSET_SIGMA, recorded_tracks, recording_offset
from coloc_graph.exchange.stances import MotionThresholds, Movements, derive_stances
from coloc_graph.exchange.still_cameras import movements_by_images
from coloc_graph.run import EncodedImage, Image, Motion, Stance, atomic_run
from coloc_graph.run.encode import ImageFormat
from coloc_graph.run.image_header import read_image_header
from coloc_graph.team import Team, read_team

Array = NDArray[np.float64]

STANCES_HEADER = ("stance", "start", "end", "observers", "movers", "anchors")
BY_IMAGES = MotionThresholds(settle=0.0)  # by images a camera stands at once, unlike by odometry


@dataclass(frozen=True)
class ImagesSummary:
    """Summary of an import.

    Attributes
    ----------
    images
        Number of images by robot.
    stances
        The stances.
    stood
        For each robot the duration at rest and the recorded duration [s]; empty if stances were given.
    offsets
        Time offsets that were applied to the robots' recordings, as stated or found [s].
    """

    images: dict[str, int]
    stances: tuple[Stance, ...]
    stood: dict[str, tuple[float, float]]
    offsets: dict[str, float]


def import_images(
    team_path: str | Path,
    sources: Sequence[str],
    out: str | Path,
    *,
    times: str | Path | None = None,
    fps: float | None = None,
    time_pattern: str | None = None,
    stances: str | Path | None = None,
    offsets: Mapping[str, float] | None = None,
    image_format: ImageFormat = "png",
    progress: Callable[[int, int], None] | None = None,
) -> ImagesSummary:
    """Make a run of images.

    Parameters
    ----------
    team_path
        team.toml.
    sources
        `ROBOT=SOURCE` each: a folder, a glob (`A=DIR/*/A/*.png`), or a video.
    out
        The run to write.
    times
        CSV `robot,file,time` [UTC s]; `file` is the end of an image's path that tells it from the others.
    fps
        Images a second, of all robots, that begin at the same time.
    time_pattern
        Name of an image with `{s}`, `{ms}`, `{us}` or `{ns}` where its time is.
    stances
        CSV `stance,start,end,observers,movers,anchors`, names separated by spaces. Without it stances are found: a
        robot stands while the background of its images is still, and robots without images move all the time.
    offsets
        By how much a robot's recording is later than its times say, by robot [s]. Of videos with their own times, which
        do not say when they began, others are found by the motion that they show.
    image_format
        Of images that are neither JPEG nor PNG, or that need a change: EXIF orientation, alpha, 16 bits.

    Raises
    ------
    InputError
        If a file is missing or wrong, or no stance is found.
    """
    team = read_team(team_path)
    found = open_sources(team, sources, times=Path(times) if times is not None else None, fps=fps, pattern=time_pattern)
    if len(found) < 2:
        raise InputError("a stance needs two observers: give the images of two robots, such as A=images/A B=images/B")
    found, moved = _together(team, found, dict(offsets or {}))
    if any(robot not in (offsets or {}) for robot in moved):
        team = msgspec.structs.replace(team, clock_sigma=max(team.clock_sigma, OFFSET_SIGMA))
    if stances is not None:
        made, moves = _read_stances(Path(stances), team, found), []
    else:
        moves = [movements_by_images(one.robot, one.times, one.pixels()) for one in found]
        made = _find_stances(team, found, moves)
    total = sum(map(len, found))
    with atomic_run(Path(out), team, image_format=image_format) as writer:
        rest: list[Stance | Motion] = sorted(
            [*made, *(motion for one in moves for motion in one.motions())], key=_begin, reverse=True
        )
        for done, record in enumerate(heapq.merge(*(_sized(one, team) for one in found), key=lambda one: one.time), 1):
            while rest and _begin(rest[-1]) <= record.time:
                writer.write(rest.pop())
            writer.write(record)
            if progress is not None and (done % 50 == 0 or done == total):
                progress(done, total)
        for one in reversed(rest):
            writer.write(one)
    stood = {one.robot: (sum(end - begin for begin, end in one.standing()), one.end - one.start) for one in moves}
    return ImagesSummary({one.robot: len(one) for one in found}, tuple(made), stood, moved)


def _together(
    team: Team, sources: Sequence[ImageSource], stated: dict[str, float]
) -> tuple[list[ImageSource], dict[str, float]]:
    """Sources moved in time, and by how much each was, by robot [s]: as stated, or as the motion that they show."""
    unknown = [robot for robot in stated if robot not in [one.robot for one in sources]]
    if unknown:
        raise InputError(f"--offset names robot {unknown[0]}, of which no images are given; leave it out")
    offsets, first = dict(stated), sources[0]
    open_yet = [one for one in sources[1:] if not (first.has_start and one.has_start) and one.robot not in stated]
    if open_yet:
        seen = {}
        for one in (first.shifted(offsets.get(first.robot, 0.0)), *open_yet):
            standing = movements_by_images(one.robot, one.times, one.pixels()).standing()
            seen[one.robot] = recorded_tracks(team, one.robot, one.times, one.pixels(), standing)
        for one in open_yet:
            offsets[one.robot] = recording_offset(team, seen[first.robot], seen[one.robot])
    return [one.shifted(offsets.get(one.robot, 0.0)) for one in sources], offsets


def _begin(record: Stance | Motion) -> float:
    return record.start if isinstance(record, Stance) else record.time


def _sized(source: ImageSource, team: Team) -> Iterator[Image | EncodedImage]:
    """Yield the images of a source and check their size against the team."""
    camera = team[source.robot].camera
    for number, record in enumerate(source.records()):
        if isinstance(record, Image):
            height, width = record.pixels.shape[:2]
        else:
            header = read_image_header(record.data)
            assert header is not None, "it was decoded"
            width, height = header.width, header.height
        if (width, height) != (camera.width, camera.height):
            what = source.video if source.video is not None else source.files[number]
            raise InputError(
                f"{what} has {width} x {height} pixels, and the camera of {source.robot} is {camera.width} x "
                f"{camera.height} in the team: correct the camera, and its calibration"
            )
        yield record


def _find_stances(team: Team, sources: Sequence[ImageSource], moves: Sequence[Movements]) -> list[Stance]:
    """Find stances by cameras at rest; robots without images, and those whose camera never rests, are the movers."""
    begin = min(float(one.times[0]) for one in sources)
    end = max(float(one.times[-1]) for one in sources)
    seen = {one.robot for one in sources}
    always = [Movements(name, begin, end, ((begin, end),)) for name in team.names if name not in seen]
    marked = {robot.name for robot in team.robots if robot.markers is not None}
    cameras = {one.robot: one.times for one in sources}
    found = [_with_images(one, cameras) for one in derive_stances([*moves, *always], cameras, marked, BY_IMAGES)]
    if not found:
        stood = ", ".join(
            f"{one.robot} stood {sum(b - a for a, b in one.standing()):.1f} of {one.end - one.start:.1f} s"
            for one in moves
        )
        raise InputError(
            f"no stance found: at no time do two cameras stand while a robot with markers moves ({stood}); state the "
            "stances with --stances, and give no images of a robot that only moves"
        )
    return found


def _with_images(stance: Stance, cameras: dict[str, Array]) -> Stance:
    """Shorten a stance to its first and last image."""
    own = [cameras[robot] for robot in stance.observers]
    inside = [one[(one >= stance.start) & (one <= stance.end)] for one in own]
    return replace(stance, start=float(min(one[0] for one in inside)), end=float(max(one[-1] for one in inside)))


def _read_stances(path: Path, team: Team, sources: Sequence[ImageSource]) -> list[Stance]:
    table = read_table(path, "stances", STANCES_HEADER)
    if not len(table):
        raise InputError(f"{path}: has a header and no rows; add one row for each stance, or leave it out")
    indices, begins, ends = table.stances(), table.numbers("start"), table.numbers("end")
    cameras = {one.robot: one.times for one in sources}
    made: list[Stance] = []
    for row in range(len(table)):
        observers, movers, anchors = (_names(table, row, name, team) for name in STANCES_HEADER[3:])
        stance = Stance(int(indices[row]), float(begins[row]), float(ends[row]), observers, movers, anchors)
        if stance.index != len(made):
            raise table.error(row, f"stance {stance.index} comes where {len(made)} is due; number them 0, 1, 2, ...")
        if stance.end <= stance.start or (made and stance.start < made[-1].end):
            raise table.error(row, "it ends before it starts, or starts before the last one ends; correct the times")
        if set(observers) & set(movers):
            raise table.error(row, f"`{min(set(observers) & set(movers))}` both observes and moves; name it once")
        for robot in observers:
            times = cameras.get(robot, np.empty(0))
            if not ((times >= stance.start) & (times <= stance.end)).any():
                raise table.error(row, f"observer {robot} has no image from {begins[row]:g} to {ends[row]:g} s")
        made.append(stance)
    return made


def _names(table: Table, row: int, column: str, team: Team) -> tuple[str, ...]:
    names = tuple(table.columns[column][row].split())
    for name in names:
        if name not in team.names:
            raise table.error(row, f"`{column}`: robot `{name}` is not in the team ({', '.join(team.names)})")
    return names
