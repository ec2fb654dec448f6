"""Estimate stance by stance, as on robots, and draw how the uncertainty of the leader grows and is corrected."""

import matplotlib.pyplot as plt
import numpy as np

from coloc_graph import SolveOptions, open_run, simulate, solve

simulate("hallway", "run.mcap", stances=10, seed=3, points=50)
stances, then = [], []


def note(entered):
    """Keep the uncertainty of the robot that leaped last, as it is known in this stance."""
    stance = entered.stance
    stances.append(stance.index)
    then.append(np.sqrt(np.trace(entered.estimate.covariances[stance.observers[-1]][3:5, 3:5])))


solution = solve(open_run("run.mcap"), SolveOptions(incremental=True), on_update=note)
at_end = [
    np.sqrt(np.trace(solution.estimate.covariance(stance.observers[-1], stance.index)[3:5, 3:5]))
    for stance in solution.run.stances
]
fig, ax = plt.subplots(figsize=(7, 2.8))
ax.plot(stances, 1e3 * np.array(then), "o-", label="as it entered")
ax.plot([stance.index for stance in solution.run.stances], 1e3 * np.array(at_end), "s--", label="at the end")
ax.set(xlabel="stance", ylabel="sigma of the position [mm]", title="The robot that leaped last")
ax.legend()
fig.savefig("as_it_happens.png", dpi=100, bbox_inches="tight")
