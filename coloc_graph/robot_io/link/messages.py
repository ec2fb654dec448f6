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

#: Limits of what is taken: bytes of a message, marker centres in an image, places in a way.
LARGEST = 256 * 1024
MOST_MARKERS = 64
MOST_PLACES = 100
#: Letters in a text, and in the name of a session, a command, a marker.
LONGEST_TEXT = 2000
LONGEST_NAME = 64
#: Stamps [ns] are within, and numbers that count below.
FARTHEST = 2**62
HIGHEST = 2**53

M = TypeVar("M", bound=msgspec.Struct)


class WireError(ColocError):
    """A message is malformed, or says what cannot be."""


class OversizedError(WireError):
    """A message is larger than any that is sent."""


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
            uv=list(map(tuple, seen.uv[order].tolist())),
            covariance=list(map(tuple, np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=1).tolist())),
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
        if any(not (0 < a < 1e9 and 0 < c < 1e9 and a * c > b * b) for a, b, c in self.covariance):
            raise ValueError("a covariance is not positive definite")
        if any(not 0 <= flag < 16 for flag in self.flags):
            raise ValueError("a flag is none")
        _named(self.session, *self.markers)
        _counted(self.number, self.capture)
        _stamped(self.stamp)


class Wheels(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One sample of odometry, as `run.OdometrySample`; `covariance` is its upper triangle, row by row.

    `frame` names the odometry frame that `pose` is in: another one where the wheels lost count.
    """

    session: str
    number: int
    stamp: int
    frame: str = ""
    pose: tuple[float, float, float]
    covariance: tuple[float, float, float, float, float, float]

    @classmethod
    def of(cls, sample: OdometrySample, *, session: str, number: int, stamp: int, frame: str = "") -> "Wheels":
        """The message of a sample taken at `stamp`."""
        x, y, yaw = map(float, sample.pose)
        upper = sample.covariance[np.triu_indices(3)].tolist()
        return cls(session=session, number=number, stamp=stamp, frame=frame, pose=(x, y, yaw), covariance=tuple(upper))

    def sample(self, robot: str, time: float) -> OdometrySample:
        """The record that it is, at a time [UTC s]."""
        return OdometrySample(robot, time, np.array(self.pose), _symmetric(self.covariance))

    def _check(self) -> None:
        if not all(math.isfinite(v) and abs(v) < 1e6 for v in (*self.pose, *self.covariance)):
            raise ValueError("it holds a number that is no place")
        if np.linalg.eigvalsh(_symmetric(self.covariance)).min() < -1e-12:
            raise ValueError("its covariance is not positive")
        _named(self.session, self.frame)
        _counted(self.number)
        _stamped(self.stamp)


class Event(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Something that happened to a robot: `kind` is one word, `text` a sentence or what belongs to the kind."""

    session: str
    number: int
    stamp: int
    kind: str
    text: str

    def _check(self) -> None:
        _named(self.session, self.kind)
        _short(self.text)
        _counted(self.number)
        _stamped(self.stamp)


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
        _named(self.session, self.phase)
        _short(self.fault or "", self.camera_fault or "", *self.hazards)
        _counted(self.capture or 0)
        _stamped(self.stamp, self.still_since or 0)


class Capture(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Detect markers in each image, and send them as those of this capture, one attempt to measure a stance."""

    capture: int

    def _check(self) -> None:
        _counted(self.capture)


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
        _counted(self.number)


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
        _named(self.id, self.session)
        _stamped(self.deadline)


class Hold(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A session of a robot may go on moving for a moment from `sent` on [ns by the robot's clock]."""

    session: str
    sent: int

    def _check(self) -> None:
        _named(self.session)
        _stamped(self.sent)


class Reply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What came of a command; `text` says why not, or answers."""

    id: str
    ok: bool
    text: str = ""

    def _check(self) -> None:
        _named(self.id)
        _short(self.text)


class ClockQuestion(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What time is it? Asked at an instant of the coordinator's clock [ns]."""

    asked: int

    def _check(self) -> None:
        _stamped(self.asked)


class ClockReply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a question for the time came to a robot's session and when this was sent [ns]."""

    session: str
    asked: int
    received: int
    sent: int

    def _check(self) -> None:
        _named(self.session)
        _stamped(self.asked, self.received, self.sent)


def encode(message: msgspec.Struct) -> bytes:
    """A message as bytes."""
    return msgspec.msgpack.encode(message)


def decode(data: bytes, kind: type[M]) -> M:
    """The message in bytes that came from outside; `WireError` where there is none of that kind."""
    if len(data) > LARGEST:
        raise OversizedError(f"a {kind.__name__} of {len(data)} bytes is too large: {LARGEST} at most")
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


def _named(*names: str) -> None:
    if any(len(name) > LONGEST_NAME for name in names):
        raise ValueError("a name is too long")


def _counted(*numbers: int) -> None:
    if any(not 0 <= number < HIGHEST for number in numbers):
        raise ValueError("a number that counts is none")


def _stamped(*stamps: int) -> None:
    if any(abs(stamp) >= FARTHEST for stamp in stamps):
        raise ValueError("a stamp is none")
