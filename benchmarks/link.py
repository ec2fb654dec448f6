"""The robot link on loopback, with the robot in a process of its own: round trips, latencies, clocks, recovery.

    python benchmarks/link.py [--cuts 1 3 10] [--json]

Cuts are the robot's process held (SIGSTOP) for so long, as a machine that is out of reach; what it then sends late was
put before and after. Times of samples are by one clock, both processes are on this machine.
"""

import argparse
import json
import signal
import socket
import subprocess
import sys
import time

import numpy as np

from coloc_graph.errors import RobotError
from coloc_graph.robot_io.link.coordinator_link import CoordinatorLink
from coloc_graph.robot_io.link.messages import Halt, Sample
from coloc_graph.robot_io.link.robot_link import RobotLink
from coloc_graph.simulation import reference_team

#: Samples a second, as a PS3 Eye has them, of so many markers.
RATE = 100.0
MARKERS = 4


def robot(connect: str) -> None:
    """The other process: sends samples until it is ended."""
    with RobotLink("A", connect=connect, handler=lambda body: "", session="bench") as link:
        number, due = 0, time.monotonic()
        while True:
            link.put(
                Sample(session="bench", number=number, capture=0, stamp=time.monotonic_ns(), uv=[(1.5, 2.5)] * MARKERS,
                       covariance=[(0.01, 0.0, 0.01)] * MARKERS, markers=[""] * MARKERS, flags=[0] * MARKERS,
                       peak=[99.5] * MARKERS, area=[9.5] * MARKERS)
            )  # fmt: skip
            number, due = number + 1, due + 1 / RATE
            time.sleep(max(due - time.monotonic(), 0))


def quantiles(values: list[float], scale: float) -> dict[str, float]:
    """Median and 99th percentile."""
    return {name: round(scale * float(np.percentile(values, q)), 3) for name, q in (("median", 50), ("p99", 99))}


def measure(cuts: list[float]) -> dict[str, object]:
    """All figures."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"tcp/127.0.0.1:{one.getsockname()[1]}"
    came: list[tuple[int, int, int]] = []
    with (
        subprocess.Popen([sys.executable, __file__, "--robot", address]) as program,
        CoordinatorLink(
            reference_team(),
            listen=address,
            on_sample=lambda _, one: came.append((one.number, one.stamp, time.monotonic_ns())),
            on_wheels=lambda *_: None,
            on_event=lambda *_: None,
            on_status=lambda *_: None,
            on_presence=lambda *_: None,
        ) as link,
    ):
        try:
            while not link.synchronised("A"):
                time.sleep(0.1)
            time.sleep(2.0)
            asked, errors, sigmas = [], [], []
            began = len(came)
            for n in range(1000):
                begin = time.perf_counter()
                link.ask("A", Halt(), 2.0)
                asked.append(time.perf_counter() - begin)
                if n % 5 == 0:
                    known = link.clocks["A"].estimate(time.monotonic_ns())
                    assert known is not None
                    errors.append(known.offset)
                    sigmas.append(known.sigma)
                time.sleep(0.01)
            latencies = [float(heard - stamp) for _, stamp, heard in came[began:]]
            result: dict[str, object] = {
                "round trip of a command [ms]": quantiles(asked, 1e3),
                "latency of a sample [ms]": quantiles(latencies, 1e-6),
                "clock error [us]": quantiles(np.abs(errors).tolist(), 1e-3),
                "clock sigma [us]": quantiles(sigmas, 1e-3),
                "clock error / sigma, rms": round(float(np.sqrt(np.mean(np.square(np.divide(errors, sigmas))))), 2),
            }
            for seconds in cuts:
                program.send_signal(signal.SIGSTOP)
                time.sleep(seconds)
                program.send_signal(signal.SIGCONT)
                begin = time.monotonic()
                while True:
                    try:
                        link.ask("A", Halt(), 1.0)
                        break
                    except RobotError:
                        continue
                result[f"obeys again after a cut of {seconds:g} s [s]"] = round(time.monotonic() - begin, 3)
            time.sleep(2.0)
            numbers = [number for number, _, _ in came]
            result["samples"] = {"came": len(numbers), "in order and once": numbers == list(range(len(numbers)))}
            result["lost for good"] = link.counts.missed
        finally:
            program.kill()
    return result


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuts", type=float, nargs="+", default=[1.0, 3.0, 10.0], help="seconds each (1 3 10)")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--robot", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.robot:
        robot(args.robot)
        return
    result = measure(args.cuts)
    if args.json:
        print(json.dumps(result, indent=2))
    else:
        for what, value in result.items():
            print(f"{what:48s} {value}")


if __name__ == "__main__":
    main()
