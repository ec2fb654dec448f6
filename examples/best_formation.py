"""Compare what formations promise before anybody drives: the leap against the uncertainty at the end of the way."""

from dataclasses import replace

import matplotlib.pyplot as plt

from coloc_graph.planning.formation import PAPER
from coloc_graph.planning.mission import leap_frog, stances_of
from coloc_graph.planning.prediction import Predictor
from coloc_graph.simulation import reference_team

LENGTH = 2.4  # m
IMAGES = 24.0  # s of images on the whole way, whatever the number of stances

predictor = Predictor(reference_team(), fps=30.0)
fig, ax = plt.subplots(figsize=(7, 2.8))
for abreast in (0.5, 1.0):
    leaps, sigmas = (0.185, 0.3, 0.45, 0.7), []
    for leap in leaps:
        gait = replace(PAPER, leap=leap, abreast=abreast)
        seconds = IMAGES / stances_of(gait, LENGTH)
        mission = leap_frog(predictor, gait, LENGTH, seconds, ("A", "B"), "C", designed=False)
        sigmas.append(1e3 * mission.end_sigma)
    ax.plot(leaps, sigmas, "o-", label=f"{abreast:g} m abreast")
ax.set(xlabel="leap [m]", ylabel="sigma at the end [mm]", title=f"{LENGTH:g} m with {IMAGES:g} s of images")
ax.set_yscale("log")
ax.legend(fontsize=8)
fig.savefig("best_formation.png", dpi=100, bbox_inches="tight")
