"""Noise of the marker centres of one camera, as known before a run or learnt from it."""

import math

import msgspec

from coloc_graph.team.checks import require_finite

COMPONENTS = ("scale", "floor_px", "saturated_px")


class CentreNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Standard deviations of marker centres beyond what each detection states; log-normal, as a prior and as learnt.

    The variance of a centre, per axis and without correlation between samples, is (scale * stated sigma)^2 +
    floor_px^2, or + saturated_px^2 where the core of the spot is saturated. Each value is a median, known
    within its factor (one standard deviation of its logarithm): 0.03 with a factor of 3 is 0.01 to 0.09.

    Attributes
    ----------
    scale, scale_factor
        Factor on the standard deviation that a detection states, and the factor within which it is known.
    floor_px, floor_factor
        White floor [px]: what pixels, lens and background do to a centre, whatever its light.
    saturated_px, saturated_factor
        White floor of saturated spots [px], and its factor. They are brighter or longer exposed, and may have less.
    spread, spread_factor
        Standard deviation of the logarithms of variances from stance to stance about all that, and its factor: one
        stance is shaken, or sees lights from the side.
    typical_px
        Standard deviation of a typical centre [px], as learnt; plans are made for it. None if nothing was learnt.
    """

    scale: float = 1.0
    scale_factor: float = 1.2
    floor_px: float = 0.03
    floor_factor: float = 3.0
    saturated_px: float = 0.03
    saturated_factor: float = 3.0
    spread: float = 0.2
    spread_factor: float = 3.0
    typical_px: float | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("scale", "floor_px", "saturated_px", "spread", "typical_px"):
            if getattr(self, name) is not None and getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        for name in ("scale_factor", "floor_factor", "saturated_factor", "spread_factor"):
            if not 1 < getattr(self, name) <= 100:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 1, 100 at most")

    @property
    def logs(self) -> tuple[list[float], list[float]]:
        """Means and standard deviations of the logarithms of the three variances, in the order of `COMPONENTS`."""
        medians = self.scale, self.floor_px, self.saturated_px
        factors = self.scale_factor, self.floor_factor, self.saturated_factor
        return [2 * math.log(one) for one in medians], [2 * math.log(one) for one in factors]

    @classmethod
    def of_logs(cls, means: list[float], sigmas: list[float], spread: float, spread_factor: float) -> "CentreNoise":
        """Return the noise with these means and standard deviations of the logarithms of its variances."""
        scale, floor, saturated = (math.exp(one / 2) for one in means)
        scale_f, floor_f, saturated_f = (math.exp(max(one, 1e-6) / 2) for one in sigmas)
        return cls(
            scale=scale,
            scale_factor=scale_f,
            floor_px=floor,
            floor_factor=floor_f,
            saturated_px=saturated,
            saturated_factor=saturated_f,
            spread=spread,
            spread_factor=max(spread_factor, 1 + 1e-6),
        )

    @property
    def variances(self) -> tuple[float, float, float]:
        """Expected variances: the factor on stated ones, floor and saturated [px^2]; wide where little is known."""
        means, sigmas = self.logs
        scale, floor, saturated = (math.exp(m + s * s / 2) for m, s in zip(means, sigmas, strict=True))
        return scale, floor, saturated
