"""Emulator of a Create 1 or 2: it speaks the Open Interface on a pseudo-terminal, and its wheels have physics.

    python -m coloc_graph.robot_io.create.emulator --model 2      prints the port to open

Like the real robot it has no command timeout: the last drive command holds, also when the port is closed.
"""

import argparse
import contextlib
import os
import select
import termios
import threading
import time
import tty
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.firmware import Firmware, mark
from coloc_graph.robot_io.create.odometry import WHEELS
from coloc_graph.robot_io.create.physics import Physics
from coloc_graph.robot_io.create.protocol import Mode
from coloc_graph.robot_io.create.state import CLIFFS, DROPS

_BAUDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


class CreateEmulator:
    """An emulated robot; a context manager.

    Parameters
    ----------
    model
        1 or 2.
    physics
        Parameters of the body.
    encoders
        Encoder counts (left, right) at the start.
    clock
        Clock of the physics [s].

    Attributes
    ----------
    port
        Serial port for a driver to open.
    mute
        If True, nothing is sent.
    corruption
        Fraction of the sent bytes that are changed or lost.
    received
        All bytes that came.
    """

    def __init__(
        self,
        model: int = 2,
        physics: Physics | None = None,
        *,
        encoders: tuple[int, int] = (0, 0),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.model, self._clock = model, clock
        self._firmware = Firmware(model, physics or Physics(), encoders, clock())
        self._body = self._firmware.body
        self.mute = False
        self.corruption = 0.0
        self.received = bytearray()
        self._rng = np.random.default_rng(self._body.physics.seed + 1)
        self._lock = threading.RLock()
        self._wired = self._ended = False
        self.plug_in()
        self._thread = threading.Thread(target=self._run, name=f"emulated Create {model}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the line and end the emulation."""
        self.hang_up()
        self._ended = True
        self._thread.join(timeout=2.0)

    def hang_up(self) -> None:
        """Break the line; the robot keeps its last command."""
        with self._lock:
            if self._wired:
                self._wired = False
                os.close(self._slave)
                os.close(self._master)

    def plug_in(self) -> None:
        """Connect a line with a new `port`, as at the start or after `hang_up`."""
        with self._lock:
            self.hang_up()
            self._master, self._slave = os.openpty()  # the far end stays open here: a driver may come and go
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.port, self._wired = os.ttyname(self._slave), True

    @property
    def mode(self) -> Mode:
        """Mode of the Open Interface."""
        return self._firmware.mode

    @property
    def wired(self) -> bool:
        """True if the line is connected."""
        with self._lock:
            return self._wired

    @property
    def pose(self) -> NDArray[np.float64]:
        """True pose: x [m], y [m], yaw [rad]."""
        with self._lock:
            return np.array([self._body.x, self._body.y, self._body.yaw])

    @property
    def speeds(self) -> tuple[float, float]:
        """True speeds of the left and the right wheel [m/s]."""
        with self._lock:
            return self._body.speeds[0], self._body.speeds[1]

    @property
    def wanted(self) -> tuple[float, float]:
        """Commanded speeds of the left and the right wheel [m/s]."""
        with self._lock:
            return self._body.wanted

    @property
    def still_since(self) -> float | None:
        """Time since which both wheels have stood [s, emulator's clock]; None while one turns."""
        with self._lock:
            return self._body.still_since

    def trace(self) -> NDArray[np.float64]:
        """True states of the last minutes (n, 6): time [s, its clock], x, y [m], yaw [rad], left, right [m/s]."""
        with self._lock:
            return np.array(self._body.trace)

    def poses_at(self, times: ArrayLike) -> NDArray[np.float64]:
        """True poses (n, 3) at times (n,) of the last minutes [s, emulator's clock], yaw unwrapped.

        The last step of the physics is not included.
        """
        with self._lock:
            self._body.advance(self._clock())
            return self._body.poses_at(times)

    def push(self, dx: float, dy: float, dyaw: float) -> None:
        """Displace the robot in the world [m], [rad], as by a bump; the encoders count nothing."""
        with self._lock:
            self._body.push(dx, dy, dyaw)

    def cliff(self, where: str, there: bool = True) -> None:
        """Put a cliff under the sensor "left", "front left", "front right" or "right", or take it away."""
        with self._lock:
            mark(self._firmware.cliffs, CLIFFS.values(), where, there)

    def wheel_drop(self, where: str, there: bool = True) -> None:
        """Drop the "left" or "right" wheel or the "caster" (Create 1), or raise it."""
        with self._lock:
            mark(self._firmware.drops, DROPS.values(), where, there)

    def dock(self, there: bool = True) -> None:
        """Put the robot on the charger, or take it off."""
        with self._lock:
            self._firmware.docked = there

    def restart(self) -> None:
        """Restart the robot as after a flat battery: mode, stream and speed are lost."""
        with self._lock:
            self._firmware.restart()

    def _run(self) -> None:
        while not self._ended:
            with self._lock:
                wired, master = self._wired, self._master
            try:
                if wired and select.select([master], [], [], self._body.physics.step)[0]:
                    self._receive()
                elif not wired:
                    time.sleep(self._body.physics.step)
            except (OSError, ValueError):  # hung up in between
                continue
            with self._lock:
                self._tick()

    def _tick(self) -> None:
        """Advance the robot, and send a frame if one is due."""
        now = self._clock()
        self._firmware.advance(now)
        values = self._firmware.frame(now)
        if values is not None:
            self._send(oi.encode_frame(values, header_counts=self.model == 2))

    def _receive(self) -> None:
        with self._lock:
            if not self._wired:
                return
            data = os.read(self._master, 4096)
            if not self._same_baud():
                return  # noise to its ears
            self.received += data
            answer = self._firmware.take(data, self._clock())
            if answer:
                self._send(answer)

    def _same_baud(self) -> bool:
        return _BAUDS.get(termios.tcgetattr(self._slave)[4]) == WHEELS[self.model].baud

    def _send(self, data: bytes) -> None:
        if self.mute or not self._wired:
            return
        if not self._same_baud():
            data = bytes(b ^ 0xA5 for b in data)
        if self.corruption:
            changed = self._rng.random(len(data)) < self.corruption
            noise = self._rng.integers(0, 257, len(data))
            data = bytes(int(n) if c else b for b, c, n in zip(data, changed, noise, strict=True) if not c or n < 256)
        with contextlib.suppress(OSError):  # nobody reads: lost, as on a wire
            os.write(self._master, data)


def main() -> None:
    """Run an emulated robot: print its port, then its pose, until Ctrl-C."""
    parser = argparse.ArgumentParser(description="An emulated iRobot Create on a pseudo-terminal.")
    parser.add_argument("--model", type=int, choices=(1, 2), default=2, help="Create 1 or 2 (default: 2)")
    parser.add_argument("--seed", type=int, default=0, help="seed of slip and encoder noise (default: 0)")
    options = parser.parse_args()
    with CreateEmulator(options.model, Physics(seed=options.seed)) as robot, contextlib.suppress(KeyboardInterrupt):
        print(robot.port, flush=True)
        before = None
        while True:
            time.sleep(1.0)
            line = "x {:.3f} m  y {:.3f} m  yaw {:.3f} rad".format(*robot.pose) + f"  {robot.mode.name.lower()}"
            if line != before:
                print(line, flush=True)
            before = line


if __name__ == "__main__":
    main()
