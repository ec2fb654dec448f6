"""Our ATE and RPE against evo's, run as a program on the same TUM files.

    python benchmarks/evo_agreement.py --evo DIR [--poses 20000] [--json]
    python benchmarks/evo_agreement.py --evo DIR --write tests/evo       a small pair and evo's answers, for the tests

DIR holds `evo_ape` and `evo_rpe` (evo is GPL: it is neither imported nor a dependency; install it elsewhere). Three
trajectories: one that is free in space, one on a floor that stands at times, one far from its origin; and the first two
as a team, which for evo is one trajectory after the other. Prints the largest difference of RMSE, mean, median and
greatest error, and of single errors.
"""

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.evaluation import absolute_errors, align, relative_errors
from coloc_graph.evaluation.pose_errors import Spread, spread
from coloc_graph.exchange.tum import write_tum
from coloc_graph.geometry.lie import floor_pose, se3, se3_exp, so3_exp
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.comparison import of_files

Array = NDArray[np.float64]
DISTANCES = (1.0, 2.0, 5.0, 10.0)
ALIGNED = {"none": [], "reference": ["--align_origin"], "team": ["--align"]}


def drifting(true: Array, rng: np.random.Generator, sigma: float, *, planar: bool) -> Array:
    """An estimate of true poses (n, 4, 4) whose every step is a little wrong, in a world of its own."""
    free = np.array([0, 0, 1, 1, 1, 0] if planar else [1] * 6) * [1, 1, 1, 0.5, 0.5, 0.5]
    T = np.eye(4) if planar else se3_exp([0.3, -0.2, 1.0, 1, 2, 3])
    if planar:
        T = floor_pose(1.0, -2.0, 0.8)
    steps = np.linalg.inv(true[:-1]) @ true[1:] @ se3_exp(sigma * free * rng.normal(size=(len(true) - 1, 6)))
    poses = [T]
    for step in steps:
        T = T @ step
        poses.append(T)
    return np.array(poses)


def free_in_space(n: int, rng: np.random.Generator) -> Array:
    """A path like that of a small aircraft at about 1 m/s and 100 Hz."""
    t = np.arange(n) / 100
    turn = np.cumsum(0.01 * np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.7 * t), 0.5 * np.sin(0.2 * t)], axis=1), axis=0)
    R = so3_exp(turn)
    return se3(R, np.cumsum(0.01 * rng.uniform(0.8, 1.2, (n, 1)) * R[:, :, 0], axis=0))


def on_floor(n: int, rng: np.random.Generator) -> Array:
    """A path of a robot on a floor at about 0.5 m/s and 20 Hz that stands still every now and then."""
    t = np.arange(n) / 20
    speed = np.where(np.sin(0.1 * t) > -0.3, 0.5 + 0.1 * np.sin(t), 0.0)
    yaw = np.cumsum(np.where(speed > 0, 0.4 * np.sin(0.05 * t), 0)) / 20
    return floor_pose(np.cumsum(speed * np.cos(yaw)) / 20, np.cumsum(speed * np.sin(yaw)) / 20, yaw)


def trajectories(n: int) -> dict[str, tuple[Trajectory, Trajectory]]:
    """Truth and estimate of each case."""
    rng = np.random.default_rng(11)
    out = {}
    for name, true, sigma in (
        ("space", free_in_space(n, rng), 2e-4),
        ("floor", on_floor(n // 2, rng), 5e-4),
        ("far", free_in_space(n // 4, rng) , 2e-4),
    ):  # fmt: skip
        times = 1_700_000_000.0 + np.arange(len(true)) / 100
        estimated = drifting(true, rng, sigma, planar=name == "floor")
        if name == "far":  # as in UTM
            true, estimated = true.copy(), estimated.copy()
            true[:, :3, 3] += (4.1e5, 5.2e6, 100)
            estimated[:, :3, 3] += (4.1e5, 5.2e6, 100)
        out[name] = Trajectory(name, times, true), Trajectory(name, times, estimated)
    later = {name: replace(one, times=one.times + 1e5) for name, one in zip("te", out["floor"], strict=True)}
    team = [
        Trajectory("team", np.concatenate([a.times, b.times]), np.concatenate([a.T_world_body, b.T_world_body]))
        for a, b in zip(out["space"], later.values(), strict=True)
    ]
    return out | {"team": (team[0], team[1])}


def evo(program: str, evo_dir: Path, folder: Path, files: tuple[str, str], *options: str) -> tuple[Spread, Array]:
    """Return evo's statistics and errors of two files in a folder, truth first."""
    zipped = folder / "result.zip"
    zipped.unlink(missing_ok=True)
    subprocess.run(
        [evo_dir / program, "tum", *files, *options, "--no_warnings", "--save_results", zipped],
        cwd=folder, env=os.environ | {"HOME": str(folder)}, check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    with zipfile.ZipFile(zipped) as results:
        stats = json.loads(results.read("stats.json"))
        errors = np.load(BytesIO(results.read("error_array.npy")))
    return Spread(stats["rmse"], stats["mean"], stats["median"], stats["max"]), errors


def difference(ours: Array, theirs: tuple[Spread, Array]) -> float:
    """The largest difference of statistics and of errors; infinite where their number differs."""
    if len(ours) != len(theirs[1]):
        return float("inf")
    pairs = zip(asdict(spread(ours)).values(), asdict(theirs[0]).values(), strict=True)
    return max(float(np.abs(ours - theirs[1]).max()), *(abs(a - b) for a, b in pairs))


def rows_of(evo_dir: Path, n: int, folder: Path) -> list[dict[str, object]]:
    """One row a figure."""
    rows: list[dict[str, object]] = []

    def add(name: str, figure: str, options: list[str], ours: Array, program: str) -> None:
        off = difference(ours, evo(program, evo_dir, folder, (f"{name}.true", f"{name}.est"), *options))
        rows.append({"case": name, "figure": figure, "count": len(ours), "rmse": spread(ours).rmse, "difference": off})
        print("  ".join(f"{value:.3g}" if isinstance(value, float) else f"{value}" for value in rows[-1].values()),
              file=sys.stderr, flush=True)  # fmt: skip

    for name, (true, estimated) in trajectories(n).items():
        write_tum(true, folder / f"{name}.true")
        write_tum(estimated, folder / f"{name}.est")
        for alignment, options in ALIGNED.items():
            if name == "team" and alignment == "reference":
                continue
            one = of_files([str(folder / f"{name}.est")], [str(folder / f"{name}.true")], alignment)
            (robot,) = one.estimated
            at = align(one.estimated, one.truth, one.reference, on_floor=False, alignment=one.alignment)[robot]
            distance, angle = absolute_errors(one.estimated[robot].T_world_body, at)
            add(name, f"ATE, {alignment}, m", ["-r", "trans_part", *options], distance, "evo_ape")
            add(name, f"ATE, {alignment}, deg", ["-r", "angle_deg", *options], np.rad2deg(angle), "evo_ape")
            if name == "team" or alignment == "reference":
                continue
            for length in DISTANCES if alignment == "none" else (2.0,):
                for source in ("estimate", "truth"):
                    both = relative_errors(one.estimated[robot].T_world_body, at, length, source)
                    pairs = ["--pairs_from_reference"] if source == "truth" else []
                    delta = ["-d", str(length), "-u", "m", "--all_pairs", *pairs, *options]
                    what = f"RPE {length:g} m, pairs of the {source}, {alignment}"
                    add(name, f"{what}, m", ["-r", "trans_part", *delta], both[0], "evo_rpe")
                    add(name, f"{what}, deg", ["-r", "angle_deg", *delta], np.rad2deg(both[1]), "evo_rpe")
    return rows


def write_reference(evo_dir: Path, folder: Path) -> None:
    """A small pair of files with short numbers, and what evo says of it."""
    rng = np.random.default_rng(5)
    true = on_floor(160, rng)[::2] @ se3_exp(0.05 * rng.normal(size=(80, 6)))
    times = 1_700_000_000 + np.arange(80) / 4
    folder.mkdir(exist_ok=True)
    for name, T in (("true", true), ("est", drifting(true, rng, 0.02, planar=False))):
        write_tum(Trajectory(name, times, T), folder / f"{name}.tum")
        numbers = np.loadtxt(folder / f"{name}.tum")
        np.savetxt(folder / f"{name}.tum", numbers, fmt=["%.2f", *["%.5f"] * 3, *["%.7f"] * 4])
    answers = {}
    for alignment, options in ALIGNED.items():
        for unit, relation in (("m", "trans_part"), ("deg", "angle_deg")):
            stats, _ = evo("evo_ape", evo_dir, folder, ("true.tum", "est.tum"), "-r", relation, *options)
            answers[f"ATE {alignment} {unit}"] = asdict(stats)
    for length, source in itertools.product((0.5, 1.0, 2.0), ("estimate", "truth")):
        pairs = ["--pairs_from_reference"] if source == "truth" else []
        for unit, relation in (("m", "trans_part"), ("deg", "angle_deg")):
            delta = ["-r", relation, "-d", str(length), "-u", "m", "--all_pairs", *pairs]
            stats, errors = evo("evo_rpe", evo_dir, folder, ("true.tum", "est.tum"), *delta)
            answers[f"RPE {length} {source} {unit}"] = asdict(stats) | {"pairs": len(errors)}
    (folder / "result.zip").unlink()
    shutil.rmtree(folder / ".evo", ignore_errors=True)
    (folder / "evo.json").write_text(json.dumps(answers, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--evo", type=Path, required=True, metavar="DIR", help="the folder of evo's programs")
    parser.add_argument("--poses", type=int, default=20000)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", type=Path, metavar="DIR")
    options = parser.parse_args()
    if options.write:
        write_reference(options.evo.resolve(), options.write.resolve())
        return
    with tempfile.TemporaryDirectory() as folder:
        rows = rows_of(options.evo.resolve(), options.poses, Path(folder))
    worst = {case: max(row["difference"] for row in rows if row["case"] == case) for case in {r["case"] for r in rows}}
    if options.json:
        print(json.dumps({"rows": rows, "largest_difference": worst}, indent=1))
    else:
        print(f"{len(rows)} figures; largest difference by case: {worst}")


if __name__ == "__main__":
    main()
