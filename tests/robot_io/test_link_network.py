"""The link over a bad network: two network namespaces, and a relay of packets between them that loses, delays, cuts."""

import ctypes
import fcntl
import heapq
import json
import os
import random
import select
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

COORDINATOR = "coloc-test-c"
ROBOT = "coloc-test-r"
MIDDLE = "coloc-test-m"
ADDRESS = "tcp/10.77.0.1:7447"
#: A command is to be carried out within [s].
DEADLINE = 1.0


def coordinator():
    """Asks twice a second, and says when it is obeyed again, until it is told how much there is to hear; then hears it,
    and says what it was."""
    from coloc_graph.errors import RobotError
    from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
    from coloc_graph.robot_io.link.messages import Capture
    from coloc_graph.simulation import reference_team

    heard, asked, presence = {"samples": [], "wheels": []}, [], []
    with CoordinatorLink(
        reference_team(),
        listen=ADDRESS,
        exposed=True,
        on_sample=lambda _, one: heard["samples"].append(one.number),
        on_wheels=lambda _, one: heard["wheels"].append(one.number),
        on_event=lambda *_: None,
        on_status=lambda *_: None,
        on_presence=lambda _, there: presence.append((time.monotonic(), there)),
    ) as link:
        while not heard["samples"]:
            time.sleep(0.05)
        print("there", flush=True)
        number, before = 0, True
        while not select.select([sys.stdin], [], [], 0.5)[0]:
            number += 1
            begin = time.monotonic()
            try:
                ok = link.ask("A", Capture(capture=number), DEADLINE).ok
            except RobotError:
                ok = False
            asked.append((number, begin, time.monotonic(), ok))
            if ok and not before:
                print(f"obeyed {time.monotonic()}", flush=True)
            before = ok
        expected, until = int(sys.stdin.readline()), time.monotonic() + 25.0
        while min(map(len, heard.values())) < expected and time.monotonic() < until:
            time.sleep(0.05)
        known = link.clocks["A"].estimate(time.monotonic_ns())
        answer = {**heard, "asked": asked, "presence": presence, "missed": link.counts.missed}
        print(json.dumps({**answer, "offset": known.offset, "sigma": known.sigma, "jumps": link.clocks["A"].jumps}))


def robot():
    """Measures until there is input; then says what it sent and did, and keeps it until there is more."""
    from coloc_graph.robot_io.link.messages import Sample, Wheels
    from coloc_graph.robot_io.link.robot_link import RobotLink

    done, sent = [], 0
    with RobotLink(
        "A", connect=ADDRESS, session="s", handler=lambda body: done.append((body.capture, time.monotonic())) or ""
    ) as link:
        while not select.select([sys.stdin], [], [], 0.02)[0]:
            now = time.monotonic_ns()
            link.put(Sample(session="s", number=sent, capture=0, stamp=now, uv=[(1.0, 2.0)], flags=[0], markers=[""],
                            covariance=[(1.0, 0.0, 1.0)], peak=[9.0], area=[9.0]))  # fmt: skip
            link.put(Wheels(session="s", number=sent, stamp=now, pose=(0.0, 0.0, 0.0),
                            covariance=(1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6)))  # fmt: skip
            sent += 1
        sys.stdin.readline()
        print(json.dumps({"sent": sent, "done": done, "ended": time.monotonic()}), flush=True)
        sys.stdin.readline()


def relay(control):
    """Passes packets between two devices; the file says delay and jitter [ms], the share that is lost, whether cut."""
    os.nice(-10)  # the network does not wait for a machine that is busy
    ends = []
    for device in ("coloc-mc", "coloc-mr"):
        one = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
        one.setsockopt(socket.SOL_SOCKET, 33, 1 << 23)  # SO_RCVBUFFORCE: nothing is lost but what is to be
        one.bind((device, 0))
        one.setblocking(False)
        ends.append(one)
    under_way, count, last, changed, settings = [], 0, [0.0, 0.0], 0, (0.0, 0.0, 0.0, 0.0)
    while True:
        if (now := Path(control).stat().st_mtime_ns) != changed:
            settings, changed = tuple(map(float, Path(control).read_text().split())), now
        delay, jitter, lost, cut = settings
        due = max(under_way[0][0] - time.monotonic(), 0) if under_way else 0.002
        for one in select.select(ends, [], [], min(due, 0.002))[0]:
            side = ends.index(one)
            while True:
                try:
                    packet, address = one.recvfrom(70_000)
                except (BlockingIOError, OSError):
                    break
                if address[2] == socket.PACKET_OUTGOING or cut or random.random() < lost:
                    continue
                at = time.monotonic() + (delay + random.random() * jitter) / 1e3
                last[side] = at = max(at, last[side])
                heapq.heappush(under_way, (at, count := count + 1, 1 - side, packet))
        while under_way and under_way[0][0] <= time.monotonic():
            _, _, side, packet = heapq.heappop(under_way)
            try:
                ends[side].send(packet)
            except OSError:
                continue


def whole_packets(device):
    """Have a device make its checksums and its packets itself: nobody does it behind the relay."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        for setting in (0x17, 0x1F, 0x24, 0x2C):  # ETHTOOL_STXCSUM, STSO, SGSO, SGRO
            value = ctypes.create_string_buffer(struct.pack("II", setting, 0))
            request = struct.pack("16sP", device.encode(), ctypes.addressof(value)).ljust(40, b"\0")
            fcntl.ioctl(one, 0x8946, request)  # SIOCETHTOOL


ROLES = {"coordinator": coordinator, "robot": robot, "relay": relay, "whole_packets": whole_packets}


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


def inside(namespace, role, *words):
    """The command that plays a role in a namespace."""
    return ["ip", "netns", "exec", namespace, sys.executable, __file__, role, *words]


@pytest.fixture
def network(tmp_path):
    """What sets the network between coordinator and robot: `network(delay, jitter, lost, cut)`."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    control = tmp_path / "network"
    passing = None

    def change(*settings):
        new = control.with_suffix(".new")
        new.write_text(" ".join(map(str, settings)))
        new.rename(control)

    try:
        for namespace in (COORDINATOR, ROBOT, MIDDLE):
            subprocess.run(["ip", "netns", "del", namespace], capture_output=True)
            try:
                ip("netns", "add", namespace)
            except subprocess.CalledProcessError as error:
                pytest.skip(f"network namespaces are not to be had here: {error.stderr.decode().strip()}")
        for end, namespace, address in (("c", COORDINATOR, "10.77.0.1/24"), ("r", ROBOT, "10.77.0.2/24")):
            ip(
                "link",
                "add",
                f"coloc-{end}",
                "netns",
                namespace,
                "type",
                "veth",
                "peer",
                f"coloc-m{end}",
                "netns",
                MIDDLE,
            )
            ip("-n", namespace, "addr", "add", address, "dev", f"coloc-{end}")
            for where, device in ((namespace, "lo"), (namespace, f"coloc-{end}"), (MIDDLE, f"coloc-m{end}")):
                ip("-n", where, "link", "set", device, "up")
            for where, device in ((namespace, f"coloc-{end}"), (MIDDLE, f"coloc-m{end}")):
                subprocess.run(inside(where, "whole_packets", device), check=True)
        change(0, 0, 0, 0)
        passing = subprocess.Popen(inside(MIDDLE, "relay", str(control)))
        yield change
    finally:
        if passing is not None:
            passing.kill()
            passing.wait()
        for namespace in (COORDINATOR, ROBOT, MIDDLE):
            subprocess.run(["ip", "netns", "del", namespace], capture_output=True)


def answer_of(program, told=""):
    """What a program says to a line of input."""
    program.stdin.write(f"{told}\n".encode())
    program.stdin.flush()
    while (line := program.stdout.readline()).startswith(b"obeyed"):
        pass
    return json.loads(line)


def obeyed_again(program, after, within):
    """Wait until the coordinator is obeyed [s, CLOCK_MONOTONIC], or as long as that may take."""
    at = 0.0
    while at < after and select.select([program.stdout], [], [], after + within - time.monotonic())[0]:
        at = float(program.stdout.readline().split()[1])


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [(3.0,), pytest.param((3.0, 10.0), marks=pytest.mark.long)])
def test_5_percent_loss_50_ms_jitter_and_cuts_lose_nothing(network, lengths):
    bad = 5, 50, 0.05
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "bufsize": 0}
    cuts = []
    with (
        subprocess.Popen(inside(COORDINATOR, "coordinator"), **pipes) as leader,
        subprocess.Popen(inside(ROBOT, "robot"), **pipes) as follower,
    ):
        try:
            assert leader.stdout.readline() == b"there\n"
            network(*bad, 0)
            time.sleep(2.0)
            for seconds in lengths:
                network(*bad, 1)
                begin = time.monotonic()
                time.sleep(seconds)
                network(*bad, 0)
                cuts.append((begin, time.monotonic()))
                obeyed_again(leader, cuts[-1][1], within=12.0)
                time.sleep(2.0)
            sent = answer_of(follower)
            heard = answer_of(leader, sent["sent"])
            print(f"    all of it was in {time.monotonic() - sent['ended']:.1f} s after the end")
            follower.stdin.write(b"\n")
            follower.stdin.flush()
        finally:
            leader.kill()
            follower.kill()
    presence = [(round(at - cuts[0][0], 1), there) for at, there in heard["presence"]]
    print(f"    presence, from the first cut on: {presence}")
    print(f"    {sent['sent']} sent, came: {len(heard['samples'])} samples, {len(heard['wheels'])} wheels")
    for kind in ("samples", "wheels"):
        assert heard[kind] == list(range(len(heard[kind])))
        assert len(heard[kind]) == sent["sent"] > 200
    assert heard["missed"] == 0
    asked = {number: begin for number, begin, _, _ in heard["asked"]}
    done = [number for number, _ in sent["done"]]
    assert done == sorted(set(done))  # each once, and in order
    late = max(at - asked[number] for number, at in sent["done"])
    offset, sigma = heard["offset"] / 1e6, heard["sigma"] / 1e6
    print(f"    the latest command {late:.3f} s after it was asked")
    print(f"    clock {offset:.2f} ms, sigma {sigma:.2f} ms")
    assert late < DEADLINE + 0.1  # and the clock's error
    assert {number for number, _, at, ok in heard["asked"] if ok and at < sent["ended"]} <= set(done)
    assert heard["jumps"] == 0 and abs(offset) < 5 * sigma
    for begin, end in cuts:
        gone = [at - begin for at, there in heard["presence"] if not there and at > begin]
        back = min(at for _, _, at, ok in heard["asked"] if ok and at > end) - end
        print(f"    a cut of {end - begin:.0f} s: noticed after {gone[0]:.2f} s, obeyed again {back:.2f} s after it")
        assert gone[0] < 6.0 and back < 12.0


if __name__ == "__main__":
    ROLES[sys.argv[1]](*sys.argv[2:])
