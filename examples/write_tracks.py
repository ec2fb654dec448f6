"""Write marker tracks as CSV, as a detector of your own would, with the team that they belong to."""

import csv
from pathlib import Path

import matplotlib.pyplot as plt

from coloc_graph import open_run, simulate, write_team

simulate("hallway", "simulated.mcap", stances=3, seed=1, points=60)
run = open_run("simulated.mcap")
write_team(run.team, "team.toml")
rows = [
    (stance.index, f"{image.time:.6f}", robot, marker, f"{u:.3f}", f"{v:.3f}")
    for stance in run.stances
    for robot in stance.observers
    for image in run.detections(robot, stance.start, stance.end)
    for marker, (u, v) in zip(image.markers, image.uv, strict=True)
]
with Path("tracks.csv").open("w", newline="") as file:
    writer = csv.writer(file)
    writer.writerows([("stance", "time", "robot", "marker", "u", "v"), *rows])
with Path("moves.csv").open("w", newline="") as file:  # who drove ahead before each stance
    moved = [(k.index, robot) for k in run.stances for robot in k.observers if k.index and robot not in k.anchors]
    csv.writer(file).writerows([("stance", "robot"), *moved])

fig, axes = plt.subplots(1, 2, figsize=(7, 2.7), sharey=True)
for ax, robot in zip(axes, "AB", strict=True):
    for marker in ("C/0", "C/1"):
        uv = [(float(u), float(v)) for k, _, r, m, u, v in rows if (k, r, m) == (0, robot, marker)]
        ax.plot(*zip(*uv, strict=True), ".-", linewidth=0.5, markersize=3, label=marker)
    ax.set(title=f"camera of {robot}, stance 0", xlim=(0, 320), ylim=(240, 0), xlabel="u [px]")
axes[0].legend(fontsize=8)
fig.savefig("write_tracks.png", dpi=100, bbox_inches="tight")
