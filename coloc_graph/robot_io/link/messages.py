"""Messages between robots and the coordinator: their kinds, `encode` and `decode`.

Messages are encoded as MessagePack and checked completely when they are decoded; `MessageError` says what is wrong.
Stamps are nanoseconds of the sending robot's monotonic clock unless stated otherwise.
"""

import math
import re
from typing import Any, TypeVar

import msgspec
import numpy as np

from coloc_graph.errors import ColocError
from coloc_graph.run import Detections, OdometrySample

MAX_MESSAGE_BYTES = 256 * 1024  # bytes of an encoded message
MAX_MARKERS = 64  # marker centres in one image
MAX_WAYPOINTS = 100  # waypoints of one drive
MAX_TEXT_LENGTH = 2000  # characters of a text
MAX_NAME_LENGTH = 64  # characters of the name of a session, command or marker
MAX_STAMP = 2**62  # ns, bound of a time stamp's magnitude
MAX_COUNT = 2**53  # bound of numbers that count
MAX_COORDINATE = 1e6  # m, rad, bound of a coordinate's magnitude
MAX_DRIVE_SPEED = 0.5  # m/s

SESSION = re.compile(f"[A-Za-z0-9_-]{{1,{MAX_NAME_LENGTH}}}")

M = TypeVar("M", bound=msgspec.Struct)


class MessageError(ColocError):
    """A message is malformed or contradicts itself."""


class OversizedError(MessageError):
    """A message is larger than any valid one."""


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    def _check(self) -> None:
        """Raise ValueError if a field is out of range or fields contradict each other."""


class Sample(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Marker centres in one image of a robot's camera, as in `run.Detections`.

    Attributes
    ----------
    session
        Run of the robot's program.
    number
        Count of the session's samples before this one.
    capture
        Number of the capture that the image belongs to.
    stamp
        Time of exposure [ns].
    uv
        Marker centres [px].
    covariance
        Their covariances (uu, uv, vv) [px^2].
    markers, flags, peak, area
        As in `run.Detections`, one each.
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
        """Message of detections at `stamp` [ns]; it holds the `MAX_MARKERS` brightest of them."""
        order = np.argsort(-seen.peak, kind="stable")[:MAX_MARKERS]
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
        """Record of this message, at a time [UTC s]."""
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
        if n > MAX_MARKERS or any(len(one) != n for one in (self.covariance, self.markers, self.flags, self.peak,
                                                             self.area)):  # fmt: skip
            raise ValueError(f"its lists differ in length or hold more than {MAX_MARKERS} markers")
        if not all(map(math.isfinite, (v for row in (*self.uv, *self.covariance, self.peak, self.area) for v in row))):
            raise ValueError("a number is not finite")
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
    """One sample of wheel odometry, as in `run.OdometrySample`.

    Attributes
    ----------
    session
        Run of the robot's program.
    number
        Count of the session's odometry messages before this one.
    stamp
        Time of the sample [ns].
    frame
        Name of the odometry frame of `pose`; it changes when the encoders lose count.
    pose
        x [m], y [m], yaw [rad].
    covariance
        Upper triangle of the covariance of (x, y, yaw), row by row.
    """

    session: str
    number: int
    stamp: int
    frame: str = ""
    pose: tuple[float, float, float]
    covariance: tuple[float, float, float, float, float, float]

    @classmethod
    def of(cls, sample: OdometrySample, *, session: str, number: int, stamp: int, frame: str = "") -> "Wheels":
        """Message of a sample taken at `stamp` [ns]."""
        x, y, yaw = map(float, sample.pose)
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = sample.covariance.tolist()
        upper = xx, xy, xt, yy, yt, tt
        return cls(session=session, number=number, stamp=stamp, frame=frame, pose=(x, y, yaw), covariance=upper)

    def sample(self, robot: str, time: float) -> OdometrySample:
        """Record of this message, at a time [UTC s]."""
        return OdometrySample(robot, time, np.array(self.pose), _symmetric(self.covariance))

    def _check(self) -> None:
        if not all(math.isfinite(v) and abs(v) < MAX_COORDINATE for v in (*self.pose, *self.covariance)):
            raise ValueError(f"a coordinate is not finite or beyond {MAX_COORDINATE:g}")
        if np.linalg.eigvalsh(_symmetric(self.covariance)).min() < -1e-12:
            raise ValueError("its covariance is not positive semi-definite")
        _named(self.session, self.frame)
        _counted(self.number)
        _stamped(self.stamp)


class Event(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An event of a robot.

    Parameters
    ----------
    session : str
        Session of its program.
    number : int
        Number of the event in the session, from 0.
    stamp : int
        Time [ns, robot's clock].
    kind : str
        One word.
    text : str
        A sentence, or the kind's value.
    """

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
    """State of a robot, sent ten times a second.

    Parameters
    ----------
    session : str
        Session of its program, another one after each start.
    stamp : int
        Time [ns, robot's clock].
    phase : str
        Name of its present activity.
    capture : int or None
        Number of the capture under way.
    moving : bool
        It has a motion to carry out, or its wheels turn.
    still_since : int or None
        Time since which it has stood [ns, robot's clock].
    fault, camera_fault : str or None
        Reasons for which it does not drive, or has no images.
    hazards : list of str
        Descriptions of present hazards.
    """

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
            raise ValueError("it lists more than 16 hazards")
        _named(self.session, self.phase)
        _short(self.fault or "", self.camera_fault or "", *self.hazards)
        _counted(self.capture or 0)
        _stamped(self.stamp, self.still_since or 0)


class Capture(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Detect markers in each image and send them under this capture's number, until `EndCapture`."""

    capture: int

    def _check(self) -> None:
        _counted(self.capture)


class EndCapture(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """End the capture; the answer is the number of samples that were sent."""


class Drive(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Drive through waypoints, then turn.

    Attributes
    ----------
    number
        Number that comes back in the event "arrived".
    places
        Waypoints (x, y) [m] in the robot's odometry frame.
    yaw
        Heading at the end [rad], None for any.
    speed
        Speed [m/s].
    backwards
        Allow driving backwards where that means less turning.
    """

    number: int
    places: list[tuple[float, float]]
    yaw: float | None
    speed: float
    backwards: bool = True

    def _check(self) -> None:
        numbers = [v for place in self.places for v in place] + [self.yaw or 0.0]
        if len(self.places) > MAX_WAYPOINTS or not all(math.isfinite(v) and abs(v) < MAX_COORDINATE for v in numbers):
            raise ValueError(f"it has more than {MAX_WAYPOINTS} waypoints, or a coordinate beyond {MAX_COORDINATE:g}")
        if not 0 < self.speed <= MAX_DRIVE_SPEED:
            raise ValueError(f"its speed is {self.speed} m/s, not above 0 and at most {MAX_DRIVE_SPEED} m/s")
        _counted(self.number)


class Halt(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Stop the wheels."""


class Recover(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True, tag=True):
    """Permit driving again after a fault."""


Body = Capture | EndCapture | Drive | Halt | Recover


class Command(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A command for one session of a robot, carried out once an `id` and not after `deadline` [ns, robot's clock]."""

    id: str
    session: str
    deadline: int
    body: Body

    def _check(self) -> None:
        self.body._check()
        _named(self.id, self.session)
        _stamped(self.deadline)


class Hold(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Permission for a session of a robot to go on moving for a moment from `sent` on [ns, robot's clock]."""

    session: str
    sent: int

    def _check(self) -> None:
        _named(self.session)
        _stamped(self.sent)


class Reply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Outcome of a command; `text` is the answer, or the reason for a refusal."""

    id: str
    ok: bool
    text: str = ""

    def _check(self) -> None:
        _named(self.id)
        _short(self.text)


class ClockQuestion(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Request for the time, sent at `asked` [ns, coordinator's clock]."""

    asked: int

    def _check(self) -> None:
        _stamped(self.asked)


class ClockReply(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Times at which a robot received a request for the time and answered it [ns, robot's clock]."""

    session: str
    asked: int
    received: int
    sent: int

    def _check(self) -> None:
        if not is_session(self.session):
            raise ValueError("its session is not a name of letters, digits, - and _")
        _stamped(self.asked, self.received, self.sent)


class Refusal(_Message, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Order for one session of a robot to end, since another program runs under its name; `text` says so."""

    session: str
    text: str

    def _check(self) -> None:
        _named(self.session)
        _short(self.text)


def is_session(name: str) -> bool:
    """Return whether a name can be that of a session: it is a part of zenoh keys."""
    return SESSION.fullmatch(name) is not None


def encode(message: msgspec.Struct) -> bytes:
    """Encode a message as MessagePack."""
    return msgspec.msgpack.encode(message)


def decode(data: bytes, kind: type[M]) -> M:
    """Decode and check a message of one kind.

    Raises
    ------
    MessageError
        If the bytes are not a valid message of this kind; `OversizedError` if there are too many.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise OversizedError(f"a {kind.__name__} of {len(data)} bytes is larger than {MAX_MESSAGE_BYTES} bytes")
    try:
        message = msgspec.msgpack.decode(data, type=kind)
        if isinstance(message, _Message):
            message._check()
    except (ValueError, OverflowError, RecursionError, msgspec.MsgspecError) as error:
        raise MessageError(f"not a valid {kind.__name__}: {error}") from error
    return message


def _symmetric(upper: tuple[float, ...]) -> "np.ndarray[Any, np.dtype[np.float64]]":
    xx, xy, xt, yy, yt, tt = upper
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def _short(*texts: str) -> None:
    for text in texts:
        if len(text) > MAX_TEXT_LENGTH:
            raise ValueError(f"a text has more than {MAX_TEXT_LENGTH} characters")


def _named(*names: str) -> None:
    for name in names:
        if len(name) > MAX_NAME_LENGTH:
            raise ValueError(f"a name has more than {MAX_NAME_LENGTH} characters")


def _counted(*numbers: int) -> None:
    for number in numbers:
        if not 0 <= number < MAX_COUNT:
            raise ValueError("a count is negative or too large")


def _stamped(*stamps: int) -> None:
    for stamp in stamps:
        if abs(stamp) >= MAX_STAMP:
            raise ValueError("a time stamp is out of range")
