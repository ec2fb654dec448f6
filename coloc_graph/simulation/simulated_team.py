"""A team that is not there: a live world, and the programs of its robots, each in a process of its own."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from coloc_graph.errors import RobotError
from coloc_graph.simulation import Imperfections
from coloc_graph.simulation.rig import MILD_LENS, reference_team, stated_team
from coloc_graph.team import Team, write_team

#: Images a second of a simulated camera.
FPS = 30.0
#: How well the clocks of two robots agree [s].
CLOCKS = 5e-4
#: How far a team in the field is from what is said of it.
FIELD = Imperfections(mount_sigma_deg=0.5, height_sigma=0.003, span_sigma=1e-4, floor_sigma_deg=0.05)


def field_team(imperfections: Imperfections = FIELD, fps: float = FPS) -> Team:
    """The reference rig as its people would describe it, with tolerances; its cameras do not expose together."""
    team = stated_team(reference_team(MILD_LENS), imperfections)
    new = msgspec.structs.replace
    return new(
        team,
        clock_sigma=CLOCKS,
        robots=tuple(new(robot, camera_if_any=new(robot.camera, fps=fps)) for robot in team.robots),
    )


def free_address() -> str:
    """An address of this machine at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class SimulatedTeam:
    """A world and its robots' programs; a context manager, at whose end all of them have ended.

    `connect` is where the coordinator listens. Files go into `folder`: team.toml, what each robot records, its log,
    and, at the end, truth.mcap.
    """

    def __init__(self, team: Team, folder: str | Path, *, connect: str, seed: int = 0) -> None:
        self.team, self.folder, self.connect = team, Path(folder), connect
        self.folder.mkdir(parents=True, exist_ok=True)
        self.team_path = self.folder / "team.toml"
        write_team(team, self.team_path)
        self.programs: dict[str, subprocess.Popen[bytes]] = {}
        command = [sys.executable, "-m", "coloc_graph.simulation.live_world", str(self.team_path)]
        self._log = (self.folder / "world.log").open("ab")
        self._world = subprocess.Popen(
            [*command, "--dir", str(self.folder), "--seed", str(seed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )
        self.about = self._answer()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def truth_path(self) -> Path:
        """Path of the file with the truth, complete after the mission."""
        return self.folder / "truth.mcap"

    def start(self, *names: str, program: Sequence[str] = ("-m", "coloc_graph.cli")) -> None:
        """Start the programs of robots, of all where none is named; `program` is what Python is to run as `coloc`."""
        for name in names or self.team.names:
            command = [sys.executable, *program, "robot", name, str(self.team_path)]
            command += ["--out", str(self.folder / "robots"), "--connect", self.connect]
            command += ["--camera", f"world:{self.about['socket']}", "--wheels", self.about["ports"][name]]
            command += ["--model", "2"]
            with (self.folder / f"{name}.log").open("ab") as log:
                self.programs[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def kill(self, name: str) -> None:
        """A robot's program ends without a word."""
        program = self.programs.pop(name)
        program.kill()
        program.wait()

    def tell(self, line: str) -> dict[str, Any]:
        """Have something happen in the world (`live_world.COMMANDS`); what it answers."""
        assert self._world.stdin is not None
        try:
            self._world.stdin.write(f"{line}\n".encode())
            self._world.stdin.flush()
        except BrokenPipeError:
            raise RobotError(f"the simulated world has ended: see {self.folder / 'world.log'}") from None
        answer = self._answer()
        if "error" in answer:
            raise RobotError(f"the simulated world refuses: {answer['error']}")
        return answer

    def _answer(self) -> dict[str, Any]:
        assert self._world.stdout is not None
        line = self._world.stdout.readline()
        if not line:
            raise RobotError(f"the simulated world has ended: see {self.folder / 'world.log'}")
        return dict(json.loads(line))

    def close(self) -> None:
        """End the programs, then the world, which writes its truth."""
        for program in self.programs.values():
            program.send_signal(signal.SIGTERM)
        for program in self.programs.values():
            try:
                program.wait(5.0)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()
        self.programs.clear()
        if self._world.poll() is None:
            self._world.send_signal(signal.SIGTERM)
            try:
                self._world.wait(30.0)
            except subprocess.TimeoutExpired:
                self._world.kill()
                self._world.wait()
        for pipe in (self._world.stdin, self._world.stdout, self._log):
            if pipe is not None:
                pipe.close()
