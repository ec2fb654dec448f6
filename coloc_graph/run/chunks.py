"""Chunks of an MCAP file: reading of their records, with checks against damage and hostile input."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from coloc_graph.errors import RunError

MAX_RECORD = 256 * 1024 * 1024  # bytes of a record: larger than any image; a larger length is damage
MAX_RECORDS = 250_000  # records in a chunk; writers make chunks of up to megabytes, the smallest message takes 31 bytes
HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, its CRC, length of the compression's name
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class ChannelInfo(NamedTuple):
    """Topic, schema and encoding of a channel."""

    topic: str
    schema: str
    encoding: str


class Message(msgspec.Struct, frozen=True, gc=False):
    """One message as in the file: `ns` is its time [UTC ns], `position` its index among the records of its chunk.

    Hundreds of thousands are cached: the garbage collector, for which each would be an object, does not see them.
    """

    channel: int
    ns: int
    data: bytes
    position: int


@dataclass(slots=True)
class ChunkInfo:
    """Position and contents of a chunk.

    Parameters
    ----------
    offset, length : int
        Position in the file [bytes].
    start, end : int
        First and last time [UTC ns].
    size : int
        Size without compression [bytes].
    counts : dict of int to int
        Number of messages by channel.
    index_offsets : dict of int to int
        Offsets of its message indexes by channel [bytes].
    index_length : int
        Length of all of them [bytes].
    """

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
    """Channels, and names of schemas, that chunks define; by id."""

    channels: dict[int, ChannelInfo] = field(default_factory=dict)
    schemas: dict[int, str] = field(default_factory=dict)


def damaged(path: Path, offset: int, what: str) -> RunError:
    """Return the error for a file that is neither whole nor merely cut off."""
    return RunError(f"{path}: damaged at byte {offset} ({what}); copy it again from where it was recorded")


def records(path: Path, data: bytes, offset: int) -> Iterator[tuple[int, memoryview]]:
    """Yield (opcode, body) of the records in `data`, which is at (or, compressed, in the chunk at) `offset`."""
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
            raise damaged(path, offset, "no sequence of records")
        yield opcode, view[at:until]
        at = until


def stream(body: memoryview) -> ReadDataStream:
    """Return a record's body as a stream for mcap's record classes."""
    return ReadDataStream(BytesIO(body))


def decompressed(path: Path, file: BinaryIO, chunk: ChunkInfo) -> bytes:
    """Return the decompressed records of a chunk; RunError where they do not match their checksum."""
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
        raise damaged(path, chunk.offset, "a chunk with an inconsistent header")
    if size > MAX_RECORD:
        raise damaged(path, chunk.offset, f"a chunk of {size} bytes")
    try:
        out = _decompress(name, data, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
        raise damaged(path, chunk.offset, "a chunk that cannot be decompressed") from error
    if len(out) != size or crc not in (0, zlib.crc32(out)):
        raise damaged(path, chunk.offset, "a chunk that does not match its checksum")
    return out


def _decompress(name: bytes, data: bytes, size: int) -> bytes:
    # the compressed frame states its size, too, and that would be allocated
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
    """Yield the messages of a chunk, checked, in the order of writing."""
    start, end = chunk.start, chunk.end
    for position, (opcode, body) in enumerate(records(path, decompressed(path, file, chunk), chunk.offset)):
        if opcode != Opcode.MESSAGE:
            continue
        if len(body) < _MESSAGE.size:
            raise damaged(path, chunk.offset, "a message without a header")
        channel, _, ns, _ = _MESSAGE.unpack_from(body)
        if not start <= ns <= end:
            raise damaged(path, chunk.offset, "a message outside of its chunk's time")
        yield Message(channel, ns, bytes(body[_MESSAGE.size :]), position)


def learn(path: Path, file: BinaryIO, chunk: ChunkInfo, known: Definitions) -> None:
    """Add the channels and schemas that a chunk defines to `known`."""
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
