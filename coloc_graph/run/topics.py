"""Reading of one topic's messages by time, one chunk at a time."""

import itertools
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

from coloc_graph.errors import RunError
from coloc_graph.run import schemas
from coloc_graph.run.chunks import ChunkInfo, Message, damaged, messages
from coloc_graph.run.decode import MalformedError
from coloc_graph.run.index import Index, KeptChunk

T = TypeVar("T")

KEPT_CHUNKS = 256  # decompressed chunks in the cache of a run
KEPT_MESSAGES = 250_000  # messages in the cache, besides the newest chunk
KEPT_BYTES = 64 * 1024 * 1024  # bytes in the cache, besides the newest chunk


class Item(NamedTuple):
    """A message's time [ns], its schema and its bytes."""

    ns: int
    schema: str
    data: bytes


def _chunks(index: Index, topic: str) -> tuple[dict[int, str], list[ChunkInfo]]:
    """{channel: schema} of a topic, and the chunks that hold it."""
    wanted = {channel: info.schema for channel, info in index.channels.items() if info.topic == topic}
    return wanted, [chunk for chunk in index.chunks if not wanted.keys().isdisjoint(chunk.counts)]


def read_topic(index: Index, topic: str, first: int = 0, last: int | None = None) -> Iterator[Item]:
    """Yield a topic's messages from `first` to `last` [ns], in the order in which they were written."""
    wanted, chunks = _chunks(index, topic)
    chunks = [chunk for chunk in chunks if chunk.end >= first and (last is None or chunk.start <= last)]
    for item in _in_order(index, topic, wanted, chunks):
        if first <= item.ns and (last is None or item.ns <= last):
            yield item


def _in_order(index: Index, topic: str, wanted: dict[int, str], chunks: Iterable[ChunkInfo]) -> Iterator[Item]:
    """Yield the messages of a topic in some chunks; `RunError` where time runs backwards."""
    before = 0
    for message in _messages(index, topic, wanted, chunks):
        if message.ns < before:
            raise RunError(
                f"{index.path}: time runs backwards in {topic} at {schemas.to_seconds(message.ns)} s; "
                "write each topic in the order of time"
            )
        before = message.ns
        yield Item(message.ns, wanted[message.channel], message.data)


def read_near(index: Index, topic: str, instants: Sequence[int]) -> list[Item]:
    """Return a topic's last message up to each instant [ns], the one after it, and the first and last of all.

    Only chunks that can hold one of these are read, where chunks do not overlap in time.
    """
    wanted, chunks = _chunks(index, topic)
    if all(before.end <= after.start for before, after in itertools.pairwise(chunks)):
        starts, kept = [chunk.start for chunk in chunks], {0, len(chunks) - 1}
        for instant in instants:
            at = bisect_right(starts, instant) - 1
            kept |= {at - 1, at, at + 1}
        chunks = [chunk for number, chunk in enumerate(chunks) if number in kept]
    items = list(_in_order(index, topic, wanted, chunks))
    times, chosen = [item.ns for item in items], {0, len(items) - 1}
    for instant in instants:
        at = bisect_right(times, instant) - 1
        chosen |= {at, at + 1}
    return [item for number, item in enumerate(items) if number in chosen]


def _messages(index: Index, topic: str, channels: Collection[int], chunks: Iterable[ChunkInfo]) -> Iterator[Message]:
    """Yield messages of some channels in some chunks, as written; the file is open only while this runs."""
    try:
        with index.path.open("rb") as file:
            for chunk in chunks:
                kept = index.newest.get(chunk.offset)
                if kept is None:
                    kept = _keep(index, chunk, messages(index.path, file, chunk))
                found = [one for channel in channels for one in kept.by_channel.get(channel, ())]
                if len(found) != sum(chunk.counts.get(channel, 0) for channel in channels):
                    raise damaged(index.path, chunk.offset, f"not as many messages of {topic} as its index says")
                if len(channels) > 1:
                    found.sort(key=lambda one: one.position)
                yield from found
    except OSError as error:
        raise RunError(f"{index.path}: cannot be read ({error.strerror}); check the disk") from error


def _keep(index: Index, chunk: ChunkInfo, read: Iterable[Message]) -> KeptChunk:
    """Put the messages of a chunk, by channel, into the cache: of a stance each robot's topics are read."""
    by_channel: dict[int, list[Message]] = {}
    count = 0
    for count, one in enumerate(read, start=1):
        by_channel.setdefault(one.channel, []).append(one)
    last = next(reversed(index.newest.values()), None)
    before = (0, 0) if last is None else (last.number_before + last.number, last.size_before + last.size)
    index.newest[chunk.offset] = kept = KeptChunk(by_channel, count, chunk.size, *before)
    while len(index.newest) > 1 and _too_much(index.newest):
        index.newest.pop(next(iter(index.newest)), None)
    return kept


def _too_much(newest: dict[int, KeptChunk]) -> bool:
    """Return whether the cached chunks are too many, or too large."""
    first, last = next(iter(newest.values())), next(reversed(newest.values()))
    number = last.number_before + last.number - first.number_before
    size = last.size_before + last.size - first.size_before
    return len(newest) > KEPT_CHUNKS or number > KEPT_MESSAGES or size > KEPT_BYTES


def decoded(index: Index, items: tuple[str, Iterator[Item]], decoder: Callable[[Item], T]) -> Iterator[T]:
    """Yield the records of (topic, messages); RunError, with topic and time, for a malformed message."""
    topic, rows = items
    for item in rows:
        try:
            yield decoder(item)
        except MalformedError as error:
            raise RunError(
                f"{index.path}: the message of {topic} at {schemas.to_seconds(item.ns)} s is wrong: {error}; "
                "see docs/run-format.md"
            ) from error


def time_span(index: Index, topic: str) -> tuple[int, int]:
    """Return the first and last time of a topic [ns]; a chunk's own times are those of all topics, truth included."""
    wanted, chunks = _chunks(index, topic)
    times = [message.ns for message in _messages(index, topic, wanted, chunks[:1] + chunks[1:][-1:])]
    return min(times), max(times)
