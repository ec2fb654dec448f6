"""Small files that would take gigabytes or minutes are refused before they do, in one sentence."""

import resource
import struct
import subprocess
import sys
import time
import zlib

import cv2
import numpy as np
import pytest
import zstandard
from conformance_run import everything, make
from mcap.writer import CompressionType, IndexType, Writer

from coloc_graph.errors import RunError
from coloc_graph.run import EncodedImage, RunWriter, open_run
from coloc_graph.run.chunks import MAX_RECORDS
from coloc_graph.run.image_header import read_image_header, too_large
from coloc_graph.run.topics import KEPT_MESSAGES, _too_much

CHUNK = struct.Struct("<QQQII")


def chunk_of(data: bytes) -> bytes:
    """An MCAP chunk, compressed by zstd, with the header and magic of a file that was cut off."""
    packed = zstandard.ZstdCompressor(level=1).compress(data)
    body = CHUNK.pack(0, 0, len(data), zlib.crc32(data), 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def bomb(path, chunks):
    profile = b"coloc-graph-run-1"
    head = struct.pack("<I", len(profile)) + profile + struct.pack("<I", 0)
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, len(head)) + head + b"".join(chunks))
    return path


def refused_quickly(path):
    """The sentence for a file, by a process that may take 1 GiB and 10 s of its own time."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))\n"
        "resource.setrlimit(resource.RLIMIT_CPU, (10, 10))\n"
        "from coloc_graph.cli import main; sys.exit(main(['info', sys.argv[1]]))"
    )
    process = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert process.returncode == 2, process.stderr
    assert process.stderr.count("\n") == 1 and process.stderr.startswith("coloc: ")
    return process.stderr


def test_a_chunk_of_millions_of_tiny_messages_is_refused(tmp_path):
    message = struct.pack("<BQ", 5, 22) + bytes(22)
    path = bomb(tmp_path / "tiny.mcap", [chunk_of(message * 2_000_000)])
    assert path.stat().st_size < 40_000
    assert f"a part with more than {MAX_RECORDS} records" in refused_quickly(path)


def test_many_chunks_of_many_messages_are_refused(tmp_path):
    message = struct.pack("<BQ", 5, 22) + bytes(22)
    path = bomb(tmp_path / "many.mcap", [chunk_of(message * 200_000)] * 50)
    assert "messages in" in refused_quickly(path)


def test_a_file_that_is_all_compression_is_refused(tmp_path):
    size = 64 * 1024 * 1024
    path = bomb(tmp_path / "zeros.mcap", [chunk_of(struct.pack("<BQ", 200, size) + bytes(size))] * 20)
    assert "which no recording does" in refused_quickly(path)


def test_an_ordinary_run_without_indexes_and_with_high_compression_is_read(tmp_path):
    run = open_run(everything(tmp_path / "run.mcap"))
    assert run.topics
    assert not _too_much(run._index.newest) and KEPT_MESSAGES >= MAX_RECORDS


def png(width: int, height: int, bits: int = 8, colour: int = 0, data: bytes = b"") -> bytes:
    def part(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(data)) + part(b"IEND", b"")


@pytest.mark.parametrize(("data", "says"), [
    (png(65_000, 65_000), "has 65000 x 65000 pixels, and 67108864 are decoded at most"),
    (png(64, 64, bits=16), "1 channels of 16 bits"),
    (png(64, 64, colour=6), "4 channels of 8 bits"),
    (b"\x89PNG\r\n\x1a\n", "is not a png"),
])  # fmt: skip
def test_the_size_of_an_image_is_checked_before_it_is_decoded(tmp_path, data, says):
    path = tmp_path / "run.mcap"
    with RunWriter(path, make.team()) as writer:
        writer.write(EncodedImage("A", 1.0, "png", data))
    began, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RunError, match=says):
        list(open_run(path).images("A"))
    assert time.process_time() - began < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024  # KiB


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
@pytest.mark.parametrize("options", [(".png", []), (".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])])
def test_headers_of_images_are_read(shape, options):
    data = cv2.imencode(options[0], np.zeros(shape, np.uint8), options[1])[1].tobytes()
    header = read_image_header(data)
    assert (header.height, header.width, header.channels, header.bits) == (48, 64, 3 if len(shape) == 3 else 1, 8)
    assert too_large(header, data) is None
    for cut in range(0, len(data), 7):  # a part is a header or none, and no exception
        read_image_header(data[:cut])


def test_a_jpeg_of_very_many_scans_is_too_large():
    data = cv2.imencode(".jpg", np.zeros((2048, 4096), np.uint8))[1].tobytes()
    assert too_large(read_image_header(data), data) is None
    assert "scans" in too_large(read_image_header(data), data + 100 * b"\xff\xda")


def test_a_foreign_writer_without_indexes_is_read(tmp_path):
    path = tmp_path / "plain.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, index_types=IndexType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/x", "json", schema)
        for ns in range(5000):
            writer.add_message(channel, log_time=ns, publish_time=ns, data=b"{}")
        writer.finish()
    with pytest.raises(RunError, match="without a /team"):
        open_run(path)
