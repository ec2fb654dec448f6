"""Tell LEDs from reflections and lamps, with a probability.

An LED is a point of light behind one point spread: whatever its brightness, the pixels between two levels cover an area
that is known, its bright pixels are round, and the brightest lie in their middle. A reflection is dimmer, drawn out, or
lopsided; a lamp is larger. How large and bright the LEDs of a camera are is learnt from its lights, by expectation
maximisation of a mixture of both kinds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UPPER_LEVEL = 0.8  # of a light's peak, the upper of the two levels between which its area is measured
MIN_LEVELS_RATIO = 1.2  # of the two levels, below which a light is too dim to tell its size
TYPICAL_SIZE = (0.7, 0.7)  # logarithm of an LED's point spread [px], and its standard deviation, before any is seen
TYPICAL_PEAK = (5.5, 1.0)  # the same of its peak [grey levels], extrapolated where it saturates
PEAK_SPREAD = 0.6  # of the logarithms of LEDs' peaks: they differ by a factor of 4
SPREAD_LIGHTS = 4.0  # number of lights that `PEAK_SPREAD` counts as, against those that are seen
SIZE_SPREAD = 0.3  # of the logarithms of their sizes
LARGER = 0.5  # logarithm of the ratio of other lights' sizes to LEDs': no light is sharper than the lens
GLINTS = 0.3  # share of other lights that look like LEDs but for their brightness
DIMMER = 1.5  # logarithm of the factor by which other lights are dimmer than LEDs
OTHER_PEAK_SPREAD = 1.3  # of the logarithms of other lights' peaks
OTHER_SIZE_SPREAD = 0.8  # of the logarithms of their sizes
LONG_SPREAD = 0.45  # of the logarithm of an LED's ratio of axes
OTHER_LONG_SPREAD = 1.0  # the same of other lights
LOPSIDED_SPREAD = 0.45  # distance of an LED's brightest pixels from its middle, by its LEDs' size
OTHER_LOPSIDED_SPREAD = 0.8  # the same of other lights
PRIOR = 0.5  # probability that a light is an LED, before it is looked at
STARTS = (0.0, 0.12, 0.25, 0.5)  # ranks, by brightness and sharpness, of the lights from which LEDs are learnt
ROUNDS = 8  # of learning
MAX_ABOVE = 4.0  # logarithm of the factor by which a peak exceeds the upper level, at most
LED_PROBABILITY = 0.4  # above which a light counts as an LED: a lost LED costs more than a reflection that motion tells
CERTAIN = 12.0  # log odds beyond which nothing is certain


class Forms(NamedTuple):
    """Forms of n lights; NaN where a light does not tell.

    Attributes
    ----------
    peak
        Logarithms of the peaks [grey levels above the background], extrapolated beyond the sensor's limit.
    size
        Logarithms of the standard deviations of the point spread that they would have [px].
    long
        Logarithms of the ratios of axes of the bright pixels.
    lopsided
        Distances from the middle of the bright pixels to that of the brightest [px].
    """

    peak: Array
    size: Array
    long: Array
    lopsided: Array

    def rows(self, which: slice) -> "Forms":
        """Return the forms of some of the lights."""
        return Forms(*(one[which] for one in self))


def forms_of_windows(light: Array, inner: NDArray[np.bool_], levels: float, saturation: Array) -> Forms:
    """Measure the forms of lights in windows.

    Parameters
    ----------
    light
        Windows less the background, (n, s, s) [grey levels].
    inner
        Bright pixels of each light, (n, s, s).
    levels
        Level above which pixels are bright [grey levels].
    saturation
        Level at which the sensor saturates, less the background, (n,) [grey levels].
    """
    peak = np.where(inner, light, 0.0).max(axis=(1, 2))
    high = UPPER_LEVEL * peak
    core = inner & (light > high[:, None, None])
    (area, x, y, xx, xy, yy), (brightest, core_x, core_y, *_) = _moments(inner), _moments(core)
    # a core at the sensor's limit hides how bright a light is: then the area between two levels tells its size
    limited = peak >= saturation
    ratio = np.log(np.maximum(np.where(limited, high, peak), 1e-9) / levels)
    rim = np.where(limited, np.maximum(area - brightest, 1.0), area)
    tells = (ratio > np.log(MIN_LEVELS_RATIO)) & (rim > 0)
    variance = np.where(tells, rim / (2 * np.pi * np.where(tells, ratio, 1.0)), 1.0)
    above = np.minimum(brightest / (2 * np.pi * variance), MAX_ABOVE)
    # a pixel has a variance of its own, which rounds off what few pixels make
    half, apart = (xx + yy) / 2 + 1 / 12, np.hypot((xx - yy) / 2, xy)
    long = np.log((half + apart) / np.maximum(half - apart, 1 / 12)) / 2
    return Forms(
        np.log(np.maximum(high, 1e-9)) + np.where(tells & limited, above, -np.log(UPPER_LEVEL)),
        np.where(tells, np.log(variance) / 2, np.nan),
        long,
        np.where(brightest > 0, np.hypot(core_x - x, core_y - y), np.nan),
    )


def forms_of_records(peak: Array, area: Array, blurred: NDArray[np.bool_], levels: float = 35.0) -> Forms:
    """Forms of recorded lights, from their peaks (n,) [grey levels], areas (n,) [px], and which are drawn out."""
    known = (peak > MIN_LEVELS_RATIO * levels) & (area > 0)
    ratio = np.log(np.where(known, peak, np.e * levels) / levels)
    size = np.log(np.where(known, area, 1.0) / (2 * np.pi * ratio)) / 2
    unknown = np.full(len(peak), np.nan)
    return Forms(
        np.where(peak > 0, np.log(np.maximum(peak, 1e-9)), np.nan),
        np.where(known, size, np.nan),
        np.where(blurred, np.log(2.5), unknown),
        unknown,
    )


def led_log_odds(forms: Forms) -> Array:
    """Logarithms of the odds (n,) that lights of one camera are LEDs."""
    starts = _starts(forms)
    if not starts:
        return np.zeros(len(forms.peak))
    odds, likelihood = _learnt(forms, *np.array(starts).T)
    return np.asarray(odds[np.where(np.isnan(likelihood), -np.inf, likelihood).argmax()])


def _learnt(forms: Forms, peak: Array, size: Array) -> tuple[Array, Array]:
    """Log odds (k, n) and log likelihoods (k,) of the mixture, from k starts of the LEDs' typical peak and size."""
    width = np.full(len(peak), PEAK_SPREAD)
    long, other_long = _log_density(forms.long, LONG_SPREAD), _log_density(forms.long, OTHER_LONG_SPREAD)
    for _ in range(ROUNDS):
        brightness, off = forms.peak - peak[:, None], forms.size - size[:, None]
        lopsided = forms.lopsided / np.exp(size)[:, None]
        of_peak = _log_density(brightness, width[:, None]), _log_density(brightness + DIMMER, OTHER_PEAK_SPREAD)
        of_form = (
            _log_density(off, SIZE_SPREAD) + long + _log_density(lopsided, LOPSIDED_SPREAD),
            _log_density(off - LARGER, OTHER_SIZE_SPREAD) + other_long + _log_density(lopsided, OTHER_LOPSIDED_SPREAD),
        )
        other_form = np.logaddexp(np.log(1 - GLINTS) + of_form[1], np.log(GLINTS) + of_form[0])
        led = np.log(PRIOR) + of_peak[0] + of_form[0]
        other = np.log(1 - PRIOR) + of_peak[1] + other_form
        odds = np.clip(led - other, -CERTAIN, CERTAIN)
        p = 1 / (1 + np.exp(-odds))
        likelihood = np.logaddexp(led, other).sum(axis=1)
        peak, size = _mean(forms.peak, p, *TYPICAL_PEAK, width), _mean(forms.size, p, *TYPICAL_SIZE, SIZE_SPREAD)
        width = _spread(forms.peak - peak[:, None], p)
    prior = _log_density(peak - TYPICAL_PEAK[0], TYPICAL_PEAK[1])
    prior += _log_density(size - TYPICAL_SIZE[0], TYPICAL_SIZE[1])
    return np.asarray(odds), likelihood + prior


def led_probability(forms: Forms) -> Array:
    """Probabilities (n,) that lights of one camera are LEDs."""
    return np.asarray(1 / (1 + np.exp(-led_log_odds(forms))))


def track_probability(forms: Forms, counts: Sequence[int]) -> list[float]:
    """Probabilities that tracks of one camera are LEDs, from the forms of their samples, track by track.

    The mean of the samples' log odds counts: a light looks from image to image as it looks.
    """
    ends = np.cumsum(counts)
    sums = np.concatenate([[0.0], np.cumsum(led_log_odds(forms))])
    mean = (sums[ends] - sums[ends - counts]) / np.maximum(counts, 1)
    return [float(one) for one in 1 / (1 + np.exp(-mean))]


def _starts(forms: Forms) -> list[tuple[float, float]]:
    """Peaks and sizes to begin with: those of single lights, from the brightest and sharpest on."""
    known = np.flatnonzero(np.isfinite(forms.peak) & np.isfinite(forms.size))
    order = known[np.argsort(forms.size[known] - forms.peak[known])]
    some = np.unique([min(int(share * len(order)), len(order) - 1) for share in STARTS]) if len(order) else ()
    return [(float(forms.peak[order[n]]), float(forms.size[order[n]])) for n in some]


def _log_density(off: Array, spread: float | Array) -> Array:
    """Logarithms of normal densities, of the shape of `off`; 0 where a value is unknown (NaN)."""
    density = -np.log(spread) - np.minimum((off / spread) ** 2 / 2, 2 * CERTAIN)
    return np.where(np.isnan(density), 0.0, density)


def _mean(values: Array, weights: Array, prior: float, prior_sigma: float, sigma: float | Array) -> Array:
    """Means (k,) of values (n,) of standard deviations `sigma`, by weights (k, n), with a prior; NaN does not count."""
    known = np.isfinite(values)
    weights, precision = weights[:, known], 1 / np.square(sigma)
    total = weights.sum(axis=1) * precision
    return np.asarray((weights @ values[known] * precision + prior / prior_sigma**2) / (total + prior_sigma**-2))


def _spread(off: Array, weights: Array) -> Array:
    """Standard deviations (k,) of peaks from `off` the mean (k, n), at most `PEAK_SPREAD`, which counts as lights."""
    squares = SPREAD_LIGHTS * PEAK_SPREAD**2 + (weights * off**2).sum(axis=1)
    return np.asarray(np.minimum(np.sqrt(squares / (SPREAD_LIGHTS + weights.sum(axis=1))), PEAK_SPREAD))


def _moments(mask: NDArray[np.bool_]) -> tuple[Array, ...]:
    """Pixels, middle x and y, and second moments xx, xy, yy (n,) of masks (n, s, s)."""
    powers = np.arange(mask.shape[2], dtype=float) ** np.arange(3)[:, None]
    m = (powers @ mask @ powers.T).reshape(-1, 9).T
    area = m[0]
    x, xx, y, xy, _, yy = m[1:7] / np.maximum(area, 1.0)
    return area, x, y, xx - x * x, xy - x * y, yy - y * y
