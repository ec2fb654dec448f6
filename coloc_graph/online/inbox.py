"""Messages of all robots on their way from the link's threads to the mission's main loop; `Inbox`."""

import queue
from collections.abc import Iterator

from coloc_graph.machine import machine
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Event, Sample, Status, Wheels
from coloc_graph.robot_io.link.session import OpenSession
from coloc_graph.robot_io.link.zenoh_config import Tls
from coloc_graph.team import Team

Message = Sample | Wheels | Event | Status | bool  # a bool is presence: the robot's program came, or has gone
MAX_DRAIN_TIME = 0.3  # time after which messages that keep coming are interrupted [s]


class Inbox:
    """Queue of (robot, message), filled by any thread and read by one."""

    def __init__(self) -> None:
        self._queue: queue.Queue[tuple[str, Message]] = machine.new_queue()
        self.status_times: dict[str, float] = {}  # when the newest status of each robot came [s, monotonic clock]

    def put(self, robot: str, message: Message) -> None:
        """Add a message of a robot; never waits."""
        if isinstance(message, Status):
            self.status_times[robot] = machine.monotonic()
        self._queue.put((robot, message))

    def messages(self, seconds: float) -> Iterator[tuple[str, Message]]:
        """Yield messages as they come for `seconds` [s], and then those that wait, for `MAX_DRAIN_TIME` at most."""
        until = machine.monotonic() + seconds
        while (now := machine.monotonic()) < until + MAX_DRAIN_TIME:
            try:
                yield self._queue.get(timeout=max(until - now, 0.001))
            except queue.Empty:
                return


def linked(
    inbox: Inbox, team: Team, *, listen: str, tls: Tls | None, exposed: bool, open_session: OpenSession
) -> CoordinatorLink:
    """Open the link to the robots, all of whose messages go into the inbox; see `CoordinatorLink`."""
    return CoordinatorLink(
        team,
        listen=listen,
        tls=tls,
        exposed=exposed,
        open_session=open_session,
        on_sample=inbox.put,
        on_wheels=inbox.put,
        on_event=inbox.put,
        on_status=inbox.put,
        on_presence=inbox.put,
    )
