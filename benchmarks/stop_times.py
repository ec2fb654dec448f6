"""Stop times of a robot's wheels after a fault, by the wheels' own clock, deceleration included.

    python benchmarks/stop_times.py [--cases CASE ...] [--tries SPEED:TRIES ...] [--json]

`coloc robot` drives an emulated Create (2 m/s^2 at each wheel) with the permission of a coordinator's link, which
reaches it through a TCP relay; for faults of the coordinator it is the mover of a mission, whose observers only answer.
In each try the wheels turn at the full speed when the fault happens; the time until
both stand is measured by the emulator. The limit is 0.5 s.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import cv2
import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from fake_robots import FakeRobot
from tcp_relay import Relay

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.create.emulator import CreateEmulator
from coloc_graph.robot_io.create.physics import Physics
from coloc_graph.robot_io.deadlines import PERMISSION_PERIOD, STAND_WITHIN
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Drive, Recover
from coloc_graph.simulation.simulated_team import field_team, free_address
from coloc_graph.team import write_team
from coloc_graph.team.body import Devices

NAME = "C"  # the robot that drives
FPS = 5.0  # rate of the images of a mission's camera [1/s]
LONGEST = 900.0  # duration of these images [s]
FAR = 1000.0  # way to the mover's first waypoint [m]
START = 60.0  # s that a program may take to start
WATCH = 1.5  # s for which the wheels are watched after a fault


class Rig:
    """A coordinator's link, a relay, the emulated wheels, and the program of a robot, which is started again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        team, address = field_team(), free_address()
        write_team(team, folder / "team.toml")
        (folder / "images").mkdir()
        camera = team[NAME].camera
        cv2.imwrite(str(folder / "images" / "0.png"), np.zeros((camera.height, camera.width), np.uint8))
        self.wheels = CreateEmulator(2, Physics(seed=1))
        self.relay: Any = Relay(int(address.rpartition(":")[2]))
        self.link = CoordinatorLink(
            team,
            listen=address,
            on_sample=lambda *_: None,
            on_wheels=lambda *_: None,
            on_event=lambda *_: None,
            on_status=lambda *_: None,
            on_presence=lambda *_: None,
        )
        self.program: subprocess.Popen[bytes] | None = None
        self._number, self._ended = 0, threading.Event()
        self._holder = threading.Thread(target=self._hold, daemon=True)

    def __enter__(self) -> Self:
        self._holder.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._holder.join()
        if self.program is not None:
            self.program.send_signal(signal.SIGCONT)
            self.program.terminate()
            self.program.wait(20)
        self.link.close()
        self.relay.__exit__()
        self.wheels.close()

    def _hold(self) -> None:
        while not self._ended.wait(PERMISSION_PERIOD):
            self.link.hold()

    def start(self) -> None:
        """Start the robot's program unless it runs."""
        if self.program is None or self.program.poll() is not None:
            command = [sys.executable, "-m", "coloc_graph.cli", "robot", NAME, str(self.folder / "team.toml")]
            command += ["--out", str(self.folder / "out"), "--connect", f"tcp/127.0.0.1:{self.relay.port}"]
            command += ["--camera", f"video:{self.folder / 'images'}", "--wheels", self.wheels.port, "--model", "2"]
            with (self.folder / "robot.log").open("ab") as log:
                self.program = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def drive(self, speed: float) -> None:
        """Have the wheels turn at a speed [m/s], for a random time."""
        until = time.monotonic() + START
        while time.monotonic() < until:
            self.start()
            try:
                self._number += 1
                drive = Drive(number=self._number, places=[(1e5, 0.0)], yaw=None, speed=speed)
                if not self.link.ask(NAME, drive, 2.0).ok:
                    self.link.ask(NAME, Recover(), 2.0)
                    continue
            except RobotError:
                continue
            again = time.monotonic() + 3.0
            while time.monotonic() < again:
                if min(map(abs, self.wheels.speeds)) > 0.97 * speed:
                    time.sleep(random.uniform(0.0, 0.15))
                    if min(map(abs, self.wheels.speeds)) > 0.97 * speed:
                        return
                time.sleep(0.01)
        raise SystemExit(f"the robot does not drive:\n{(self.folder / 'robot.log').read_text()[-2000:]}")

    def time_to_stand(self, since: float) -> float:
        """Time from an instant until both wheels stand [s]; infinite if they still turn at the end."""
        time.sleep(max(since + WATCH - time.monotonic(), 0.0))
        stood = self.wheels.still_since
        return float("inf") if stood is None else max(stood - since, 0.0)

    @property
    def watchdog(self) -> int:
        """Process id of the watchdog beside the robot's driver."""
        assert self.program is not None
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(path.read_text().rpartition(")")[2].split()[1])
                if parent == self.program.pid and b"watchdog.py" in (path.parent / "cmdline").read_bytes():
                    return int(path.parent.name)
            except OSError:
                continue
        raise SystemExit("the robot's program has no watchdog process")


def signalled(number: int, to_watchdog: bool) -> Callable[[Rig], Callable[[], None]]:
    """A case in which a process is sent a signal."""

    def act(rig: Rig) -> Callable[[], None]:
        assert rig.program is not None
        pid = rig.watchdog if to_watchdog else rig.program.pid
        os.kill(pid, number)
        return (lambda: os.kill(pid, signal.SIGCONT)) if number == signal.SIGSTOP else lambda: None

    return act


def cut(rig: Rig) -> Callable[[], None]:
    """The case in which the network holds back all."""
    rig.relay.cut()
    return lambda: rig.relay.mend()


class MissionRig:
    """A mission's coordinator, two fake robots that stand, and the program of a real one that drives for ever."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.address = folder, free_address()
        team = field_team(fps=FPS)
        # the mover believes that it starts far behind its first waypoint
        far = msgspec.json.decode(json.dumps({"start": [-FAR, 0.0, 0.0]}), type=Devices)
        robots = [msgspec.structs.replace(one, devices=far) if one.name == NAME else one for one in team.robots]
        team = msgspec.structs.replace(team, robots=tuple(robots))
        write_team(team, folder / "team.toml")
        (folder / "images").mkdir()
        camera = team[NAME].camera
        first = folder / "images" / f"{0:06}.png"
        cv2.imwrite(str(first), np.zeros((camera.height, camera.width), np.uint8))
        for number in range(1, round(FPS * LONGEST)):
            (folder / "images" / f"{number:06}.png").hardlink_to(first)
        self.wheels = CreateEmulator(2, Physics(seed=1))
        self.coordinator: subprocess.Popen[bytes] | None = None
        self.program: subprocess.Popen[bytes] | None = None
        self._missions = 0
        self._observers = [FakeRobot(name, self.address) for name in team.names if name != NAME]

    def __enter__(self) -> Self:
        command = [sys.executable, "-m", "coloc_graph.cli", "robot", NAME, str(self.folder / "team.toml")]
        command += ["--out", str(self.folder / "out"), "--connect", self.address, "--model", "2"]
        command += ["--camera", f"video:{self.folder / 'images'}", "--wheels", self.wheels.port]
        with (self.folder / "robot.log").open("ab") as log:
            self.program = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        return self

    def __exit__(self, *_: object) -> None:
        for one in (self.coordinator, self.program):
            if one is not None:
                one.send_signal(signal.SIGCONT)
                one.terminate()
                one.wait(20)
        for robot in self._observers:
            robot.__exit__()
        self.wheels.close()

    def drive(self, speed: float) -> None:
        """Have the wheels turn at a speed [m/s] on the way of a mission."""
        if self.coordinator is None or self.coordinator.poll() is not None or self._speed != speed:
            if self.coordinator is not None:
                self.coordinator.terminate()
                self.coordinator.wait(20)
            self._missions, self._speed = self._missions + 1, speed
            command = [sys.executable, str(Path(__file__).with_name("hanging_coordinator.py"))]
            command += [str(self.folder / "team.toml"), str(self.folder / f"mission-{self._missions}")]
            with (self.folder / "coordinator.log").open("ab") as log:
                self.coordinator = subprocess.Popen(
                    [*command, self.address, str(speed)], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log
                )
        until, since = time.monotonic() + START, None
        while time.monotonic() < until:
            fast = min(map(abs, self.wheels.speeds)) > 0.97 * speed
            since = (since or time.monotonic()) if fast else None
            if since is not None and time.monotonic() - since > random.uniform(0.1, 0.3):
                return
            time.sleep(0.01)
        raise SystemExit("\n".join((self.folder / f"{n}.log").read_text()[-2000:] for n in ("robot", "coordinator")))

    def fault(self, number: int) -> float:
        """Send the coordinator a signal; the time of the fault [s, monotonic clock] comes back."""
        assert self.coordinator is not None and self.coordinator.stdout is not None
        since = time.monotonic()
        self.coordinator.send_signal(number)
        if number in (signal.SIGUSR1, signal.SIGUSR2):
            since = float(self.coordinator.stdout.readline())
        return since

    def time_to_stand(self, since: float) -> float:
        """Time from an instant until both wheels stand [s]; infinite if they still turn at the end."""
        until = since + 1.1  # a hang ends, and the robot is sent on
        while time.monotonic() < until:
            stood = self.wheels.still_since
            if stood is not None:
                return max(stood - since, 0.0)
            time.sleep(0.002)
        return float("inf")

    def mend(self, number: int) -> None:
        """Let a stopped coordinator go on."""
        assert self.coordinator is not None
        if number == signal.SIGSTOP:
            self.coordinator.send_signal(signal.SIGCONT)
        elif number == signal.SIGKILL:
            self.coordinator.wait()
        time.sleep(0.2)


#: Faults of the coordinator: the signal that causes each.
COORDINATOR_CASES: dict[str, int] = {
    "coordinator, main loop hangs": signal.SIGUSR1,
    "coordinator, hangs in an ask": signal.SIGUSR2,
    "coordinator, SIGSTOP": signal.SIGSTOP,
    "coordinator, SIGKILL": signal.SIGKILL,
}

#: What happens; each returns what undoes it.
CASES: dict[str, Callable[[Rig], Callable[[], None]]] = {
    "robot's program, SIGKILL": signalled(signal.SIGKILL, to_watchdog=False),
    "robot's program, SIGSTOP": signalled(signal.SIGSTOP, to_watchdog=False),
    "watchdog process, SIGKILL": signalled(signal.SIGKILL, to_watchdog=True),
    "watchdog process, SIGSTOP": signalled(signal.SIGSTOP, to_watchdog=True),
    "link cut": cut,
}


def measure(case: str, tries: dict[float, int]) -> dict[float, list[float]]:
    """Stop times [s] of one case, by speed [m/s]."""
    times: dict[float, list[float]] = {speed: [] for speed in tries}
    if (fault := COORDINATOR_CASES.get(case)) is not None:
        with tempfile.TemporaryDirectory() as folder, MissionRig(Path(folder)) as mission:
            for speed, number in tries.items():
                for _ in range(number):
                    mission.drive(speed)
                    times[speed].append(mission.time_to_stand(mission.fault(fault)))
                    mission.mend(fault)
        return times
    with tempfile.TemporaryDirectory() as folder, Rig(Path(folder)) as rig:
        for speed, number in tries.items():
            for _ in range(number):
                rig.drive(speed)
                since = time.monotonic()
                undo = CASES[case](rig)
                times[speed].append(rig.time_to_stand(since))
                undo()
    return times


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cases = [*CASES, *COORDINATOR_CASES]
    parser.add_argument("--cases", nargs="+", choices=cases, default=cases, metavar="CASE", help="(default: all)")
    parser.add_argument("--tries", nargs="+", default=["0.45:30", "0.2:10"], help="SPEED:TRIES (0.45:30 0.2:10)")
    parser.add_argument("--json", action="store_true", help="print JSON with all times")
    options = parser.parse_args()
    tries = {float(speed): int(number) for speed, _, number in (one.partition(":") for one in options.tries)}
    results = {case: measure(case, tries) for case in options.cases}
    if options.json:
        print(json.dumps(results, indent=2))
        return
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; the limit is {STAND_WITHIN} s\n")
    print(f"{'case':28s} {'m/s':>5s} {'tries':>5s} {'median':>7s} {'p99':>7s} {'max':>7s} [s]")
    for case, by_speed in results.items():
        for speed, times in by_speed.items():
            median, p99 = np.quantile(times, [0.5, 0.99])
            print(f"{case:28s} {speed:5.2f} {len(times):5d} {median:7.3f} {p99:7.3f} {max(times):7.3f}")


if __name__ == "__main__":
    main()
