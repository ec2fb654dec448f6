"""`coloc robot` as a service: what it tells systemd, and that it needs no more packages than the list says."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from coloc_graph.robot_io.service_manager import ServiceManager
from coloc_graph.simulation import reference_team
from coloc_graph.team import write_team

ROOT = Path(__file__).parents[2]
REQUIREMENTS = ROOT / "deploy" / "robot-requirements.txt"
#: Modules of the required distributions that are called otherwise.
MODULES = {"eclipse-zenoh": "zenoh", "foxglove-schemas-protobuf": "foxglove_schemas_protobuf",
           "opencv-python-headless": "cv2", "protobuf": "google", "pyserial": "serial"}  # fmt: skip
STARTS = """
import importlib.abc, sys
class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        top = name.split(".")[0]
        if top not in sys.stdlib_module_names and top not in {allowed!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
from coloc_graph.cli import main
sys.exit(main({arguments!r}))
"""


@pytest.fixture
def manager_socket(tmp_path, monkeypatch):
    """The socket of a service manager, as in this process's environment."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(20.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listener


def test_signs_of_life_come_as_often_as_the_watchdog_needs(manager_socket, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    with ServiceManager() as manager:
        manager.ready()
        assert manager_socket.recv(64) == b"READY=1"
        for _ in range(100):
            manager.alive()  # at once: one message
        time.sleep(0.06)
        manager.alive()
    received = [manager_socket.recv(64) for _ in range(3)]
    assert received == [b"WATCHDOG=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_another_process_is_watched_or_none(manager_socket, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    with ServiceManager() as manager:
        manager.alive()
    assert manager_socket.recv(64) == b"STOPPING=1"
    monkeypatch.delenv("NOTIFY_SOCKET")
    with ServiceManager() as manager:
        manager.ready()
    manager_socket.settimeout(0.05)
    with pytest.raises(TimeoutError):
        manager_socket.recv(64)


def test_a_service_manager_that_went_away_stops_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    with ServiceManager() as manager:
        manager.ready()


@pytest.mark.realtime
def test_a_robot_needs_the_listed_packages_only_and_reports_to_systemd(tmp_path, manager_socket):
    names = re.findall(r"^([\w-]+)", REQUIREMENTS.read_text(encoding="utf-8"), re.MULTILINE)
    allowed = {"coloc_graph", *(MODULES.get(name, name) for name in names)}
    write_team(reference_team(), tmp_path / "team.toml")
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (320, 240), isColor=False)
    for _ in range(20):
        video.write(np.full((240, 320), 10, np.uint8))
    video.release()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    arguments = ["robot", "A", str(tmp_path / "team.toml"), "--out", str(tmp_path / "records"),
                 "--camera", f"video:{tmp_path / 'v.avi'}", "--connect", f"tcp/127.0.0.1:{port}"]  # fmt: skip
    environment = {**os.environ, "WATCHDOG_USEC": "400000", "PYTHONPATH": str(ROOT)}
    environment.pop("WATCHDOG_PID", None)
    program = subprocess.Popen(
        [sys.executable, "-c", STARTS.format(allowed=allowed, arguments=arguments)],
        env=environment, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        try:
            assert manager_socket.recv(64) == b"READY=1"
        except TimeoutError:
            program.kill()
            pytest.fail(program.communicate()[1])
        assert [manager_socket.recv(64) for _ in range(2)] == [b"WATCHDOG=1"] * 2
        program.send_signal(signal.SIGTERM)
        _, errors = program.communicate(timeout=20)
        assert program.returncode == 0, errors
    finally:
        program.kill()
        program.wait()


def test_the_list_asks_for_what_the_package_asks_for():
    wanted = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for line in REQUIREMENTS.read_text(encoding="utf-8").splitlines():
        assert line.startswith("#") or f'"{line}"' in wanted, line
