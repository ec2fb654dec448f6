"""A mission in the field of a simulation, to which things happen: what the tests of the online system share."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

from tcp_relay import Relay

from coloc_graph.simulation.simulated_team import SimulatedTeam, field_team, free_address

TEAM = field_team(fps=10.0)  # images cost most of the time of processors


class Mission:
    """A coordinator and three robots, each in a process of its own, the robots behind a relay that can be cut."""

    def __init__(self, folder: Path, stances: int, seed: int = 1) -> None:
        self.folder, self.stances = folder, stances
        self.listen = free_address()
        self.relay = Relay(int(self.listen.rpartition(":")[2]))
        self.field = SimulatedTeam(TEAM, folder / "field", connect=f"tcp/127.0.0.1:{self.relay.port}", seed=seed)
        self.coordinator: subprocess.Popen | None = None
        self.stops: dict[str, float] = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.coordinator is not None and self.coordinator.poll() is None:
            self.coordinator.send_signal(signal.SIGTERM)
            self.coordinator.wait(20.0)
        self.field.close()
        self.relay.__exit__()

    def start_coordinator(self, *more: str) -> None:
        command = [sys.executable, "-m", "coloc_graph.cli", "coordinate", str(self.field.team_path)]
        command += ["--out", str(self.folder / "mission"), "--stances", str(self.stances), "--goal", "100,0"]
        command += ["--speed", "0.45", "--longest", "6", "--listen", self.listen, *more]
        with (self.folder / "coordinator.log").open("ab") as log:
            self.coordinator = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    @property
    def rows(self) -> list[dict]:
        """All that happened so far, of mission.jsonl."""
        path = self.folder / "mission" / "mission.jsonl"
        if not path.exists():
            return []
        return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]

    def states(self) -> list[tuple[int, str, str]]:
        return [(row["stance"], row["state"], row["reason"]) for row in self.rows if row["what"] == "state"]

    def wait_for(self, stance: int, state: str, timeout: float = 120.0) -> None:
        """Wait until a state of a stance, or a later stance, is the newest."""
        until = time.monotonic() + timeout
        while time.monotonic() < until:
            now = self.states()[-1:]
            if now and (now[0][0] > stance or now[0][1] in ("done", "failed") or now[0][:2] == (stance, state)):
                return
            assert self.coordinator is None or self.coordinator.poll() is None, self.log()
            time.sleep(0.05)
        raise AssertionError(f"stance {stance} has not come to {state} within {timeout} s\n{self.log()}")

    def wait_moving(self, timeout: float = 10.0) -> None:
        until = time.monotonic() + timeout
        while time.monotonic() < until and not self.fastest() > 0.05:
            time.sleep(0.02)

    def anchor(self, timeout: float = 10.0) -> str:
        """Of the observers the one that stands while the other leaps."""
        until = time.monotonic() + timeout
        while time.monotonic() < until:
            turning = self.field.tell("speeds")["speeds"]
            leaping = [name for name in "AB" if max(map(abs, turning[name])) > 0.05]
            if leaping:
                return "B" if leaping == ["A"] else "A"
            time.sleep(0.03)
        raise AssertionError(f"no observer leaps\n{self.log()}")

    def fastest(self) -> float:
        """The fastest wheel of all robots, as it truly turns [m/s]."""
        return max(abs(speed) for pair in self.field.tell("speeds")["speeds"].values() for speed in pair)

    def time_to_stand(self, name: str, timeout: float = 3.0) -> None:
        """Measure for how long wheels are seen to turn on: when it was last asked for, and they did."""
        began = asked = time.monotonic()
        self.stops[name] = 0.0
        while self.fastest() > 0 and asked - began < timeout:
            self.stops[name] = asked - began
            time.sleep(0.01)
            asked = time.monotonic()

    def wait_end(self, timeout: float) -> int:
        assert self.coordinator is not None
        return self.coordinator.wait(timeout)

    def log(self) -> str:
        return "\n".join(
            f"--- {path.name}\n{path.read_text()[-3000:]}"
            for path in [*self.folder.glob("*.log"), *self.folder.glob("field/*.log")]
        )
