"""`Blink`: how a robot's markers go off and on, by which those of several robots are told apart."""

from collections.abc import Sequence

import msgspec

from coloc_graph.team.checks import require_finite

SHORTEST = 0.02  # s, shortest bit: a camera takes at least two images in it
LONGEST = 0.25  # s, longest bit: a track that is off for longer is lost
IMAGES_A_BIT = 2  # images in a bit, at least
MOST_BITS = 32  # bits of a code, at most


class Blink(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All markers of a robot are on where `code` has a 1 and off where it has a 0, each for `bit` [s], over and over.

    Nothing is said of when it begins. No two 0s follow each other: a light that is off for one bit at a time is
    followed all along.
    """

    code: str
    bit: float = 0.1

    def __post_init__(self) -> None:
        require_finite(self)
        if not SHORTEST <= self.bit <= LONGEST:
            raise ValueError(f"`bit` is {self.bit}; give seconds from {SHORTEST} to {LONGEST}")
        if set(self.code) != {"0", "1"} or len(self.code) > MOST_BITS:
            raise ValueError(f"`code` is `{self.code}`; give up to {MOST_BITS} of 0 and 1, with both in it")
        if "00" in self.code + self.code[0]:
            raise ValueError(
                f"`code` is `{self.code}`, which has two 0s in a row (it is repeated over and over); let the markers "
                "be off for one bit at a time"
            )

    @property
    def cycle(self) -> str:
        """The shortest code that blinks alike, whenever it begins."""
        n = next(n for n in range(1, len(self.code) + 1) if self.code == self.code[n:] + self.code[:n])
        return min(self.code[k:n] + self.code[:k] for k in range(n))


def require_told_apart(blinks: Sequence[tuple[str, float | None, Blink]], cameras: Sequence[tuple[str, float]]) -> None:
    """Raise ValueError where two robots (name, hue of the markers, code) blink alike, or a camera (name, frames a
    second) is too slow to see it."""
    alike: dict[tuple[float | None, str], tuple[str, str]] = {}
    for name, hue, blink in blinks:
        first, _, other = blinks[0]
        if blink.bit != other.bit:
            raise ValueError(
                f"a bit of robot {first} is {other.bit} s long and one of robot {name} {blink.bit} s; give all the "
                "same `bit`"
            )
        before, code = alike.setdefault((hue, blink.cycle), (name, blink.code))
        if before != name:
            raise ValueError(
                f"robots {before} and {name} blink alike, wherever their codes begin ({code} and {blink.code}); give "
                "each a code of its own, as 110, 1110 or 11110"
            )
    for camera, fps in cameras if blinks else ():
        bit = blinks[0][2].bit
        if bit * fps < IMAGES_A_BIT:
            raise ValueError(
                f"the camera of robot {camera} takes {fps:g} images a second, too few for a `bit` of {bit} s; give at "
                f"least {IMAGES_A_BIT / fps:.3g} s, or a faster camera"
            )
