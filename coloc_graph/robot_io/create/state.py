"""Sensor data of a Create in words and SI units; `CreateState`."""

from collections.abc import Mapping
from functools import cache

import msgspec

from coloc_graph.robot_io.create.protocol import BumpDrop, Mode, Packet

#: Positions of cliffs, dropped wheels and bumps.
CLIFFS = {
    Packet.CLIFF_LEFT: "left",
    Packet.CLIFF_FRONT_LEFT: "front left",
    Packet.CLIFF_FRONT_RIGHT: "front right",
    Packet.CLIFF_RIGHT: "right",
}
DROPS = {BumpDrop.DROP_LEFT: "left", BumpDrop.DROP_RIGHT: "right", BumpDrop.DROP_CASTER: "caster"}
_BUMPS = {BumpDrop.BUMP_LEFT: "left", BumpDrop.BUMP_RIGHT: "right"}

#: Packets of the stream of each model; a Create 1 is asked for `DELTAS` only every `DELTA_PERIOD`.
DELTAS = (Packet.DISTANCE, Packet.ANGLE)
_COMMON = (
    Packet.BUMPS_DROPS, *CLIFFS, Packet.CHARGERS, Packet.MODE, Packet.CHARGING_STATE, Packet.VOLTAGE, Packet.CHARGE,
    Packet.CAPACITY, Packet.REQUESTED_LEFT, Packet.REQUESTED_RIGHT,
)  # fmt: skip
STREAMED: dict[int, tuple[Packet, ...]] = {1: _COMMON, 2: (*_COMMON, Packet.LEFT_TICKS, Packet.RIGHT_TICKS)}

#: Hazards that a driver may be told to stop on.
HAZARDS = ("bump", "cliff", "wheel_drop", "charger")


class CreateState(msgspec.Struct, frozen=True):
    """Sensor data of one frame.

    Attributes
    ----------
    time
        Time of the frame [UTC s].
    mode
        Mode of the Open Interface.
    bumps, cliffs, wheel_drops
        Their positions: "left", "front right", "caster" and so on.
    charger
        "home base", "internal" or None.
    charging
        True while the battery charges.
    voltage
        Battery voltage [V].
    charge, capacity
        Charge and capacity of the battery [Ah].
    requested
        Speeds (left, right) of the last command that the robot took [m/s].
    ticks
        Encoder counts (left, right), None on a Create 1.
    """

    time: float
    mode: Mode
    bumps: frozenset[str]
    cliffs: frozenset[str]
    wheel_drops: frozenset[str]
    charger: str | None
    charging: bool
    voltage: float
    charge: float
    capacity: float
    requested: tuple[float, float]
    ticks: tuple[int, int] | None

    def hazards(self) -> dict[str, str]:
        """Present hazards: a description of each, by its name in `HAZARDS`."""
        words = {
            "bump": self.bumps and f"a bump on the {' and '.join(sorted(self.bumps))}",
            "cliff": self.cliffs and f"a cliff at the {' and '.join(sorted(self.cliffs))}",
            "wheel_drop": self.wheel_drops and f"a dropped wheel ({' and '.join(sorted(self.wheel_drops))})",
            "charger": self.charger and f"the charger ({self.charger})",
        }
        return {name: str(said) for name, said in words.items() if said}


def read_state(values: Mapping[int, int], time: float) -> CreateState:
    """Read the state from the packets of a frame at `time` [UTC s]. Raises `ValueError` for an unknown mode."""
    chargers = values[Packet.CHARGERS]
    bumps, drops = _pressed(values[Packet.BUMPS_DROPS])
    ticks = (values[Packet.LEFT_TICKS], values[Packet.RIGHT_TICKS]) if Packet.LEFT_TICKS in values else None
    return CreateState(
        time,
        Mode(values[Packet.MODE]),
        bumps,
        frozenset([where for packet, where in CLIFFS.items() if values[packet]]),
        drops,
        "home base" if chargers & 2 else "internal" if chargers & 1 else None,
        values[Packet.CHARGING_STATE] in (1, 2, 3),
        values[Packet.VOLTAGE] * 1e-3,
        values[Packet.CHARGE] * 1e-3,
        values[Packet.CAPACITY] * 1e-3,
        (values[Packet.REQUESTED_LEFT] * 1e-3, values[Packet.REQUESTED_RIGHT] * 1e-3),
        ticks,
    )


@cache
def _pressed(bits: int) -> tuple[frozenset[str], frozenset[str]]:
    """Positions of bumps and of dropped wheels from packet 7."""
    bumps, drops = (frozenset(where for bit, where in known.items() if bits & bit) for known in (_BUMPS, DROPS))
    return bumps, drops
