"""The wheels: a real driver on a real pseudo-terminal, with an emulated robot at the other end."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import serial
from scipy.stats import chi2
from separate_emulator import EmulatorProcess
from wheel_nees import nees

from coloc_graph.errors import InputError, RobotError
from coloc_graph.robot_io.create import protocol as oi
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.robot_io.create.physics import Physics, Wall
from coloc_graph.robot_io.create.protocol import Mode, decode_values
from coloc_graph.robot_io.deadlines import STAND_WITHIN, reaction_time

pytestmark = pytest.mark.realtime
#: After whatever befalls it, the wheels are to stand still within this [s].
STOPPED = STAND_WITHIN


def until(met, timeout=20.0):
    """Whether it comes true in time."""
    deadline = time.monotonic() + timeout
    while not met():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def keep(create, v, w, seconds):
    """Drive for so long, with renewals."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        create.drive(v, w)
        time.sleep(min(0.05, left))


def set_off(create, robot, v=0.2, w=0.0):
    """Have it moving at full speed."""
    assert until(lambda: create.drive(v, w, 0.5) is not None and max(robot.speeds) > 0.9 * v), robot.speeds


def stopped_after(robot, since, within=STOPPED):
    """How long after `since` the wheels stood still [s]."""
    assert until(lambda: robot.still_since is not None), "the wheels still turn"
    took = robot.still_since - since
    print(f"    stopped after {took:.3f} s")
    assert took < within
    return took


@pytest.fixture(scope="module")
def emulators():
    with EmulatorProcess() as process:
        yield process


@pytest.fixture
def robot(emulators):
    with emulators.robot(2) as emulator:
        yield emulator


@pytest.fixture
def create(robot):
    with Create(robot.port, 2, robot="A") as driver:
        yield driver


@pytest.mark.parametrize("model", [1, 2])
def test_the_model_is_found_out_by_baud_and_checksum(emulators, model, monkeypatch):
    monkeypatch.setattr("coloc_graph.robot_io.create.line.ANSWER_TIMEOUT", 0.4)
    with emulators.robot(model) as robot, Create(robot.port) as create:
        assert create.model == model
        assert create._line.decoder.header_counts is (model == 2)
        assert create.state.mode == Mode.SAFE and robot.mode == Mode.SAFE
        before = create.frames[0]
        assert until(lambda: create.frames[0] >= before + 20)
        assert create.frames[1] == 0


def test_what_is_sent_is_the_open_interface_to_the_byte(robot):
    with Create(robot.port, 2) as create:
        assert create.drive(0.2, 0.0) == (0.2, 0.0)
        create.drive(0.0, 1.0)  # to the left: the right wheel ahead, the left one back, by 117.5 mm each
        create.stop()
        listed = bytes([7, 9, 10, 11, 12, 34, 35, 21, 22, 25, 26, 42, 41, 43, 44])
    start = bytes([128, 148, len(listed)]) + listed + bytes([131, 145, 0, 0, 0, 0])
    assert robot.received.startswith(start + bytes([145, 0, 200, 0, 200, 145, 0, 118, 255, 138, 145, 0, 0, 0, 0]))
    assert robot.received.endswith(bytes([145, 0, 0, 0, 0, 150, 0, 128]))
    assert robot.mode == Mode.PASSIVE


def test_sensors(create, robot):
    state = create.state
    assert (state.bumps, state.cliffs, state.wheel_drops, state.charger) == (frozenset(),) * 3 + (None,)
    assert (state.voltage, state.charge, state.capacity) == pytest.approx((15.4, 2.1, 2.696))
    assert not state.charging
    robot.cliff("front left")
    robot.wheel_drop("right")
    robot.dock()
    assert until(lambda: create.state.charging)
    state = create.state
    assert (state.cliffs, state.wheel_drops, state.charger) == ({"front left"}, {"right"}, "home base")
    assert state.hazards()["cliff"] == "a cliff at the front left"


def test_a_wall_presses_the_bumper_and_stops_who_asks_for_it(emulators):
    walls = [Wall(0.25, -1.0, 0.5, 1.0)]
    with emulators.robot(2, Physics(walls=walls)) as robot, Create(robot.port, 2, stop_on=["bump"]) as create:
        with pytest.raises(RobotError, match="it met a bump on the left and right: put it right and call recover"):
            keep(create, 0.3, 0.0, 2.0)
        assert robot.pose[0] < 0.25 - 0.165
        stopped_after(robot, time.monotonic())
        create.recover()  # it still touches, and may go back
        keep(create, -0.2, 0.0, 0.3)
        assert until(lambda: not create.state.bumps)


# ---- what stops the wheels


@pytest.mark.parametrize(("model", "speed"), [(2, 0.2), (2, 0.4), (1, 0.2)])
def test_a_lease_that_expires_stops_the_wheels(emulators, model, speed):
    with emulators.robot(model) as robot, Create(robot.port, model) as create:
        set_off(create, robot, speed)
        since = time.monotonic()
        create.drive(speed, 0.0)
        assert stopped_after(robot, since) > 0.1  # a frame that came late has used up a part of the lease
        assert create.fault is None
        create.drive(speed, 0.0)  # no fault: it may go on


def test_renewals_keep_it_going_and_a_stop_ends_it(create, robot):
    began = time.monotonic()
    keep(create, 0.2, 0.0, 0.6)
    assert robot.still_since is None and create.moving
    since = time.monotonic()
    create.stop()
    stopped_after(robot, since, within=0.25)
    assert until(lambda: not create.moving)
    t, x, _, _, left, right = robot.trace().T
    assert np.all(np.abs(np.diff(left)) <= 2.0 * np.diff(t) + 1e-9) and np.array_equal(left, right)
    assert 0.1 < x[-1] < 0.2 * (since - began) + 0.05 and left.max() == pytest.approx(0.2)


def test_an_exception_in_the_block_stops_the_wheels(robot):
    with pytest.raises(ZeroDivisionError), Create(robot.port, 2) as create:
        set_off(create, robot)
        since = time.monotonic()
        1 / 0  # noqa: B018
    stopped_after(robot, since)
    assert robot.mode == Mode.PASSIVE
    with pytest.raises(RobotError, match="is not open: open it"):
        create.drive(0.1, 0.0)
    with create:  # and it can be opened again
        create.drive(0.1, 0.0)


def test_silence_of_the_sensors_stops_the_wheels(create, robot):
    set_off(create, robot)
    robot.mute = True
    since = time.monotonic()
    with pytest.raises(RobotError, match=r"no sensor data came for 0\.3 s"):
        keep(create, 0.2, 0.0, 2.0)
    stopped_after(robot, since)
    with pytest.raises(RobotError, match="did not go back to safe mode because no sensor data come"):
        create.recover(timeout=0.2)
    robot.mute = False
    assert until(lambda: create._feed.age < 0.05)
    create.recover()
    set_off(create, robot)


def test_a_reader_that_fails_stops_the_wheels(create, robot, monkeypatch):
    set_off(create, robot)

    def broken(_):
        raise SystemExit("a bug")

    since = time.monotonic()
    monkeypatch.setattr(create._feed, "take", broken)
    with pytest.raises(RobotError, match=r"its driver failed \(SystemExit\('a bug'\)\)"):
        keep(create, 0.2, 0.0, 1.0)
    stopped_after(robot, since)


def test_a_deadline_thread_that_fails_stops_the_wheels(create, robot, monkeypatch):
    set_off(create, robot)

    since = time.monotonic()
    monkeypatch.setattr("coloc_graph.robot_io.create.driver.HUNG", "a bug")
    assert until(lambda: create.fault is not None)
    stopped_after(robot, since)


@pytest.mark.parametrize(("befall", "words"), [
    (lambda robot: robot.cliff("front right"), "left safe mode for passive because of a cliff at the front right"),
    (lambda robot: robot.wheel_drop("left"), "left safe mode for passive because of a dropped wheel .left."),
    (lambda robot: robot.dock(), "left safe mode for passive because of the charger .home base."),
    (lambda robot: robot.restart(), "no sensor data came"),
])  # fmt: skip
def test_a_robot_that_leaves_its_mode_is_told_at_the_next_drive(create, robot, befall, words):
    set_off(create, robot)
    since = time.monotonic()
    befall(robot)
    with pytest.raises(RobotError, match=words):
        keep(create, 0.2, 0.0, 2.0)
    stopped_after(robot, since)
    with pytest.raises(RobotError, match=words):  # again, until someone says that it is put right
        create.drive(0.2, 0.0)
    if "dropped" in words:
        with pytest.raises(RobotError, match="did not go back to safe mode because of a dropped wheel"):
            create.recover(timeout=0.2)
    robot.wheel_drop("left", False)
    robot.dock(False)
    create.recover()
    if "cliff" in words:  # still there: it may back away from it
        assert create.drive(-0.2, 0.0) == (-0.2, 0.0)
        assert until(lambda: min(robot.speeds) < -0.1)
        return
    set_off(create, robot)


def test_in_full_mode_the_driver_stops_for_what_the_robot_would_not(robot):
    with Create(robot.port, 2, full=True) as create:
        set_off(create, robot)
        since = time.monotonic()
        robot.cliff("left")
        with pytest.raises(RobotError, match="it met a cliff at the left"):
            keep(create, 0.2, 0.0, 1.0)
        stopped_after(robot, since)
        assert robot.mode == Mode.FULL
        create.recover()
        set_off(create, robot)
        robot.dock()  # not in stop_on
        keep(create, 0.2, 0.0, 0.1)


def test_a_stop_that_gets_lost_is_sent_again(create, robot, monkeypatch):
    set_off(create, robot)
    since = time.monotonic()
    lost = []
    send = create._line.send

    def lossy(data):
        return lost.append(data) if data == oi.HALT and len(lost) < 2 else send(data)

    monkeypatch.setattr(create._line, "send", lossy)
    create.stop()
    stopped_after(robot, since)
    assert lost == [oi.HALT] * 2


def test_a_bad_line_is_counted_and_driven_over(create, robot):
    robot.corruption = 0.01
    keep(create, 0.2, 0.0, 0.8)
    robot.corruption = 0.0
    good, bad = create.frames
    assert good > 15 and bad > 2
    create.stop()
    stopped_after(robot, time.monotonic())
    assert until(lambda: abs(create.odometry.pose[0] - robot.pose[0]) < 0.02)


def test_a_stop_has_the_last_word_over_a_drive_that_is_under_way(create, robot):
    def insist():
        with contextlib.suppress(RobotError):
            while True:
                create.drive(0.1, 0.0)

    for n in range(0, 15, 2):
        thread = threading.Thread(target=insist)
        thread.start()
        time.sleep(0.001 * n)
        create.emergency_stop(f"test {n}")
        thread.join(timeout=20.0)
        assert not thread.is_alive()
        assert until(lambda: robot.wanted == (0.0, 0.0), 0.1)
        create.recover()


def test_a_stop_while_it_recovers_holds(create, robot, monkeypatch):
    create.emergency_stop("once")
    wait = create._wait

    def interrupted(*arguments):
        create.emergency_stop("twice")
        return wait(*arguments)

    monkeypatch.setattr(create, "_wait", interrupted)
    with pytest.raises(RobotError, match="stopped again while it recovered"):
        create.recover()
    monkeypatch.undo()
    with pytest.raises(RobotError, match="stopped again"):
        create.drive(0.1, 0.0)
    create.recover()
    set_off(create, robot)


def test_an_ordinary_end_is_no_fault(robot, caplog):
    for _ in range(3):
        with Create(robot.port, 2) as create:
            create.drive(0.1, 0.0)
    assert not caplog.records


# ---- the end of a process

PROGRAM = """
import os, signal, sys, time
from coloc_graph.robot_io.create.driver import Create
{before}
create = Create(sys.argv[1], 2).open()
end = time.monotonic() + 20
sent = False
while time.monotonic() < end:
    try:
        create.drive(0.2, 0.0, 0.5)
    except Exception as error:
        print("refused:", error, flush=True)
        time.sleep(0.3)
        sys.exit(7)
    if not sent and create.state.requested[0] > 0.1:
        sent = True
        time.sleep(0.15)
        print("moving", time.monotonic(), flush=True)
        {after}
    time.sleep(0.02)
"""
ENDS = {
    "SIGTERM": ("", "pass", -signal.SIGTERM),
    "SIGHUP": ("", "pass", -signal.SIGHUP),
    "SIGINT": ("", "pass", 1),  # Python's KeyboardInterrupt
    "exception": ("", "1 / 0", 1),
    "exit": ("", "sys.exit(3)", 3),
    "own handler": ("signal.signal(signal.SIGTERM, lambda *_: os.write(1, b'mine\\n'))", "pass", 7),
}


@pytest.mark.parametrize("how", ENDS)
def test_the_end_of_its_process_stops_the_wheels(robot, how):
    before, after, code = ENDS[how]
    program = PROGRAM.format(before=before, after=after)
    child = subprocess.Popen(
        [sys.executable, "-c", program, robot.port], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        words = child.stdout.readline().split()
        assert words and words[0] == "moving", child.stderr.read()
        since = float(words[1])  # the monotonic clock is one for all processes
        assert robot.trace()[:, 4:].max() == pytest.approx(0.2)  # it may brake by now
        if code < 0 or how in ("SIGINT", "own handler"):
            since = time.monotonic()
            child.send_signal(getattr(signal, how, signal.SIGTERM))
        stopped_after(robot, since)
        out, err = child.communicate(timeout=30)
    finally:
        child.kill()
        child.wait()
    # Python ends on an unhandled Ctrl-C by the signal itself
    assert child.returncode in {code, -signal.SIGINT if how == "SIGINT" else code}, err
    if how == "own handler":
        assert out.startswith("mine\nrefused:") and "the process was sent SIGTERM" in out
    if how in ("exception", "SIGINT"):
        assert ("ZeroDivisionError" if how == "exception" else "KeyboardInterrupt") in err


@contextlib.contextmanager
def driving_process(robot, **more):
    """A process of its own that drives on; ended hard."""
    program = PROGRAM.format(before="", after="while True: create.drive(0.2, 0.0); time.sleep(0.05)")
    child = subprocess.Popen([sys.executable, "-c", program, robot.port], stdout=subprocess.PIPE, text=True, **more)
    try:
        assert child.stdout.readline().startswith("moving")
        yield child
    finally:
        child.kill()
        child.communicate(timeout=30)


@pytest.mark.parametrize("group", [False, True])
def test_a_kill_stops_the_wheels(robot, group):
    with driving_process(robot, start_new_session=True) as child:
        assert until(lambda: robot.speeds == pytest.approx((0.2, 0.2)))
        os.killpg(child.pid, signal.SIGKILL) if group else child.kill()
        stopped_after(robot, time.monotonic())
        assert until(lambda: robot.mode == Mode.PASSIVE)
    with Create(robot.port, 2) as create:  # the line is free again
        set_off(create, robot)


def test_a_kill_amid_a_command_stops_the_wheels(robot):
    with Create(robot.port, 2) as create:
        set_off(create, robot)
        create._line._serial.write(oi.drive_direct(200, 200)[:-2])  # the next bytes are taken for its speeds
        since, watchdog = time.monotonic(), create._line._watchdog
        watchdog._process.stdin.close()  # as at a kill
        stopped_after(robot, since)


def test_a_process_that_is_paused_has_its_wheels_stopped(robot):
    with driving_process(robot) as child:
        child.send_signal(signal.SIGSTOP)
        stopped_after(robot, time.monotonic())


def test_nothing_is_driven_once_the_watchdog_is_gone(robot):
    with Create(robot.port, 2) as create:
        set_off(create, robot)
        create._line._watchdog._process.kill()
        since = time.monotonic()
        with pytest.raises(RobotError, match=r"its watchdog process has ended.*open it again"):
            keep(create, 0.2, 0.0, 2.0)
        stopped_after(robot, since)
        assert "watchdog" in create.fault
    with Create(robot.port, 2) as create:
        set_off(create, robot)


def test_a_watchdog_that_does_not_answer_stops_the_wheels_and_is_a_fault_if_it_lasts(robot):
    with Create(robot.port, 2) as create:
        watchdog = create._line._watchdog._process
        keep(create, 0.45, 0.0, 0.4)
        watchdog.send_signal(signal.SIGSTOP)
        since = time.monotonic()
        keep(create, 0.45, 0.0, STOPPED)
        assert robot.speeds == (0.0, 0.0) and robot.still_since - since < STOPPED
        assert create.drive(0.45, 0.0) == (0.0, 0.0) and create.fault is None
        with pytest.raises(RobotError, match=r"its watchdog process has not answered for 1 s: .*recover"):
            keep(create, 0.45, 0.0, 2.0)
        watchdog.send_signal(signal.SIGCONT)
        assert until(lambda: create._line.watchdog_silence == 0.0)
        create.recover()
        set_off(create, robot)


def test_the_watchdog_holds_the_deadline_of_a_motion_by_itself(robot, monkeypatch):
    """The driver's own threads end no motion here: they only show that they run."""
    with Create(robot.port, 2) as create:
        halts = []
        monkeypatch.setattr(create, "_halt", halts.append)
        create.drive(0.4, 0.0)
        since = time.monotonic()
        assert until(lambda: robot.still_since is None)
        stopped_after(robot, since)
        assert halts
        monkeypatch.undo()


@pytest.mark.parametrize("speed", [0.05, 0.2, 0.45, 0.5])
def test_deadlines_are_shorter_the_faster_it_drives(create, robot, speed):
    """Of each: the time from the last sign of life to the stop command, and the wheels' own time to stand."""

    def reaction():
        before = time.monotonic()
        create.drive(speed, 0.0, 0.5)
        deadline = create._deadline
        assert deadline <= time.monotonic() + reaction_time(speed)  # the last sign of life was before now
        return deadline - before

    assert until(lambda: reaction() > reaction_time(speed) - 0.1)
    before = time.monotonic()
    assert reaction_time(speed) + speed / 2.0 <= STOPPED - 0.1
    create.drive(speed, 0.0, 0.5, granted=before - 0.05)
    assert create._deadline <= before - 0.05 + reaction_time(speed)
    assert create.drive(speed, 0.0, granted=before - 0.4) == (0.0, 0.0)
    assert not create.moving or until(lambda: not create.moving)
    create.drive(0.0, 2.0, 0.5)  # turning on the spot: the wheels turn as fast
    assert create._deadline <= time.monotonic() + reaction_time(0.23)


def test_signal_handlers_are_as_before_after_the_last_is_closed(emulators, robot):
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)]
    with emulators.robot(2) as other, Create(robot.port, 2), Create(other.port, 2):
        assert signal.getsignal(signal.SIGTERM) is not before[0]
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)] == before


def test_opened_outside_the_main_thread_it_says_what_will_not_stop_it(robot, caplog):
    opened = []
    thread = threading.Thread(target=lambda: opened.append(Create(robot.port, 2).open()))
    thread.start()
    thread.join(timeout=30.0)
    try:
        assert "signals will not stop" in caplog.text
        set_off(opened[0], robot)
        with pytest.raises(RobotError, match="open already"):
            opened[0].open()
    finally:
        since = time.monotonic()
        opened[0].close()
    stopped_after(robot, since)


# ---- the line


def test_a_line_that_hangs_up_is_a_clear_error_and_hangs_nothing(robot):
    with Create(robot.port, 2) as create:
        set_off(create, robot)
        robot.hang_up()
        since = time.monotonic()
        with pytest.raises(RobotError, match=r"pts.* lost .*check the cable"):
            keep(create, 0.2, 0.0, 2.0)
        assert time.monotonic() - since < 0.3
        for forbidden in (create.stop, create.recover):
            with pytest.raises(RobotError, match="close it and open it again"):
                forbidden()
    assert time.monotonic() - since < 1.0
    assert until(lambda: robot.speeds == pytest.approx((0.2, 0.2)))  # as the docs say


def test_a_robot_whose_port_comes_back_is_stopped(robot, tmp_path):
    link = tmp_path / "create"  # as udev keeps it
    link.symlink_to(robot.port)
    with Create(str(link), 2) as create:
        set_off(create, robot)
        robot.hang_up()
        assert until(lambda: create.fault is not None)
        assert until(lambda: robot.speeds == pytest.approx((0.2, 0.2)))
        robot.plug_in()
        link.unlink()
        link.symlink_to(robot.port)
        stopped_after(robot, time.monotonic())
        assert robot.mode == Mode.PASSIVE


def test_a_port_that_is_not_there_or_in_use_or_silent(robot, tmp_path, monkeypatch):
    monkeypatch.setattr("coloc_graph.robot_io.create.line.ANSWER_TIMEOUT", 0.4)
    with pytest.raises(RobotError, match=r"cannot open .*nothing.*plugged in, free"):
        Create(str(tmp_path / "nothing")).open()
    with Create(robot.port, 2), pytest.raises(RobotError, match=r"cannot open .*free"):
        Create(robot.port, 2).open()
    with pytest.raises(RobotError, match=r"no Create answers on .* at 57600 baud: switch it on, check model and cable"):
        Create(robot.port, 1).open()
    silent, line = os.openpty()
    try:
        since = time.monotonic()
        with pytest.raises(RobotError, match="at 115200 or 57600 baud"):
            Create(os.ttyname(line)).open()
        assert time.monotonic() - since < 3.0
    finally:
        os.close(silent)
        os.close(line)


def test_a_robot_on_the_charger_can_be_read_but_not_driven(robot):
    robot.dock()
    with Create(robot.port, 2) as create:
        assert create.state.charging
        with pytest.raises(RobotError, match="did not enter safe mode because of the charger"):
            create.drive(0.1, 0.0)


# ---- commands


def test_limits_keep_the_curve(create, robot):
    v, w = create.drive(1.0, 1.0)
    assert v == pytest.approx(w, rel=0.01) and v + w * 0.1175 == pytest.approx(0.5, abs=2e-3)
    v, w = create.drive(0.1, -8.0)
    assert (v, w) == pytest.approx((0.025, -2.0), abs=5e-3)
    create.stop()
    create.max_speed, create.max_turn = 0.1, 0.5
    assert create.drive(-0.3, 0.0) == (-0.1, 0.0)
    assert create.drive(0.0, 3.0) == pytest.approx((0.0, 0.5), abs=5e-3)
    for bad in ((float("nan"), 0.0), (0.0, float("inf"))):
        with pytest.raises(InputError, match="is not a motion"):
            create.drive(*bad)
    for lease in (0.0, -1.0, 0.51, float("nan")):
        with pytest.raises(InputError, match=r"at most 0\.5 s"):
            create.drive(0.1, 0.0, lease)


def test_arguments_that_make_no_driver():
    for arguments in ({"model": 3}, {"stop_on": ["rain"]}, {"stop_on": "cliff"}, {"max_speed": 0.0}):
        with pytest.raises(InputError):
            Create("nowhere", **arguments)


# ---- odometry


@pytest.mark.parametrize("model", [2, 1])
def test_a_corner_is_told_within_its_sigmas(emulators, model):
    with emulators.robot(model, Physics(seed=5)) as robot, Create(robot.port, model, robot="A", max_turn=4.0) as create:
        start = robot.pose
        for _ in range(2):
            keep(create, 0.5, 0.0, 0.45)
            keep(create, 0.0, 4.0, np.pi / 8)
        create.stop()
        assert until(lambda: robot.still_since is not None)
        assert until(lambda: create._feed.sample.time > time.time() - 0.01 and create._feed.age < 0.1, 4.0)
        samples = create.take_odometry()
        value, off = nees(samples, start, robot.pose)
    print(f"    model {model}: off by {off} rad, m, m, NEES {value:.2f}")
    assert all(one.robot == "A" for one in samples)
    assert np.ptp([one.pose[:2] for one in samples], axis=0).min() > 0.15
    assert value < chi2.ppf(0.9999, 3)
    assert all(np.linalg.eigvalsh(one.covariance)[0] > 0 for one in samples)
    times = np.diff([one.time for one in samples])
    assert times.min() > 0
    if model == 2:
        assert np.hypot(*off[1:]) < 0.1


def test_encoders_that_wrap_in_either_direction_leave_no_jump(emulators):
    with emulators.robot(2, encoders=(65500, 30)) as robot, Create(robot.port, 2) as create:
        keep(create, 0.0, -2.0, 0.6)  # to the right: the left wheel up beyond 65535, the right one down below 0
        create.stop()
        assert until(lambda: create.odometry.time > time.time() - 0.02 and robot.still_since is not None)
        left, right = create.state.ticks
        assert left < 1000 and right > 64000
        x, y, yaw = create.odometry.pose
        assert np.hypot(x, y) < 0.01 and yaw == pytest.approx(robot.pose[2], abs=0.05)


# ---- the emulator by itself


def test_the_emulator_answers_queries_and_the_old_drive_command(robot):
    with serial.Serial(robot.port, 115200, timeout=1.0) as line:
        line.write(bytes([128, 132]) + oi.query([35, 22]))
        assert line.read(3) == bytes([3]) + (15_400).to_bytes(2, "big")
        line.write(bytes([137, 0, 200, 0, 1]) + oi.query([41, 42]))  # on the spot, to the left
        assert decode_values([41, 42], line.read(4)) == {41: 200, 42: -200}
        line.write(bytes([137, 0, 200, 0x80, 0]) + oi.query([42]))
        assert line.read(2) == bytes([0, 200])
        line.write(bytes([137, 0, 200, 0x01, 0xF4]) + oi.query([41, 42]))  # a circle of 500 mm to the left
        assert decode_values([41, 42], line.read(4)) == {41: 247, 42: 153}
        line.write(bytes([173, 145, 0, 100, 0, 100]))
        assert until(lambda: robot.mode == Mode.OFF and robot.still_since is not None)
    with pytest.raises(ValueError, match='"above" is none of left'):
        robot.cliff("above")
    before = len(robot.received)
    with serial.Serial(robot.port, 57600, timeout=0.05) as line:
        line.write(bytes([128, 131]))
        assert line.read(1) == b"" and len(robot.received) == before


def test_the_emulator_as_a_program():
    child = subprocess.Popen(
        [sys.executable, "-m", "coloc_graph.robot_io.create.emulator", "--model", "1"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        port = child.stdout.readline().strip()
        with Create(port, 1) as create:
            create.drive(0.1, 0.0)
    finally:
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=30)
    assert child.returncode == 0
