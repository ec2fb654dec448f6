"""The link: real sessions over loopback, over a relay that is cut, with certificates, and with those who have none."""

import contextlib
import logging
import socket
import stat
import subprocess
import sys
import threading
import time
import uuid

import msgspec
import pytest
import zenoh
from tcp_relay import Relay

from coloc_graph.cli import main
from coloc_graph.errors import InputError, RobotError
from coloc_graph.robot_io.link import recovery
from coloc_graph.robot_io.link.certificates import make_certificates
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import (
    MAX_MESSAGE_BYTES,
    Capture,
    Command,
    Drive,
    EndCapture,
    Event,
    Halt,
    Hold,
    Reply,
    Sample,
    Status,
    Wheels,
    decode,
    encode,
)
from coloc_graph.robot_io.link.recovery import RECOVERY_PERIOD
from coloc_graph.robot_io.link.robot_link import RobotLink
from coloc_graph.robot_io.link.session import KEPT_KINDS
from coloc_graph.robot_io.link.zenoh_config import Tls, config_of, tls_of
from coloc_graph.simulation import reference_team
from coloc_graph.team import write_team

TEAM = reference_team()
#: How long things may take on a machine that is busy [s].
LONG = 15.0


def until(met, timeout=LONG):
    """Whether it comes true in time."""
    deadline = time.monotonic() + timeout
    while not met():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Heard:
    """A coordinator's link and all that it heard."""

    def __init__(self, port, *, tls=None, **options):
        self.samples, self.wheels, self.events, self.status, self.presence = [], [], [], [], []
        self.address = f"{'tls' if tls else 'tcp'}/127.0.0.1:{port}"
        self.link = CoordinatorLink(
            TEAM,
            listen=self.address,
            on_sample=lambda *one: self.samples.append(one),
            on_wheels=lambda *one: self.wheels.append(one),
            on_event=lambda *one: self.events.append(one),
            on_status=lambda *one: self.status.append(one),
            on_presence=lambda *one: self.presence.append(one),
            tls=tls,
            **options,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.link.close()

    def there(self, name):
        """Wait until a robot is there and its clock is known."""
        assert until(lambda: self.link.clocks[name].known and (name, True) in self.presence), self.presence
        return self


class Robot:
    """A robot's link, and the commands it carried out."""

    def __init__(self, name, address, *, session="first", answer=lambda body: "", **options):
        self.bodies, self.sent = [], dict.fromkeys((Sample, Wheels, Event), 0)
        self.session, self._answer = session, answer
        self.link = RobotLink(name, connect=address, handler=self._obey, session=session, **options)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.link.close()

    def _obey(self, body):
        self.bodies.append(body)
        return self._answer(body)

    def put_sample(self):
        self.link.put(
            Sample(session=self.session, number=self._number(Sample), capture=0, stamp=time.monotonic_ns(),
                   uv=[(1.0, 2.0)], covariance=[(1.0, 0.0, 1.0)], markers=[""], flags=[0], peak=[9.0], area=[9.0])
        )  # fmt: skip

    def put_wheels(self):
        self.link.put(
            Wheels(session=self.session, number=self._number(Wheels), stamp=time.monotonic_ns(), pose=(0.0, 0.0, 0.0),
                   covariance=(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6))
        )  # fmt: skip

    def put_event(self, text=""):
        number = self._number(Event)
        self.link.put(Event(session=self.session, number=number, stamp=time.monotonic_ns(), kind="fault", text=text))

    def _number(self, kind):
        self.sent[kind] += 1
        return self.sent[kind] - 1


@pytest.fixture
def soon_asked(monkeypatch):
    """The newest message is requested after a shorter time; the time [s]."""
    monkeypatch.setattr(recovery, "NEWEST_PERIOD", 0.3)
    return recovery.NEWEST_PERIOD


@pytest.fixture
def pair():
    """A coordinator and robot A, who know each other."""
    with Heard(free_port()) as heard, Robot("A", heard.address) as robot:
        heard.there("A")
        yield heard, robot


@contextlib.contextmanager
def outsider(address, tls=None):
    """A zenoh session of somebody else's."""
    session = zenoh.open(config_of(connect=address, tls=tls))
    try:
        yield session
    finally:
        session.close()


def raw_ask(heard, name, data, timeout=30.0):
    """What a robot answers to bytes; None where nothing comes."""
    for one in heard.link._session.zenoh.get(f"coloc/{name}/command/first", payload=data, timeout=timeout):
        if one.ok is not None:
            return decode(one.ok.payload.to_bytes(), Reply)
    return None


def command(body, *, session="first", left=60.0):
    deadline = time.monotonic_ns() + round(1e9 * left)
    return Command(id=uuid.uuid4().hex, session=session, deadline=deadline, body=body)


# what is measured, and what is asked


def test_what_a_robot_sends_comes_in_order_and_once(pair):
    heard, robot = pair
    for _ in range(300):
        robot.put_sample()
        robot.put_wheels()
        robot.put_event("why")
    status = Status(session="first", stamp=1, phase="idle", capture=None, moving=False, still_since=0, fault=None,
                    camera_fault=None, hazards=[])  # fmt: skip
    robot.link.put(status)
    for kind in (heard.samples, heard.wheels, heard.events):
        assert until(lambda kind=kind: len(kind) >= 300)
        assert [(name, one.number) for name, one in kind] == [("A", n) for n in range(300)]
    assert until(lambda: heard.status == [("A", status)])
    assert heard.link.counts.taken == 901 and heard.link.counts.missed == 0
    assert robot.link.connected


def test_a_command_is_carried_out_and_answered(pair):
    heard, robot = pair
    robot._answer = lambda body: "12" if isinstance(body, EndCapture) else ""
    assert heard.link.ask("A", Capture(capture=5), 3.0).ok
    assert heard.link.ask("A", EndCapture(), 3.0).text == "12"
    drive = Drive(number=1, places=[(1.0, 2.0)], yaw=None, speed=0.2)
    assert heard.link.ask("A", drive, 3.0).ok
    assert robot.bodies == [Capture(capture=5), EndCapture(), drive]


def test_a_command_that_fails_says_why(pair, caplog):
    heard, robot = pair

    def refuse(body):
        raise RobotError("its wheels are off") if isinstance(body, Halt) else ZeroDivisionError("oh")

    robot._answer = refuse
    reply = heard.link.ask("A", Halt(), 3.0)
    assert (reply.ok, reply.text) == (False, "its wheels are off")
    reply = heard.link.ask("A", EndCapture(), 3.0)
    assert not reply.ok and "ZeroDivisionError" in reply.text
    assert "could not carry out `EndCapture`" in caplog.text


def test_a_command_that_comes_again_is_answered_alike_and_not_carried_out_again(pair):
    heard, robot = pair
    answers = iter("abc")
    robot._answer = lambda body: next(answers)
    data = encode(command(Halt()))
    assert [raw_ask(heard, "A", data).text for _ in range(3)] == ["a", "a", "a"]
    assert robot.bodies == [Halt()] and robot.link.counts.replayed == 2


def test_a_slow_robot_is_asked_again_and_does_it_once(pair):
    heard, robot = pair
    robot._answer = lambda body: time.sleep(1.0) or "done"
    assert heard.link.ask("A", Halt(), LONG).text == "done"
    assert robot.bodies == [Halt()]


def test_late_malformed_oversized_and_foreign_commands_are_refused_counted_and_logged(pair, caplog):
    heard, robot = pair
    assert "too late" in raw_ask(heard, "A", encode(command(Halt(), left=-0.001))).text
    assert "another session" in raw_ask(heard, "A", encode(command(Halt(), session="before"))).text
    for _ in range(3):
        assert raw_ask(heard, "A", b"\xc1 no command", 0.3) is None
    assert raw_ask(heard, "A", bytes(MAX_MESSAGE_BYTES + 1), 0.3) is None
    assert until(lambda: robot.link.counts.oversized == 1)
    counts = robot.link.counts
    assert (counts.late, counts.replayed, counts.malformed, counts.taken) == (1, 1, 3, 0)
    assert robot.bodies == []
    assert len([one for one in caplog.records if "malformed" in one.message]) == 1  # not a line for each
    assert "A refuses `Halt`, which came" in caplog.text
    assert heard.link.ask("A", Halt(), 3.0).ok  # and the robot goes on


def test_nobody_answers_is_a_sentence(pair):
    heard, _ = pair
    begin = time.monotonic()
    with pytest.raises(RobotError, match=r"robot B has not answered `Halt` within 0\.3 s: check its program"):
        heard.link.ask("B", Halt(), 0.3)
    assert time.monotonic() - begin < 3.0


def test_permission_to_move_counts_from_when_it_was_sent(pair):
    heard, robot = pair
    assert robot.link.last_heard == 0
    before = time.monotonic_ns()
    heard.link.hold()
    assert until(lambda: robot.link.last_heard > 0)
    assert abs(robot.link.last_heard - before) < 1e9
    last = robot.link.last_heard
    old = Hold(session="first", sent=time.monotonic_ns() - 60 * 10**9)
    for hold in (old, Hold(session="before", sent=time.monotonic_ns())):
        heard.link._session.zenoh.put("coloc/A/hold", encode(hold))
    heard.link._session.zenoh.put("coloc/A/hold", b"?")
    assert until(lambda: robot.link.counts.malformed == 1 and robot.link.counts.replayed == 1)
    assert robot.link.last_heard == last


def comes_to_count(heard, other, key, data, what):
    """Whether what an outsider puts is counted; what it puts before it knows that somebody listens goes nowhere."""
    before = getattr(heard.link.counts, what)
    return until(lambda: other.put(key, data) or getattr(heard.link.counts, what) > before)


def test_what_robots_send_is_checked(pair, caplog):
    heard, robot = pair
    with outsider(heard.address) as other:
        for key, data, what in (
            ("coloc/A/status", b"\x00", "malformed"),
            ("coloc/A/time", b"\x00", "malformed"),
            ("coloc/A/status", bytes(MAX_MESSAGE_BYTES + 1), "oversized"),
            ("coloc/Z/status", b"", "foreign"),
            ("coloc/**", b"\x00", "foreign"),
        ):
            assert comes_to_count(heard, other, key, data, what), (key, what)
    robot.put_event("first")
    assert until(lambda: len(heard.events) == 1)
    again = encode(heard.events[0][1])
    heard.link._receiver(Event)("coloc/A/events", again)
    assert heard.link.counts.replayed == 1 and len(heard.events) == 1
    late = msgspec.structs.replace(heard.events[0][1], number=4)
    heard.link._receiver(Event)("coloc/A/events", encode(late))
    assert until(lambda: heard.link.counts.missed == 3)  # it was asked for them, and has none
    assert len(heard.events) == 2 and "3 Event messages of A are lost" in caplog.text


def test_what_does_not_come_by_itself_is_asked_for(soon_asked, pair):
    heard, robot = pair
    robot.put_event("0")
    assert until(lambda: len(heard.events) == 1)
    subscribers = [one for one in heard.link._session._declared if isinstance(one, zenoh.Subscriber)]
    for one in (one for one in subscribers if str(one.key_expr).rpartition("/")[2] in KEPT_KINDS):
        one.undeclare()
    for number in range(1, 300):
        robot.put_event(str(number))
    assert until(lambda: len(heard.events) == 300)
    assert [int(one.text) for _, one in heard.events] == list(range(300))
    assert heard.link.counts.missed == 0
    time.sleep(1.5 * soon_asked)  # the newest is asked for again, and is no replay
    assert heard.link.counts.replayed == 0


def test_a_request_that_fails_is_no_answer(pair, monkeypatch):
    """What is missing is lost when the robot answers that it has it no more, not when nothing is heard of it."""
    heard, robot = pair
    robot.put_event("0")
    assert until(lambda: len(heard.events) == 1)
    assert not heard.link._recoveries["B"].request(Event, "_sn=0..9")  # nobody is there to answer
    assert not heard.link._recoveries["A"].request(Sample, "_sn=0..9")  # nothing was ever sent
    assert heard.link._recoveries["A"].request(Event, "_sn=5..9") and heard.link._recoveries["A"].request(
        Event, "_max=1"
    )
    failing = [True]
    of_a = heard.link._recoveries["A"]
    request = of_a.request
    monkeypatch.setattr(of_a, "request", lambda *one: not failing[0] and request(*one))
    gap = msgspec.structs.replace(heard.events[0][1], number=2)
    heard.link._receiver(Event)("coloc/A/events", encode(gap))
    time.sleep(5 * RECOVERY_PERIOD)
    assert len(heard.events) == 1 and heard.link.counts.missed == 0
    failing[0] = False
    assert until(lambda: len(heard.events) == 2) and heard.link.counts.missed == 1


def test_a_reply_that_is_an_error_is_no_answer(pair):
    heard, _ = pair

    def fail(query):
        query.reply_err(b"not now")

    with outsider(heard.address) as other:
        other.declare_queryable("coloc/C/events/@adv/pub/x/y/_", fail)
        assert until(lambda: any(other.info.peers_zid()))
        asked = [heard.link._recoveries["C"].request(Event, "_max=1") for _ in range(5) if time.sleep(0.1) is None]
        assert asked == [False] * 5


def test_restarts_of_one_robot_leave_another_robots_data_alone(soon_asked, pair):
    heard, a = pair
    for _ in range(40):
        a.put_wheels()
    assert until(lambda: len(heard.wheels) == 40)
    for n in range(4):
        with Robot("B", heard.address, session=f"run-{n}") as b:
            b.put_event(str(n))
            assert until(lambda n=n: sum(name == "B" for name, _ in heard.events) == n + 1), heard.presence
            a.put_wheels()
    with outsider(heard.address) as other:  # as a robot that makes up sessions, by the hundred
        before = heard.link.counts.unknown
        assert comes_to_count(heard, other, "coloc/B/events", encode(event_of("x", 1)), "unknown")
        for n in range(300):
            other.put("coloc/B/events", encode(event_of(f"made-up-{n}", 1)))
        assert until(lambda: heard.link.counts.unknown >= before + 300)
    a.put_wheels()
    assert until(lambda: len(heard.wheels) == 45)
    time.sleep(1.5 * soon_asked)
    assert [one.number for _, one in heard.wheels] == list(range(45))
    assert heard.link.counts.missed == 0 and heard.link.counts.replayed == 0


def event_of(session, number):
    return Event(session=session, number=number, stamp=1, kind="tick", text="")


def test_a_second_program_of_the_same_name_is_refused_and_the_first_one_goes_on(pair, caplog):
    heard, first = pair
    another_clock = {"clock": lambda: time.monotonic_ns() + 3600 * 10**9}
    with Robot("A", heard.address, session="second", **another_clock) as second:
        second.put_event("of the second")
        assert until(lambda: second.link.refused is not None)
        assert second.link.refused == (
            "another program runs as robot A already: end it first, or give this one its own name"
        )
        assert heard.link.counts.duplicate >= 1 and "refused a second program that runs as robot A" in caplog.text
        for n in range(20):
            assert heard.link.ask("A", Capture(capture=n), LONG).ok
        heard.link.hold()
        first.put_event("of the first")
        assert until(lambda: first.link.last_heard > 0 and len(heard.events) == 1)
        assert first.bodies == [Capture(capture=n) for n in range(20)] and second.bodies == []
        assert second.link.last_heard == 0 and first.link.refused is None
    assert heard.presence == [("A", True)]
    assert heard.link.clocks["A"].jumps == 0
    assert abs(heard.link.clocks["A"].estimate(time.monotonic_ns()).offset) < 1e9
    first.link.close()
    assert until(lambda: heard.presence[-1] == ("A", False))
    with Robot("A", heard.address, session="third") as third:
        assert until(lambda: heard.link._inboxes["A"].session == "third")
        assert heard.link.ask("A", Capture(capture=99), LONG).ok and third.bodies == [Capture(capture=99)]
        assert heard.presence[-1] == ("A", True) and third.link.refused is None
        third.put_event("of the third")
        assert until(lambda: len(heard.events) == 2)
    assert [one.text for _, one in heard.events] == ["of the first", "of the third"]


def test_a_command_to_a_program_that_was_restarted_meanwhile_is_refused(pair):
    heard, robot = pair
    ended = threading.Event()
    robot._answer = lambda body: ended.wait(LONG) and "late"
    replies = []
    asking = threading.Thread(target=lambda: replies.append(heard.link.ask("A", Halt(), LONG)))
    asking.start()
    assert until(lambda: robot.bodies)
    robot.link._session.zenoh.close()
    with Robot("A", heard.address, session="second") as second:
        asking.join()
        ended.set()
        assert not replies[0].ok and "restarted meanwhile" in replies[0].text and second.bodies == []


# clocks


def test_clocks_are_found_over_the_link_and_their_jumps():
    ahead = [3600 * 10**9]
    with Heard(free_port()) as heard, Robot("A", heard.address, clock=lambda: time.monotonic_ns() + ahead[0]) as robot:
        assert until(lambda: heard.link.synchronised("A", 5e-3))
        known = heard.link.clocks["A"].estimate(time.monotonic_ns())
        print(f"    error {(known.offset - ahead[0]) / 1e3:.0f} us, sigma {known.sigma / 1e3:.0f} us")
        assert abs(known.offset - ahead[0]) < max(6 * known.sigma, 1e6)
        assert heard.link.ask("A", Halt(), LONG).ok  # its deadline is in the robot's time
        ahead[0] += 10**9
        assert until(lambda: heard.link.clocks["A"].jumps >= 1)
        assert until(lambda: heard.link.synchronised("A", 5e-3))
        known = heard.link.clocks["A"].estimate(time.monotonic_ns())
        assert abs(known.offset - ahead[0]) < max(6 * known.sigma, 1e6)
        assert heard.link.ask("A", Halt(), LONG).ok and robot.link.counts.late == 0


def test_what_is_measured_waits_for_the_clock():
    with Heard(free_port()) as heard:
        publishers = heard.link._publishers
        heard.link._publishers = dict.fromkeys(publishers, lambda _: None)  # nobody is asked for the time
        with Robot("A", heard.address) as robot:
            for _ in range(5):
                robot.put_sample()
            assert until(lambda: ("A", True) in heard.presence) and heard.samples == []
            heard.link._publishers = publishers
            assert until(lambda: len(heard.samples) == 5)


# presence, restarts, cuts

ROBOT = """
import sys, time
from coloc_graph.robot_io.link.robot_link import RobotLink
from coloc_graph.robot_io.link.messages import Event
with RobotLink("A", connect=sys.argv[1], handler=lambda body: "", session=sys.argv[2]) as link:
    for number in range(10**6):
        link.put(Event(session=sys.argv[2], number=number, stamp=time.monotonic_ns(), kind="tick", text=""))
        time.sleep(0.01)
"""


def test_a_robot_that_is_killed_is_missed_at_once_and_welcome_again():
    with Heard(free_port()) as heard:
        for session in ("one", "two"):
            program = subprocess.Popen([sys.executable, "-c", ROBOT, heard.address, session])
            try:
                assert until(lambda session=session: sum(one.session == session for _, one in heard.events) > 20, 60)
                assert heard.presence[-1] == ("A", True)
            finally:
                program.kill()
                program.wait()
            killed = time.monotonic()
            assert until(lambda: heard.presence[-1] == ("A", False))
            print(f"    missed after {time.monotonic() - killed:.3f} s")
        for session in ("one", "two"):
            numbers = [one.number for _, one in heard.events if one.session == session]
            assert numbers == list(range(len(numbers)))
        assert heard.link.counts.missed == 0


def test_a_coordinator_that_comes_late_or_again_gets_what_it_missed():
    port = free_port()
    with Robot("A", f"tcp/127.0.0.1:{port}") as robot:
        for _ in range(50):
            robot.put_sample()
        for total in (50, 80):
            with Heard(port) as heard:
                assert until(lambda heard=heard, total=total: len(heard.samples) >= total)
                assert [one.number for _, one in heard.samples] == list(range(total))
                assert until(lambda: robot.link.connected)
            assert until(lambda: not robot.link.connected)
            for _ in range(30):
                robot.put_sample()


@pytest.mark.parametrize(("seconds", "presence"), [(0.7, False), (4.0, True)], ids=["short", "longer than the lease"])
def test_what_is_measured_during_a_cut_comes_afterwards(seconds, presence):
    port = free_port()
    with Relay(port) as relay, Heard(port) as heard, Robot("A", f"tcp/127.0.0.1:{relay.port}") as robot:
        heard.there("A")
        ended = threading.Event()

        def measure():
            while not ended.wait(0.01):
                robot.put_sample()
                robot.put_wheels()

        measuring = threading.Thread(target=measure)
        measuring.start()
        assert until(lambda: len(heard.samples) > 20)
        relay.cut()
        was_cut = time.monotonic()
        with pytest.raises(RobotError, match="has not answered"):
            heard.link.ask("A", Halt(), min(seconds, 1.0) / 2)
        bodies = len(robot.bodies)
        assert not presence or until(lambda: heard.presence[-1] == ("A", False))
        if presence:
            print(f"    noticed after {time.monotonic() - was_cut:.2f} s")
        time.sleep(max(was_cut + seconds - time.monotonic(), 0))
        relay.mend()
        mended = time.monotonic()
        count = len(heard.samples)
        assert until(lambda: len(heard.samples) > count)
        assert until(lambda: heard.presence[-1] == ("A", True))
        assert until(lambda: heard.link.ask("A", Capture(capture=1), LONG).ok)
        print(f"    back after {time.monotonic() - mended:.2f} s")
        ended.set()
        measuring.join()
        assert until(lambda: len(heard.samples) >= robot.sent[Sample] and len(heard.wheels) >= robot.sent[Wheels])
        for kind in (heard.samples, heard.wheels):
            assert [one.number for _, one in kind] == list(range(len(kind)))
        assert heard.link.counts.missed == 0
        assert robot.bodies[bodies:] == [Capture(capture=1)]  # the command of the cut was late, or was lost


def test_of_a_command_whose_answer_is_lost_the_answer_comes_again():
    port = free_port()
    with Relay(port) as relay, Heard(port) as heard, Robot("A", f"tcp/127.0.0.1:{relay.port}") as robot:
        heard.there("A")
        robot._answer = lambda body: relay.drop() or "done"  # the line goes while it is carried out
        assert heard.link.ask("A", Halt(), LONG).text == "done"
        assert robot.bodies == [Halt()] and robot.link.counts.replayed >= 1


# who may listen and who may speak


@pytest.mark.parametrize("address", ["127.0.0.1:7447", "tcp/127.0.0.1", "udp/127.0.0.1:7447", "tcp/localhost:port"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(InputError, match="is not a valid address of a link"):
        Robot("A", address)


def test_others_are_let_in_without_certificates_only_where_that_is_said(caplog):
    port = free_port()
    with pytest.raises(
        InputError, match=r"can be reached from other machines, which could steer the robots: .*--exposed"
    ):
        config_of(listen=f"tcp/0.0.0.0:{port}")
    with caplog.at_level(logging.WARNING):
        config_of(listen=f"tcp/0.0.0.0:{port}", exposed=True)
    assert "can see and steer the robots" in caplog.text
    config_of(listen="tcp/[::1]:7447")


def test_a_port_that_is_taken_is_a_sentence():
    with Heard(free_port()) as heard, pytest.raises(RobotError, match="cannot open the link"):
        Heard(int(heard.address.rpartition(":")[2]))


def test_certificates_are_made_once_for_their_owner_alone(tmp_path, capsys):
    write_team(TEAM, tmp_path / "team.toml")
    folder = tmp_path / "certificates"
    assert main(["certificates", str(folder), str(tmp_path / "team.toml")]) == 0
    assert "for A: ca.pem, A.pem, A.key" in capsys.readouterr().out
    names = ["ca", "coordinator", *TEAM.names]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        f"{name}.{kind}" for name in names for kind in ("key", "pem")
    )
    for name in names:
        assert stat.S_IMODE((folder / f"{name}.key").stat().st_mode) == 0o600
    before = (folder / "ca.key").read_bytes()
    assert main(["certificates", str(folder), str(tmp_path / "team.toml")]) == 2
    assert "exists; replace it and all others with --force" in capsys.readouterr().err
    assert (folder / "ca.key").read_bytes() == before
    assert main(["certificates", str(folder), str(tmp_path / "team.toml"), "--force"]) == 0
    assert (folder / "ca.key").read_bytes() != before
    assert stat.S_IMODE((folder / "ca.key").stat().st_mode) == 0o600
    with pytest.raises(InputError, match="a robot cannot be called `coordinator`"):
        make_certificates(tmp_path / "other", ["A", "coordinator"])
    with pytest.raises(InputError, match=r"D\.pem does not exist: make certificates"):
        config_of(connect="tls/127.0.0.1:7447", tls=tls_of(folder, "D"))
    with pytest.raises(InputError, match="belong together"):
        config_of(connect="tcp/127.0.0.1:7447", tls=tls_of(folder, "A"))


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certificates")
    make_certificates(folder, TEAM.names)
    return folder


@pytest.fixture
def secured(certificates):
    """A coordinator and robot A with certificates, who know each other."""
    with (
        Heard(free_port(), tls=tls_of(certificates, "coordinator")) as heard,
        Robot("A", heard.address, tls=tls_of(certificates, "A")) as robot,
    ):
        heard.there("A")
        yield heard, robot


def test_with_certificates_everything_works(secured):
    heard, robot = secured
    assert heard.link.ask("A", Capture(capture=1), LONG).ok
    for _ in range(20):
        robot.put_sample()
    heard.link.hold()
    assert until(lambda: len(heard.samples) == 20 and robot.link.last_heard > 0 and robot.link.connected)


def test_a_coordinator_with_certificates_gets_what_it_missed(certificates):
    port = free_port()
    with Robot("A", f"tls/127.0.0.1:{port}", tls=tls_of(certificates, "A")) as robot:
        for _ in range(50):
            robot.put_sample()
        with Heard(port, tls=tls_of(certificates, "coordinator")) as heard:
            assert until(lambda: len(heard.samples) >= 50)
            assert [one.number for _, one in heard.samples] == list(range(50))


def test_a_stranger_is_not_let_in(secured, certificates, tmp_path):
    heard, robot = secured
    make_certificates(tmp_path, TEAM.names)  # of another authority
    others = tls_of(tmp_path, "A")
    mixed = Tls(tls_of(certificates, "A").ca, others.certificate, others.key)  # who knows ours, and has none of it
    for tls in (others, mixed):
        with outsider(heard.address, tls) as stranger:
            for _ in range(6):
                stranger.put("coloc/A/status", b"\x00")
                assert not list(stranger.get("coloc/A/command/first", payload=encode(command(Halt())), timeout=0.05))
            assert list(stranger.info.peers_zid()) == []
    with outsider(heard.address.replace("tls/", "tcp/")) as stranger:
        for _ in range(6):
            stranger.put("coloc/A/status", b"\x00")
            time.sleep(0.02)
        assert list(stranger.info.peers_zid()) == []
    assert heard.link.counts.malformed == 0 and robot.bodies == []
    assert heard.link.ask("A", Halt(), LONG).ok


def test_a_robot_speaks_only_as_itself_and_commands_nobody(secured, certificates):
    heard, robot = secured
    with outsider(heard.address, tls_of(certificates, "B")) as bad:
        assert until(lambda: len(list(bad.info.peers_zid())) == 1)
        bad.liveliness().declare_token("coloc/B/alive/bad")
        assert until(lambda: ("B", True) in heard.presence)
        overheard = []
        bad.declare_subscriber(
            "coloc/**", lambda one: overheard.append(str(one.key_expr)), allowed_origin=zenoh.Locality.REMOTE
        )
        bad.declare_queryable("coloc/A/command/first", lambda query: query.reply(query.key_expr, b"mine"))
        bad.declare_queryable("coloc/*/command/*", lambda query: query.reply(query.key_expr, b"mine"))
        bad.liveliness().declare_token("coloc/C/alive/bad")
        for key in ("coloc/A/status", "coloc/C/status", "coloc/*/status", "coloc/**", "coloc/A/time", "coloc/A/hold"):
            for _ in range(5):
                bad.put(key, b"\x00")
        answers = list(bad.get("coloc/A/command/first", payload=encode(command(Halt())), timeout=0.5))
        assert {one.ok.payload.to_bytes() for one in answers if one.ok is not None} <= {b"mine"}  # it hears itself
        bad.put("coloc/B/status", b"\x00")
        assert until(lambda: heard.link.counts.malformed >= 1)
        time.sleep(0.3)
        assert heard.link.counts.malformed == 1  # that of B as itself, and nothing else came
        assert heard.link.counts.foreign == 0 and ("C", True) not in heard.presence
        assert robot.bodies == [] and robot.link.counts.malformed == 0
        robot.put_sample()
        assert heard.link.ask("A", Capture(capture=2), LONG).ok
        assert heard.link.counts.malformed == 1
        heard.link.hold()
        assert until(lambda: len(heard.samples) == 1)
        assert not [key for key in overheard if not key.startswith("coloc/B/")]


def test_a_robot_obeys_nobody_but_the_coordinator(certificates):
    config = config_of(listen=f"tls/127.0.0.1:{(port := free_port())}", tls=tls_of(certificates, "B"), robots=["A"])
    config.insert_json5("access_control/enabled", "false")
    session = zenoh.open(config)
    try:
        with Robot("A", f"tls/127.0.0.1:{port}", tls=tls_of(certificates, "A")) as robot:
            assert until(lambda: len(list(session.info.peers_zid())) == 1)
            session.liveliness().declare_token("coloc/coordinator/alive")
            for _ in range(10):
                session.put("coloc/A/hold", encode(Hold(session="first", sent=time.monotonic_ns())))
                asked = session.get("coloc/A/command/first", payload=encode(command(Halt())), timeout=0.1)
                assert not [one for one in asked if one.ok is not None]
            assert robot.bodies == [] and robot.link.last_heard == 0 and not robot.link.connected
    finally:
        session.close()
