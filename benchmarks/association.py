"""Association of tracks between two cameras by motion alone: share of right ones, and of sure ones.

    python benchmarks/association.py [--scenes 500] [--lockstep 200] [--json]

Scenes of 1 to 5 robots with two lights each that wander before two cameras at random places, 20 images a second for 6
to 12 s, 2 % missed, one false detection an image; followed and bound to robots as any stance is. In lock-step scenes
two robots drive the same way side by side, and one camera may not see one of them.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence

import numpy as np

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import MarkerTracker, Track, plane_from_mount
from coloc_graph.frontend.images.detection import Blobs, Detector
from coloc_graph.frontend.pairing.association import MIN_POSTERIOR, Association, associate
from coloc_graph.frontend.pairing.correspondence import Candidates
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.crowd import STEP, Faults, Seen, detect, lights_of, wander
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

TEAM = reference_team()
ROBOT = TEAM["A"]
FPS = 20.0


def pair_of_views(rng: np.random.Generator) -> list[View]:
    """Two cameras 0.5 to 1.2 m apart, turned towards each other by 15 to 50 degrees in all."""
    apart, turned = rng.uniform(0.5, 1.2), np.deg2rad(rng.uniform(15, 50))
    return [
        View(ROBOT.camera, floor_pose(0.0, side * apart / 2, -side * turned / 2) @ ROBOT.mount.T_body_camera)
        for side in (1, -1)
    ]


def tracks_of(seen: Seen, movers: int) -> tuple[list[Track], list[int]]:
    """Return the movers' tracks in a camera, and the light of most samples of each."""
    assert ROBOT.markers is not None and ROBOT.markers.span is not None
    tracker = MarkerTracker("A", Detector(), size=(320, 240))
    for one in seen.images:
        tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area))
    plane = plane_from_mount(ROBOT.mount, ROBOT.markers)
    kept = markers_of_movers(tracker.tracks(), ROBOT.camera, [plane], [ROBOT.markers.span], movers)
    number = {one.time: n for n, one in enumerate(seen.images)}
    lights = []
    for track in kept:
        own = []
        for when, uv in zip(track.times.tolist(), track.uv, strict=True):
            k = number[when]
            own.append(int(seen.lights[k][np.argmin(np.abs(seen.images[k].uv - uv).sum(axis=1))]))
        lights.append(Counter(own).most_common(1)[0][0])
    return kept, lights


def verdict(found: Association | None, lights: Sequence[Sequence[int]]) -> str:
    """Right, wrong though sure, ambiguous, or nothing."""
    if found is None:
        return "nothing"
    if found.posterior < MIN_POSTERIOR:
        return "ambiguous"
    return "right" if all(lights[0][a] == lights[1][b] for a, b in found.chosen) else "wrong"


def scene(seed: int, *, lockstep: bool) -> tuple[str, float, int]:
    """Return the result of one scene, the time of association [s], and the fewest samples of its chosen pairs."""
    rng = np.random.default_rng((seed, lockstep))
    movers, seconds = 2 if lockstep else 1 + seed % 5, rng.uniform(6, 12)
    poses = wander(1 if lockstep else movers, seconds + STEP, (0.8, 2.2, -0.6, 0.6), rng)
    if lockstep:
        aside = rng.uniform(0.4, 0.8) * np.array([np.cos(a := rng.uniform(-np.pi, np.pi)), np.sin(a), 0.0])
        poses = np.concatenate([poses - aside / 2, poses + aside / 2], axis=1)
    times = np.arange(round(seconds * FPS)) / FPS
    assert ROBOT.markers is not None
    p_lights = lights_of(poses, times, ROBOT.markers.p_body)
    faults, both, lights = Faults(false_detections=1.0), [], []
    hidden = int(rng.integers(4)) if lockstep else 0  # which of both cameras misses a robot, if any
    for n, view in enumerate(pair_of_views(rng)):
        shown = p_lights[:, : 1 if hidden == n + 1 else None]
        tracks, own = tracks_of(detect(view, "AB"[n], shown, times, faults, rng), movers)
        both.append(tracks)
        lights.append(own)
    began = time.perf_counter()
    try:
        candidates = Candidates(both[0], both[1], ROBOT.camera, ROBOT.camera)
        made = associate(candidates)
        found = made if isinstance(made, Association) else None
        n = sum(len(candidates.indices[ab]) for ab in found.chosen) if found else 0
    except DegenerateGeometry:
        found, n = None, 0
    return verdict(found, lights), time.perf_counter() - began, n


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--lockstep", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    out: dict[str, object] = {}
    for name, count, lockstep in (("scenes", options.scenes, False), ("lockstep", options.lockstep, True)):
        rows = [scene(seed, lockstep=lockstep) for seed in range(count)]
        wanted = "ambiguous" if lockstep else "right"
        enough = [row for row in rows if row[2] >= 100 or row[0] == "nothing"]
        out[name] = {
            "of": len(rows),
            "with_100_samples": len(enough),
            **{f"{what}_percent": 100 * sum(row[0] == what for row in enough) / max(len(enough), 1)
               for what in ("right", "wrong", "ambiguous", "nothing")},
            "ms_median": 1e3 * float(np.median([row[1] for row in rows])),
            "ms_p99": 1e3 * float(np.percentile([row[1] for row in rows], 99)),
            "unexpected": {seed: row[0] for seed, row in enumerate(rows) if row[0] != wanted},
        }  # fmt: skip
    print(json.dumps(out, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
