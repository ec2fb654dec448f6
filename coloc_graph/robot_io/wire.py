"""What passes between robots and the coordinator: `encode`, `decode`, and the kinds of messages.

Messages are MessagePack. Whatever comes in is checked here once, completely; `WireError` says what is wrong.
Stamps are nanoseconds of the monotonic clock of the robot that sends, unless said otherwise.
"""

import math
from typing import Any, TypeVar

import msgspec
import numpy as np

from coloc_graph.errors import ColocError
from coloc_graph.run import Detections, OdometrySample

#: Limits of what is taken: bytes of a message, marker centres in an image, places in a way, letters in a text.
LARGEST, MOST_MARKERS, MOST_PLACES, LONGEST_TEXT = 256 * 1024, 64, 100, 2000

M = TypeVar("M", bound=msgspec.Struct)


class WireError(ColocError):
    """A message is malformed, oversized, or says what cannot be."""


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    def _check(self) -> None:
        """Raise ValueError where its fields contradict each other."""


class Sample(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The marker centres in one image of a robot's camera, as `run.Detections`; `covariance` is (uu, uv, vv) [px^2].

    `number` counts all samples of a session from 0, `capture` is the one that the image belongs to.
    """

    session: str
    number: int
    capture: int
    stamp: int
    uv: list[tuple[float, float]]
    covariance: list[tuple[float, float, float]]
    markers: list[str]
    flags: list[int]
    peak: list[float]
    area: list[float]

    @classmethod
    def of(cls, seen: Detections, *, session: str, number: int, capture: int, stamp: int) -> "Sample":
        """The message of what was detected at `stamp`; of more centres than it can hold the brightest."""
        order = np.argsort(-seen.peak, kind="stable")[:MOST_MARKERS]
        C = seen.covariance[order]
        return cls(
            session=session,
            number=number,
            capture=capture,
            stamp=stamp,
            uv=seen.uv[order].tolist(),
            covariance=np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=1).tolist(),
            markers=[seen.markers[n] for n in order],
            flags=seen.flags[order].tolist(),
            peak=seen.peak[order].tolist(),
            area=seen.area[order].tolist(),
        )

    def detections(self, robot: str, time: float) -> Detections:
        """The record that it is, at a time [UTC s]."""
        n = len(self.uv)
        uu, uv, vv = np.array(self.covariance, float).reshape(n, 3).T
        return Detections(
            robot,
            time,
            np.array(self.uv, float).reshape(n, 2),
            np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-2),
            tuple(self.markers),
            np.array(self.flags, np.uint8),
            np.array(self.peak, float),
            np.array(self.area, float),
        )

    def _check(self) -> None:
        n = len(self.uv)
        if n > MOST_MARKERS or any(len(one) != n for one in (self.covariance, self.markers, self.flags, self.peak,
                                                             self.area)):  # fmt: skip
            raise ValueError("its lists differ in length, or hold too many markers")
        if not all(map(math.isfinite, (v for row in (*self.uv, *self.covariance, self.peak, self.area) for v in row))):
            raise ValueError("it holds a number that is not finite")
        if any(abs(u) > 1e5 or abs(v) > 1e5 for u, v in self.uv):
            raise ValueError("a marker is far outside any image")
        if any(not (a > 0 and c > 0 and a * c > b * b) for a, b, c in self.covariance):
            raise ValueError("a covariance is not positive definite")
        if any(not 0 <= flag < 16 for flag in self.flags) or any(len(marker) > 64 for marker in self.markers):
            raise ValueError("a flag or a marker's name is none")
        _counted(self.number, self.capture)


class Wheels(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One sample of odometry, as `run.OdometrySample`; `covariance` is its upper triangle, row by row."""

    session: str
    number: int
    stamp: int
    pose: tuple[float, float, float]
    covariance: tuple[float, float, float, float, float, float]

    @classmethod
    def of(cls, sample: OdometrySample, *, session: str, number: int, stamp: int) -> "Wheels":
        """The message of a sample taken at `stamp`."""
        x, y, yaw = map(float, sample.pose)
        upper = sample.covariance[np.triu_indices(3)].tolist()
        return cls(session=session, number=number, stamp=stamp, pose=(x, y, yaw), covariance=tuple(upper))

    def sample(self, robot: str, time: float) -> OdometrySample:
        """The record that it is, at a time [UTC s]."""
        return OdometrySample(robot, time, np.array(self.pose), _symmetric(self.covariance))

    def _check(self) -> None:
        if not all(map(math.isfinite, (*self.pose, *self.covariance))) or max(map(abs, self.pose)) > 1e6:
            raise ValueError("it holds a number that is no place")
        if np.linalg.eigvalsh(_symmetric(self.covariance)).min() < -1e-12:
            raise ValueError("its covariance is not positive")
        _counted(self.number)


class Event(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Something that happened to a robot: `kind` is one word, `text` a sentence or what belongs to the kind."""

    session: str
    number: int
    stamp: int
    kind: str
    text: str

    def _check(self) -> None:
        _short(self.kind, self.text)
        _counted(self.number)


class Status(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a robot is, ten times a second. `session` changes when its program begins anew."""

    session: str
    stamp: int
    phase: str
    capture: int | None
    moving: bool
    still_since: int | None
    fault: str | None
    camera_fault: str | None
    hazards: list[str]

    def _check(self) -> None:
        if len(self.hazards) > 16:
            raise ValueError("it has too many hazards")
        _short(self.phase, self.fault or "", self.camera_fault or "", *self.hazards)


class Capture(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Detect markers in each image, and send them as those of this capture, one attempt to measure a stance."""

    capture: int


class EndCapture(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Enough; how many samples were sent is answered."""


class Drive(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Drive through places (x, y) [m] of your odometry frame at a speed [m/s], then turn to `yaw` [rad], if there is
    one; `number` comes back in the event "arrived".
    """

    number: int
    places: list[tuple[float, float]]
    yaw: float | None
    speed: float
    backwards: bool = True

    def _check(self) -> None:
        numbers = [v for place in self.places for v in place] + [self.yaw or 0.0]
        if len(self.places) > MOST_PLACES or not all(math.isfinite(v) and abs(v) < 1e6 for v in numbers):
            raise ValueError("its places are too many, or none")
        if not 0 < self.speed <= 0.5:
            raise ValueError(f"its speed is {self.speed} m/s")


class Halt(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Stop."""


class Recover(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Whatever you stopped for: you may drive again."""


Body = Capture | EndCapture | Drive | Halt | Recover


class Command(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A command for one session of a robot: not after `deadline` [ns by the robot's clock], and once for each `id`."""

    id: str
    session: str
    deadline: int
    body: Body

    def _check(self) -> None:
        self.body._check()
        if len(self.id) > 64:
            raise ValueError("its id is too long")


class Reply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What came of a command; `text` says why not, or answers."""

    id: str
    ok: bool
    text: str = ""

    def _check(self) -> None:
        _short(self.id, self.text)


class ClockReply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a question for the time came and when this was sent [ns]; `asked` is the stamp of the question."""

    asked: int
    received: int
    sent: int


def encode(message: msgspec.Struct) -> bytes:
    """A message as bytes."""
    return msgspec.msgpack.encode(message)


def decode(data: bytes, kind: type[M]) -> M:
    """The message in bytes that came from outside; `WireError` where there is none of that kind."""
    if len(data) > LARGEST:
        raise WireError(f"a {kind.__name__} of {len(data)} bytes is too large: {LARGEST} at most")
    try:
        message = msgspec.msgpack.decode(data, type=kind)
        if isinstance(message, _Message):
            message._check()
    except (ValueError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise WireError(f"what came is no {kind.__name__}: {error}") from error
    return message


def _symmetric(upper: tuple[float, ...]) -> "np.ndarray[Any, np.dtype[np.float64]]":
    C = np.zeros((3, 3))
    C[np.triu_indices(3)] = upper
    return np.triu(C) + np.triu(C, 1).T


def _short(*texts: str) -> None:
    if any(len(text) > LONGEST_TEXT for text in texts):
        raise ValueError("a text is too long")


def _counted(*numbers: int) -> None:
    if any(not 0 <= number < 2**53 for number in numbers):
        raise ValueError("a number that counts is none")
