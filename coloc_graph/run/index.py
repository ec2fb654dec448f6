"""Index of the MCAP file of a run: its chunks, their messages, and what is damaged.

mcap's own readers need a whole file, trust every length that they read, and do not locate damage. This one walks over
the record headers (https://mcap.dev/spec), the same way for a whole file and for one that was cut off.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Statistics

from coloc_graph.errors import RunError
from coloc_graph.run.chunks import (
    HEAD,
    MAX_RECORD,
    MAX_RECORDS,
    ChannelInfo,
    ChunkInfo,
    Definitions,
    Message,
    damaged,
    learn,
    messages,
    records,
    stream,
)

MAGIC = b"\x89MCAP0\r\n"
MAX_COMPRESSION = 2000  # ratio of decompressed to compressed size; noiseless images reach a few hundred with zstd
FOOTER_HEAD = HEAD.pack(Opcode.FOOTER, 20)
FOOTER_SIZE = len(FOOTER_HEAD) + 20


class KeptChunk(NamedTuple):
    """Messages of a decompressed chunk by channel.

    Their number and size [bytes], and the sums of these over all chunks put into the cache before.
    """

    by_channel: dict[int, list[Message]]
    number: int
    size: int
    number_before: int
    size_before: int


@dataclass(frozen=True)
class Index:
    """Index of an MCAP file.

    Parameters
    ----------
    path : Path
        The file.
    profile : str
        Profile in its header.
    chunks : tuple of ChunkInfo
        In the order of the file.
    channels : dict of int to ChannelInfo
        Channels that have messages.
    lost : int or None
        Bytes at the end that could not be read; None of a whole file.
    newest : dict
        Cache of decompressed chunks by their offsets.
    """

    path: Path
    profile: str
    chunks: tuple[ChunkInfo, ...]
    channels: dict[int, ChannelInfo]
    lost: int | None
    newest: dict[int, KeptChunk] = field(default_factory=dict, repr=False, compare=False)


def is_mcap(path: Path) -> bool:
    """Return whether a file begins with the magic bytes of MCAP."""
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def build_index(path: Path) -> Index:
    """Build the index of an MCAP file, whole or cut off.

    Raises
    ------
    RunError
        The file is damaged, or not an MCAP file.
    """
    if path.exists() and not path.is_file():
        raise RunError(f"{path}: is not a file; give the path of a run (.mcap)")
    try:
        with path.open("rb") as file:
            return _Walk(path, file).index()
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}); give the path of a run (.mcap)") from error


class _Walk:
    """One pass over the headers of a file's records."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self.file = file
        self.size = file.seek(0, 2)
        self.profile = ""
        self.chunks: list[ChunkInfo] = []
        self.data_end: int | None = None

    def index(self) -> Index:
        self._check_magic()
        footer = self._footer()
        reached = self._walk(whole=footer is not None)
        self._require_plausible_size()
        counted = 0
        for chunk in self.chunks:
            # a writer can do without indexes, and a whole chunk can have its indexes cut off
            if not chunk.counts or (footer is None and chunk is self.chunks[-1]):
                counted += self._count_messages(chunk)
            if counted > max(self.size, MAX_RECORDS):
                raise damaged(self.path, chunk.offset, f"more than {counted} messages in {self.size} bytes")
        if footer is not None and footer.summary_start:
            self._compare_with_summary(footer)
        lost = None if footer is not None else max(self.size - reached, 0)
        return Index(self.path, self.profile, tuple(self.chunks), self._channels(), lost)

    def _read(self, offset: int, length: int) -> bytes:
        self.file.seek(offset)
        return self.file.read(length)

    def _check_magic(self) -> None:
        magic = self._read(0, len(MAGIC))
        if not magic:
            raise RunError(f"{self.path}: is empty; record it again")
        if not MAGIC.startswith(magic):
            raise RunError(f"{self.path}: is not an MCAP file; give the path of a run (.mcap)")

    def _footer(self) -> Footer | None:
        """Return the footer of a whole file; None where it was cut off."""
        start = self.size - len(MAGIC) - FOOTER_SIZE
        if start < len(MAGIC):
            return None
        tail = self._read(start, FOOTER_SIZE + len(MAGIC))
        if not tail.startswith(FOOTER_HEAD) or not tail.endswith(MAGIC):
            return None
        footer: Footer = Footer.read(stream(memoryview(tail)[len(FOOTER_HEAD) :]))
        if footer.summary_start and not len(MAGIC) <= footer.summary_start <= start:
            raise damaged(self.path, start, "the footer points outside of the file")
        return footer

    def _walk(self, whole: bool) -> int:
        """Note all records up to the end of the data or the last whole one; return the offset there [bytes]."""
        end = self.size - len(MAGIC) if whole else self.size
        offset = len(MAGIC)
        while offset < end and self.data_end is None:
            head = self._read(offset, HEAD.size)
            if not whole and (len(head) < HEAD.size or (head[0] == 0 and self._only_zeros(offset))):
                return offset
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            if opcode == 0 or length > MAX_RECORD:
                raise damaged(self.path, offset, f"a record of kind {opcode} and {length} bytes")
            if offset + HEAD.size + length > end:
                if whole:
                    raise damaged(self.path, offset, "a record reaches beyond the end")
                return offset
            self._note(opcode, offset, length)
            offset += HEAD.size + length
        if whole and self.data_end is None:
            raise damaged(self.path, offset, "the end of the data is missing")
        return offset

    def _only_zeros(self, offset: int) -> bool:
        # after a power cut a file system leaves zeros in blocks that were never written
        self.file.seek(offset)
        return all(not block.strip(b"\0") for block in iter(lambda: self.file.read(1 << 20), b""))

    def _note(self, opcode: int, offset: int, length: int) -> None:
        if (offset == len(MAGIC)) != (opcode == Opcode.HEADER):
            raise damaged(self.path, offset, "the header is not the first record")
        if opcode == Opcode.HEADER:
            body = self._read(offset + HEAD.size, min(length, 1024))
            self.profile = body[4 : 4 + int.from_bytes(body[:4], "little")].decode("utf-8", "replace")
        elif opcode == Opcode.CHUNK:
            if length < 40:
                raise damaged(self.path, offset, "a chunk without a header")
            start, end, size = struct.unpack("<QQQ", self._read(offset + HEAD.size, 24))
            self.chunks.append(ChunkInfo(offset, HEAD.size + length, start, end, size))
        elif opcode == Opcode.MESSAGE_INDEX:
            self._note_index(offset, length)
        elif opcode == Opcode.MESSAGE:
            raise RunError(f"{self.path}: has a message outside of chunks at byte {offset}; write the run in chunks")
        elif opcode == Opcode.DATA_END:
            self.data_end = offset + HEAD.size + length

    def _note_index(self, offset: int, length: int) -> None:
        channel, size = struct.unpack("<HI", self._read(offset + HEAD.size, 6)) if length >= 6 else (0, -1)
        if size != length - 6 or size % 16 or not self.chunks:
            raise damaged(self.path, offset, "an inconsistent message index")
        chunk = self.chunks[-1]
        chunk.index_length += HEAD.size + length
        if size:  # some writers also list channels without messages in the chunk
            chunk.counts[channel] = chunk.counts.get(channel, 0) + size // 16
            chunk.index_offsets[channel] = offset

    def _require_plausible_size(self) -> None:
        """Raise `RunError` for a decompression bomb."""
        size = sum(chunk.size for chunk in self.chunks)
        if size > MAX_RECORD + MAX_COMPRESSION * self.size:
            raise RunError(
                f"{self.path}: its {self.size} bytes decompress to {size}, which no recording does; record it again, "
                "or compress it less"
            )

    def _count_messages(self, chunk: ChunkInfo) -> int:
        chunk.counts = {}
        for message in messages(self.path, self.file, chunk):
            chunk.counts[message.channel] = chunk.counts.get(message.channel, 0) + 1
        return sum(chunk.counts.values())

    def _compare_with_summary(self, footer: Footer) -> None:
        """Compare chunks and counts with those in the summary: headers and indexes have no checksums."""
        start = footer.summary_start
        footer_start = self.size - len(MAGIC) - FOOTER_SIZE
        summary = self._read(start, footer_start - start)
        crc = zlib.crc32(self._read(footer_start, FOOTER_SIZE - 4), zlib.crc32(summary))
        if start != self.data_end or footer.summary_crc not in (0, crc):
            raise damaged(self.path, start, "a summary that does not match its checksum")
        chunks: list[ChunkIndex] = []
        counts: dict[int, int] | None = None
        try:
            for opcode, body in records(self.path, summary, start):
                if opcode == Opcode.CHUNK_INDEX:
                    chunks.append(ChunkIndex.read(stream(body)))
                elif opcode == Opcode.STATISTICS:
                    counts = Statistics.read(stream(body)).channel_message_counts
        except (McapError, struct.error, ValueError) as error:
            raise damaged(self.path, start, "a summary that cannot be read") from error
        if chunks:
            self._compare_chunks(chunks)
        if counts is not None and {channel: n for channel, n in counts.items() if n} != self._totals():
            raise damaged(self.path, start, "the number of messages is not that of the summary")

    def _compare_chunks(self, wanted: list[ChunkIndex]) -> None:
        if len(wanted) != len(self.chunks):
            raise damaged(self.path, wanted[0].chunk_start_offset, "the number of chunks is not that of the summary")
        for said, chunk in zip(sorted(wanted, key=lambda said: said.chunk_start_offset), self.chunks, strict=True):
            same = (
                said.chunk_start_offset == chunk.offset
                and said.chunk_length == chunk.length
                and said.message_start_time == chunk.start
                and said.message_end_time == chunk.end
                and said.message_index_length == chunk.index_length
                and chunk.index_offsets.items() <= said.message_index_offsets.items()
            )
            if not same:
                raise damaged(self.path, chunk.offset, "a chunk differs from its entry in the summary")

    def _totals(self) -> dict[int, int]:
        totals: dict[int, int] = {}
        for chunk in self.chunks:
            for channel, count in chunk.counts.items():
                totals[channel] = totals.get(channel, 0) + count
        return totals

    def _channels(self) -> dict[int, ChannelInfo]:
        """Return all channels that have messages, from the chunks in which they first appear."""
        known = Definitions()
        skipped: list[ChunkInfo] = []
        for chunk in self.chunks:
            if chunk.counts.keys() <= known.channels.keys():
                skipped.append(chunk)
                continue
            learn(self.path, self.file, chunk, known)
            if not chunk.counts.keys() <= known.channels.keys():
                # other writers may define a channel in a chunk that has none of its messages
                for other in skipped:
                    learn(self.path, self.file, other, known)
                skipped.clear()
            missing = chunk.counts.keys() - known.channels.keys()
            if missing:
                raise damaged(self.path, chunk.offset, f"channel {min(missing)} is used but not defined")
        return {channel: known.channels[channel] for channel in self._totals()}
