"""Detect LEDs in an image, and draw the covariance of each centre and the reasons to doubt it."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

from coloc_graph.frontend import detect_leds
from coloc_graph.run import Flag
from coloc_graph.simulation import render, spots

uv = np.array([(18.3, 20.6), (50.8, 20.2), (82.4, 19.7), (112.0, 20.0), (116.5, 20.4)])
lights = spots(uv, radius=[1.5, 3.0, 1.2, 1.6, 1.6], level=[200, 900, 200, 200, 200],
               motion=[(0, 0), (0, 0), (9, 3), (0, 0), (0, 0)])  # fmt: skip
image = render(lights, size=(134, 40), background=10.0, rng=np.random.default_rng(0))
blobs = detect_leds(image)

fig, ax = plt.subplots(figsize=(7, 2.5))
ax.imshow(image, cmap="gray", vmin=0, vmax=255)
for centre, covariance, flags in zip(blobs.uv, blobs.covariance, blobs.flags, strict=True):
    (small, large), vectors = np.linalg.eigh(covariance)
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    ax.add_patch(Ellipse(centre, 40 * large**0.5, 40 * small**0.5, angle=angle, fill=False, color="tab:orange"))
    reasons = ", ".join(flag.name.lower() for flag in Flag if flag and flags & flag) or "good"
    ax.text(centre[0], 37, reasons, color="white", ha="center", fontsize=8)
    print(f"({centre[0]:.2f}, {centre[1]:.2f}) +- {np.sqrt(large):.3f} px: {reasons}")
ax.set(title="Ellipses of 20 sigma", xticks=[], yticks=[])
fig.savefig("detect_lights.png", dpi=100, bbox_inches="tight")
