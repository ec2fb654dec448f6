"""An open camera that returns its newest frame within a timeout; `CameraSource`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import CameraError, ColocError
from coloc_graph.machine import machine
from coloc_graph.team import Camera

#: A clock [ns].
Clock = Callable[[], int]

OPENING = 5.0  # s that a camera may take to open
ENDING = 1.0  # s that its thread may take to end
WAIT = 0.1  # s that a device waits for a frame before it checks for its end
STALE = 0.5  # s after which a frame is not returned any more: its camera may have stopped since


@dataclass(frozen=True, eq=False)
class Frame:
    """One image.

    Attributes
    ----------
    stamp_ns
        Time [ns] by the clock that was given at opening: the middle of the exposure if the source knows it
        (docs/cameras.md).
    pixels
        Grey values (height, width), uint8.
    """

    stamp_ns: int
    pixels: NDArray[np.uint8]


class Device(Protocol):
    """A source of frames that is opened, read and closed in one thread."""

    def grab(self) -> Frame | None:
        """Return the next frame, None if none comes for about `WAIT`. Raises `CameraError` if none will come."""

    def close(self) -> None:
        """Close the device."""


class CameraSource:
    """Frames of one camera, read in a thread of its own; a context manager.

    Only the newest frame is kept. After a `CameraError`, `read` works again if frames come again; `reopen` opens the
    camera again. One thread may read while another closes it.

    Parameters
    ----------
    name
        Name of the camera in messages.
    camera
        The team's description of the camera.
    connect
        Opens the device.
    opening
        Time that the camera may take to open [s].

    Raises
    ------
    CameraError
        If the camera does not open.
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
        """Return the newest unread frame. Raises `CameraError` if none comes within `timeout` [s]."""
        return self._feed.read(timeout)

    @property
    def dropped(self) -> int:
        """Count of frames that were not read."""
        return self._dropped + self._feed.dropped

    @property
    def fault(self) -> str | None:
        """Reason for which no frame will come until the camera is opened again; None if there is none."""
        return self._feed.lost

    def reopen(self) -> None:
        """Close the camera and open it again. Raises `CameraError` if it does not open."""
        self.close()
        self._dropped += self._feed.dropped
        self._feed = _Feed(self.name, self.camera, self._connect)
        self._feed.open(self._opening)

    def close(self) -> None:
        """Close the camera, within `ENDING` even if the device hangs."""
        self._feed.close()


class _Feed:
    """Frames from one opening to its end, so that a device that hangs cannot disturb the next opening."""

    def __init__(self, name: str, camera: Camera, connect: Callable[[], Device]) -> None:
        self.name, self._shape, self._connect = name, (camera.height, camera.width), connect
        self.lost: str | None = None
        self.dropped = 0
        self._frame: Frame | None = None
        self._came = 0.0
        self._opened = False
        self._ended = machine.new_event()
        self._changed = machine.new_condition()
        self._thread = machine.new_thread(target=self._run, name=name)

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
            " again"
        )

    def _fresh(self) -> Frame | None:
        if self._frame is not None and machine.monotonic() - self._came > STALE:
            self._frame = None
            self.dropped += 1
        return self._frame

    def close(self) -> None:
        self._ended.set()
        self._end(f"{self.name} is closed: open it again")
        if self._thread is not machine.current_thread():
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
        except Exception as error:  # the reader must learn of it
            self._end(f"{self.name}: its reader failed ({error!r}); open it again")
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
            self._frame, self._came = frame, machine.monotonic()
            self._changed.notify_all()

    def _end(self, why: str) -> None:
        with self._changed:
            self.lost = self.lost or why
            self._changed.notify_all()


def clock_ahead(clock: Clock) -> int:
    """Offset of a clock from CLOCK_MONOTONIC now [ns]."""
    if clock == machine.monotonic_ns:
        return 0
    best = None
    for _ in range(5):  # an interruption between the readings would show as an offset
        before, there, after = machine.monotonic_ns(), clock(), machine.monotonic_ns()
        if best is None or after - before < best[0]:
            best = after - before, there - (before + after) // 2
        if best[0] < 20_000:
            break
    assert best is not None
    return best[1]
