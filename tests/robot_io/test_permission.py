"""A robot's program on emulated wheels: its motions end with the coordinator's permission, and its name is its own."""

import threading
import time

import cv2
import numpy as np
import pytest
from separate_emulator import EmulatorProcess

from coloc_graph.errors import RobotError
from coloc_graph.online.robot import RobotProgram
from coloc_graph.robot_io.deadlines import STAND_WITHIN, reaction_time
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Drive
from coloc_graph.simulation.simulated_team import field_team, free_address

pytestmark = pytest.mark.realtime
TEAM = field_team()
SPEED = 0.45


def until(met, timeout=15.0):
    deadline = time.monotonic() + timeout
    while not met():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def program(folder, address, wheels=None):
    (folder / "images").mkdir(exist_ok=True)
    camera = TEAM["C"].camera
    cv2.imwrite(str(folder / "images" / "0.png"), np.zeros((camera.height, camera.width), np.uint8))
    return RobotProgram(
        "C", TEAM, connect=address, folder=folder, camera=f"video:{folder / 'images'}", wheels=wheels, model=2
    )


def test_a_motion_depends_on_the_permission_and_a_second_program_ends(tmp_path):
    address, events, stop, permitted = free_address(), [], threading.Event(), threading.Event()
    permitted.set()
    ignore = {f"on_{kind}": lambda *_: None for kind in ("sample", "wheels", "status", "presence")}
    with (
        EmulatorProcess() as emulators,
        emulators.robot(2) as wheels,
        CoordinatorLink(TEAM, listen=address, on_event=lambda *one: events.append(one), **ignore) as link,
        program(tmp_path, address, wheels.port) as robot,
    ):

        def hold():
            while not stop.wait(0.05):
                if permitted.is_set():
                    link.hold()

        threads = [threading.Thread(target=hold), threading.Thread(target=robot.run, args=(stop,))]
        for thread in threads:
            thread.start()
        try:
            drive = Drive(number=1, places=[(100.0, 0.0)], yaw=None, speed=SPEED)
            assert link.ask("C", drive, 15.0).ok
            assert until(lambda: link.ask("C", drive, 15.0).ok and min(wheels.speeds) > 0.95 * SPEED, 30.0), events
            left = []
            for _ in range(40):
                deadline, granted = robot._wheels._deadline, robot._link.last_heard * 1e-9
                if deadline is not None:
                    left.append(deadline - granted)
                time.sleep(0.01)
            assert left and max(left) <= reaction_time(SPEED) + 2e-3
            with program(tmp_path, address) as second:
                with pytest.raises(RobotError, match="another program runs as robot C already: end it first"):
                    second.run(threading.Event())
                assert link.ask("C", drive, 15.0).ok
            assert until(lambda: link.ask("C", drive, 15.0).ok and min(wheels.speeds) > 0.95 * SPEED, 30.0), events
            permitted.clear()
            since = time.monotonic()
            assert until(lambda: wheels.still_since is not None and wheels.still_since > since)
            assert wheels.still_since - since < STAND_WITHIN
        finally:
            stop.set()
            for thread in threads:
                thread.join()
