"""Lights that blink: which of a team's robots' are on when, by clocks of their own; and codes for many robots."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from coloc_graph.simulation.paths import Array
from coloc_graph.team import Blink, Team

#: One standard deviation of how wrong a robot's own clock goes, as a share: that of a ceramic resonator.
CLOCK_SIGMA = 1e-3
MIN_ZERO_DISTANCE = 3  # bits, least distance between two zeros of a code


@dataclass(frozen=True)
class Blinking:
    """A robot's lights: their code began `began` [s] before time 0, by a clock that is `fast` by this share."""

    blink: Blink
    began: float
    fast: float

    def on(self, times: Array) -> NDArray[np.bool_]:
        """At which of some instants (n,) [s] they are on."""
        code = np.array([bit == "1" for bit in self.blink.code])
        bits = np.floor((times + self.began) * (1 + self.fast) / self.blink.bit)
        return np.asarray(code[bits.astype(np.int64) % len(code)])


def blinking(team: Team, rng: np.random.Generator) -> Mapping[str, Blinking]:
    """Blinking of the robots of a team that have a code."""
    drawn = {one.name: (rng.uniform(), rng.standard_normal()) for one in team.robots}
    return {
        one.name: Blinking(
            one.blink, drawn[one.name][0] * len(one.blink.code) * one.blink.bit, CLOCK_SIGMA * drawn[one.name][1]
        )
        for one in team.robots
        if one.blink is not None
    }


def with_codes(team: Team, bit: float = 0.1) -> Team:
    """A team whose robots all blink, each with one of the shortest codes that there are."""
    codes: list[str] = []
    for n in itertools.count(MIN_ZERO_DISTANCE):
        if len(codes) >= len(team.robots):
            break
        found = {Blink(code="".join("1" * (k - 1) + "0" for k in parts)).cycle for parts in _compositions(n)}
        codes += sorted(code for code in found if len(code) == n)
    robots = tuple(replace(one, blink=Blink(code=code, bit=bit)) for one, code in zip(team.robots, codes, strict=False))
    return replace(team, robots=robots)


def _compositions(n: int) -> Iterator[tuple[int, ...]]:
    """All ways to make n of numbers of at least `MIN_ZERO_DISTANCE`, in order."""
    for first in range(MIN_ZERO_DISTANCE, n - MIN_ZERO_DISTANCE + 1):
        yield from ((first, *rest) for rest in _compositions(n - first))
    if n >= MIN_ZERO_DISTANCE:
        yield (n,)
