"""Open Interface of the iRobot Create 1 and 2: commands, sensor packets, stream decoder; no I/O.

Source: "iRobot Create Open Interface" (Create 1, 2006) and "iRobot Create 2 Open Interface specification" (2015).
Integers are big-endian; speeds are in mm/s.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

START = 128
SAFE = 131
FULL = 132
SENSORS = 142
QUERY_LIST = 149
STREAM = 148
PAUSE_RESUME = 150
DRIVE = 137
DRIVE_DIRECT = 145
POWER = 133
STOP_INTERFACE = 173
RESET = 7

HEADER = 19  # first byte of a stream frame
STREAM_PERIOD = 0.015  # s between two stream frames
MAX_WHEEL_SPEED = 500  # mm/s, bound of a wheel's speed

#: Number of bytes that follow an opcode, for both models; 0 if it is not listed. Lists are in `split_command`.
ARGUMENTS = {
    129: 1, 136: 1, 137: 4, 138: 1, 139: 3, 141: 1, 142: 1, 144: 3, 145: 4, 146: 4, 147: 1, 150: 1, 151: 1, 155: 1,
    156: 2, 157: 2, 158: 1, 162: 2, 163: 4, 164: 4, 165: 1, 167: 15, 168: 3,
}  # fmt: skip


class Mode(IntEnum):
    """Mode of the Open Interface (packet 35); the wheels can be driven in safe and full mode."""

    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


class Packet(IntEnum):
    """Sensor packets that this package uses."""

    BUMPS_DROPS = 7
    CLIFF_LEFT = 9
    CLIFF_FRONT_LEFT = 10
    CLIFF_FRONT_RIGHT = 11
    CLIFF_RIGHT = 12
    DISTANCE = 19
    ANGLE = 20
    CHARGING_STATE = 21
    VOLTAGE = 22
    CHARGE = 25
    CAPACITY = 26
    CHARGERS = 34
    MODE = 35
    REQUESTED_RIGHT = 41
    REQUESTED_LEFT = 42
    LEFT_TICKS = 43
    RIGHT_TICKS = 44


class BumpDrop(IntFlag):
    """The bits of packet 7."""

    BUMP_RIGHT = 1
    BUMP_LEFT = 2
    DROP_RIGHT = 4
    DROP_LEFT = 8
    DROP_CASTER = 16  # Create 1 only


@dataclass(frozen=True)
class Layout:
    """Layout of a packet: `size` [bytes], and `signed` for a signed integer."""

    size: int
    signed: bool = False


_BYTE = Layout(1)
_WORD = Layout(2)
_SIGNED_WORD = Layout(2, signed=True)

#: Single packets of both models. Encoder counts (43, 44) wrap at 65536 and are read as unsigned.
PACKETS: dict[int, Layout] = (
    dict.fromkeys((*range(7, 19), 21, 32, 34, 35, 36, 37, 38, 45, 52, 53, 58), _BYTE)
    | dict.fromkeys((22, 25, 26, *range(27, 32), 33, 43, 44, *range(46, 52)), _WORD)
    | dict.fromkeys((19, 20, 23, 39, 40, 41, 42, 54, 55, 56, 57), _SIGNED_WORD)
    | {24: Layout(1, signed=True)}
)

#: Group packets: the first and last packet of each; a Create 1 knows 0 to 6 only.
GROUPS: dict[int, tuple[int, int]] = {
    0: (7, 26), 1: (7, 16), 2: (17, 20), 3: (21, 26), 4: (27, 34), 5: (35, 42), 6: (7, 42),
    100: (7, 58), 101: (43, 58), 106: (46, 51), 107: (54, 58),
}  # fmt: skip

#: Number of the last single packet of each model.
LAST_PACKET = {1: 42, 2: 58}


def drive_direct(right: int, left: int) -> bytes:
    """Command that sets the speeds of both wheels [mm/s], right first. Raises `ValueError` beyond +-500."""
    if not max(abs(right), abs(left)) <= MAX_WHEEL_SPEED:
        raise ValueError(f"wheel speeds are within +-{MAX_WHEEL_SPEED} mm/s, not {right} and {left}")
    return struct.pack(">Bhh", DRIVE_DIRECT, right, left)


#: Command that stops both wheels; the mode stays as it is.
HALT = drive_direct(0, 0)


def stream(packets: Sequence[int]) -> bytes:
    """Command that starts a stream of these packets, in this order; it replaces an earlier stream."""
    return bytes([STREAM, len(packets), *packets])


def pause_stream() -> bytes:
    """Command that pauses the stream until `resume_stream` or another `stream`."""
    return bytes([PAUSE_RESUME, 0])


def resume_stream() -> bytes:
    """Command that resumes the stream."""
    return bytes([PAUSE_RESUME, 1])


def query(packets: Sequence[int]) -> bytes:
    """Command that requests these packets once; `decode_values` reads the answer, their bare values."""
    return bytes([SENSORS, packets[0]]) if len(packets) == 1 else bytes([QUERY_LIST, len(packets), *packets])


def expand(packets: Sequence[int]) -> tuple[int, ...]:
    """Replace groups by their packets. Raises `KeyError` for an unknown packet."""
    singles: list[int] = []
    for one in packets:
        first, last = GROUPS.get(one, (one, one))
        singles += [i for i in range(first, last + 1) if i in PACKETS]
        if one not in PACKETS and one not in GROUPS:
            raise KeyError(one)
    return tuple(singles)


def decode_values(packets: Sequence[int], data: bytes) -> dict[int, int]:
    """Decode values of single packets, one after the other. Raises `ValueError` if the length differs."""
    if len(data) != sum(PACKETS[i].size for i in packets):
        raise ValueError(f"{len(data)} bytes are not the packets {list(packets)}")
    values, at = {}, 0
    for i in packets:
        size, signed = PACKETS[i].size, PACKETS[i].signed
        values[i] = int.from_bytes(data[at : at + size], "big", signed=signed)
        at += size
    return values


def encode_value(packet: int, value: int) -> bytes:
    """Encode a packet's value as the robot sends it: an unsigned value wraps, a signed one is clipped."""
    size, signed = PACKETS[packet].size, PACKETS[packet].signed
    top = 1 << (8 * size)
    value = max(-top // 2, min(top // 2 - 1, value)) if signed else value % top
    return value.to_bytes(size, "big", signed=signed)


def encode_frame(values: Mapping[int, int], *, header_counts: bool) -> bytes:
    """Encode a stream frame `[19][n][id value ...][checksum]`; the checksum includes the 19 on a Create 2 only."""
    body = b"".join(bytes([i]) + encode_value(i, value) for i, value in values.items())
    frame = bytes([HEADER, len(body)]) + body
    return frame + bytes([-sum(frame if header_counts else frame[1:]) & 0xFF])


def split_command(buffer: bytes) -> tuple[bytes | None, bytes]:
    """Split the first complete command from a buffer; (None, buffer) if there is none."""
    if not buffer:
        return None, buffer
    length = 1 + ARGUMENTS.get(buffer[0], 0)
    if buffer[0] in (STREAM, QUERY_LIST, 152):  # a count, then as many
        length = 2 + buffer[1] if len(buffer) > 1 else 2
    elif buffer[0] == 140:  # a song: number, count, two bytes a note
        length = 3 + 2 * buffer[2] if len(buffer) > 2 else 3
    return (buffer[:length], buffer[length:]) if len(buffer) >= length else (None, buffer)


class StreamDecoder:
    """Decoder of stream frames from bytes in any pieces; it resynchronises after damaged bytes.

    Parameters
    ----------
    layouts
        Lists of single packets that were requested; frames of other lists are invalid.

    Attributes
    ----------
    header_counts
        True if the checksum includes the header, None until two frames in a row agree on it.
    good, bad
        Counts of valid frames, and of damaged ones: stretches of invalid bytes, in lengths of the longest frame.
    """

    def __init__(self, *layouts: Sequence[int]) -> None:
        self._layouts = {sum(1 + PACKETS[i].size for i in one): (tuple(one), _struct(one)) for one in layouts}
        self._longest = max(self._layouts) + 3
        self._buffer = bytearray()
        self._stretch = 0
        self._last: bool | None = None
        self.header_counts: bool | None = None
        self.good = 0
        self.bad = 0

    def feed(self, data: bytes) -> list[dict[int, int]]:
        """Return the frames that these bytes complete, each as packet -> value, in order."""
        self._buffer += data
        frames = []
        while self._buffer:
            length = self._length()
            if length is None:
                break
            frame = self._read(bytes(self._buffer[:length])) if length else None
            if frame is None:
                self._skip()
            else:
                frames.append(frame)
                self.good += 1
                self._stretch = 0
                del self._buffer[:length]
        return frames

    def _length(self) -> int | None:
        """Length of the frame at the buffer's start; 0 if there can be none, None while it is incomplete."""
        if self._buffer[0] != HEADER or (len(self._buffer) > 1 and self._buffer[1] not in self._layouts):
            return 0
        if len(self._buffer) < 2 or len(self._buffer) < self._buffer[1] + 3:
            return None
        return self._buffer[1] + 3

    def _skip(self) -> None:
        """Skip one byte that begins no frame."""
        del self._buffer[0]
        self.bad += self._stretch % self._longest == 0
        self._stretch += 1

    def _read(self, frame: bytes) -> dict[int, int] | None:
        with_header, without = sum(frame) & 0xFF == 0, sum(frame[1:]) & 0xFF == 0
        if not (with_header or without) or self.header_counts not in (None, with_header):
            return None
        packets, layout = self._layouts[frame[1]]
        read = layout.unpack(frame[2:-1])
        if read[::2] != packets:
            return None
        if self.header_counts is None and self._last == with_header:
            self.header_counts = with_header
        self._last = with_header
        return dict(zip(packets, read[1::2], strict=True))


def _struct(packets: Sequence[int]) -> struct.Struct:
    """Binary format of a frame's body: each packet's number, then its value."""
    kinds = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h"}
    return struct.Struct(">" + "".join("B" + kinds[PACKETS[i].size, PACKETS[i].signed] for i in packets))
