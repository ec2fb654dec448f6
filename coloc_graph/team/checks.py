"""Checks of numbers that the parts of a team have in common."""

import math
from collections.abc import Iterable

import msgspec


def require_finite(owner: msgspec.Struct) -> None:
    """Raise ValueError, naming the field, for a number that is not finite."""
    for name, value in msgspec.structs.asdict(owner).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"`{name}` is {value}; give a finite number")


def require_not_negative(owner: msgspec.Struct, names: Iterable[str]) -> None:
    """Raise ValueError, naming the field, for a number below 0."""
    for name in names:
        if getattr(owner, name) < 0:
            raise ValueError(f"`{name}` is {getattr(owner, name)}; give a number that is not negative")
