"""A coordinator's process beside others, with nobody who reads its output, and with signals; robots are fake."""

import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest
from fake_robots import FakeRobot, fake_team

from coloc_graph.cli import main, running
from coloc_graph.cli.nonblocking_log import CAPACITY, NonBlockingHandler
from coloc_graph.errors import InputError
from coloc_graph.online.mission_folder import MissionFolder
from coloc_graph.robot_io.link.messages import Capture
from coloc_graph.run import open_run
from coloc_graph.simulation.simulated_team import field_team, free_address
from coloc_graph.team import write_team

F_SETPIPE_SZ = 1031


def full_pipe():
    """Both ends of a pipe that takes no more."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, F_SETPIPE_SZ, 4096)
    os.set_blocking(writer, False)
    try:
        while True:
            os.write(writer, b"x" * 64)
    except BlockingIOError:
        os.set_blocking(writer, True)
    return reader, writer


def ignore_terminal():
    """As a shell does for programs in the background, and nohup."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


class Mission:
    """A coordinator's process for fake robots, whose output nobody reads."""

    def __init__(self, folder):
        self.folder, self.address = folder, free_address()
        write_team(field_team(), folder / "team.toml")
        self._pipe = full_pipe()
        self.process = self.start(stdout=self._pipe[1], stderr=self._pipe[1], preexec_fn=ignore_terminal)

    def arguments(self, *more, address=None):
        command = ["coordinate", str(self.folder / "team.toml"), "--out", str(self.folder / "mission")]
        return [*command, "--goal", "5,0", "--listen", address or self.address, *more]

    def start(self, **options):
        command = [sys.executable, "-m", "coloc_graph.cli", *self.arguments()]
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)

    def rows(self):
        path = self.folder / "mission" / "mission.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def wait_for(self, state, timeout=60.0):
        until = time.monotonic() + timeout
        while not any(row.get("state") == state for row in self.rows()):
            assert time.monotonic() < until, self.rows()
            time.sleep(0.05)

    def end(self, number):
        """Send a signal; time until the process has ended [s], and its exit code."""
        began = time.monotonic()
        self.process.send_signal(number)
        code = self.process.wait(60.0)
        return time.monotonic() - began, code

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for end in self._pipe:
            os.close(end)


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    one = Mission(tmp_path_factory.mktemp("mission"))
    with fake_team("ABC", one.address) as one.robots:
        yield one
    one.close()


def test_a_mission_goes_on_while_nobody_reads_its_output(mission):
    mission.wait_for("looking")


def test_a_second_coordinator_of_the_same_folder_is_refused_and_changes_nothing(mission, capfd):
    mission.wait_for("looking")
    folder = mission.folder / "mission"
    before = {path.name: path.stat().st_ino for path in folder.iterdir()}
    assert main(mission.arguments("--resume", address=free_address())) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1
    assert "is being written by another command" in err
    assert {path.name: path.stat().st_ino for path in folder.iterdir()} == before


def test_a_taken_port_is_refused_before_a_record_is_touched(mission, tmp_path, capfd):
    mission.wait_for("looking")
    command = ["coordinate", str(mission.folder / "team.toml"), "--listen", mission.address, "--out"]
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    (earlier / "run.mcap").write_bytes(b"a record")
    for more in ([str(tmp_path / "new")], [str(earlier), "--resume"]):
        assert main([*command, *more]) == 2
        err = capfd.readouterr().err
        assert err.count("\n") == 1 and "cannot open the link" in err and "in use" in err and ".rs" not in err
    assert not (tmp_path / "new").exists()
    assert (earlier / "run.mcap").read_bytes() == b"a record" and not list(earlier.glob("run.*.mcap"))


def test_a_second_program_of_a_robot_is_told_and_ends_and_one_after_it_is_admitted(mission, tmp_path, capfd):
    mission.wait_for("looking")
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((240, 320), np.uint8))
    command = ["robot", "A", str(mission.folder / "team.toml")]
    command += ["--out", str(tmp_path), "--connect", mission.address, "--camera", f"video:{tmp_path}"]
    assert main(command) == 2
    err = capfd.readouterr().err
    assert "Traceback" not in err and err.splitlines()[-1].startswith("coloc: another program runs as robot A already")
    first = mission.robots["A"]
    sessions = [row["session"] for row in mission.rows() if row["what"] == "session" and row["robot"] == "A"]
    assert sessions == [first.session] and first.link.refused is None
    first.__exit__()  # its program ends: the next one is welcome
    with FakeRobot("A", mission.address) as second:
        until = time.monotonic() + 30.0
        while not any(isinstance(body, Capture) for body in second.bodies):
            assert time.monotonic() < until and second.link.refused is None
            time.sleep(0.05)


def test_a_signal_ends_a_mission_of_which_nobody_reads_the_output(mission):
    mission.wait_for("looking")
    seconds, code = mission.end(signal.SIGINT)  # ignored when it was started, as in the background
    assert code == 1 and seconds < 30.0
    run = open_run(mission.folder / "mission" / "run.mcap")
    assert not run.warnings and sum(1 for _ in run.odometry("A")) > 10


def test_a_signal_ends_a_mission_that_waits_for_its_robots(tmp_path):
    one = Mission(tmp_path)
    try:
        until = time.monotonic() + 60
        while not (tmp_path / "mission" / "mission.jsonl").exists():
            assert time.monotonic() < until and one.process.poll() is None
            time.sleep(0.05)
        one.process.send_signal(signal.SIGHUP)  # it was started under nohup: that is not for it
        time.sleep(0.5)
        assert one.process.poll() is None
        seconds, code = one.end(signal.SIGTERM)
        assert code == 1 and seconds < 30.0
    finally:
        one.close()


def test_log_messages_that_nobody_reads_are_dropped_counted_and_never_waited_for():
    reader, writer = full_pipe()
    handler = NonBlockingHandler(writer)
    logger = logging.Logger("nobody reads it")
    logger.addHandler(handler)
    began = time.monotonic()
    for n in range(CAPACITY + 100):
        logger.warning("message %d", n)
    assert time.monotonic() - began < 30.0
    text = b""

    def read():
        nonlocal text
        while data := os.read(reader, 1 << 16):
            text += data

    thread = threading.Thread(target=read)
    thread.start()
    until = time.monotonic() + 10.0
    while b"were dropped" not in text and time.monotonic() < until:
        time.sleep(0.01)
    handler.close()
    os.close(writer)
    thread.join()
    os.close(reader)
    lines = text.lstrip(b"x").decode().splitlines()
    kept = [line for line in lines if line.startswith("message")]
    assert kept == [f"message {n}" for n in range(len(kept))]
    assert int(lines[-1].split()[0]) == CAPACITY + 100 - len(kept) > 0


def test_output_that_nobody_reads_is_noticed(monkeypatch, tmp_path):
    monkeypatch.setattr(running, "READER_WAIT", 0.05)
    reader, writer = full_pipe()
    with (tmp_path / "err").open("w") as err, os.fdopen(writer, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(sys, "stderr", err)
        assert not running.output_is_read()
        os.read(reader, 4096)
        assert running.output_is_read()
    os.close(reader)


def test_a_mission_folder_is_locked_and_given_back(tmp_path):
    folder = tmp_path / "mission"
    with MissionFolder(folder, resume=False), pytest.raises(InputError, match="another command"):
        MissionFolder(folder, resume=True)
    assert not folder.exists()  # nothing came to be in it
    folder.mkdir()
    (folder / "run.mcap").touch()
    (tmp_path / "alias").symlink_to(folder)
    with MissionFolder(folder, resume=True), pytest.raises(InputError, match="another command"):
        MissionFolder(tmp_path / "alias", resume=True)
    for _ in range(2):  # the lock is given back
        with pytest.raises(InputError, match="--resume"):
            MissionFolder(folder, resume=False)
    with MissionFolder(folder, resume=True):
        pass
    assert (folder / "run.mcap").exists()
