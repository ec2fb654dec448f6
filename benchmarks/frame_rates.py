"""Stances of a lone mover at any frame rate, speed and image size: how many are used, and how good they are.

    python benchmarks/frame_rates.py [--seeds 5] [--fps 5 10 30 100 200] [--speeds 0.1 0.3 1.0] [--json]

A robot with two equal lights wanders for some seconds (as long as 120 images take, 6 to 24 s) before two standing
cameras; 2 % of the lights are missed, one detection an image is false, nothing has a name. A stance is within the limit
where no light moves further from one image to the next than a quarter of the image and half the distance to the
other light (95 % of its steps). A swap is a used stance whose pose is off by more than 2 cm or 2 deg.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np
from monte_carlo import over_seeds

from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.run import Detections, Stance
from coloc_graph.simulation.crowd import STEP, Faults, detect, lights_of, wander
from coloc_graph.simulation.paths import SPEED
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team import Camera, Team
from coloc_graph.team.shared_view import View

START = 1_700_000_000.0  # UTC s
AREA = (0.8, 2.2, -0.6, 0.6)  # m, x from and to, y from and to
POSES = ((0.0, 0.4, -0.3), (0.0, -0.4, 0.3))  # x, y [m], yaw [rad] of both observers
LIMIT_SHARE = 0.95  # of the steps of a stance within the limit


@dataclass(frozen=True)
class Scene:
    """One stance as it was recorded: `Recorded` for `measure_pair`, and what is true of its steps."""

    team: Team
    seen: dict[str, list[Detections]]
    stance: Stance
    within: float  # share of the steps within the limit
    step: float  # median step of a light [px]

    path = Path("scene")
    planes: ClassVar[dict] = {}  # none is stated

    def has_detections(self, robot: str) -> bool:
        """As `Run`."""
        return True

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """As `Run`."""
        return (one for one in self.seen[robot] if start <= one.time <= end)


def scene(fps: float, speed: float, width: int, seed: int, faults: Faults | None = None) -> Scene:
    """A robot that wanders before two cameras."""
    team = _sized(reference_team(), width, fps)
    markers, rng = team["C"].markers, np.random.default_rng((seed, 7))
    assert markers is not None
    seconds = float(np.clip(120 / fps, 6, 24))
    faster = speed / SPEED
    times = np.arange(round(seconds * fps)) / fps
    poses = wander(1, faster * seconds + STEP, AREA, rng)
    p_lights = lights_of(poses, faster * times, markers.p_body)
    seen, within, steps = {}, [], []
    for name, pose in zip("AB", POSES, strict=True):
        view = View(team[name].camera, floor_pose(*pose) @ team[name].mount.T_body_camera)
        noise = faults or Faults(noise_px=0.3, false_detections=1.0)
        seen[name] = detect(view, name, p_lights, START + times, noise, rng).images
        uv, _ = view.project(p_lights.reshape(len(times), -1, 3))
        moved = np.linalg.norm(np.diff(uv, axis=0), axis=2)
        apart = np.linalg.norm(uv[:-1, 0] - uv[:-1, 1], axis=1)
        within.append(moved <= np.minimum(width / 4, apart / 2)[:, None])
        steps.append(moved)
    stance = Stance(0, START - 1, START + seconds, ("A", "B"), ("C",))
    return Scene(team, seen, stance, float(np.mean(within)), float(np.median(steps)))


def _sized(team: Team, width: int, fps: float) -> Team:
    def camera(one: Camera) -> Camera:
        k = width / one.width
        centre = ((one.cx + 0.5) * k - 0.5, (one.cy + 0.5) * k - 0.5)
        return msgspec.structs.replace(
            one, width=width, height=round(one.height * k), fx=k * one.fx, fy=k * one.fy, cx=centre[0], cy=centre[1],
            fps=fps,
        )  # fmt: skip

    robots = tuple(msgspec.structs.replace(r, camera_if_any=camera(r.camera)) for r in team.robots)
    return msgspec.structs.replace(team, robots=robots)


def measured(fps: float, speed: float, width: int, seed: int) -> dict[str, object]:
    """Measure one stance: used or the reason, errors [m], [deg], and steps [px]."""
    one = scene(fps, speed, width, seed)
    made = measure_pair(one, one.stance, "A", "B", FrontendOptions())
    row: dict[str, object] = {"fps": fps, "speed": speed, "width": width, "seed": seed, "step": one.step,
                              "within": one.within, "unusable": made.homography.unusable}  # fmt: skip
    if made.relative_pose is not None:
        T_i_j = np.linalg.inv(floor_pose(*POSES[0])) @ floor_pose(*POSES[1])
        off = np.linalg.inv(T_i_j) @ made.relative_pose.T_i_j
        row["error_m"] = float(np.linalg.norm(off[:2, 3]))
        row["error_deg"] = float(np.rad2deg(abs(np.arctan2(off[1, 0], off[0, 0]))))
    return row


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--fps", type=float, nargs="+", default=[5, 10, 30, 100, 200])
    parser.add_argument("--speeds", type=float, nargs="+", default=[0.1, 0.3, 1.0], help="of the mover [m/s]")
    parser.add_argument("--widths", type=int, nargs="+", default=[320, 640], help="of the images [px]")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print every stance")
    options = parser.parse_args()
    rows = []
    for fps in options.fps:
        for speed in options.speeds:
            for width in options.widths:
                rows += over_seeds(partial(measured, fps, speed, width), range(options.seeds), options.processes)
                own = [row for row in rows if (row["fps"], row["speed"], row["width"]) == (fps, speed, width)]
                print(f"{fps:5g} fps {speed:4g} m/s {width} px: {_line(own)}", flush=True)
                for row in own:
                    if options.json or row["unusable"]:
                        print(f"    {json.dumps(row)}", flush=True)
    limit = [row for row in rows if row["within"] >= LIMIT_SHARE]
    print(f"within the limit: {_line(limit)}\nbeyond: {_line([row for row in rows if row not in limit])}")
    reasons: dict[str, int] = defaultdict(int)
    for row in rows:
        reasons[str(row["unusable"])[:60]] += bool(row["unusable"])
    print(json.dumps({reason: count for reason, count in reasons.items() if count}, indent=2))


def _line(rows: list[dict[str, object]]) -> str:
    used = [row for row in rows if "error_m" in row]
    if not rows:
        return "none"
    swaps = sum(row["error_m"] > 0.02 or row["error_deg"] > 2 for row in used)
    off = 1e3 * float(np.median([row["error_m"] for row in used])) if used else float("nan")
    step = float(np.median([row["step"] for row in rows]))
    return f"median step {step:.1f} px, {len(used)} of {len(rows)} used, median error {off:.2f} mm, swaps {swaps}"


if __name__ == "__main__":
    main()
