"""Read and write trajectories in the TUM format, `timestamp tx ty tz qx qy qz qw`, with covariances in a second file.

Source of the format: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", 2012; evo reads it.
"""

from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError
from coloc_graph.exchange.trajectory_rows import pose_rows
from coloc_graph.geometry.lie import quaternion
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.input_file import read_text

Array = NDArray[np.float64]

_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
_UPPER = [(i, j) for i in range(6) for j in range(i, 6)]
COVARIANCE_HEADER = ",".join(["stance", "time", *(f"{_AXES[i]}_{_AXES[j]}" for i, j in _UPPER)])


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write poses as `path` (.tum), and covariances with stance numbers as `path` with .cov.csv.

    Covariances are the upper triangle in GTSAM's tangent space: rotation [rad] first, then translation [m], body frame;
    the stance is empty for poses without one. Numbers are read back bit for bit.
    """
    lines = []
    for time, T in zip(trajectory.times, trajectory.T_world_body, strict=True):
        w, x, y, z = quaternion(T[:3, :3])
        numbers = [time, *T[:3, 3], x, y, z, w]
        lines.append(" ".join(repr(float(number)) for number in numbers))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if trajectory.covariances is None:
        return
    rows = [COVARIANCE_HEADER]
    stances = [""] * len(trajectory) if trajectory.stances is None else [str(int(one)) for one in trajectory.stances]
    for stance, time, covariance in zip(stances, trajectory.times, trajectory.covariances, strict=True):
        rows.append(",".join([stance, *(repr(float(x)) for x in (time, *(covariance[ij] for ij in _UPPER)))]))
    path.with_suffix(".cov.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory in a .tum file, with covariances if the .cov.csv is beside it; the robot is the file's name.

    EuRoC's CSV and KITTI's poses with times are read as well (`trajectory_rows`). Raises `InputError` naming file and
    line, also if times do not ascend.
    """
    poses: list[Array] = []
    times: list[float] = []
    for number, values in pose_rows(path, _lines(path)):
        length = float(np.linalg.norm(values[4:]))
        if abs(length - 1) > 1e-3:
            raise InputError(f"{path}, line {number}: the quaternion is not of unit length; write qx qy qz qw")
        x, y, z, w = (value / length for value in values[4:])  # GTSAM does not normalise
        if times and not values[0] > times[-1]:
            raise InputError(
                f"{path}, line {number}: the time {values[0]!r} does not come after {times[-1]!r}; "
                "sort the poses by time, one an instant"
            )
        times.append(values[0])
        poses.append(gtsam.Pose3(gtsam.Rot3(w, x, y, z), np.array(values[1:4])).matrix())
    stances, covariances = None, None
    beside = path.with_suffix(".cov.csv")
    if beside.exists():
        cells = [line.split(",") for line in _lines(beside)[1:]]
        of_stances = any(one[0] for one in cells)
        rows = [
            _numbers(beside, number, one if of_stances else ["0", *one[1:]], 23)
            for number, one in enumerate(cells, start=2)
        ]
        if len(rows) != len(poses):
            raise InputError(f"{beside} has {len(rows)} rows and {path.name} {len(poses)} poses; write both anew")
        stances = np.array([int(row[0]) for row in rows]) if of_stances else None
        covariances = np.zeros((len(rows), 6, 6))
        for row, covariance in zip(rows, covariances, strict=True):
            for (i, j), value in zip(_UPPER, row[2:], strict=True):
                covariance[i, j] = covariance[j, i] = value
    T_world_body = np.array(poses).reshape(-1, 4, 4)
    return Trajectory(path.name.removesuffix(".tum"), np.array(times), T_world_body, stances, covariances)


def _lines(path: Path) -> list[str]:
    return read_text(path, "give a trajectory in the TUM format").splitlines()


def _numbers(path: Path, line: int, parts: list[str], count: int) -> list[float]:
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{path}, line {line}: {count} finite numbers are expected; write the file anew")
    return values
