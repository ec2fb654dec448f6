"""Depth tracks: the marker centres that each observer would have detected, with noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.run.messages import Detections
from coloc_graph.simulation.blinking import blinking
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rig import detection_sigma
from coloc_graph.simulation.world import World, stream


@dataclass(frozen=True, eq=False)
class StanceTracks:
    """Detections of one observer in one stance: `uv` (n, m, 2) [px] of m `markers` at `stamps` (n,) [s].

    `seen` (n, m) tells which of them were detected; the others' uv mean nothing. `sigma` [px] is per axis.
    Records have the markers' names unless they are `nameless`.
    """

    robot: str
    markers: tuple[str, ...]
    stamps: Array
    uv: Array
    seen: NDArray[np.bool_]
    sigma: float
    nameless: bool = False

    def records(self) -> list[Detections]:
        """One record a capture."""
        names = np.array([""] * len(self.markers) if self.nameless else self.markers)
        covariance = np.broadcast_to(self.sigma**2 * np.eye(2), (len(names), 2, 2))
        none = np.zeros(len(names))  # no image, so neither peak nor area was measured
        flags = np.zeros(len(names), np.uint8)
        out = []
        for stamp, uv, seen in zip(self.stamps.tolist(), self.uv, self.seen, strict=True):
            n = int(seen.sum())
            markers = tuple(names[seen].tolist())
            out.append(Detections(self.robot, stamp, uv[seen], covariance[:n], markers, flags[:n], none[:n], none[:n]))
        return out


def observe(world: World, k: int) -> tuple[StanceTracks, ...]:
    """Simulate detections of markers by the observers of stance k, in the order of `Stance.observers`.

    Without their names where robots blink.
    """
    rng, out = stream(world.seed, "detection", k), []
    blinks = blinking(world.true_team, stream(world.seed, "blink"))
    for capture in world.captures[k]:
        places, names, on = [], [], []
        for robot in (*world.stances[k].movers, *capture.standing):
            places.append(world.markers_world(robot, capture.times))
            names += [f"{robot}/{m}" for m in range(places[-1].shape[1])]
            lit = blinks[robot].on(capture.times) if robot in blinks else np.ones(len(capture.times), bool)
            on.append(np.repeat(lit[:, None], places[-1].shape[1], axis=1))
        uv, inside = capture.view.project(np.concatenate(places, axis=1))
        noisy = uv + world.imperfections.noise_px * rng.standard_normal(uv.shape)
        seen = capture.recorded & inside & np.concatenate(on, axis=1)
        sigma = detection_sigma(world.imperfections)
        tracks = StanceTracks(capture.robot, tuple(names), capture.stamps, noisy, seen, sigma, nameless=bool(blinks))
        out.append(tracks)
    return tuple(out)
