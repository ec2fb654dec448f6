"""Clocks: what the filter says of itself against the truth, in simulated networks, and clocks that jump."""

from dataclasses import dataclass

import numpy as np
import pytest

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.clock import MIN_EXCHANGES, ClockFilter

MS = 1_000_000


@dataclass
class Network:
    """Exchanges ten times a second with a clock that is `ahead` [ns] and drifts [1e-6], over a network whose ways take
    `base` and on top an exponential time, of mean `there` and `back` [ns], each in order."""

    base: float
    there: float
    back: float
    ahead: int = 0
    ppm: float = 0.0
    asymmetry: float = 0.0

    def robot(self, t):
        return int(t) + self.ahead + round(self.ppm * 1e-6 * t)

    def exchanges(self, rng, n, start=0):
        arrived = answered = 0.0
        for i in range(start, start + n):
            asked = i * 100 * MS + rng.uniform(0, MS)
            arrived = max(asked + self.base * (1 + self.asymmetry) + rng.exponential(self.there), arrived)
            sent = arrived + rng.uniform(1e4, 3e5)
            answered = max(sent + self.base * (1 - self.asymmetry) + rng.exponential(self.back), answered)
            yield int(asked), self.robot(arrived), self.robot(sent), int(answered) + 1


NETWORKS = {
    "one machine": Network(3e4, 5e4, 5e4),
    "a loaded machine": Network(3e4, 1e6, 3e5),
    "a wired network": Network(3e5, 2e5, 2e5, ppm=30),
    "a radio network": Network(1.5e6, 2e6, 4e6, ppm=-50),
    "one way takes longer": Network(2e6, 1e6, 1e6, ppm=20, asymmetry=0.1),
    "50 ms of jitter": Network(0, 5e7, 5e7, ppm=40),
    "a clock that is slewed": Network(3e5, 2e5, 2e5, ppm=500),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_the_error_is_as_large_as_it_is_said_to_be(name):
    network, z, errors, synchronised = NETWORKS[name], [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        network.ahead = int(rng.uniform(-1e15, 1e15))  # days
        clock = ClockFilter()
        for i, exchange in enumerate(network.exchanges(rng, 300)):
            clock.add(*exchange)
            now = exchange[3] + 50 * MS
            if i >= MIN_EXCHANGES:
                known = clock.estimate(now)
                errors.append(network.robot(now) - now - known.offset)
                z.append(errors[-1] / known.sigma)
                synchronised.append(clock.synchronised(now, 1e-3))
        assert clock.jumps == 0
    rms_z = np.sqrt(np.mean(np.square(z)))
    print(f"    {name}: {np.std(errors) / 1e3:.0f} us, z {rms_z:.2f}, synchronised {np.mean(synchronised):.2f}")
    assert 0.05 < rms_z < 1.2  # the floor for what cannot be seen of an asymmetry is most of it where there is none
    assert np.mean(np.abs(z) > 3) < 0.02
    good = np.abs(np.array(errors))[synchronised]
    assert np.mean(good > MS) < 0.003  # what is said to be known to 1 ms is


def test_instants_go_to_the_other_clock_and_back():
    network = Network(1e5, 1e4, 1e4, ahead=-(10**15), ppm=20)
    clock = ClockFilter()
    for exchange in network.exchanges(np.random.default_rng(0), 100):
        clock.add(*exchange)
    at = exchange[3]
    assert abs(clock.to_robot(at) - network.robot(at)) < 0.1 * MS
    assert abs(clock.to_coordinator(network.robot(at)) - at) < 0.1 * MS
    for before in (0, 10**9, 6 * 10**10):  # what is recovered after a cut is old
        assert abs(clock.to_coordinator(clock.to_robot(at - before)) - (at - before)) < 10


def test_nothing_is_known_before_the_first_exchange_and_little_after_it():
    clock = ClockFilter()
    assert not clock.known and clock.estimate(0) is None and not clock.synchronised(0)
    with pytest.raises(RobotError, match="robot's clock is not known yet"):
        clock.to_coordinator(0)
    network, rng = Network(1e5, 1e5, 1e5, ahead=10**12), np.random.default_rng(0)
    for n, exchange in enumerate(network.exchanges(rng, MIN_EXCHANGES), 1):
        clock.add(*exchange)
        assert clock.known and clock.synchronised(exchange[3]) == (n == MIN_EXCHANGES)
    assert abs(clock.to_robot(0) - 10**12) < MS
    assert not clock.synchronised(exchange[3] + 6 * 10**9)  # nothing was heard for long


@pytest.mark.parametrize("by", [-(10**12), -100 * MS, -5 * MS, 5 * MS, 3600 * 10**9])
def test_a_clock_that_jumps_is_noticed_at_once_and_found_again(by):
    network, rng, clock = Network(3e5, 2e5, 2e5, ahead=10**12, ppm=10), np.random.default_rng(1), ClockFilter()
    for exchange in network.exchanges(rng, 100):
        clock.add(*exchange)
    assert clock.synchronised(exchange[3]) and clock.jumps == 0
    network.ahead += by
    for n, exchange in enumerate(network.exchanges(rng, 40, start=100)):
        clock.add(*exchange)
        assert clock.jumps == 1
        assert clock.synchronised(exchange[3]) == (n >= MIN_EXCHANGES - 1)
    assert abs(clock.estimate(exchange[3]).offset - network.ahead) < 0.2 * MS


def test_what_cannot_have_been_is_refused():
    clock = ClockFilter()
    for wrong in [(10, 0, 0, 5), (0, 10, 5, 20), (0, 0, 100, 50)]:
        with pytest.raises(ValueError, match="answer was received before its question"):
            clock.add(*wrong)
    assert not clock.known
