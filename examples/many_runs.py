"""Solve a folder of runs on a Dask cluster of this machine, and draw the errors of all runs."""

from pathlib import Path

import matplotlib.pyplot as plt
from distributed import Client, LocalCluster

from coloc_graph import simulate
from coloc_graph.results.many_runs import result_folders, runs_in, solve_runs

if __name__ == "__main__":  # workers import this file
    Path("runs").mkdir(exist_ok=True)
    for seed in range(4):
        simulate("hallway", f"runs/{seed}.mcap", stances=2, seed=seed, points=30)
    runs = runs_in("runs")
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        outcomes = solve_runs(runs, result_folders(runs, "runs", "results"), executors=client.get_executor)
    fig, ax = plt.subplots(figsize=(7, 2.4))
    for one in outcomes:
        ate = one.summary["accuracy"]["ate_m"]
        print(f"{one.run}: {1e3 * ate:.1f} mm")
        ax.bar(one.run.name, 1e3 * ate, color="tab:blue")
    ax.set(ylabel="RMS position error [mm]")
    fig.savefig("many_runs.png", dpi=100, bbox_inches="tight")
