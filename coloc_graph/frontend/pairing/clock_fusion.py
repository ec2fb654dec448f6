"""Fuse the clock offset of a pair of robots over all stances of a run, since one stance alone may not determine it."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from coloc_graph.frontend.pairing.clock_offset import DISAGREEMENT, NOT_OBSERVABLE, ClockOffset, fuse
from coloc_graph.frontend.stance import PairMeasurement


def share_clock_offsets(
    measurements: Sequence[PairMeasurement], clock_sigma: float, before: Sequence[PairMeasurement] = ()
) -> tuple[tuple[PairMeasurement, ...], list[str]]:
    """Repeat measurements at the clock offset fused over all stances of each pair.

    Parameters
    ----------
    measurements
        Measurements, with the evidence of each on the offset.
    clock_sigma
        Standard deviation of the clocks' agreement [s]; 0 changes nothing.
    before
        Earlier measurements, which contribute evidence and are not repeated.

    Returns
    -------
    tuple
        The repeated measurements, whose information contains the offset's uncertainty, and warnings.
    """
    if clock_sigma == 0:
        return tuple(measurements), []
    evidence: dict[tuple[str, str], list[ClockOffset]] = defaultdict(list)
    for one in (*before, *measurements):
        pair, known = _in_order(one, one.offset_evidence)
        evidence[pair] += [known] if known is not None else []
    warnings: list[str] = []
    fused: dict[tuple[str, str], ClockOffset] = {}
    for pair, known_by_stances in evidence.items():
        fused[pair], chance = fuse(known_by_stances, ClockOffset(0.0, clock_sigma))
        if chance < DISAGREEMENT:
            values = [1e3 * one.value for one in known_by_stances]
            warnings.append(
                f"the stances disagree on the clock offset of {pair[0]} and {pair[1]} ({min(values):.1f} to "
                f"{max(values):.1f} ms): the clocks drift or were set during the run; synchronise them, or split it"
            )
        if not fused[pair].is_observed(clock_sigma):
            warnings.append(f"{pair[0]} and {pair[1]}: {NOT_OBSERVABLE}")
    shared = []
    for one in measurements:
        pair, _ = _in_order(one, None)
        offset = fused[pair] if pair == (one.homography.robot_i, one.homography.robot_j) else fused[pair].reversed()
        again = one if one.at_offset is None else one.at_offset(offset)
        same = {name: getattr(one, name) for name in ("offset_evidence", "seen", "standing", "landmarks")}
        shared.append(replace(again, at_offset=None, **same))
    return tuple(shared), warnings


def _in_order(one: PairMeasurement, offset: ClockOffset | None) -> tuple[tuple[str, str], ClockOffset | None]:
    """Names of the pair in alphabetical order, and the offset of the second's clock from the first's."""
    i, j = one.homography.robot_i, one.homography.robot_j
    if i < j:
        return (i, j), offset
    return (j, i), offset and offset.reversed()
