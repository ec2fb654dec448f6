"""Blink codes, by which the markers of several robots are distinguished: `Blink`."""

from collections.abc import Sequence

import msgspec

from coloc_graph.team.checks import require_finite

MIN_BIT = 0.02  # s, duration of a bit: a camera takes at least two images in it
MAX_BIT = 0.25  # s, duration of a bit: a track that is off for longer is lost
MIN_IMAGES_PER_BIT = 2  # images in a bit
MAX_BITS = 32  # bits of a code


class Blink(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Repeated blink code of all markers of a robot, of unknown phase.

    Parameters
    ----------
    code : str
        1 is on, 0 is off. No two 0s follow each other, so that a track survives.
    bit : float
        Duration of each bit [s].
    """

    code: str
    bit: float = 0.1

    def __post_init__(self) -> None:
        require_finite(self)
        if not MIN_BIT <= self.bit <= MAX_BIT:
            raise ValueError(f"`bit` is {self.bit}; give seconds from {MIN_BIT} to {MAX_BIT}")
        if set(self.code) != {"0", "1"} or len(self.code) > MAX_BITS:
            raise ValueError(f"`code` is `{self.code}`; give up to {MAX_BITS} of 0 and 1, with both in it")
        if "00" in self.code + self.code[0]:
            raise ValueError(
                f"`code` is `{self.code}`, which has two 0s in a row (it is repeated); let the markers be off for one "
                "bit at a time"
            )

    @property
    def cycle(self) -> str:
        """Canonical form: the shortest code with the same blinking, at its smallest rotation."""
        n = next(n for n in range(1, len(self.code) + 1) if self.code == self.code[n:] + self.code[:n])
        return min(self.code[k:n] + self.code[:k] for k in range(n))


def require_distinguishable(
    blinks: Sequence[tuple[str, float | None, Blink]], cameras: Sequence[tuple[str, float]]
) -> None:
    """Raise ValueError where two robots (name, hue of the markers, code) blink alike, or a camera is too slow.

    `cameras` are (name, frames per second).
    """
    alike: dict[tuple[float | None, str], tuple[str, str]] = {}
    for name, hue, blink in blinks:
        first, _, other = blinks[0]
        if blink.bit != other.bit:
            raise ValueError(
                f"a bit of robot {first} takes {other.bit} s and one of robot {name} {blink.bit} s; give all robots "
                "the same `bit`"
            )
        before, code = alike.setdefault((hue, blink.cycle), (name, blink.code))
        if before != name:
            raise ValueError(
                f"robots {before} and {name} blink alike ({code} and {blink.code}); give each a code of its own, as "
                "110, 1110 or 11110"
            )
    for camera, fps in cameras if blinks else ():
        bit = blinks[0][2].bit
        if bit * fps < MIN_IMAGES_PER_BIT:
            raise ValueError(
                f"the camera of robot {camera} takes {fps:g} images per second, too few for a `bit` of {bit} s; give "
                f"at least {MIN_IMAGES_PER_BIT / fps:.3g} s, or a faster camera"
            )
