"""Open sources of a robot's images (a folder, a glob across folders, or a video), and find the time of each image."""

import glob
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.csv_table import read_table
from coloc_graph.image_file import SUFFIXES, images_in, natural_key, range_of, read_image, to_8_bits
from coloc_graph.input_file import read_bytes
from coloc_graph.run import EncodedImage, Image
from coloc_graph.run.image_header import JPEG_MAGIC, PNG_MAGIC
from coloc_graph.team import Team

Array = NDArray[np.float64]

START = 1_000_000_000.0  # UTC s of the first image where times are counted from it
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIMES_HEADER = ("robot", "file", "time")


@dataclass(frozen=True, eq=False)
class ImageSource:
    """Images of one robot at ascending `times` (n,) [UTC s]: `files`, or the frames of a `video`.

    `has_start` is False of a video whose own times are taken: nothing says when it began.
    """

    robot: str
    times: Array
    files: tuple[Path, ...] = ()
    video: Path | None = None
    has_start: bool = True

    def __len__(self) -> int:
        return len(self.times)

    def shifted(self, seconds: float) -> "ImageSource":
        """Return the source with all times shifted [s]."""
        return replace(self, times=self.times + seconds)

    def pixels(self) -> Iterator[NDArray[np.uint8]]:
        """Yield all images with 8 bits, grey or BGR."""
        for record in self.records():
            if isinstance(record, Image):
                yield record.pixels
            else:
                data = np.frombuffer(record.data, np.uint8)
                yield np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)

    def records(self) -> Iterator[Image | EncodedImage]:
        """Yield all images as records of a run; JPEG and PNG are kept if every decoder agrees on them."""
        times = self.times.tolist()
        if self.video is not None:
            for time, frame in zip(times, _frames(self.video), strict=False):
                yield Image(self.robot, time, frame)
            return
        values = range_of(self.files, read_image(self.files[0]))
        for time, path in zip(times, self.files, strict=True):
            decoded = read_image(path)
            data = read_bytes(path, "give it anew") if decoded.unchanged else b""
            if data.startswith(JPEG_MAGIC):
                yield EncodedImage(self.robot, time, "jpeg", data)
            elif data.startswith(PNG_MAGIC):
                yield EncodedImage(self.robot, time, "png", data)
            else:
                yield Image(self.robot, time, to_8_bits(decoded, values))


def open_sources(
    team: Team,
    given: Sequence[str],
    *,
    times: Path | None = None,
    fps: float | None = None,
    pattern: str | None = None,
) -> list[ImageSource]:
    """Open sources of images `ROBOT=SOURCE`, with times from a CSV, a rate, file names, or a video's container.

    Raises
    ------
    InputError
        A source has no images, or its times are unknown or do not ascend.
    """
    if sum(one is not None for one in (times, fps, pattern)) > 1:
        raise InputError("times come from --times, --fps or --time-pattern; give one of them")
    if fps is not None and not 0 < fps < np.inf:
        raise InputError(f"--fps is {fps}; give the images a second, above 0")
    table = _read_times(times, team) if times is not None else None
    found: list[ImageSource] = []
    for one in given:
        robot, equals, where = one.partition("=")
        if not equals or not where:
            raise InputError(f"`{one}` is not ROBOT=SOURCE: give a folder, a glob or a video, such as A=images/A")
        if team[robot].camera_if_any is None:
            raise InputError(f"robot {robot} has no camera in the team; give it one under [robots.camera]")
        if robot in [source.robot for source in found]:
            raise InputError(f"robot {robot} has two sources; give one, a glob may span folders: '{robot}=DIR/*/*.png'")
        files, video = _files(where)
        if video is not None:
            if times is not None or pattern is not None:
                raise InputError(
                    f"{video} is a video, whose frames have no names; leave --times and --time-pattern out"
                )
            own = _video_times(video, fps)
        elif table is not None:
            assert times is not None
            own = _times_of(files, robot, table, times)
        elif pattern is not None:
            own = _times_by_name(files, pattern)
        elif fps is not None:
            own = START + np.arange(len(files)) / fps
        else:
            raise InputError(f"the times of the images of {robot} are not known: give --times, --fps or --time-pattern")
        late = np.flatnonzero(np.diff(own) <= 0)
        if len(late) and video is None:
            order = np.argsort(own, kind="stable")
            own, files = own[order], tuple(files[n] for n in order.tolist())
            twice = np.flatnonzero(np.diff(own) <= 0)
            if len(twice):
                raise InputError(
                    f"{files[twice[0]]} and {files[twice[0] + 1]} of {robot} have the same time {own[twice[0]]:.6f} s; "
                    "correct the times"
                )
        found.append(ImageSource(robot, own, files, video, has_start=video is None or fps is not None))
    return found


def _files(where: str) -> tuple[tuple[Path, ...], Path | None]:
    """List the image files of a folder or a glob, or a video."""
    path = Path(where)
    if path.is_dir():
        return tuple(images_in(path)), None
    if path.is_file() and path.suffix.lower() not in SUFFIXES:
        return (), path
    if path.is_file():
        return (path,), None
    paths = [Path(one) for one in glob.glob(where, recursive=True)]  # noqa: PTH207 - it may be absolute
    files = sorted((one for one in paths if one.suffix.lower() in SUFFIXES), key=natural_key)
    if not files:
        raise InputError(f"{where}: there is no such folder or video, and no image whose name is like that")
    return tuple(files), None


def _read_times(path: Path, team: Team) -> dict[str, list[tuple[tuple[str, ...], float]]]:
    table = read_table(path, "times", TIMES_HEADER)
    places, seconds = table.robots(team), table.numbers("time")
    found: dict[str, list[tuple[tuple[str, ...], float]]] = {}
    for place, file, time in zip(places.tolist(), table.columns["file"], seconds.tolist(), strict=True):
        found.setdefault(team.names[place], []).append((tuple(Path(file).parts), time))
    return found


def _times_of(
    files: Sequence[Path], robot: str, table: dict[str, list[tuple[tuple[str, ...], float]]], path: Path
) -> Array:
    """Time of each file, from the row whose `file` is the end of its path."""
    by_end: dict[tuple[str, ...], float] = {}
    for parts, time in table.get(robot, []):
        if parts in by_end:
            raise InputError(f"{path}: `{'/'.join(parts)}` of {robot} is there twice; state its time once")
        by_end[parts] = time
    lengths, own = sorted({len(parts) for parts in by_end}), []
    used: dict[tuple[str, ...], Path] = {}
    for file in files:
        ends = [end for n in lengths if (end := file.parts[-n:]) in by_end]
        if not ends:
            raise InputError(f"{path}: has no time of {file} of robot {robot}; add a row, or leave the image out")
        end = ends[-1]
        if end in used:
            raise InputError(
                f"{path}: `{'/'.join(end)}` is the end of both {used[end]} and {file}; give more of their paths"
            )
        used[end] = file
        own.append(by_end[end])
    return np.array(own)


def _times_by_name(files: Sequence[Path], pattern: str) -> Array:
    """Times in file names, by a pattern such as `frame_{ms}`."""
    unit = re.search(r"\{(s|ms|us|ns)\}", pattern)
    if unit is None:
        raise InputError(f"--time-pattern is `{pattern}`; write {{s}}, {{ms}}, {{us}} or {{ns}} where the time is")
    before, after = (re.escape(one) for one in (pattern[: unit.start()], pattern[unit.end() :]))
    shape = re.compile(before + r"([0-9]+(?:\.[0-9]+)?)" + after)
    own = []
    for file in files:
        at = shape.search(file.name)
        if at is None:
            raise InputError(f"{file}: its name is not like `{pattern}`; correct --time-pattern, or leave it out")
        own.append(float(at[1]) * UNITS[unit[1]])
    return np.array(own)


def _frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        while True:
            there, frame = capture.read()
            if not there:
                return
            yield np.asarray(frame, np.uint8)
    finally:
        capture.release()


def _video_times(path: Path, fps: float | None) -> Array:
    """Times of a video's frames, by a rate or from its container."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    stamps: list[float] = []
    try:
        if not capture.isOpened():
            raise InputError(f"{path} is neither an image nor a video that OpenCV reads; give a folder, glob or video")
        while capture.grab():
            stamps.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3)
    finally:
        capture.release()
    if not stamps:
        raise InputError(f"{path}: holds no frame; record it again")
    if fps is not None:
        return START + np.arange(len(stamps)) / fps
    own = START + np.array(stamps)
    if len(own) > 1 and (np.diff(own) <= 0).any():
        raise InputError(f"{path}: the times in its container do not ascend; give its --fps")
    return own
