"""A small dataset in the format of MR.CLAM: its robots do what they are told, but not quite, and a moment later."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coloc_graph.exchange.mrclam import ACROSS, ALONG, RANGING, TURN

START = 1_248_444_000.0
BARCODES = {1: 5, 2: 14, 3: 41, 6: 63, 7: 81, 8: 7, 9: 70, 10: 45, 11: 27}
LANDMARKS = {6: (0.0, -2.5), 7: (3.0, -2.0), 8: (3.2, 2.0), 9: (0.5, 2.8), 10: (-2.6, 1.5), 11: (-2.4, -1.8)}
#: Of all robots: the way is so much of what was told, so much later.
SCALE = 0.94
TURN_SCALE = 0.95
DELAY = 0.2
#: Ranges are depths by so much, and those of robots so much longer [m].
DEPTH = 0.92
ROBOT_OFFSET = 0.04


@dataclass(frozen=True)
class Made:
    """The folder, and the true poses (n, 3) of each subject at `times` (n,)."""

    path: Path
    times: np.ndarray
    true: dict[int, np.ndarray]


def make(path, seed=0, seconds=60.0, robots=(1, 2, 3), turned=0.0, shifted=(0.0, 0.0)):
    """Write a dataset; all of it can be turned [rad] and shifted [m], which changes no measurement."""
    rng = np.random.default_rng(seed)
    path.mkdir(parents=True, exist_ok=True)
    dt = 0.05
    times = START + np.arange(0.0, seconds, dt)
    true = {n: _drive(rng, path, n, times, dt) for n in robots}
    _measure(rng, path, times, true)
    c, s = np.cos(turned), np.sin(turned)
    R = np.array([[c, -s], [s, c]])
    moved = {}
    for n, poses in true.items():
        moved[n] = np.column_stack([poses[:, :2] @ R.T + shifted, poses[:, 2] + turned])
        _write(path / f"Robot{n}_Groundtruth.dat", np.column_stack([times, moved[n]]))
    places = {n: R @ np.array(at) + shifted for n, at in LANDMARKS.items()}
    _write(path / "Landmark_Groundtruth.dat", [[n, *at, 1e-4, 1e-4] for n, at in places.items()])
    _write(path / "Barcodes.dat", [[n, BARCODES[n]] for n in (*robots, *LANDMARKS)])
    return Made(path, times, moved)


def _drive(rng, path, n, times, dt):
    """Commands, and the way that comes of them: round and round in the middle of the landmarks."""
    commands = np.zeros((len(times), 2))
    k = 0
    while k < len(times):
        length = rng.integers(40, 90)
        commands[k : k + length] = (0.12, rng.choice([-0.3, 0.0, 0.25, 0.3]))
        k += length
    late = round(DELAY / dt)
    done = np.vstack([np.zeros((late, 2)), commands[:-late]]) * (SCALE, TURN_SCALE)
    way, turn = (done * dt).T
    along, across = (np.sqrt(a**2 * np.abs(way) + t**2 * dt) for a, t in (ALONG, ACROSS))
    turned = np.sqrt(TURN[0] ** 2 * np.abs(turn) + TURN[1] ** 2 * np.abs(way) + TURN[2] ** 2 * dt)
    way, side, turn = (
        way + along * rng.normal(size=len(times)),
        across * rng.normal(size=len(times)),
        turn + turned * rng.normal(size=len(times)),
    )
    poses = np.empty((len(times), 3))
    x, y, yaw = 1.0 * np.cos(2 * n), 1.0 * np.sin(2 * n), 2.5 * n
    for k in range(len(times)):
        poses[k] = x, y, yaw
        # walls turn a robot back, as a push would: the way it goes is its own
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, yaw = x + c * way[k] - s * side[k], y + s * way[k] + c * side[k], yaw + turn[k]
    _write(path / f"Robot{n}_Odometry.dat", np.column_stack([times, commands]))
    return poses


def _measure(rng, path, times, true):
    """Ranges and bearings, four times a second, with errors that last as the team says they do."""
    targets = {**true, **{n: np.tile((*at, 0.0), (len(times), 1)) for n, at in LANDMARKS.items()}}
    for n, poses in true.items():
        rows, last = [], {}
        for k in range(20, len(times) - 20, 5):
            for m, there in targets.items():
                d = there[k, :2] - poses[k, :2]
                distance = np.hypot(*d)
                bearing = (np.arctan2(d[1], d[0]) - poses[k, 2] + np.pi) % (2 * np.pi) - np.pi
                if m == n or abs(bearing) > 1.2 or not 0.4 < distance < 7.0:
                    continue
                z = rng.normal(size=2)
                if m in last:
                    before, at = last[m]
                    r = np.exp(-(times[k] - at) / np.array([RANGING.range_memory, RANGING.bearing_memory]))
                    z = r * before + np.sqrt(1 - r**2) * z
                last[m] = z, times[k]
                of_range = RANGING.range_sigma + RANGING.range_sigma_per_m2 * distance**2
                of_bearing = np.hypot(np.deg2rad(RANGING.bearing_sigma_deg), RANGING.across_sigma / distance)
                read = distance * (1 - DEPTH * (1 - np.cos(bearing))) + ROBOT_OFFSET * (m in true)
                rows.append([times[k], BARCODES[m], read + of_range * z[0], bearing + of_bearing * z[1]])
        _write(path / f"Robot{n}_Measurement.dat", rows)


def _write(path, rows):
    text = "\n".join(" ".join(f"{value:.9g}" if abs(value) < 1e6 else f"{value:.3f}" for value in row) for row in rows)
    path.write_text(f"# made for a test\n{text}\n")
