"""The bytes of the iRobot Create: commands as the Open Interface has them, and a decoder that survives a bad line."""

import random

import pytest

from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.protocol import Packet, StreamDecoder, decode_values, encode_frame, split_command

ASKED = (Packet.BUMPS_DROPS, Packet.MODE, Packet.REQUESTED_LEFT, Packet.LEFT_TICKS, Packet.RIGHT_TICKS)


def frame(header_counts=True, **changed):
    values = {Packet.BUMPS_DROPS: 3, Packet.MODE: 2, Packet.REQUESTED_LEFT: -200, Packet.LEFT_TICKS: 65530}
    values |= {Packet.RIGHT_TICKS: 19} | {Packet[name]: value for name, value in changed.items()}
    return encode_frame(values, header_counts=header_counts)


@pytest.mark.parametrize(("command", "expected"), [
    (oi.drive_direct(200, 100), "145 0 200 0 100"),  # the right wheel first
    (oi.drive_direct(-200, 500), "145 255 56 1 244"),
    (oi.HALT, "145 0 0 0 0"),
    (oi.stream([29, 13]), "148 2 29 13"),
    (oi.pause_stream(), "150 0"),
    (oi.resume_stream(), "150 1"),
    (oi.query([35]), "142 35"),
    (oi.query([9, 13]), "149 2 9 13"),
    (bytes([oi.START, oi.SAFE, oi.FULL, oi.STOP_INTERFACE, oi.RESET]), "128 131 132 173 7"),
])  # fmt: skip
def test_commands_are_the_open_interfaces_to_the_byte(command, expected):
    assert command == bytes(int(word) for word in expected.split())


def test_a_wheel_is_not_asked_for_what_it_cannot():
    for speeds in ((501, 0), (0, -501), (float("nan"), 0)):
        with pytest.raises(ValueError, match="500 mm/s"):
            oi.drive_direct(*speeds)


def test_the_packets_have_the_sizes_that_the_groups_add_up_to():
    sizes = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52, 100: 80, 101: 28, 106: 12, 107: 9}
    assert set(sizes) == set(oi.GROUPS)
    for group, size in sizes.items():
        assert sum(oi.PACKETS[i].size for i in oi.expand([group])) == size
    with pytest.raises(KeyError):
        oi.expand([99])


def test_values_have_their_signs():
    data = bytes([0xFF, 0xFF, 0xFF, 0xFF, 0xFF])
    assert decode_values([19, 43, 24], data) == {19: -1, 43: 65535, 24: -1}
    assert oi.encode_value(43, 65537) == b"\0\1"  # counts wrap
    assert oi.encode_value(19, 40000) == b"\x7f\xff"  # a distance is capped
    with pytest.raises(ValueError, match="not the packets"):
        decode_values([19], b"\0")


@pytest.mark.parametrize(("text", "header_counts"), [
    ("19 5 29 2 25 13 0 182", False),  # the example in the Create 1's specification
    ("19 5 29 2 25 13 0 163", True),  # the same in the Create 2's
])  # fmt: skip
def test_the_examples_of_both_specifications(text, header_counts):
    data = bytes(int(word) for word in text.split())
    assert encode_frame({29: 537, 13: 0}, header_counts=header_counts) == data
    decoder = StreamDecoder([29, 13])
    assert decoder.feed(data * 2) == [{29: 537, 13: 0}] * 2
    assert (decoder.header_counts, decoder.good, decoder.bad) == (header_counts, 2, 0)


def test_once_the_checksum_is_known_the_other_kind_is_damage():
    decoder = StreamDecoder(ASKED)
    assert len(decoder.feed(frame() * 2)) == 2
    assert decoder.feed(frame(header_counts=False) + frame()) == decoder.feed(frame())
    assert (decoder.good, decoder.bad) == (4, 1)


def test_frames_are_found_at_every_split():
    data = b"".join(frame(MODE=mode, LEFT_TICKS=19 * 256 + mode) for mode in (1, 2, 3))
    whole = StreamDecoder(ASKED).feed(data)
    assert [one[Packet.MODE] for one in whole] == [1, 2, 3]
    for at in range(len(data) + 1):
        decoder = StreamDecoder(ASKED)
        assert decoder.feed(data[:at]) + decoder.feed(data[at:]) == whole
    decoder = StreamDecoder(ASKED)
    assert [one for byte in data for one in decoder.feed(bytes([byte]))] == whole
    assert decoder.bad == 0


def test_two_layouts_may_take_turns():
    short = encode_frame({35: 2}, header_counts=False)
    long = encode_frame({35: 2, 19: -4, 20: 7}, header_counts=False)
    found = StreamDecoder([35], [35, 19, 20]).feed(short + long + short)
    assert found == [{35: 2}, {35: 2, 19: -4, 20: 7}, {35: 2}]


def test_damaged_frames_are_counted_and_the_next_is_found():
    good = frame()
    wrong_sum, short, other_list = (
        good[:-1] + bytes([good[-1] ^ 1]),
        good[:-4],
        encode_frame({35: 2}, header_counts=True),
    )
    for damage, count in ((wrong_sum, 1), (short, 1), (other_list, 1), (b"bl-start\r\n", 1), (wrong_sum * 3, 3)):
        decoder = StreamDecoder(ASKED)
        assert len(decoder.feed(good + damage + good)) == 2
        assert (decoder.good, decoder.bad) == (2, count)


def mutated(rng, data):
    """One to three bytes changed, lost, doubled or put in; sometimes garbage, sometimes the end is missing."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        at, kind = rng.randrange(len(out)), rng.randrange(6)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            out[at] = rng.choice((0, 19, 255, rng.randrange(256)))
        elif kind == 2 and len(out) > 1:
            del out[at]
        elif kind == 3:
            out.insert(at, rng.choice((19, rng.randrange(256))))
        elif kind == 4:
            out[at:at] = rng.randbytes(rng.randint(1, 40))
        else:
            del out[max(at, 1) :]  # never all of it
    return bytes(out)


def test_five_thousand_damaged_frames_in_random_pieces():
    rng = random.Random(7)
    wrong = counted = 0
    for n in range(5_000):
        kind = bool(n % 2)
        original, clean = frame(kind, LEFT_TICKS=rng.randrange(65536)), frame(kind)
        damaged = mutated(rng, original)
        data = clean * 2 + damaged + clean * 2
        decoder, found, at = StreamDecoder(ASKED), [], 0
        while at < len(data):
            piece = rng.randint(1, 30)
            found += decoder.feed(data[at : at + piece])
            at += piece
        truth, sent = StreamDecoder(ASKED).feed(clean + original)
        assert found[:2] == [truth] * 2 and found[-1] == truth, (n, damaged)
        # what is damaged swallows at most one of the frames behind it
        assert decoder.good == len(found) >= 3, (n, damaged)
        assert decoder.header_counts is kind
        wrong += sum(one not in (truth, sent) for one in found)
        if damaged and len(found) == 4:  # no frame was made of the damaged bytes
            assert decoder.bad >= 1, (n, damaged)
            counted += 1
    assert counted > 2_500
    assert wrong < 60  # an eight-bit checksum misses one in 256


def test_noise_is_no_frames():
    rng = random.Random(3)
    decoder = StreamDecoder(ASKED)
    found = [one for _ in range(500) for one in decoder.feed(rng.randbytes(97))]
    assert len(found) <= 1 and decoder.bad > 1000


def test_commands_are_split_as_they_come():
    commands = [bytes([128, 131][n : n + 1]) for n in (0, 1)]
    commands += [oi.stream([7, 35]), oi.drive_direct(1, 2), oi.query([9, 13]), bytes([140, 0, 2, 60, 8, 62, 8])]
    commands += [bytes([137, 0, 200, 0x80, 0]), bytes([139, 8, 0, 128]), oi.pause_stream(), bytes([173])]
    data = b"".join(commands)
    found, buffer = [], b""
    for byte in data:
        buffer += bytes([byte])
        command, buffer = split_command(buffer)
        found += [command] if command else []
    assert found == commands and buffer == b""
    assert split_command(b"") == (None, b"")
