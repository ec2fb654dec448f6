"""What passes over the link: there and back, what is refused, and what comes of messages that were tampered with."""

import math
import random

import msgspec
import numpy as np
import pytest

from coloc_graph.robot_io.link.command_filter import CommandFilter
from coloc_graph.robot_io.link.counters import LinkCounter
from coloc_graph.robot_io.link.messages import (
    MAX_MARKERS,
    MAX_MESSAGE_BYTES,
    Capture,
    ClockQuestion,
    ClockReply,
    Command,
    Drive,
    EndCapture,
    Event,
    Halt,
    Hold,
    MessageError,
    OversizedError,
    Recover,
    Refusal,
    Reply,
    Sample,
    Status,
    Wheels,
    decode,
    encode,
)
from coloc_graph.run import Detections, OdometrySample


def detections(n, seed=0):
    rng = np.random.default_rng(seed)
    spread = rng.normal(0, 0.3, (n, 2, 2))
    return Detections(
        "A",
        12.5,
        rng.uniform(0, 300, (n, 2)),
        spread @ spread.swapaxes(1, 2) + 0.01 * np.eye(2),
        tuple(f"C/{i}" for i in range(n)),
        rng.integers(0, 16, n).astype(np.uint8),
        rng.uniform(10, 200, n),
        rng.uniform(4, 40, n),
    )


def sample(n=3, **changes):
    return msgspec.structs.replace(
        Sample.of(detections(n), session="s", number=4, capture=2, stamp=123456789), **changes
    )


WHEELS = Wheels.of(
    OdometrySample("A", 1.0, np.array([1.0, 2.0, 0.5]), np.diag([1e-4, 2e-4, 3e-4])), session="s", number=9, stamp=77
)
DRIVE = Drive(number=1, places=[(0.5, 0.25), (1.0, 0.0)], yaw=0.3, speed=0.2)
STATUS = Status(
    session="s", stamp=5, phase="idle", capture=None, moving=False, still_since=4, fault=None, camera_fault="dark",
    hazards=["bump"],
)  # fmt: skip


def command(body=DRIVE, **changes):
    return msgspec.structs.replace(Command(id="0" * 32, session="s", deadline=10**12, body=body), **changes)


BODIES = (Capture(capture=3), EndCapture(), DRIVE, msgspec.structs.replace(DRIVE, yaw=None), Halt(), Recover())
VALID = [
    *map(sample, (3, 0, MAX_MARKERS)), WHEELS, Event(session="s", number=0, stamp=1, kind="fault", text="why"), STATUS,
    *map(command, BODIES), Reply(id="0" * 32, ok=False, text="no"), Hold(session="s", sent=10**12),
    ClockQuestion(asked=1), ClockReply(session="s", asked=1, received=2, sent=3),
    Refusal(session="s", text="two of them"),
]  # fmt: skip


@pytest.mark.parametrize("message", VALID, ids=lambda one: type(one).__name__)
def test_what_is_sent_is_what_comes(message):
    assert decode(encode(message), type(message)) == message


def test_detections_and_odometry_come_as_they_were():
    seen = detections(5)
    back = decode(encode(Sample.of(seen, session="s", number=0, capture=0, stamp=1)), Sample).detections("A", 12.5)
    order = np.argsort(-seen.peak)
    for name in ("uv", "covariance", "flags", "peak", "area"):
        np.testing.assert_allclose(getattr(back, name), getattr(seen, name)[order], rtol=1e-15)
        assert getattr(back, name).dtype == getattr(seen, name).dtype
    assert back.markers == tuple(seen.markers[i] for i in order)
    assert sample(0).detections("A", 1.0).covariance.shape == (0, 2, 2)
    odometry = decode(encode(WHEELS), Wheels).sample("A", 1.0)
    assert odometry.pose.tolist() == [1.0, 2.0, 0.5]
    assert odometry.covariance.tolist() == np.diag([1e-4, 2e-4, 3e-4]).tolist()


def test_of_too_many_markers_the_brightest_are_sent():
    seen = detections(100)
    sent = Sample.of(seen, session="s", number=0, capture=0, stamp=1)
    assert sent.peak == sorted(seen.peak.tolist(), reverse=True)[:MAX_MARKERS]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (sample(uv=[(math.nan, 0.0)] * 3), "not finite"),
        (sample(peak=[math.inf] * 3), "not finite"),
        (sample(uv=[(1e7, 0.0)] * 3), "far outside"),
        (sample(covariance=[(1.0, 1.0, 1.0)] * 3), "positive definite"),
        (sample(covariance=[(-1.0, 0.0, -1.0)] * 3), "positive definite"),
        (sample(covariance=[(1e300, 0.0, 1.0)] * 3), "positive definite"),
        (sample(area=[1.0] * 2), "differ in length"),
        (sample(flags=[16, 0, 0]), "flag"),
        (sample(markers=["x" * 65, "", ""]), "name has more than 64"),
        (sample(number=-1), "count is negative"),
        (sample(stamp=2**63), "stamp is out"),
        (sample(session="s" * 1000), "name has more than 64"),
        (
            msgspec.structs.replace(sample(), **{name: getattr(sample(65), name) for name in ("uv",)}),
            "more than 64",
        ),
        (msgspec.structs.replace(WHEELS, pose=(math.nan, 0.0, 0.0)), "coordinate"),
        (msgspec.structs.replace(WHEELS, covariance=(-1.0, 0.0, 0.0, 1.0, 0.0, 1.0)), "not positive semi"),
        (Event(session="s", number=0, stamp=1, kind="k", text="x" * 5000), "text has more than 2000"),
        (msgspec.structs.replace(STATUS, hazards=["x"] * 17), "hazards"),
        (command(msgspec.structs.replace(DRIVE, speed=0.6)), "speed"),
        (command(msgspec.structs.replace(DRIVE, speed=math.nan)), "speed"),
        (command(msgspec.structs.replace(DRIVE, yaw=math.inf)), "waypoints"),
        (command(msgspec.structs.replace(DRIVE, places=[(0.0, math.nan)])), "waypoints"),
        (command(msgspec.structs.replace(DRIVE, places=[(0.0, 0.0)] * 101)), "waypoints"),
        (command(id="i" * 65), "name has more than 64"),
    ],
)
def test_what_cannot_be_is_refused(message, why):
    with pytest.raises(MessageError, match=why):
        decode(encode(message), type(message))


#: Values out of range, by the name of a field.
BEYOND = (
    dict.fromkeys(("number", "capture"), (-1, 2**53))
    | dict.fromkeys(("stamp", "still_since", "asked", "received", "sent", "deadline"), (2**62, -(2**62)))
    | dict.fromkeys(("session", "id", "kind", "frame", "phase"), ("x" * 65,))
    | dict.fromkeys(("text", "fault", "camera_fault"), ("x" * 2001,))
)


@pytest.mark.parametrize("message", [*VALID, *BODIES], ids=lambda one: type(one).__name__)
def test_each_field_is_checked(message):
    checked = set(msgspec.structs.asdict(message)) & set(BEYOND)
    for name in checked:
        for value in BEYOND[name]:
            changed = msgspec.structs.replace(message, **{name: value})
            with pytest.raises(MessageError, match=r"count is|stamp is|name has|text has|session is"):
                if isinstance(message, (Capture, EndCapture, Drive, Halt, Recover)):
                    decode(encode(command(changed)), Command)
                else:
                    decode(encode(changed), type(message))


def test_other_kinds_fields_and_sizes_are_refused():
    with pytest.raises(MessageError, match="unknown field"):
        decode(msgspec.msgpack.encode({**msgspec.to_builtins(Hold(session="s", sent=1)), "more": 1}), Hold)
    with pytest.raises(MessageError, match="Invalid value 'Explode'"):
        decode(encode(command()).replace(b"\xa5Drive", b"\xa7Explode"), Command)
    with pytest.raises(MessageError, match=r"Expected `int`, got `str` - at `\$.sent`"):
        decode(msgspec.msgpack.encode({"session": "s", "sent": "now"}), Hold)
    with pytest.raises(MessageError):
        decode(b"", Sample)
    with pytest.raises(OversizedError, match=f"larger than {MAX_MESSAGE_BYTES} bytes"):
        decode(bytes(MAX_MESSAGE_BYTES + 1), Sample)


def mutations(rng, message, n):
    """Bytes of a message with bits flipped, bytes put in, cut out and repeated, ends cut off; some are still valid."""
    data = encode(message)
    headers = bytes([0x00, 0x7F, 0x80, 0xC0, 0xC1, 0xCB, 0xCF, 0xD9, 0xDC, 0xDD, 0xDF, 0xFF])
    for _ in range(n):
        one = bytearray(data)
        for _ in range(rng.choice((1, 1, 2, 3))):
            at = int(rng.random() * (len(one) + 1))
            match rng.choice(("flip", "flip", "header", "put in", "cut out", "cut off", "repeat")):
                case "flip" if at < len(one):
                    one[at] ^= 1 << rng.choice(range(8))
                case "header" if at < len(one):
                    one[at] = rng.choice(headers)
                case "put in":
                    one[at:at] = rng.randbytes(rng.choice(range(1, 9)))
                case "cut out":
                    del one[at : at + rng.choice(range(1, 9))]
                case "cut off":
                    del one[at:]
                case "repeat":
                    one[at:at] = one[at : at + rng.choice(range(1, 40))]
        yield bytes(one)


def test_tampered_messages_are_valid_or_refused():
    rng = random.Random(7)
    n = 33_000 // len(VALID)
    valid = refused = 0
    carried_out = []
    counter = LinkCounter()
    commands = CommandFilter("A", "s", lambda body: carried_out.append(body) or "", lambda: 0, counter)
    for message in VALID:
        for data in mutations(rng, message, n):
            try:
                again = decode(data, type(message))
            except MessageError:
                refused += 1
            else:
                valid += 1
                assert decode(encode(again), type(message)) == again
            if isinstance(message, Command):
                commands.answer(data)
            elif isinstance(message, Hold):
                commands.take_hold(data)
    print(f"    {valid} valid, {refused} refused, {len(carried_out)} carried out")
    assert valid + refused == n * len(VALID) >= 30_000
    assert valid > 300 and refused > 15_000
    counts = counter.counts()
    assert counts.malformed > 6_000 and counts.taken == len(carried_out)
    assert all(isinstance(body, Capture | EndCapture | Drive | Halt | Recover) for body in carried_out)
    assert all(0 < body.speed <= 0.5 for body in carried_out if isinstance(body, Drive))


def test_headers_that_promise_much_cost_nothing():
    for data in (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\x91" * 200_000):
        for kind in (Sample, Command, Status):
            with pytest.raises(MessageError):
                decode(data, kind)
