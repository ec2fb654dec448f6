"""Marginalise old poses of an incremental graph, so that an update costs the same however long the run is.

Factors on old poses are linearised at the estimate, and the poses are eliminated by QR, one after the other. What they
say of the poses and calibration variables that stay is left as linear factors.

Source: Sibley, Matthies, Sukhatme, "Sliding Window Filter with Application to Planetary Landing", 2010.
"""

from collections.abc import Sequence

import gtsam

LAG = 50  # stances whose poses stay variables where mounts are calibrated
MAX_STANCES_PER_LAG = 1.5  # stances, in units of the lag, at which those before the last `LAG` are marginalised


def marginal_factors(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, gone: Sequence[int]
) -> list[gtsam.LinearContainerFactor]:
    """Return what factors on variables that go say of those that stay.

    Parameters
    ----------
    factors
        All factors on the variables that go.
    values
        Estimates of all variables that they are on, at which they are linearised.
    gone
        Keys of the variables that go, in the order of elimination.
    """
    linear = factors.linearize(values)
    left = [linear.at(n) for n in range(linear.size())]
    for key in gone:
        together, others = gtsam.GaussianFactorGraph(), []
        for factor in left:
            if key in factor.keys():  # noqa: SIM118
                together.push_back(factor)
            else:
                others.append(factor)
        ordering = gtsam.Ordering()
        ordering.push_back(key)
        _, rest = gtsam.JacobianFactor(together).eliminate(ordering)
        left = [*others, rest] if rest.keys() and rest.rows() else others
    return [gtsam.LinearContainerFactor(factor, values) for factor in left]
