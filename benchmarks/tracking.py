"""Many markers followed in detections that are missed, false and merged: is a track of one marker, and how fast is it.

    python benchmarks/tracking.py [--seeds 20] [--movers 5] [--seconds 60] [--json]
    python benchmarks/tracking.py --blink [--fps 100]       white lights of robots that blink: whose is a track?

Robots with two lights each drive about before the reference pair of cameras at 100 fps, 2 % of the lights missed and 5
false detections an image. Beside the tracker: the assignment of each image by itself to where lights were last
(nearest, all at once), which knows no speed.

With `--blink` each track is cut into pieces of some length, and of each it is asked whose it is, by itself, and with
the piece of the robot's other light: right, undecided, or wrong (of the light that most of the piece is of).
"""

import argparse
import json
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
from monte_carlo import over_seeds
from scipy.optimize import linear_sum_assignment

from coloc_graph.frontend.images.detection import Blobs, Detector
from coloc_graph.frontend.tracks.blink_codes import BlinkCodes
from coloc_graph.frontend.tracks.track import Track, TrackerOptions
from coloc_graph.frontend.tracks.tracking import MarkerTracker
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.blinking import blinking, with_codes
from coloc_graph.simulation.crowd import Faults, Seen, crowd
from coloc_graph.simulation.rig import reference_team
from coloc_graph.simulation.scenarios import single_step
from coloc_graph.team.shared_view import View


def views() -> list[View]:
    """The reference pair, 0.8 m apart."""
    team = reference_team()
    return [
        View(team[name].camera, floor_pose(*pose) @ team[name].mount.T_body_camera)
        for name, pose in zip("AB", single_step().poses, strict=True)
    ]


def follow(seen: Seen, options: TrackerOptions | None = None) -> tuple[list[Track], float]:
    """The tracks of one camera, and how long they took [s]."""
    blobs = [(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area)) for one in seen.images]
    began = time.process_time()
    tracker = MarkerTracker("A", Detector(), options, size=(320, 240))
    for when, found in blobs:
        tracker.take(when, found)
    tracks = tracker.tracks()
    return tracks, time.process_time() - began


def nearest(seen: Seen, gate: float = 20.0, patience: int = 30) -> list[Track]:
    """Each image's detections to the places where lights were last; the least total distance."""
    live: list[tuple[list[float], list[np.ndarray]]] = []
    ended = []
    for one in seen.images:
        uv = one.uv[one.flags == 0]
        apart = np.array([np.linalg.norm(uv - places[-1], axis=1) for _, places in live]).reshape(len(live), len(uv))
        rows, columns = linear_sum_assignment(np.minimum(apart, gate))
        good = apart[rows, columns] < gate
        for row, column in zip(rows[good], columns[good], strict=True):
            live[row][0].append(one.time)
            live[row][1].append(uv[column])
        live += [([one.time], [uv[column]]) for column in set(range(len(uv))) - set(columns[good].tolist())]
        ended += [track for track in live if one.time - track[0][-1] > patience / 100]
        live = [track for track in live if one.time - track[0][-1] <= patience / 100]
    return [
        Track("A", "", np.array(t), np.array(uv), np.zeros((len(t), 2, 2)), np.zeros(len(t)))
        for t, uv in ended + live
        if len(t) >= 8
    ]


def lights_in(track: Track, seen: Seen) -> np.ndarray:
    """Of which light each sample of a track is, (n,); -1 where it is of none."""
    number = {one.time: n for n, one in enumerate(seen.images)}
    lights = np.empty(len(track), np.int64)
    for n, (when, uv) in enumerate(zip(track.times.tolist(), track.uv, strict=True)):
        k = number[when]
        lights[n] = seen.lights[k][np.argmin(np.abs(seen.images[k].uv - uv).sum(axis=1))]
    return lights


def figures(tracks: Sequence[Track], seen: Seen) -> dict[str, float]:
    """Of all samples in tracks: the share that is of the light that most of its track is of, and so on."""
    pure = total = swaps = false = 0
    covered: dict[int, int] = {}
    for track in tracks:
        lights = lights_in(track, seen)
        real = lights[lights >= 0]
        total += len(track)
        if len(real) < len(track) / 2:
            false += 1
            continue
        values, counts = np.unique(real, return_counts=True)
        pure += int(counts.max())
        swaps += int((np.diff(real) != 0).sum())
        covered[int(values[counts.argmax()])] = covered.get(int(values[counts.argmax()]), 0) + int(counts.max())
    there = sum(int((one >= 0).sum()) for one in seen.lights)
    return {
        "purity_percent": 100 * pure / max(total, 1),
        "swaps": swaps,
        "false_tracks": false,
        "covered_percent": 100 * sum(covered.values()) / there,
        "tracks_a_light": len(tracks) / len({int(n) for one in seen.lights for n in one if n >= 0}),
    }


LENGTHS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)


def whose(
    seconds: float, fps: float, movers: int, seed: int
) -> tuple[list[dict[str, float]], list[tuple[object, ...]]]:
    """Figures of the tracks of each camera; and of pieces of them (seconds, lights, verdict)."""
    names = tuple(f"R{n}" for n in range(movers))
    team = with_codes(reference_team(names=names))
    codes = BlinkCodes({one.name: one.blink.code for one in team.robots if one.blink}, 0.1)
    lamps = list(blinking(team, np.random.default_rng((seed, 1))).values())
    assert team[names[0]].markers is not None
    both, _ = crowd(views(), team[names[0]].markers.p_body, movers=movers, seconds=seconds, fps=fps, seed=seed,
                    faults=Faults(), blinking=lamps)  # fmt: skip
    rows, verdicts = [], []
    for seen in both:
        tracks, _ = follow(seen, TrackerOptions(off=codes.bit, off_rate=codes.rate))
        rows.append(figures(tracks, seen))
        lights = [lights_in(track, seen) for track in tracks]
        for length in LENGTHS:
            for begin in seen.images[0].time + np.arange(0.0, seconds - length + 1e-6, length):
                pieces: dict[int, list[Track]] = {}
                for track, own in zip(tracks, lights, strict=True):
                    within = (track.times >= begin) & (track.times < begin + length)
                    # a piece of that length, but for what a light is off at its ends
                    if not within.any() or np.ptp(track.times[within]) < length - 2.5 * codes.bit:
                        continue
                    real = own[within][own[within] >= 0]
                    light = int(np.bincount(real).argmax()) if len(real) else -1
                    missed = track.missed[(track.missed >= begin) & (track.missed < begin + length)]
                    columns = (one[within] for one in (track.times, track.uv, track.covariance, track.peak))
                    piece = Track("A", "", *columns, missed=missed)
                    pieces.setdefault(light // 2, []).append(piece)
                    verdicts.append((length, 1, _verdict(codes.robot_of([piece]), names, light // 2)))
                verdicts += [
                    (length, 2, _verdict(codes.robot_of(two), names, robot))
                    for robot, two in pieces.items()
                    if len(two) == 2 and robot >= 0
                ]
    return rows, verdicts


def _verdict(found: str, names: Sequence[str], robot: int) -> str:
    return "undecided" if not found else "right" if robot >= 0 and found == names[robot] else "wrong"


def blink(options: argparse.Namespace) -> None:
    """Over seeds: how good tracks of lights that blink are, and how often it is known whose they are."""
    work = partial(whose, options.seconds, options.fps, options.movers)
    done = over_seeds(work, range(options.seeds), options.processes)
    rows = [row for rows, _ in done for row in rows]
    verdicts = [one for _, verdicts in done for one in verdicts]
    print(json.dumps({name: float(np.mean([row[name] for row in rows])) for name in rows[0]}, indent=2))
    for length, lights in sorted({one[:2] for one in verdicts}):
        own = [verdict for *what, verdict in verdicts if what == [length, lights]]
        shares = "  ".join(
            f"{100 * own.count(name) / len(own):7.3f} % {name}" for name in ("right", "undecided", "wrong")
        )
        print(f"{length:4g} s, {lights} light{'s' * (lights > 1)}: {shares}  of {len(own)}")


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--movers", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--blink", action="store_true")
    parser.add_argument("--fps", type=float, default=100.0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.blink:
        blink(options)
        return
    team, rows = reference_team(), []
    assert team["C"].markers is not None
    for seed in range(options.seeds):
        both, _ = crowd(views(), team["C"].markers.p_body, movers=options.movers, seconds=options.seconds, seed=seed,
                        faults=Faults())  # fmt: skip
        for seen in both:
            tracks, taken = follow(seen)
            row = {"seed": seed} | figures(tracks, seen)
            row["times_real_time_both"] = options.seconds / taken / len(both)
            row |= {f"nearest_{name}": value for name, value in figures(nearest(seen), seen).items()}
            rows.append(row)
            if not options.json:
                print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if name != "seed"}
    mean["worst_purity_percent"] = min(row["purity_percent"] for row in rows)
    mean["swaps_in_all"] = sum(row["swaps"] for row in rows)
    mean["nearest_swaps_in_all"] = sum(row["nearest_swaps"] for row in rows)
    print(json.dumps(mean, indent=2))


if __name__ == "__main__":
    main()
