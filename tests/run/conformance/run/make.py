"""Writes the conformance files beside it: `python tests/conformance/run/make.py`.

They are committed, so that a change of the format shows; write them anew only with a new format number.
"""

import math
from pathlib import Path

import numpy as np

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import (
    Detections,
    Flag,
    Image,
    Motion,
    OdometrySample,
    Planes,
    RunWriter,
    Stance,
    atomic_run,
)
from coloc_graph.team import Camera, Markers, Mount, Robot, Team

HERE = Path(__file__).parent
T0 = 1_700_000_000.25


def team(tilt_deg: float = 20.0) -> Team:
    camera = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
    mount = Mount(height=0.4, tilt_deg=tilt_deg)
    markers = Markers(height=0.15, positions=((0.0, 0.125), (0.0, -0.125)))
    robots = tuple(Robot(name=name, camera_if_any=camera, mount_if_any=mount, markers=markers) for name in "ABC")
    return Team(reference="A", robots=robots)


def pixels(k: int) -> np.ndarray:
    """A grey ramp that moves with k, (24, 32)."""
    rows, columns = np.mgrid[:24, :32]
    return ((4 * rows + 3 * columns + k) % 256).astype(np.uint8)


def detections(robot: str, time: float) -> Detections:
    return Detections(
        robot=robot,
        time=time,
        uv=np.array([[1.5, 2.25], [30.0, 20.125]]),
        covariance=np.array([[[0.09, 0.01], [0.01, 0.08]], [[0.25, 0.0], [0.0, 0.25]]]),
        markers=("C/0", ""),
        flags=np.array([Flag.NONE, Flag.SATURATED | Flag.BLURRED], np.uint8),
        peak=np.array([200.0, 255.0]),
        area=np.array([4.0, 9.5]),
    )


def write_everything(writer: RunWriter) -> None:
    """Every kind of record, three of each robot's."""
    writer.write_true_team(team(20.5))
    writer.write(Stance(0, T0, T0 + 1, ("A", "B"), ("C",)))
    writer.write(Planes(0, T0, {"A": (0.0, 0.6, 0.8, 0.25), "B": (0.0, 0.6, 0.8, 0.5)}))
    for k in range(3):
        time = T0 + k / 10
        for robot in "AB":
            writer.write(Image(robot, time, pixels(k)))
            writer.write(detections(robot, time))
        writer.write(OdometrySample("C", time, np.array([0.1 * k, -0.2, 0.3]), np.diag([1e-4, 2e-4, 3e-4])))
        writer.write_truth("C", time, floor_pose(1.0 + 0.1 * k, 2.0, math.pi / 2))
    writer.write(Motion("C", T0, True))
    writer.write(Motion("C", T0 + 0.5, False))
    writer.write(Stance(1, T0 + 1, T0 + 2, ("B", "C"), ("A",), ("B",)))


def main() -> None:
    with atomic_run(HERE / "minimal.mcap", team()) as writer:
        writer.write(Stance(0, T0, T0 + 1, ("A", "B"), ("C",)))
    with atomic_run(HERE / "everything.mcap", team(), image_format="png") as writer:
        write_everything(writer)
    whole = (HERE / "everything.mcap").read_bytes()
    # inside of the indexes behind the last chunk, which is whole itself
    (HERE / "cut-off.mcap").write_bytes(whole[: whole.rindex(b"\x07" + b"\x16\x00\x00") + 5])
    flipped = bytearray(whole)
    flipped[whole.rindex(b"zstd", 0, len(whole) // 3) + 500] ^= 0x10  # inside the second chunk
    (HERE / "damaged.mcap").write_bytes(flipped)


if __name__ == "__main__":
    main()
