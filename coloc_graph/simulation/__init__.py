"""Worlds that write the same run a real team writes: with truth in it, and as many imperfections as you like.

`simulate` writes a run; `build_world` with `observe` is the same without a file, fast enough for Monte Carlo.
"""

from coloc_graph.simulation.recording import record, simulate
from coloc_graph.simulation.rendering import Sensor, Spots, render, spots
from coloc_graph.simulation.rig import MILD_LENS, Imperfections, reference_team
from coloc_graph.simulation.scenarios import SCENARIOS, Scenario, hallway, scenario, single_step, six_step
from coloc_graph.simulation.tracks import StanceTracks, observe
from coloc_graph.simulation.world import EPOCH, World, build_world

__all__ = [
    "EPOCH",
    "MILD_LENS",
    "SCENARIOS",
    "Imperfections",
    "Scenario",
    "Sensor",
    "Spots",
    "StanceTracks",
    "World",
    "build_world",
    "hallway",
    "observe",
    "record",
    "reference_team",
    "render",
    "scenario",
    "simulate",
    "single_step",
    "six_step",
    "spots",
]
