"""The instant that is shown: set by the controls, moved on by playing."""

import time
from collections.abc import Iterable

import numpy as np

from coloc_graph.viewer.inbox import Request
from coloc_graph.viewer.panel import Panel, set_value
from coloc_graph.viewer.scene import Scene

REST_DELAY = 0.35  # s without a move until time is at rest, and all is drawn


class Playback:
    """Time in the run [s], and when it last moved."""

    def __init__(self, scene: Scene) -> None:
        self.time = scene.middle(len(scene) - 1)
        self._moved_at = 0.0

    @property
    def is_at_rest(self) -> bool:
        """True if time has not moved for a while."""
        return time.perf_counter() - self._moved_at > REST_DELAY

    def advance(self, scene: Scene, panel: Panel, requests: Iterable[Request], played: float) -> None:
        """Move time by the requests, and by `played` seconds at the panel's speed; at the end it starts anew."""
        before = self.time
        for kind, value in requests:
            if not len(scene):
                continue
            if kind == "stance":
                self.time = scene.middle(min(int(value), len(scene) - 1))
            elif kind == "time":
                self.time = float(scene.starts[0]) + value
            elif kind == "step":
                self.time = scene.middle(int(np.clip(scene.row_at(self.time) + value, 0, len(scene) - 1)))
            elif kind == "play":
                set_value(panel.play, not panel.play.value)
        if played and len(scene):
            end = float(scene.ends.max())
            self.time += played * panel.speed.value
            if self.time > end:
                self.time = float(scene.starts[0]) if before >= end - 1e-6 else end
        if self.time != before:
            self._moved_at = time.perf_counter()
