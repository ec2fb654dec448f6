"""An emulated Create behind its line: commands, wheels and sensors, without a thread; `Firmware`."""

import struct
from collections.abc import Collection

import numpy as np

from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.odometry import WHEELS
from coloc_graph.robot_io.create.physics import Body, Physics
from coloc_graph.robot_io.create.protocol import Mode, Packet
from coloc_graph.robot_io.create.state import CLIFFS, DROPS

#: Values of packets that do not change.
CONSTANT: dict[int, int] = {Packet.VOLTAGE: 15_400, Packet.CHARGE: 2_100, Packet.CAPACITY: 2_696}
#: Packets that count, so that each frame has others.
COUNTS = (Packet.LEFT_TICKS, Packet.RIGHT_TICKS, Packet.DISTANCE, Packet.ANGLE)


class Firmware:
    """A Create that obeys bytes and reports sensors; for one thread at a time.

    Parameters
    ----------
    model
        1 or 2.
    physics
        Parameters of the body.
    encoders
        Encoder counts (left, right) at the start.
    now
        Time at the start [s].

    Attributes
    ----------
    body
        True state of the robot.
    mode
        Mode of the Open Interface.
    listed, streaming, next_frame
        Packets of the stream, True while it is sent, and the time of its next frame [s].
    """

    def __init__(self, model: int, physics: Physics, encoders: tuple[int, int], now: float) -> None:
        self.model, self._encoders = model, encoders
        self.body = Body(model, physics, now)
        self.mode = Mode.OFF
        self.cliffs, self.drops, self.docked = set[str](), set[str](), False
        self._asked_at = [0.0, 0.0]
        self._pending = b""
        self.listed: tuple[int, ...] = ()
        self.streaming, self.next_frame = False, 0.0
        self._state: tuple[object, ...] = ()
        self._values: dict[int, int | None] = {}

    def advance(self, now: float) -> None:
        """Advance the physics, and react as the robot does by itself."""
        self.body.advance(now)
        forward = max(self.body.wanted) > 0
        if self.mode == Mode.SAFE and (self.drops or self.docked or (self.cliffs and forward)):
            self.mode, self.body.wanted = Mode.PASSIVE, (0.0, 0.0)

    def frame(self, now: float) -> dict[int, int] | None:
        """Return the packets of the frame that is due; None if none is."""
        if not self.streaming or now < self.next_frame:
            return None
        late = now - self.next_frame
        self.next_frame += oi.STREAM_PERIOD * (1 + late // oi.STREAM_PERIOD)
        body = self.body
        state = (
            self.listed, self.mode, body.wanted, body.bump_left, body.bump_right, self.docked,
            frozenset(self.cliffs), frozenset(self.drops),
        )  # fmt: skip
        if state != self._state:  # most frames differ in counts alone
            self._state = state
            self._values = {packet: None if packet in COUNTS else self._value(packet) for packet in self.listed}
        return {i: self._value(i) if value is None else value for i, value in self._values.items()}

    def take(self, data: bytes, now: float) -> bytes:
        """Obey the commands in these bytes, of which the last may be cut; return the answer."""
        self.body.advance(now)
        self._pending += data
        answers = b""
        while True:
            command, self._pending = oi.split_command(self._pending)
            if command is None:
                return answers
            answers += self._obey(command, now)

    def restart(self) -> None:
        """Restart as after a flat battery: mode, stream and speed are lost."""
        self.mode, self.streaming, self.body.wanted = Mode.OFF, False, (0.0, 0.0)

    def _obey(self, command: bytes, now: float) -> bytes:
        op = command[0]
        if op == oi.START:
            self._enter(Mode.PASSIVE)
        elif op in (oi.RESET, oi.STOP_INTERFACE) and self.model == 2:
            self._enter(Mode.OFF)
            self.streaming = False
        elif self.mode == Mode.OFF:
            return b""
        elif op == oi.POWER and self.model == 2:
            self._enter(Mode.PASSIVE)
        elif op in (oi.SAFE, oi.FULL):
            self.mode = Mode.SAFE if op == oi.SAFE else Mode.FULL
        elif op == oi.DRIVE_DIRECT and self.mode >= Mode.SAFE:
            right, left = struct.unpack(">hh", command[1:])
            self._drive(left, right)
        elif op == oi.DRIVE and self.mode >= Mode.SAFE:
            speed, radius = struct.unpack(">hh", command[1:])
            self._drive(*_of_radius(speed, radius, WHEELS[self.model].base * 1e3))
        elif op in (oi.SENSORS, oi.QUERY_LIST):
            asked = self._known(command[1:] if op == oi.SENSORS else command[2:])
            return b"".join(oi.encode_value(i, self._value(i)) for i in asked)
        elif op == oi.STREAM:
            self.listed = self._known(command[2:])
            self.streaming, self.next_frame = bool(self.listed), now
        elif op == oi.PAUSE_RESUME:
            self.streaming = bool(command[1]) and bool(self.listed)
        return b""

    def _enter(self, mode: Mode) -> None:
        self.mode, self.body.wanted = mode, (0.0, 0.0)

    def _known(self, packets: bytes) -> tuple[int, ...]:
        known = [i for i in packets if i in oi.PACKETS or i in oi.GROUPS]
        return tuple(i for i in oi.expand(known) if i <= oi.LAST_PACKET[self.model])

    def _drive(self, left: int, right: int) -> None:
        top = oi.MAX_WHEEL_SPEED
        self.body.wanted = (max(-top, min(top, left)) / 1e3, max(-top, min(top, right)) / 1e3)

    def _value(self, packet: int) -> int:
        body = self.body
        if packet == Packet.BUMPS_DROPS:
            bumps = body.bump_left * oi.BumpDrop.BUMP_LEFT | body.bump_right * oi.BumpDrop.BUMP_RIGHT
            return int(bumps | sum(bit for bit, where in DROPS.items() if where in self.drops))
        if packet in CLIFFS:
            return int(CLIFFS[Packet(packet)] in self.cliffs)
        if packet in (Packet.LEFT_TICKS, Packet.RIGHT_TICKS):
            i = packet - Packet.LEFT_TICKS
            return self._encoders[i] + int(body.counted[i] // WHEELS[2].metres)
        if packet in (Packet.DISTANCE, Packet.ANGLE):
            # whole units since it was last asked; the remainder is lost, as on the real one
            left, right = body.counted
            i = packet - Packet.DISTANCE
            counted = ((left + right) / 2 * 1e3, np.degrees((right - left) / body.base))[i]
            whole = int(counted - self._asked_at[i])
            self._asked_at[i] = counted
            return whole
        match packet:
            case Packet.MODE:
                return int(self.mode)
            case Packet.CHARGERS | Packet.CHARGING_STATE:
                return 2 * self.docked
            case Packet.REQUESTED_LEFT | Packet.REQUESTED_RIGHT:
                return round(body.wanted[packet == Packet.REQUESTED_RIGHT] * 1e3)
            case 38:
                return len(self.listed)
        return CONSTANT.get(packet, 0)


def mark(marked: set[str], known: Collection[str], where: str, there: bool) -> None:
    """Add a sensor to those that are `marked`, or remove it. Raises `ValueError` if it is not `known`."""
    if where not in known:
        raise ValueError(f'"{where}" is none of {", ".join(known)}')
    (marked.add if there else marked.discard)(where)


def _of_radius(speed: int, radius: int, base: float) -> tuple[int, int]:
    """Wheel speeds (left, right) [mm/s] of the drive command 137: radius [mm], -1 and 1 spin, 0x8000 is straight."""
    if radius in (-0x8000, 0x7FFF):
        return speed, speed
    if abs(radius) == 1:
        return -speed * radius, speed * radius
    share = base / 2 / radius if radius else 0.0
    return round(speed * (1 - share)), round(speed * (1 + share))
