"""The messages of one topic, by time and one chunk at a time, from the file to records."""

from collections.abc import Callable, Collection, Iterable, Iterator
from typing import NamedTuple, TypeVar

from coloc_graph.errors import RunError
from coloc_graph.run import schemas
from coloc_graph.run.chunks import ChunkInfo, Message, damaged, messages
from coloc_graph.run.decode import MalformedError
from coloc_graph.run.index import Index

T = TypeVar("T")

#: So many chunks of a run are kept once they are read.
KEPT = 24


class Item(NamedTuple):
    """A message's time [ns], its schema and its bytes."""

    ns: int
    schema: str
    data: memoryview


def _chunks(index: Index, topic: str) -> tuple[dict[int, str], list[ChunkInfo]]:
    """{channel: schema} of a topic, and the chunks that hold it."""
    wanted = {channel: info.schema for channel, info in index.channels.items() if info.topic == topic}
    return wanted, [chunk for chunk in index.chunks if not wanted.keys().isdisjoint(chunk.counts)]


def read_topic(index: Index, topic: str, first: int = 0, last: int | None = None) -> Iterator[Item]:
    """A topic's messages from `first` to `last` [ns], in the order in which they were written."""
    wanted, chunks = _chunks(index, topic)
    chunks = [chunk for chunk in chunks if chunk.end >= first and (last is None or chunk.start <= last)]
    before = 0
    for message in _messages(index, topic, wanted, chunks):
        if message.ns < before:
            raise RunError(
                f"{index.path}: time runs backwards in {topic} at {schemas.to_seconds(message.ns)} s; "
                "write each topic in the order of time"
            )
        before = message.ns
        if first <= message.ns and (last is None or message.ns <= last):
            yield Item(message.ns, wanted[message.channel], message.data)


def _messages(index: Index, topic: str, channels: Collection[int], chunks: Iterable[ChunkInfo]) -> Iterator[Message]:
    """The messages of some channels in some chunks, in the order of writing; the file is open only while this runs."""
    try:
        with index.path.open("rb") as file:
            for chunk in chunks:
                by_channel = index.newest.get(chunk.offset)
                if by_channel is None:
                    by_channel = _keep(index, chunk, messages(index.path, file, chunk))
                found = [one for channel in channels for one in by_channel.get(channel, ())]
                if len(found) != sum(chunk.counts.get(channel, 0) for channel in channels):
                    raise damaged(index.path, chunk.offset, f"not as many messages of {topic} as its index says")
                if len(channels) > 1:
                    found.sort(key=lambda one: one.place)
                yield from found
    except OSError as error:
        raise RunError(f"{index.path}: cannot be read ({error.strerror}); check the disk") from error


def _keep(index: Index, chunk: ChunkInfo, read: Iterable[Message]) -> dict[int, list[Message]]:
    """The messages of a chunk by channel, kept as one of the newest: of a stance each robot's topics are asked for."""
    by_channel: dict[int, list[Message]] = {}
    for one in read:
        by_channel.setdefault(one.channel, []).append(one)
    while len(index.newest) >= KEPT:
        index.newest.pop(next(iter(index.newest)), None)
    index.newest[chunk.offset] = by_channel
    return by_channel


def decoded(index: Index, items: tuple[str, Iterator[Item]], decoder: Callable[[Item], T]) -> Iterator[T]:
    """The records of (topic, messages); RunError, with topic and time, for a message that is wrong."""
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
    """First and last time of a topic [ns]; a chunk's own times are those of all topics, truth included."""
    wanted, chunks = _chunks(index, topic)
    times = [message.ns for message in _messages(index, topic, wanted, chunks[:1] + chunks[1:][-1:])]
    return min(times), max(times)
