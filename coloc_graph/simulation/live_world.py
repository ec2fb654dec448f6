"""A world that is live: robots on emulated wheels, and what their cameras see of it, in real time; `LiveWorld`.

    python -m coloc_graph.simulation.live_world TEAM.toml --dir DIR

docs/cameras.md says how robots are connected to it.
"""

import argparse
import contextlib
import json
import math
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import ColocError, InputError
from coloc_graph.robot_io.create.emulator import CreateEmulator
from coloc_graph.robot_io.create.physics import Physics
from coloc_graph.run import atomic_run
from coloc_graph.simulation.live_images import ImageServer, LiveCamera
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rendering import Sensor
from coloc_graph.simulation.rig import true_team
from coloc_graph.simulation.scenarios import HALF_ANGLE, Pose
from coloc_graph.simulation.scenery import scenery_along
from coloc_graph.simulation.uneven_floor import UnevenFloor
from coloc_graph.simulation.world import stream
from coloc_graph.team import Team, read_team

TRUTH_RATE = 20.0  # 1/s, rate of true poses
TRUTH_TAKEN = 1.0  # s, period at which they are read from the wheels, which keep a few minutes
LENGTH = 10.0  # m, depth of the region of bright objects ahead of the start
AHEAD = 0.36 / math.tan(HALF_ANGLE)  # m, distance ahead at which the observers look, where the mover stands
#: No path of a Unix socket may be longer [bytes].
MAX_PATH_POINTS = 100


def start_poses(robots: int) -> tuple[Pose, ...]:
    """Initial poses of a team of 3 robots or more: the last one in front, the others on an arc, turned towards it.

    The first two stand as those of the hallway do.
    """
    if robots < 3:
        raise InputError(f"a team of {robots} robots cannot leap-frog; give 3 or more, or their poses")
    reach = 0.36 / math.sin(HALF_ANGLE)
    # the first two are the middle ones
    turns = [HALF_ANGLE * (1 + 2 * (i // 2)) * (1 if i % 2 else -1) for i in range(robots - 1)]
    observers = [
        (AHEAD - reach * math.cos(turn) + 0.185 * (i % 2), -reach * math.sin(turn), turn)
        for i, turn in enumerate(turns)
    ]
    return (*observers, (AHEAD + 0.1, 0.0, 0.0))


class LiveWorld:
    """Robots of a team on a floor, from now on; a context manager.

    `poses` are where they begin: x, y [m], yaw [rad], in the team's order (`start_poses` by default). What is true is
    drawn from the team's tolerances by `seed`. `model` is that of the Creates. `address` is the socket on which cameras
    are served, `ports` maps a robot to the path of its serial line, which stays the same when the line is hung up and
    plugged in again. Both lie in a folder of this world that is open to its user alone, and is removed at the end.
    """

    def __init__(
        self,
        team: Team,
        *,
        seed: int = 0,
        poses: Sequence[Pose] | None = None,
        model: int = 2,
        sensor: Sensor | None = None,
    ) -> None:
        if seed < 0:
            raise InputError(f"`seed` is {seed}; give a whole number that is not negative")
        poses = start_poses(len(team.robots)) if poses is None else poses
        if len(poses) != len(team.robots):
            raise InputError(f"there are {len(poses)} start poses for {len(team.robots)} robots; give one each")
        self.team, self.true_team = team, true_team(team, stream(seed, "team"))
        sigma = math.radians(team.floor.tilt_sigma_deg) if team.floor else 0.0
        self._floor = UnevenFloor(sigma, stream(seed, "floor"))
        self._taken: dict[str, list[Array]] = {robot: [] for robot in team.names}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._began = time.monotonic()
        self._samples = 0
        with contextlib.ExitStack() as undo:
            folder = Path(tempfile.mkdtemp(prefix="coloc-"))
            undo.callback(shutil.rmtree, folder, ignore_errors=True)
            self.address = str(folder / "cameras")
            if len(self.address.encode()) > MAX_PATH_POINTS:
                raise InputError(f"the folder for temporary files, {folder.parent}, has too long a path for a socket")
            self.emulators: dict[str, CreateEmulator] = {}
            self.ports: dict[str, str] = {}
            for index, (robot, pose) in enumerate(zip(team.names, poses, strict=True)):
                physics = Physics(seed=int(stream(seed, "wheels", index).integers(1 << 31)), start=pose)
                self.emulators[robot] = undo.enter_context(CreateEmulator(model, physics))
                self.ports[robot] = str(folder / f"create-{robot}")
                self.plug_in(robot)
            first = min(pose[0] for pose in poses)
            scenery = scenery_along(first, first + LENGTH, stream(seed, "scenery"))
            see = sensor or Sensor()

            def camera(robot: str) -> Callable[[], LiveCamera]:
                return lambda: LiveCamera(robot, self.true_team, self.poses_at, scenery, see, seed)

            self._images = ImageServer(
                Path(self.address),
                {robot: camera(robot) for robot in team.names},
                {robot.name: robot.camera.fps for robot in team.robots},
            )
            undo.callback(self._images.close)
            self._keeper = threading.Thread(target=self._keep_truth, name="truth of the live world", daemon=True)
            self._keeper.start()
            self._close = undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it; what was true can still be asked."""
        if not self._ended.is_set():
            self._ended.set()
            self._keeper.join(timeout=2 * TRUTH_TAKEN)
            self._take()
            self._close.close()

    def freeze_camera(self, robot: str, frozen: bool = True) -> None:
        """A robot's camera delivers nothing any more, or does so again."""
        (self._images.frozen.add if frozen else self._images.frozen.discard)(self._known(robot))

    def push(self, robot: str, dx: float, dy: float, dyaw: float) -> None:
        """Somebody bumps into a robot: it moves by so much in the world [m], [rad], and its wheels know nothing."""
        self.emulators[self._known(robot)].push(dx, dy, dyaw)

    def hang_up(self, robot: str) -> None:
        """A robot's serial line breaks; it goes on as it was told last."""
        Path(self.ports[self._known(robot)]).unlink(missing_ok=True)
        self.emulators[robot].hang_up()

    def plug_in(self, robot: str) -> None:
        """A robot's serial line is there again, under its path in `ports`."""
        link = Path(self.ports[self._known(robot)])
        link.unlink(missing_ok=True)
        if not self.emulators[robot].wired:
            self.emulators[robot].plug_in()
        link.symlink_to(self.emulators[robot].port)

    def poses_at(self, times: Array) -> Array:
        """Return true T_world_body (robots, n, 4, 4) of all robots, in the team's order.

        At times (n,) of the last minutes [s, CLOCK_MONOTONIC].
        """
        planar = np.concatenate([emulator.poses_at(times) for emulator in self.emulators.values()])
        return self._floor.pose(planar).reshape(len(self.emulators), -1, 4, 4)

    def truth(self, robot: str) -> tuple[NDArray[np.int64], Array]:
        """All true poses so far: times (n,) [ns, CLOCK_MONOTONIC], T_world_body (n, 4, 4), at `TRUTH_RATE`."""
        if not self._ended.is_set():
            self._take()
        with self._lock:
            planar = np.concatenate([np.zeros((0, 3)), *self._taken[self._known(robot)]])
        times = np.rint(1e9 * self._instants(np.arange(len(planar)))).astype(np.int64)
        return times, self._floor.pose(planar)

    def write_truth(self, path: str | Path, epoch_ns: int) -> None:
        """Write team, true team and truth as a run. UTC is CLOCK_MONOTONIC + `epoch_ns`."""
        with atomic_run(path, self.team) as writer:
            writer.write_true_team(self.true_team)
            for robot in self.team.names:
                times, T_world_body = self.truth(robot)
                for time_ns, T in zip(times.tolist(), T_world_body, strict=True):
                    writer.write_truth(robot, (time_ns + epoch_ns) * 1e-9, T)

    def _known(self, robot: str) -> str:
        if robot not in self.emulators:
            raise InputError(f"the simulated world has no robot {robot}; it has {', '.join(self.emulators)}")
        return robot

    def _instants(self, numbers: NDArray[np.int64]) -> Array:
        """The instants (n,) [s, CLOCK_MONOTONIC] of true poses by their numbers."""
        return np.asarray(self._began + numbers / TRUTH_RATE)

    def _keep_truth(self) -> None:
        while not self._ended.wait(TRUTH_TAKEN):
            self._take()

    def _take(self) -> None:
        """Take what has been true since the last time."""
        with self._lock:
            until = int((time.monotonic() - Physics.step - self._began) * TRUTH_RATE) + 1
            times = self._instants(np.arange(self._samples, until))
            if len(times):
                for robot, emulator in self.emulators.items():
                    self._taken[robot].append(emulator.poses_at(times))
                self._samples = until


def _obey(world: LiveWorld, line: str) -> dict[str, Any]:
    """Carry out one line, and what to answer."""
    command, *rest = line.split()
    match command, rest:
        case "speeds", []:
            return {"speeds": {robot: emulator.speeds for robot, emulator in world.emulators.items()}}
        case "poses", []:
            return {"poses": {robot: emulator.pose.tolist() for robot, emulator in world.emulators.items()}}
        case "freeze" | "thaw", [robot]:
            world.freeze_camera(robot, command == "freeze")
        case "push", [robot, *by] if len(by) == 3:
            world.push(robot, *map(float, by))
        case "hangup", [robot]:
            world.hang_up(robot)
        case "plug", [robot]:
            world.plug_in(robot)
        case _:
            raise InputError(f"`{line.strip()}` is no command; use {COMMANDS}")
    return {"ok": True}


#: What the program takes on its standard input.
COMMANDS = "speeds, poses, freeze ROBOT, thaw ROBOT, push ROBOT DX DY DYAW, hangup ROBOT, plug ROBOT"


def _run(options: argparse.Namespace) -> None:
    folder = Path(options.dir)
    folder.mkdir(parents=True, exist_ok=True)
    lines: SimpleQueue[str | None] = SimpleQueue()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: lines.put(None))

    def listen() -> None:
        with open(0, "rb", buffering=0, closefd=False) as stdin:
            while line := stdin.readline():
                lines.put(line.decode(errors="replace"))
        lines.put(None)

    with LiveWorld(read_team(options.team), seed=options.seed, model=options.model) as world:
        about = {"socket": world.address, "ports": world.ports, "epoch_ns": options.epoch}
        with contextlib.suppress(BrokenPipeError):  # whoever started it has gone
            print(json.dumps(about), flush=True)
            threading.Thread(target=listen, name="commands", daemon=True).start()
            while (line := lines.get()) is not None:
                if line.strip():
                    try:
                        answer = _obey(world, line)
                    except (ColocError, ValueError) as error:
                        answer = {"error": str(error)}
                    print(json.dumps(answer), flush=True)
    world.write_truth(folder / "truth.mcap", options.epoch)


def main() -> int:
    """Run a world until SIGTERM, Ctrl-C or the end of standard input; then write DIR/truth.mcap."""
    parser = argparse.ArgumentParser(
        description="A simulated world in real time: emulated wheels on pseudo-terminals, cameras on a Unix socket. "
        f"Prints where they are as one line of JSON. Standard input takes {COMMANDS}."
    )
    parser.add_argument("team", metavar="TEAM.toml")
    parser.add_argument("--dir", required=True, help="where truth.mcap is written at the end")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn from the team's tolerances, and of noise")
    parser.add_argument("--model", type=int, choices=(1, 2), default=2, help="Create 1 or 2 (default 2)")
    parser.add_argument(
        "--epoch",
        type=int,
        default=time.time_ns() - time.monotonic_ns(),
        metavar="NS",
        help="UTC less the monotonic clock, in nanoseconds (default: as it is now)",
    )
    try:
        _run(parser.parse_args())
    except (ColocError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
