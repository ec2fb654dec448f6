"""Everything that other threads leave for the render thread: requests of the controls, and published data."""

import threading
import time
from collections import deque
from collections.abc import Iterator
from enum import Enum, auto

from coloc_graph.viewer.live import LivePoses, LiveStance
from coloc_graph.viewer.scene import Scene, ShownPlan

Request = tuple[str, float]


class Work(Enum):
    """Next task of the render thread."""

    FRAME = auto()
    POSES = auto()
    CLOSE = auto()


class Inbox:
    """Requests and published data on their way to the render thread; every other thread only leaves something here."""

    def __init__(self) -> None:
        self.idle = threading.Event()
        self.live_poses: LivePoses | None = None
        self._requests: deque[Request] = deque()
        self._published: deque[Scene | LiveStance | ShownPlan] = deque()
        self._changed = threading.Condition()
        self._frame_is_due = True
        self._poses_are_due = self._closing = False

    @property
    def has_published(self) -> bool:
        """True if something was published that is not taken in yet."""
        return bool(self._published)

    def wake(self) -> None:
        """Have a frame made."""
        with self._changed:
            self._frame_is_due = True
            self.idle.clear()
            self._changed.notify()

    def request(self, kind: str, value: float) -> None:
        """Leave the request of a control, see `panel.Ask`."""
        self._requests.append((kind, value))
        self.wake()

    def publish(self, item: Scene | LiveStance | LivePoses | ShownPlan) -> None:
        """Leave a scene, a stance, a plan or poses; of poses only the newest is kept."""
        if isinstance(item, LivePoses):
            with self._changed:
                self.live_poses, self._poses_are_due = item, True
                self._changed.notify()
            return
        self._published.append(item)
        self.wake()

    def close(self) -> None:
        """Have the render thread end."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    def take_requests(self) -> Iterator[Request]:
        """Take out the requests, oldest first."""
        while self._requests:
            yield self._requests.popleft()

    def take_published(self) -> Iterator[Scene | LiveStance | ShownPlan]:
        """Take out scenes and stances, oldest first."""
        while self._published:
            yield self._published.popleft()

    def wait(self, *, is_playing: bool, is_pending: bool, is_at_rest: bool, due: float) -> Work:
        """Wait for the next task; poses are moved alone where no frame is due.

        Parameters
        ----------
        is_playing, is_pending, is_at_rest
            Whether time plays, something of the last frame is still being made, and time has not moved for a while.
        due
            Instant of `time.perf_counter` at which a frame is made even if nothing was left [s].
        """
        with self._changed:
            if not (is_playing or self._frame_is_due or is_pending or self._published):
                self.idle.set()
            continues = is_playing or is_pending or not is_at_rest or bool(self._published)
            timeout = 0.0 if is_playing else max(due - time.perf_counter(), 0.0)
            self._changed.wait_for(
                lambda: self._frame_is_due or self._poses_are_due or self._closing,
                timeout=timeout if continues else None,
            )
            if self._closing:
                return Work.CLOSE
            is_due = is_playing or self._frame_is_due or (continues and time.perf_counter() >= due)
            self._frame_is_due = self._poses_are_due = False
        return Work.FRAME if is_due else Work.POSES
