"""One chunk of an MCAP file: its records, checked before anything in them is believed."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from coloc_graph.errors import RunError

#: Larger than any image; a larger length is damage, and nothing is allocated for it.
MAX_RECORD = 256 * 1024 * 1024
#: Most records in one chunk. Writers make chunks of kilobytes to a few megabytes; the smallest message takes 31 bytes.
MAX_RECORDS = 250_000
HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, its CRC, length of the compression's name
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class ChannelInfo(NamedTuple):
    """Topic, schema and encoding of a channel."""

    topic: str
    schema: str
    encoding: str


class Message(NamedTuple):
    """One message as it is in the file, `ns` UTC nanoseconds; `place` is where it is among the others of its chunk."""

    channel: int
    ns: int
    data: memoryview
    place: int


@dataclass(slots=True)
class ChunkInfo:
    """Place of a chunk in the file and its `size` without compression [bytes], the times in it [ns], and the number of
    messages by channel."""

    offset: int
    length: int
    start: int
    end: int
    size: int
    counts: dict[int, int] = field(default_factory=dict)
    index_offsets: dict[int, int] = field(default_factory=dict)
    index_length: int = 0


@dataclass(frozen=True)
class Definitions:
    """The channels and the names of the schemas (by id) that chunks define."""

    channels: dict[int, ChannelInfo] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)


def damaged(path: Path, offset: int, what: str) -> RunError:
    """The sentence for a file that is neither whole nor merely cut off."""
    return RunError(f"{path}: damaged at byte {offset} ({what}); copy it again from where it was recorded")


def records(path: Path, data: bytes, offset: int) -> Iterator[tuple[int, memoryview]]:
    """(opcode, body) of the records in `data`, which is at (or, compressed, in the chunk at) `offset`."""
    view = memoryview(data)
    at, end, left = 0, len(view), MAX_RECORDS
    while at < end:
        left -= 1
        if left < 0:
            raise damaged(path, offset, f"a part with more than {MAX_RECORDS} records")
        opcode, length = HEAD.unpack_from(view, at) if at + HEAD.size <= end else (0, 0)
        at += HEAD.size
        until = at + length
        if not opcode or until > end:
            raise damaged(path, offset, "what is in it is not a row of records")
        yield opcode, view[at:until]
        at = until


def stream(body: memoryview) -> ReadDataStream:
    """A record's body as mcap's record classes read it."""
    return ReadDataStream(BytesIO(body))


def decompressed(path: Path, file: BinaryIO, chunk: ChunkInfo) -> bytes:
    """The records in a chunk; RunError where they are not what was written (CRC)."""
    file.seek(chunk.offset + HEAD.size)
    body = file.read(chunk.length - HEAD.size)
    at = _CHUNK.size
    if len(body) != chunk.length - HEAD.size or len(body) < at:
        raise damaged(path, chunk.offset, "a chunk that is too short")
    start, end, size, crc, name_length = _CHUNK.unpack_from(body)
    name = body[at : at + name_length]
    at += name_length + 8
    data = body[at:]
    if (start, end, size) != (chunk.start, chunk.end, chunk.size) or len(data) != int.from_bytes(
        body[at - 8 : at], "little"
    ):
        raise damaged(path, chunk.offset, "a chunk whose head contradicts itself")
    if size > MAX_RECORD:
        raise damaged(path, chunk.offset, f"a chunk of {size} bytes")
    try:
        out = _decompress(name, data, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
        raise damaged(path, chunk.offset, "a chunk that cannot be decompressed") from error
    if len(out) != size or crc not in (0, zlib.crc32(out)):
        raise damaged(path, chunk.offset, "a chunk that does not have its checksum")
    return out


def _decompress(name: bytes, data: bytes, size: int) -> bytes:
    # what is inside states its size too, and that is what would be allocated
    if name == b"zstd":
        stated = zstandard.get_frame_parameters(data).content_size
        if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(stated)
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    if name == b"lz4":
        stated = lz4.frame.get_frame_info(data)["content_size"]
        if stated not in (size, 0):
            raise ValueError(stated)
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    if name:
        raise ValueError(name)
    return data


def messages(path: Path, file: BinaryIO, chunk: ChunkInfo) -> Iterator[Message]:
    """The messages in a chunk, in the order of writing; all are checked."""
    start, end = chunk.start, chunk.end
    for place, (opcode, body) in enumerate(records(path, decompressed(path, file, chunk), chunk.offset)):
        if opcode != Opcode.MESSAGE:
            continue
        if len(body) < _MESSAGE.size:
            raise damaged(path, chunk.offset, "a message without a head")
        channel, _, ns, _ = _MESSAGE.unpack_from(body)
        if not start <= ns <= end:
            raise damaged(path, chunk.offset, "a message outside of its chunk's time")
        yield Message(channel, ns, body[_MESSAGE.size :], place)


def learn(path: Path, file: BinaryIO, chunk: ChunkInfo, known: Definitions) -> None:
    """Add the channels and schemas that a chunk defines to those that are known."""
    for opcode, body in records(path, decompressed(path, file, chunk), chunk.offset):
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream(body))
                known.schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream(body))
                schema_name = known.schemas.get(channel.schema_id, "")
                known.channels[channel.id] = ChannelInfo(channel.topic, schema_name, channel.message_encoding)
        except (McapError, struct.error, ValueError) as error:
            raise damaged(path, chunk.offset, "a channel that cannot be read") from error
