"""The live world: real sockets and pseudo-terminals, what is seen against what is true, and what can be done to it."""

import json
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.errors import CameraError, InputError, RobotError
from coloc_graph.evaluation import true_poses
from coloc_graph.frontend.images.detection import detect_leds
from coloc_graph.geometry.lie import so3_log
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.robot_io import Create, open_camera
from coloc_graph.robot_io.camera.source import STALE
from coloc_graph.robot_io.create.physics import Body, Physics
from coloc_graph.run import read_true_team, read_truth
from coloc_graph.simulation import MILD_LENS, Imperfections, Sensor, reference_team
from coloc_graph.simulation.live_world import MAX_PATH_POINTS, TRUTH_RATE, LiveWorld, start_poses
from coloc_graph.simulation.rig import stated_team
from coloc_graph.simulation.uneven_floor import UnevenFloor
from coloc_graph.team import write_team
from coloc_graph.team.shared_view import View

IMPERFECT = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-3, floor_sigma_deg=0.3)


def team_of(robots=3, fps=30.0):
    team = stated_team(reference_team(MILD_LENS), IMPERFECT)
    return replace(
        team,
        robots=tuple(
            replace(team.robots[0], name=chr(ord("A") + n), camera_if_any=replace(team.robots[0].camera, fps=fps))
            for n in range(robots)
        ),
    )


@pytest.fixture(scope="module")
def world():
    with LiveWorld(team_of(), seed=5) as live:
        yield live


@pytest.fixture
def own():
    """A world that may be spoilt."""
    with LiveWorld(team_of(), seed=2) as live:
        yield live


def camera_of(world, robot, **options):
    return open_camera(f"world:{world.address}", world.team[robot].camera, robot, **options)


def until(met, timeout=20.0):
    deadline = time.monotonic() + timeout
    while not met():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def cameras_running():
    return sum(thread.name == "a camera of the live world" for thread in threading.enumerate())


def expected(world, robot, frame, other):
    """Where the true LEDs of another robot project in a frame, (m, 2) [px], and which are in it."""
    T_world_body = dict(zip(world.team.names, world.poses_at([frame.stamp_ns * 1e-9])[:, 0], strict=True))
    true = world.true_team
    view = View(true[robot].camera, T_world_body[robot] @ true[robot].mount.T_body_camera)
    T = T_world_body[other]
    return view.project(true[other].markers.p_body @ T[:3, :3].T + T[:3, 3])


def off(frame, uv):
    """How far the nearest blob is from each place (m,) [px]."""
    found = detect_leds(frame.pixels).uv
    return np.linalg.norm(found[:, None] - uv, axis=-1).min(axis=0)


# ---- what is seen


@pytest.mark.realtime
@pytest.mark.parametrize("robot", ["A", "B"])
def test_leds_are_seen_where_the_truth_projects_them(world, robot):
    with camera_of(world, robot) as camera:
        for _ in range(5):
            frame = camera.read(2.0)
            uv, inside = expected(world, robot, frame, "C")
            assert inside.all()
            assert off(frame, uv).max() < 0.2


def test_they_are_where_the_tolerances_drew_them_and_not_where_the_team_says(world):
    with camera_of(world, "A") as camera:
        frame = camera.read(2.0)
    T_world_body = world.poses_at([frame.stamp_ns * 1e-9])[:, 0]
    nominal = View(world.team["A"].camera, T_world_body[0] @ world.team["A"].mount.T_body_camera)
    T = T_world_body[2]
    uv, _ = nominal.project(world.team["C"].markers.p_body @ T[:3, :3].T + T[:3, 3])
    assert off(frame, uv).min() > 0.5


def keep_driving(wheels, v, w):
    """Drive on; a robot that stopped since a busy machine read its sensors late is told to go on."""
    with suppress(RobotError):
        if wheels.fault is not None:
            wheels.recover()
        wheels.drive(v, w, 0.5)


@pytest.mark.realtime
def test_a_moving_robot_is_seen_where_it_was_in_the_middle_of_the_exposure(own):
    with Create(own.ports["C"], 2) as wheels, camera_of(own, "A") as camera:
        errors = []
        until_then = time.monotonic() + 2.0
        while time.monotonic() < until_then:
            keep_driving(wheels, 0.15, 0.5)
            frame = camera.read(2.0)
            uv, inside = expected(own, "A", frame, "C")
            if inside.all() and np.linalg.norm(uv[0] - uv[1]) > 15:
                errors.append(off(frame, uv))
        wheels.stop()
    assert own.emulators["C"].pose[0] > own.truth("C")[1][0, 0, 3] + 0.1
    assert len(errors) > 15
    # a stamp that is 5 ms late would be 0.3 px off
    assert np.median(np.max(errors, axis=1)) < 0.15


@pytest.mark.realtime
def test_a_moving_camera_sees_from_where_it_is(own):
    with Create(own.ports["A"], 2) as wheels, camera_of(own, "A") as camera:
        errors = []
        begin = time.monotonic()
        while len(errors) < 24 and (since := time.monotonic() - begin) < 20.0:  # a busy machine has few images a second
            keep_driving(wheels, 0.0, 0.3 if since % 1.6 < 0.8 else -0.3)
            frame = camera.read(2.0)
            uv, inside = expected(own, "A", frame, "C")
            if inside.all():
                errors.append(off(frame, uv))
        wheels.stop()
    assert len(errors) == 24
    assert np.median(np.max(errors, axis=1)) < 0.2


def test_a_camera_that_has_moved_sees_what_one_that_is_opened_there_does():
    quiet = Sensor(read_noise=0.0, shot_gain=0.0)
    with LiveWorld(team_of(), sensor=quiet) as own, camera_of(own, "A") as camera:
        before = camera.read(2.0)
        own.push("A", 0.1, -0.05, 0.1)
        moved = time.monotonic_ns()
        while (after := camera.read(2.0)).stamp_ns < moved + 10_000_000:
            pass
        with camera_of(own, "A") as opened:
            assert np.array_equal(after.pixels, opened.read(2.0).pixels)
        assert (after.pixels != before.pixels).mean() > 0.05


@pytest.mark.realtime
def test_images_come_at_the_cameras_rate_soon_and_with_noise_of_their_own(world):
    with camera_of(world, "B") as camera:
        frames, ages = [], []
        for _ in range(30):
            frames.append(camera.read(2.0))
            ages.append((time.monotonic_ns() - frames[-1].stamp_ns) * 1e-9)
    stamps = np.array([frame.stamp_ns for frame in frames]) * 1e-9
    steps = np.diff(stamps) * 30
    assert np.abs(steps - np.rint(steps)).max() < 1e-6
    assert np.median(steps) == pytest.approx(1)
    assert 0.002 < np.median(ages) < 0.05
    # sensors' noise: two images differ by the root of two of it
    differ = frames[0].pixels.astype(float) - frames[1].pixels
    assert 2.2 < np.std(differ) / np.sqrt(2) < 2.8
    assert all(np.std(frames[0].pixels.astype(float) - frame.pixels) > 3 for frame in frames[1:])


@pytest.mark.realtime
def test_stamps_are_of_the_clients_clock(world):
    ahead = 3_600_000_000_000
    with camera_of(world, "A", clock=lambda: time.monotonic_ns() + ahead) as camera:
        frame = camera.read(2.0)
        age = time.monotonic_ns() + ahead - frame.stamp_ns
    assert 0 < age * 1e-9 < 1.0


@pytest.mark.realtime
def test_only_cameras_that_somebody_has_opened_are_rendered(world):
    assert until(lambda: cameras_running() == 0)
    with camera_of(world, "A") as camera:
        camera.read(2.0)
        assert cameras_running() == 1
    assert until(lambda: cameras_running() == 0)


# ---- what is refused, and what goes wrong


def test_the_socket_is_its_users_alone(world):
    folder = Path(world.address).parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert len(world.address) < MAX_PATH_POINTS


@pytest.mark.parametrize(("line", "words"), [
    (b'{"robot": "Z"}\n', "has no robot Z; it has A, B, C"),
    (b"give me images\n", "the request is none"),
    (b"[]\n", "the request is none"),
    (b"x" * 5000, "the request is none"),
])  # fmt: skip
def test_a_request_that_is_none_is_answered_so(world, line, words):
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(world.address)
        client.sendall(line)
        client.settimeout(3.0)
        answer = b""
        while data := client.recv(4096):
            answer += data
    assert words in json.loads(answer)["error"]


def test_a_robot_that_is_not_there_has_no_camera(world):
    with pytest.raises(CameraError, match=r"camera of robot Z .* the simulated world has no robot Z; it has A, B, C"):
        open_camera(f"world:{world.address}", world.team["A"].camera, "Z")


def test_a_team_that_says_another_size_is_told(world):
    small = replace(world.team["A"].camera, width=160, height=120)
    with (
        open_camera(f"world:{world.address}", small, "A") as camera,
        pytest.raises(CameraError, match="delivers images of 320 x 240 px, but the team says 160 x 120"),
    ):
        camera.read(2.0)


@pytest.mark.realtime
def test_a_frozen_camera_is_an_error_in_time_and_thaws(own):
    with camera_of(own, "A") as camera, camera_of(own, "B") as other:
        camera.read(2.0)
        own.freeze_camera("A")
        time.sleep(STALE + 0.2)
        since = time.monotonic()
        with pytest.raises(CameraError, match="has delivered no image"):
            camera.read(0.5)
        assert time.monotonic() - since < 2
        other.read(2.0)
        own.freeze_camera("A", False)
        camera.read(2.0)
        camera.reopen()
        camera.read(2.0)


@pytest.mark.realtime
def test_a_client_that_does_not_read_holds_up_nobody(own):
    with socket.socket(socket.AF_UNIX) as client, camera_of(own, "A") as camera:
        client.connect(own.address)
        client.sendall(b'{"robot": "A"}\n')
        time.sleep(0.5)
        camera.read(2.0)
        since = time.monotonic()
        own.close()
        assert time.monotonic() - since < 5
        with pytest.raises(CameraError, match=r"the simulated world closed the connection|is lost"):
            for _ in range(3):
                camera.read(2.0)
        assert not Path(own.address).parent.exists()
    assert until(lambda: cameras_running() == 0)


# ---- bodies and truth


def test_a_push_moves_the_body_and_no_encoder(own):
    with Create(own.ports["B"], 2) as wheels:
        before = own.emulators["B"].pose
        own.push("B", 0.02, -0.01, 0.1)
        assert own.emulators["B"].pose - before == pytest.approx([0.02, -0.01, 0.1], abs=1e-9)
        time.sleep(0.2)
        assert np.array_equal(wheels.odometry.pose, np.zeros(3))
    times, T = own.truth("B")
    assert T[-1, :2, 3] - T[0, :2, 3] == pytest.approx([0.02, -0.01], abs=1e-9)
    assert np.all(np.diff(times) == pytest.approx(1e9 / TRUTH_RATE, abs=1e3))


def test_a_line_that_is_hung_up_comes_back_under_its_name(own):
    port = own.ports["A"]
    with Create(port, 2):
        own.hang_up("A")
        assert not Path(port).exists()
    own.plug_in("A")
    with Create(port, 2) as wheels:
        wheels.drive(0.1, 0.0)
        assert until(lambda: max(own.emulators["A"].speeds) > 0.05)


def test_poses_of_the_past_are_those_of_the_trace(own):
    with Create(own.ports["C"], 2) as wheels:
        for _ in range(12):
            wheels.drive(0.2, -1.5, 0.5)
            time.sleep(0.05)
    own.push("C", 0.1, 0.0, -0.2)
    emulator = own.emulators["C"]
    trace = emulator.trace()
    moved = trace[np.flatnonzero(np.abs(trace[:, 4:]).max(axis=1))]
    rows = moved[:: len(moved) // 20]
    assert len(rows) >= 20
    poses = emulator.poses_at(rows[:, 0])
    assert poses[:, :2] == pytest.approx(rows[:, 1:3], abs=1e-9)
    turned = poses[:, 2] - rows[:, 3]
    assert np.cos(turned) == pytest.approx(np.ones(len(rows)))
    assert emulator.poses_at([time.monotonic() - 60])[0] == pytest.approx(trace[0, 1:4])


def test_yaw_is_whole_where_a_turn_goes_past_half_a_circle():
    body = Body(2, Physics(start=(0.0, 0.0, 3.0)), 0.0)
    body.wanted = (-0.1, 0.1)
    body.advance(1.0)
    yaw = body.poses_at(np.arange(0.0, 1.0, 1e-4))[:, 2]
    assert yaw[-1] > np.pi or yaw[0] < -np.pi
    assert np.abs(np.diff(yaw)).max() < 0.01


def test_the_floor_tilts_by_the_place_and_by_nothing_else(rng):
    sigma = np.deg2rad(0.3)
    floor = UnevenFloor(sigma, rng)
    xy = rng.uniform(-20, 20, (4000, 2))
    T = floor.pose(np.column_stack([xy, np.zeros(4000)]))
    roll, pitch = np.arctan2(T[:, 2, 1], T[:, 2, 2]), -np.arcsin(T[:, 2, 0])
    for tilt in (roll, pitch):
        assert tilt.std() == pytest.approx(sigma, rel=0.06)
        assert abs(tilt.mean()) < 4 * sigma / np.sqrt(4000)
    assert np.array_equal(T, floor.pose(np.column_stack([xy, np.zeros(4000)])))
    # the same slope, whichever way the body looks: its z stays where it is
    turned = floor.pose(np.column_stack([xy, np.full(4000, 2.0)]))
    assert turned[:, :3, 2] == pytest.approx(T[:, :3, 2], abs=2e-5)
    there = floor.slope(xy)
    assert (floor.slope(np.add(xy, (0.005, 0.0))) - there).std() < 0.15 * sigma
    assert abs(np.mean(floor.slope(np.add(xy, (0.0, 0.1))) * there)) < 0.25 * sigma**2
    assert np.array_equal(UnevenFloor(0.0, rng).pose([[1.0, 2.0, 0.5]])[0, :3, 2], [0, 0, 1])


def test_what_is_true_is_drawn_from_the_tolerances_by_the_seed(world):
    team = world.team
    with LiveWorld(team, seed=5) as again, LiveWorld(team, seed=6) as other:
        assert again.true_team == world.true_team != other.true_team
    offs = [world.true_team[r].mount.tilt_deg - team[r].mount.tilt_deg for r in team.names]
    assert all(0 < abs(off) < 4 for off in offs) and len(set(offs)) == 3


def test_the_truth_is_a_run_that_evaluations_read(own, tmp_path):
    own.push("B", 0.05, 0.0, 0.0)
    time.sleep(0.3)
    epoch = 1_700_000_000_000_000_000
    own.write_truth(tmp_path / "truth.mcap", epoch)
    assert read_true_team(tmp_path / "truth.mcap") == own.true_team
    truth = read_truth(tmp_path / "truth.mcap")
    times, T = own.truth("B")
    read = truth["B"]
    assert len(read) <= len(times)
    assert read.times == pytest.approx((times[: len(read)] + epoch) * 1e-9, abs=1e-6)
    assert read.T_world_body == pytest.approx(T[: len(read)], abs=1e-12)
    asked = Trajectory("B", read.times[1:3] + 0.01, T[:2])
    assert true_poses(truth, asked).shape == (2, 4, 4)
    assert np.linalg.norm(so3_log(T[-1, :3, :3])) > 0.1  # it looks to the left, as it began


@pytest.mark.parametrize("robots", [3, 4, 5, 6])
def test_a_team_begins_with_its_last_robot_before_all_others(robots):
    team = replace(team_of(robots), floor=None)
    with LiveWorld(team) as live:
        bodies = live.poses_at([time.monotonic()])[:, 0]
        positions = bodies[:, :2, 3]
        apart = np.linalg.norm(positions[:, None] - positions, axis=-1)[~np.eye(robots, dtype=bool)]
        assert apart.min() > 0.5
        for robot, T in zip(team.names[:-1], bodies, strict=False):
            true = live.true_team[robot]
            view = View(true.camera, T @ true.mount.T_body_camera)
            markers = live.true_team[team.names[-1]].markers.p_body @ bodies[-1, :3, :3].T + bodies[-1, :3, 3]
            assert view.sees(markers, 10.0).all()


def test_three_begin_as_the_hallway_does():
    (xa, ya, yaw_a), (xb, yb, yaw_b), _ = start_poses(3)
    assert (xa, ya, yaw_a) == pytest.approx((0.0, 0.36, -np.deg2rad(17)))
    assert (xb, yb, yaw_b) == pytest.approx((0.185, -0.36, np.deg2rad(17)))


def test_what_makes_no_world_is_refused():
    with pytest.raises(InputError, match="a team of 2 robots cannot leap-frog; give 3 or more, or their poses"):
        LiveWorld(replace(team_of(), robots=team_of().robots[:2]))
    with pytest.raises(InputError, match="there are 2 start poses for 3 robots; give one each"):
        LiveWorld(team_of(), poses=[(0.0, 0.0, 0.0)] * 2)
    with pytest.raises(InputError, match="`seed` is -1"):
        LiveWorld(team_of(), seed=-1)
    with LiveWorld(team_of()) as live, pytest.raises(InputError, match="has no robot Q; it has A, B, C"):
        live.push("Q", 0, 0, 0)


# ---- the program


class Program:
    def __init__(self, folder, *options):
        write_team(team_of(), folder / "team.toml")
        command = [sys.executable, "-m", "coloc_graph.simulation.live_world", str(folder / "team.toml")]
        self.out = folder / "out"
        self.process = subprocess.Popen(
            [*command, "--dir", str(self.out), *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        line = self.process.stdout.readline()
        self.about = json.loads(line) if line else None

    def ask(self, line):
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            pipe.close()


@pytest.mark.realtime
def test_the_program_serves_takes_commands_and_ends_with_the_truth(tmp_path):
    with Program(tmp_path, "--seed", "3", "--epoch", "5000000000") as program:
        assert program.about["epoch_ns"] == 5_000_000_000
        address, ports = program.about["socket"], program.about["ports"]
        with open_camera(f"world:{address}", team_of()["B"].camera, "B") as camera, Create(ports["C"], 2) as wheels:
            camera.read(5.0)

            def drives():
                keep_driving(wheels, 0.2, 0.0)
                return max(program.ask("speeds")["speeds"]["C"]) > 0.15

            assert until(drives)
            wheels.stop()
            assert program.ask("freeze B") == {"ok": True}
            time.sleep(STALE + 0.1)
            with pytest.raises(CameraError, match="no image"):
                camera.read(0.2)
            assert program.ask("thaw B") == {"ok": True}
            camera.read(2.0)
            before = program.ask("poses")["poses"]["A"]
            assert program.ask("push A 0.02 0 0.1") == {"ok": True}
            assert np.subtract(program.ask("poses")["poses"]["A"], before) == pytest.approx([0.02, 0, 0.1], abs=1e-9)
        assert program.ask("hangup A") == {"ok": True} and not Path(ports["A"]).exists()
        assert program.ask("plug A") == {"ok": True} and Path(ports["A"]).exists()
        assert "has no robot Q" in program.ask("freeze Q")["error"]
        assert "`dance` is no command; use speeds, poses" in program.ask("dance")["error"]
        assert "could not convert" in program.ask("push A far 0 0")["error"]
        program.process.send_signal(signal.SIGTERM)
        assert program.process.wait(30) == 0
        assert program.process.stderr.read() == ""
    assert not Path(address).parent.exists()
    truth = read_truth(program.out / "truth.mcap")
    assert set(truth) == {"A", "B", "C"}
    moved = truth["C"].positions[-1] - truth["C"].positions[0]
    assert moved[0] > 0.005


def test_the_program_ends_when_its_input_does(tmp_path):
    with Program(tmp_path) as program:
        program.process.stdin.close()
        assert program.process.wait(30) == 0
    assert (program.out / "truth.mcap").exists()
    assert [path.name for path in program.out.iterdir()] == ["truth.mcap"]


def test_the_program_refuses_with_a_sentence(tmp_path):
    command = [sys.executable, "-m", "coloc_graph.simulation.live_world", str(tmp_path / "none.toml"), "--dir", "x"]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: ") and "cannot be read" in ended.stderr
