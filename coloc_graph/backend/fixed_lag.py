"""Marginalise old poses of an incremental graph, so that an update costs the same however long the run is.

Factors on old poses are linearised at the estimate, and the poses are eliminated by QR. What they say of the poses and
calibration variables that stay is left as one linear factor. Stances and keyframes of ranging runs leave alike.

Source: Sibley, Matthies, Sukhatme, "Sliding Window Filter with Application to Planetary Landing", 2010.
"""

from collections.abc import Iterable

import gtsam

LAG = 50  # stances whose poses stay variables where mounts are calibrated
MAX_STANCES_PER_LAG = 1.5  # stances, in units of the lag, at which those before the last `LAG` are marginalised


def marginal_factor(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, gone: Iterable[int]
) -> gtsam.LinearContainerFactor | None:
    """Return what linear factors on variables that go say of those that stay; None where they say nothing.

    It is one factor: several would become more each time, since those on variables that stay are never eliminated.

    Parameters
    ----------
    linear
        All factors on the variables that go.
    values
        Estimates of all variables that they are on, at which they are linearised.
    gone
        Keys of the variables that go, in the order of elimination.
    """
    ordering = gtsam.Ordering()
    for key in gone:
        ordering.push_back(key)
    _, left = linear.eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
    if not left.keys().size():
        return None
    _, one = gtsam.EliminateQR(left, gtsam.Ordering())
    return gtsam.LinearContainerFactor(one, values) if one.rows() else None
