"""Read the MCAP files of a ROS 2 bag of any profile, up to where they were cut off, within bounds of memory."""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from coloc_graph.errors import BagError
from coloc_graph.run.chunks import damaged, messages
from coloc_graph.run.index import Index, build_index
from coloc_graph.run.schemas import PROFILE_PREFIX

#: Encoding of the messages of ROS 2.
CDR = "cdr"


@dataclass(frozen=True)
class McapTopic:
    """Topic with the attributes of rosbags' connections."""

    topic: str
    msgtype: str
    msgcount: int
    digest: str = ""


class McapBag:
    """Reader of the MCAP files of one bag, in their order.

    Parameters
    ----------
    paths
        Files.

    Raises
    ------
    BagError
        If a file is a run, or holds no message of ROS 2.
    RunError
        If a file is damaged; it names the byte.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._indexes = [build_index(path) for path in paths]
        counts: dict[tuple[str, str], int] = {}
        encodings: set[str] = set()
        for index in self._indexes:
            if index.profile.startswith(PROFILE_PREFIX):
                raise BagError(f"{index.path}: is a run already; solve it as it is")
            for channel, info in index.channels.items():
                encodings.add(info.encoding)
                if info.encoding == CDR:
                    count = sum(chunk.counts.get(channel, 0) for chunk in index.chunks)
                    counts[info.topic, info.schema] = counts.get((info.topic, info.schema), 0) + count
        if not encodings and any(index.lost is not None for index in self._indexes):
            raise BagError(f"{paths[0]}: was cut off before its first message; record the bag again")
        if not counts:
            found = f"they are in {', '.join(sorted(encodings))}" if encodings else "there are none"
            raise BagError(
                f"{paths[0]}: is an MCAP file without messages of ROS 2, which are in {CDR} ({found}); give the bag "
                "as ROS 1 or ROS 2 recorded it"
            )
        self.connections = [McapTopic(topic, schema, count) for (topic, schema), count in counts.items()]

    @property
    def notes(self) -> list[str]:
        """Sentences on files that were cut off."""
        return [
            f"{index.path}: was cut off, its last {index.lost} bytes could not be read; all before them was"
            for index in self._indexes
            if index.lost is not None
        ]

    def messages(self, connections: Sequence[McapTopic]) -> Iterator[tuple[McapTopic, int, bytes]]:
        """Yield messages of some topics: topic, time of reception [ns], and data, in that order in each file."""
        wanted = {(one.topic, one.msgtype): one for one in connections}
        for index in self._indexes:
            channels = {
                channel: wanted[info.topic, info.schema]
                for channel, info in index.channels.items()
                if info.encoding == CDR and (info.topic, info.schema) in wanted
            }
            yield from _in_order(index, channels)

    def close(self) -> None:
        """Do nothing: files are open only while messages are read."""


def _in_order(index: Index, channels: dict[int, McapTopic]) -> Iterator[tuple[McapTopic, int, bytes]]:
    """Messages of some channels by time, across chunks that overlap in time."""
    waiting: list[tuple[int, int, McapTopic, bytes]] = []
    number = 0
    with index.path.open("rb") as file:
        for chunk in sorted(index.chunks, key=lambda one: one.start):
            while waiting and waiting[0][0] < chunk.start:
                ns, _, topic, data = heapq.heappop(waiting)
                yield topic, ns, data
            due = sum(chunk.counts.get(channel, 0) for channel in channels)
            if not due:
                continue
            for one in messages(index.path, file, chunk):
                if one.channel in channels:
                    heapq.heappush(waiting, (one.ns, number, channels[one.channel], one.data))
                    number, due = number + 1, due - 1
            if due:
                raise damaged(index.path, chunk.offset, "not as many messages as its index says")
    while waiting:
        ns, _, topic, data = heapq.heappop(waiting)
        yield topic, ns, data
