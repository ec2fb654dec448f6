"""What is left of a run after a kill, a cut, and damage."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conformance_run import check_everything, everything, make

from coloc_graph.errors import RunError
from coloc_graph.run import RunWriter, open_run, read_true_team, read_truth

SUPPORT = str(Path(__file__).parents[1] / "support")
SLACK = 0.15  # of a busy machine's scheduler


def read_all(path):
    """Everything that is in a file, as comparable text."""
    run = open_run(path)
    rows = [repr(run.team), repr(run.stances), repr(run.planes)]
    with np.printoptions(threshold=sys.maxsize):
        for robot in run.team.names:
            for read in (run.images, run.detections, run.odometry, run.motions):
                rows += [repr(record) for record in read(robot)]
        rows += [repr(trajectory) for trajectory in read_truth(path).values()]
    return run, [*rows, repr(read_true_team(path))]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = everything(tmp_path_factory.mktemp("run") / "whole.mcap")
    return path, path.read_bytes(), read_all(path)[1]


def test_a_flipped_bit_is_found_or_harmless(whole, tmp_path):
    _, data, wanted = whole
    random = np.random.default_rng(1)
    path = tmp_path / "flipped.mcap"
    found = 0
    for at in sorted(random.choice(len(data), 300, replace=False)):
        flipped = bytearray(data)
        flipped[at] ^= 1 << random.integers(8)
        path.write_bytes(flipped)
        try:
            rows = read_all(path)[1]
        except RunError as error:
            assert "flipped.mcap" in str(error), at
            assert "\n" not in str(error), at
            found += 1
        else:
            assert rows == wanted, at
    assert found > 200


def test_a_wrong_byte_in_a_head_is_found_or_harmless(whole, tmp_path):
    """The headers, lengths and indexes, which have no checksum of their own."""
    _, data, wanted = whole
    run = open_run(whole[0])
    chunk = run._index.chunks[1]
    heads = [*range(53), *range(chunk.offset, chunk.offset + 57)]
    heads += range(chunk.offset + chunk.length, chunk.offset + chunk.length + chunk.index_length + 13)
    heads += range(len(data) - 37, len(data))
    path = tmp_path / "flipped.mcap"
    for at in heads[::4]:
        flipped = bytearray(data)
        flipped[at] ^= (0x01, 0x08, 0xFF)[at % 3]
        path.write_bytes(flipped)
        try:
            rows = read_all(path)[1]
        except RunError as error:
            assert "flipped.mcap" in str(error), at
        else:
            assert rows == wanted, at


def test_a_file_cut_anywhere_opens_with_what_was_whole(tmp_path):
    with RunWriter(tmp_path / "run.mcap", make.team(), image_format="png", flush_every=None) as writer:
        writer.write_true_team(make.team(20.5))
        for k in range(40):
            for robot in "AB":
                writer.write(make.detections(robot, make.T0 + k / 10))
            if k % 5 == 4:
                writer._flush()
    data = (tmp_path / "run.mcap").read_bytes()
    run = open_run(tmp_path / "run.mcap")
    ends = [chunk.offset + chunk.length for chunk in run._index.chunks]
    path = tmp_path / "cut.mcap"
    for size in [*range(0, len(data), 50), *range(12), *ends, *(end - 1 for end in ends), len(data) - 1]:
        path.write_bytes(data[:size])
        if size < ends[0]:
            with pytest.raises(RunError, match="empty" if size == 0 else "nothing usable was recorded"):
                open_run(path)
            continue
        cut = open_run(path)
        chunks = sum(end <= size for end in ends)
        assert len(list(cut.detections("B"))) == 5 * (chunks - 1), size
        assert cut.team == make.team()
        # a cut may be between any two records, not only behind a chunk
        assert (
            cut._index.lost == 0
            if size in ends
            else cut._index.lost < size - max(end for end in ends if end <= size) + 1
        )
        words = "was cut off, the last" if cut._index.lost else "was cut off or is still being"
        assert words in cut.warnings[0], size
        assert "the last 0 bytes" not in cut.warnings[0]


def test_zeros_at_the_end_are_a_cut_and_anything_else_is_damage(whole, tmp_path):
    _, data, _ = whole
    body = data[: open_run(whole[0])._index.chunks[1].offset]
    path = tmp_path / "run.mcap"
    path.write_bytes(body + bytes(5000))
    assert "the last 5000 bytes" in open_run(path).warnings[0]
    path.write_bytes(body + bytes(5000) + b"x")
    with pytest.raises(RunError, match="damaged at byte"):
        open_run(path)


def test_a_length_beyond_the_end_of_a_finished_file_is_damage_not_a_cut(whole, tmp_path):
    _, data, _ = whole
    chunk = open_run(whole[0])._index.chunks[1]
    path = tmp_path / "run.mcap"
    path.write_bytes(data[: chunk.offset + 1] + (10**6).to_bytes(8, "little") + data[chunk.offset + 9 :])
    with pytest.raises(RunError, match=f"damaged at byte {chunk.offset} .*beyond the end"):
        open_run(path)
    path.write_bytes(data[: chunk.offset + 1] + (2**60).to_bytes(8, "little") + data[chunk.offset + 9 : -8])
    with pytest.raises(RunError, match=f"damaged at byte {chunk.offset} "):
        open_run(path)


@pytest.mark.parametrize("content", [b"", b"hello, world", b"\x89MCAP1\r\n" + bytes(100)])
def test_what_is_no_run_is_refused(tmp_path, content):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(RunError, match="is empty" if not content else "not an MCAP"):
        open_run(path)


def test_a_folder_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(RunError, match="not a file"):
        open_run(tmp_path)
    with pytest.raises(RunError, match="No such file"):
        open_run(tmp_path / "missing.mcap")


def test_a_file_that_vanishes_while_it_is_read_is_a_sentence(tmp_path):
    run = open_run(everything(tmp_path / "run.mcap"))
    run.path.write_bytes(run.path.read_bytes()[:2000])
    run._index.newest.clear()  # a run of one chunk, which opening it has read
    with pytest.raises(RunError, match="too short"):
        list(run.images("A"))
    run.path.unlink()
    with pytest.raises(RunError, match="cannot be read"):
        list(run.images("A"))


RECORDER = """
import sys, time
sys.path.insert(0, sys.argv[2])
from conformance_run import make
from coloc_graph.run import Image, RunWriter
writer = RunWriter(sys.argv[1], make.team())
pixels = make.pixels(0)
began = time.time()
while time.time() - began < float(sys.argv[3]):
    now = time.time()
    writer.write(Image("A", now, pixels))
    print(now, flush=True)
    time.sleep(0.01)
print("idle", flush=True)
time.sleep(60)
"""


def record(path, seconds):
    return subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(path), SUPPORT, str(seconds)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )


@pytest.mark.parametrize("lifetime", [0.7, 1.3])
def test_a_killed_recorder_loses_half_a_second_at_most(tmp_path, lifetime):
    path = tmp_path / "run.mcap"
    with record(path, 60) as process:
        written = [float(process.stdout.readline())]
        while written[-1] - written[0] < lifetime:
            written.append(float(process.stdout.readline()))
        killed = time.time()
        process.send_signal(signal.SIGKILL)
        written += [float(line) for line in process.stdout.read().split()]
    run = open_run(path)
    found = [image.time for image in run.images("A")]
    assert found == pytest.approx(written[: len(found)], abs=1e-6)
    assert killed - found[-1] < 0.5 + SLACK
    assert "was cut off" in run.warnings[0]


def test_a_killed_recorder_that_was_idle_loses_nothing(tmp_path):
    path = tmp_path / "run.mcap"
    with record(path, 0.2) as process:
        written = [float(line) for line in iter(process.stdout.readline, "idle\n")]
        time.sleep(0.5 + SLACK)
        process.send_signal(signal.SIGKILL)
    assert len(list(open_run(path).images("A"))) == len(written)


def test_a_recording_can_be_read_while_it_is_written(tmp_path):
    with RunWriter(tmp_path / "run.mcap", make.team(), image_format="png", flush_every=0.1) as writer:
        make.write_everything(writer)
        time.sleep(0.1 + SLACK)
        check_everything(open_run(tmp_path / "run.mcap"))
    assert open_run(tmp_path / "run.mcap").warnings == ()
