"""Order and completeness of a robot's numbered messages: restarts, reordering, loss, replay, other robots' traffic."""

import random

import pytest

from coloc_graph.robot_io.link.counters import LinkCounter
from coloc_graph.robot_io.link.messages import Event, Sample, Wheels, encode
from coloc_graph.robot_io.link.reordering import MAX_REQUESTS, REQUEST_SIZE, ReorderBuffer
from coloc_graph.robot_io.link.robot_inbox import MAX_ENDED, MAX_PRESENT, RobotInbox
from coloc_graph.robot_io.link.session import CACHED


def taken(buffer, *numbers):
    return [int(one) for number in numbers for one in buffer.take(number, b"%d" % number)]


def test_messages_are_put_in_order_and_gaps_are_requested():
    buffer = ReorderBuffer(window=1000)
    assert taken(buffer, 0) == [0] and buffer.missing() is None
    assert taken(buffer, 2, 600) == [] and buffer.missing() == (1, 1)
    assert taken(buffer, 1) == [1, 2]
    assert buffer.missing() == (3, 2 + REQUEST_SIZE)
    assert taken(buffer, 2, 600) == [] and buffer.repeated == 2
    for _ in range(MAX_REQUESTS - 1):
        assert buffer.requested(3, 2 + REQUEST_SIZE) == [] and buffer.lost == 0
    assert buffer.requested(3, 2 + REQUEST_SIZE) == [] and buffer.lost == REQUEST_SIZE
    assert buffer.missing() == (3 + REQUEST_SIZE, 2 + 2 * REQUEST_SIZE)
    assert buffer.requested(3, 2 + REQUEST_SIZE) == []  # an answer to an earlier request
    assert [int(one) for one in buffer.end()] == [600] and buffer.lost == 3 + 600 - 6
    assert buffer.missing() is None and taken(buffer, 601) == [601]


def test_requests_for_a_gap_that_shrinks_are_counted_anew():
    buffer = ReorderBuffer(window=1000)
    taken(buffer, 5)
    for number in range(4):
        assert buffer.requested(number, 4) == [] and buffer.lost == 0
        assert taken(buffer, number) == [number]
    for n in range(MAX_REQUESTS):
        assert [int(one) for one in buffer.requested(4, 4)] == ([5] if n == MAX_REQUESTS - 1 else [])
    assert buffer.lost == 1


def test_a_gap_that_the_sender_cannot_fill_any_more_is_lost_at_once():
    buffer = ReorderBuffer(window=3)
    assert [taken(buffer, n) for n in (5, 6, 4, 8)] == [[], [], [4, 5, 6], []]
    assert buffer.lost == 4 and buffer.missing() == (7, 7)
    buffer = ReorderBuffer(window=3)
    assert taken(buffer, 0, 2) == [0] and taken(buffer, 4) == [2] and buffer.lost == 1
    assert taken(buffer, 3) == [3, 4] and taken(buffer, 1) == [] and buffer.repeated == 1
    assert taken(buffer, 72_000) == [] and buffer.missing() == (71_998, 71_999)
    assert taken(buffer, 2**52) == [72_000]


def test_what_is_held_is_bounded_in_bytes(monkeypatch):
    monkeypatch.setattr("coloc_graph.robot_io.link.reordering.MAX_HELD_BYTES", 1000)
    buffer = ReorderBuffer(window=CACHED)
    handed_on = [one for n in range(1, 30) for one in buffer.take(2 * n, bytes(100))]
    assert sum(map(len, buffer._held.values())) <= 1000
    assert len(handed_on) >= 19 and buffer.lost >= 20


@pytest.mark.parametrize("seed", range(60))
def test_each_message_comes_once_and_in_order_or_is_lost(seed):
    """Loss, reordering, repetition and requests at random: what is handed on and what is lost make up all of it."""
    rng = random.Random(seed)
    sent, window = 400, rng.choice([20, 100, 1000])
    loss, delay = rng.uniform(0, 0.4), rng.choice([0, 3, 30])
    buffer = ReorderBuffer(window)
    arrivals = sorted((n + rng.uniform(0, delay), n) for n in range(sent) if rng.random() > loss)
    arrivals += [(rng.uniform(0, sent), n) for n in range(sent) if rng.random() < 0.1]  # repetitions
    handed_on = []
    for _, number in sorted(arrivals):
        handed_on += taken(buffer, number)
        if rng.random() < 0.2 and (gap := buffer.missing()) is not None:
            first, last = gap
            assert first == buffer.next_number and first <= last < first + REQUEST_SIZE
            for n in range(first, last + 1):
                if rng.random() > loss and n > number - window:
                    handed_on += taken(buffer, n)
            handed_on += map(int, buffer.requested(first, last))
        assert len(handed_on) + buffer.lost == buffer.next_number
        assert len(buffer._held) <= window and all(n > buffer.next_number for n in buffer._held)
    handed_on += map(int, buffer.end())
    assert handed_on == sorted(set(handed_on))
    assert len(handed_on) + buffer.lost == buffer.next_number and not buffer._held and buffer._held_bytes == 0
    if loss == 0:
        assert handed_on == list(range(sent))


# sessions of a robot's program


def event(session, number):
    return Event(session=session, number=number, stamp=1, kind="tick", text="")


class Inbox:
    """The inbox of a robot and what it delivered."""

    def __init__(self, counter=None):
        self.delivered, self.counter = [], counter or LinkCounter()
        self.inbox = RobotInbox("A", lambda one: self.delivered.append((one.session, one.number)), self.counter)
        self.now = 0

    def restart(self, session, ended=None):
        """The program that ran has ended, another runs and has told its time."""
        self.now += 1
        if ended is not None:
            self.inbox.disconnect(ended)
        self.inbox.connect(session, self.now)
        self.inbox.begin()

    def take(self, session, *numbers, **more):
        for number in numbers:
            self.inbox.take(event(session, number), encode(event(session, number)), **more)

    @property
    def counts(self):
        return self.counter.counts()


def test_messages_before_the_clock_is_known_are_requested_later():
    a = Inbox()
    a.inbox.connect("one", 1)
    a.take("one", 0, 1)
    assert a.delivered == [] and a.counts.unknown == 2
    a.inbox.begin()
    a.take("one", 3)
    assert a.inbox.missing() == [(Event, 0, 2)]
    a.take("one", 0, 1, 2, requested=True)
    assert a.delivered == [("one", n) for n in range(4)]
    a.take("one", 3, requested=True)  # was requested and had come meanwhile: no replay
    assert a.counts.replayed == 0
    a.take("one", 3)
    assert a.counts.replayed == 1 and a.counts.missed == 0


def test_what_an_ended_program_took_with_it_is_lost_and_holds_nothing_back():
    a = Inbox()
    a.restart("one")
    a.take("one", 0, 2, 3)
    a.restart("two", ended="one")
    assert a.delivered == [("one", 0), ("one", 2), ("one", 3)] and a.counts.missed == 1
    a.take("two", 0)
    a.take("one", 3, 2, 1, 5)  # still under way when its program ended
    assert a.delivered[3:] == [("two", 0), ("one", 5)]
    assert (a.counts.replayed, a.counts.missed) == (3, 2)


def test_a_session_that_comes_back_goes_on_where_it_was():
    """As after a cut that was longer than the lease, with another program in between."""
    a = Inbox()
    a.restart("one")
    a.take("one", 0, 1)
    a.restart("two", ended="one")
    a.take("two", 0)
    a.restart("one", ended="two")
    a.take("one", 0, 1, requested=True)
    a.take("one", 2)
    assert a.delivered == [("one", 0), ("one", 1), ("two", 0), ("one", 2)] and a.counts.missed == 0


def test_restarts_and_made_up_sessions_of_one_robot_leave_another_alone():
    counter = LinkCounter()
    a, b = Inbox(counter), Inbox(counter)
    a.restart("first")
    for n in range(3 * MAX_ENDED):
        b.restart(f"s{n}", ended=f"s{n - 1}")
        b.take(f"s{n}", 1, 2)  # held behind a gap
        b.take(f"made-up-{n}", 0)
        a.take("first", n)
    assert a.delivered == [("first", n) for n in range(3 * MAX_ENDED)]
    assert len(b.inbox._ended) == MAX_ENDED and len(b.inbox._present) == 1
    assert sum(len(one._held) for one in b.inbox._buffers.values()) == 2
    assert counter.counts().unknown == 3 * MAX_ENDED and counter.counts().replayed == 0
    assert b.delivered == [(f"s{n}", k) for n in range(3 * MAX_ENDED - 1) for k in (1, 2)]


@pytest.mark.parametrize("seed", range(20))
def test_over_random_restarts_each_message_comes_once_and_in_order(seed):
    rng = random.Random(seed)
    a, expected_end = Inbox(), {}
    session = None
    for n in range(rng.randrange(2, 15)):
        before, session = session, f"s{n}"
        a.restart(session, ended=before)
        numbers = [k for k in range(60) if rng.random() > 0.2]
        numbers += rng.choices(range(60), k=20)
        rng.shuffle(numbers)
        for number in numbers:
            a.take(session, number)
            if before is not None and rng.random() < 0.1:
                a.take(before, rng.randrange(80))
        expected_end[session] = max(numbers)
    a.restart("last", ended=session)
    for one in expected_end:
        numbers = [number for session, number in a.delivered if session == one]
        assert numbers == sorted(set(numbers)) and max(numbers) >= expected_end[one]
    total = sum(max(number for session, number in a.delivered if session == one) + 1 for one in expected_end)
    assert len(a.delivered) + a.counts.missed == total


def test_the_first_program_of_a_name_is_in_charge_and_further_ones_are_duplicates():
    a = Inbox()
    a.restart("one")
    a.inbox.connect("two", 10)
    a.inbox.begin()
    assert a.inbox.session == "one" and a.inbox.duplicates(asked=10) == []
    assert a.inbox.duplicates(asked=11) == ["two"]  # "one" was asked after "two" came, and answered
    a.take("two", 0)
    assert a.delivered == [] and a.counts.unknown == 1
    a.inbox.disconnect("two")
    assert a.inbox.present and a.inbox.duplicates(asked=12) == []
    a.inbox.connect("three", 20)
    a.inbox.disconnect("one")
    assert a.inbox.in_charge == "three" and a.inbox.session == "one"
    a.inbox.begin()
    assert a.inbox.session == "three"
    a.inbox.disconnect("three")
    assert not a.inbox.present and a.inbox.in_charge == "three"
    a.inbox.connect("three", 30)  # after a cut
    assert a.inbox.present and a.inbox.session == "three"
    for n in range(10 * MAX_PRESENT):
        a.inbox.connect(f"made-up-{n}", 31)
    assert len(a.inbox._present) == MAX_PRESENT and a.inbox.in_charge == "three"


def test_kinds_of_messages_are_ordered_apart():
    a = Inbox()
    a.restart("one")
    wheels = Wheels(session="one", number=1, stamp=1, pose=(0.0, 0.0, 0.0), covariance=(1.0, 0.0, 0.0, 1.0, 0.0, 1.0))
    a.take("one", 0)
    a.inbox.take(wheels, encode(wheels))
    a.take("one", 1)
    assert a.delivered == [("one", 0), ("one", 1)] and a.inbox.missing() == [(Wheels, 0, 0)]
    assert set(a.inbox.last_taken) == {Event, Wheels} and Sample not in a.inbox.last_taken
    for _ in range(MAX_REQUESTS):
        a.inbox.answered("before", Wheels, 0, 0)
    assert a.counts.missed == 0
    for _ in range(MAX_REQUESTS):
        a.inbox.answered("one", Wheels, 0, 0)
    assert a.counts.missed == 1 and a.delivered[-1] == ("one", 1)
