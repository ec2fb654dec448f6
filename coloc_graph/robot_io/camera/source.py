"""An open camera: `CameraSource` gives its newest frame, within a time, or says why there is none."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import CameraError, ColocError
from coloc_graph.team import Camera

#: A clock [ns].
Clock = Callable[[], int]

#: How long a camera may take to open, and its thread to end [s].
OPENING = 5.0
ENDING = 1.0
#: A device waits so long for a frame before it looks whether it is to end [s].
WAIT = 0.1
#: A frame that came longer ago is not given any more [s]: its camera may have stopped since.
STALE = 0.5


@dataclass(frozen=True, eq=False)
class Frame:
    """One image: `pixels` (height, width), grey, uint8, and when it was taken by the clock of who opened the camera.

    `stamp_ns` is in the middle of the exposure where the source knows it; docs/cameras.md says what each source does.
    """

    stamp_ns: int
    pixels: NDArray[np.uint8]


class Device(Protocol):
    """What frames come from: it is opened, read and closed in one thread."""

    def grab(self) -> Frame | None:
        """The next frame; None where none came for about `WAIT`. `CameraError` where none will come."""

    def close(self) -> None:
        """Let go of it."""


class CameraSource:
    """Frames of one camera, read in a thread of its own; a context manager.

    `name` is the camera's in messages, `connect` opens its device. Only the newest frame is kept: `dropped` counts
    those that nobody read. After a `CameraError`, `read` may work again where frames come again, and `reopen` begins
    anew. One thread may read while another closes it.
    """

    def __init__(self, name: str, camera: Camera, connect: Callable[[], Device], *, opening: float = OPENING) -> None:
        self.name, self.camera = name, camera
        self._connect, self._opening = connect, opening
        self._dropped = 0
        self._feed = _Feed(name, camera, connect)
        self._feed.open(opening)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, timeout: float = 1.0) -> Frame:
        """The newest frame that was not given yet; `CameraError` where none comes within `timeout` [s]."""
        return self._feed.read(timeout)

    @property
    def dropped(self) -> int:
        """How many frames came and were not read."""
        return self._dropped + self._feed.dropped

    @property
    def fault(self) -> str | None:
        """Why no frame will come until it is opened anew; None where nothing is known against it."""
        return self._feed.lost

    def reopen(self) -> None:
        """Close it and open it anew. `CameraError` where it does not open."""
        self.close()
        self._dropped += self._feed.dropped
        self._feed = _Feed(self.name, self.camera, self._connect)
        self._feed.open(self._opening)

    def close(self) -> None:
        """Let go of the camera; returns in `ENDING` at the latest, whatever the device does."""
        self._feed.close()


class _Feed:
    """The frames from one opening to its end: a device that hangs cannot harm the next opening."""

    def __init__(self, name: str, camera: Camera, connect: Callable[[], Device]) -> None:
        self.name, self._shape, self._connect = name, (camera.height, camera.width), connect
        self.lost: str | None = None
        self.dropped = 0
        self._frame: Frame | None = None
        self._came = 0.0
        self._opened = False
        self._ended = threading.Event()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def open(self, timeout: float) -> None:
        self._thread.start()
        with self._changed:
            self._changed.wait_for(lambda: self._opened or self.lost, timeout)
            if not self._opened and not self.lost:
                self.lost = f"{self.name} did not open within {timeout:g} s: check that it is plugged in, and try again"
            if self._opened:
                return
        self._ended.set()
        raise CameraError(self.lost)

    def read(self, timeout: float) -> Frame:
        with self._changed:
            self._changed.wait_for(lambda: self._fresh() is not None or self.lost, timeout)
            frame = self._fresh()
            if frame is not None:
                self._frame = None
                return frame
            if self.lost:
                raise CameraError(self.lost)
        raise CameraError(
            f"{self.name} has delivered no image for {timeout:g} s: check that it is plugged in and running, or open it"
            " anew"
        )

    def _fresh(self) -> Frame | None:
        if self._frame is not None and time.monotonic() - self._came > STALE:
            self._frame = None
            self.dropped += 1
        return self._frame

    def close(self) -> None:
        self._ended.set()
        self._end(f"{self.name} is closed: open it anew")
        if self._thread is not threading.current_thread():
            self._thread.join(ENDING)

    def _run(self) -> None:
        device = None
        try:
            device = self._connect()
            with self._changed:
                self._opened = True
                self._changed.notify_all()
            while not self._ended.is_set():
                frame = device.grab()
                if frame is not None:
                    self._put(frame)
        except ColocError as error:
            self._end(str(error))
        except Exception as error:  # whoever reads is to hear of it
            self._end(f"{self.name}: its reader failed ({error!r}); open it anew")
        finally:
            if device is not None:
                device.close()

    def _put(self, frame: Frame) -> None:
        if frame.pixels.shape != self._shape:
            (h, w), (height, width) = frame.pixels.shape, self._shape
            raise CameraError(
                f"{self.name} delivers images of {w} x {h} px, but the team says {width} x {height}: set the camera's"
                " `width` and `height` in team.toml to what it delivers, and calibrate it so"
            )
        with self._changed:
            self.dropped += self._frame is not None
            self._frame, self._came = frame, time.monotonic()
            self._changed.notify_all()

    def _end(self, why: str) -> None:
        with self._changed:
            self.lost = self.lost or why
            self._changed.notify_all()


def clock_ahead(clock: Clock) -> int:
    """By how much a clock is ahead of CLOCK_MONOTONIC now [ns]."""
    if clock is time.monotonic_ns:
        return 0
    best = None
    for _ in range(5):  # an interruption between the readings would show as an offset
        before, there, after = time.monotonic_ns(), clock(), time.monotonic_ns()
        if best is None or after - before < best[0]:
            best = after - before, there - (before + after) // 2
        if best[0] < 20_000:
            break
    assert best is not None
    return best[1]
