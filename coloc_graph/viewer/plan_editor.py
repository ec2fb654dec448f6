"""A plan in the browser, whose robots can be dragged: what is promised of them follows; `PlanEditor`."""

import math
import threading
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
import viser

from coloc_graph.errors import ColocError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.clearance import conflicts
from coloc_graph.planning.mission import best_stance
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.planning.prediction import Predictor, Promise
from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.plan_scene import scene_of_plan
from coloc_graph.viewer.prepared import about_z
from coloc_graph.viewer.scene import Scene

SAME = 1e-9  # m, poses nearer to each other are one
MAX_NOTES = 4  # conflicts that are shown
POLL = 0.05  # s between looks at the stance that is shown
REST = 0.3  # s without a drag after which drives are planned anew
SCALE = 0.45  # m, size of the arrows by which a robot is dragged
Z_CONTROL = 0.02  # m over the floor


class PlanEditor:
    """Replans and predicts while robots are dragged; a context manager around a viewer that shows its scene.

    Parameters
    ----------
    predictor
        Predicts the stances.
    start
        The team before the first stance.
    plan
        The plan.
    goal
        Last point of the way, x, y [m].
    reasons
        One line for each stance on what decided.

    Attributes
    ----------
    plan
        The plan as it was dragged.
    promises
        What each of its stances promises.
    updates
        Number of predictions that were made since the viewer was opened.
    """

    def __init__(
        self,
        predictor: Predictor,
        start: Belief,
        plan: Plan,
        goal: tuple[float, float],
        reasons: Sequence[str] = (),
    ) -> None:
        self._reasons = reasons
        self._predictor, self._start, self._goal = predictor, start, goal
        self.plan = plan
        self.promises: tuple[Promise, ...] = tuple(predictor.of_plan(start, plan))
        self._promised = self.end_sigma
        self.updates = 0
        self._changed = threading.Condition()
        self._asked: dict[str, tuple[int, Planar]] = {}
        self._coarse: set[int] = set()
        self._ending, self._row = False, -1
        self._viewer: Viewer | None = None
        self._controls: dict[str, viser.TransformControlsHandle] = {}

    @property
    def end_sigma(self) -> float:
        """Standard deviation of the observers' last positions [m]."""
        return self.promises[-1].belief.position_sigma(self.plan.observers)

    @property
    def shown(self) -> int:
        """Row of the stance whose robots can be dragged; -1 before there is one."""
        return self._row

    @property
    def scene(self) -> Scene:
        """The scene of the plan as it is now."""
        free = self._predictor.free
        notes = [f"stance {k}: {text}" for k, text in conflicts(self.plan, free)]
        notes += [f"stance {k}: no common view" for k, one in enumerate(self.promises) if not one.points]
        sigma = f"{1e3 * self.end_sigma:.1f} mm promised at the end ({1e3 * self._promised:.1f} mm as it was planned)"
        return scene_of_plan(self._predictor.team, self.plan, self.promises, [sigma, *notes[:MAX_NOTES]], self._reasons)

    def attach(self, viewer: Viewer) -> None:
        """Add arrows by which the observers of the stance that is shown can be dragged."""
        self._viewer = viewer
        for name in self.plan.observers:
            control = viewer.server.scene.add_transform_controls(
                f"/planned/{name}", scale=SCALE, active_axes=(True, True, False), depth_test=False, opacity=0.8,
                visible=False,
            )  # fmt: skip
            control.on_update(lambda event, name=name: self._on_drag(event, name))  # type: ignore[misc]
            self._controls[name] = control
        self._thread = threading.Thread(target=self._work, name="plan-editor", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        if self._viewer is not None:
            self._thread.join(timeout=10)

    def drag(self, name: str, stance: int, pose: Planar) -> None:
        """Have a robot stand at another pose in a stance, and in those about it in which it stands there too."""
        with self._changed:
            self._asked[name] = stance, pose
            self._changed.notify()

    def _on_drag(self, event: viser.TransformControlsEvent, name: str) -> None:
        if event.client is None or self._row < 0:
            return
        x, y, _ = event.target.position
        w, *_, z = event.target.wxyz
        self.drag(name, self._row, (float(x), float(y), 2 * math.atan2(float(z), float(w))))

    def _work(self) -> None:
        viewer = self._viewer
        assert viewer is not None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._ending, timeout=REST if self._coarse else POLL)
                if self._ending:
                    return
                asked, self._asked = self._asked, {}
            for name, (k, pose) in asked.items():
                self._move(name, k, pose)
                self.updates += 1
            if not asked and self._coarse:
                self._redrive()
                asked = {"": (0, (0.0, 0.0, 0.0))}
            if asked:
                viewer.publish(self.scene)
            row = viewer.frame.row if viewer.frame is not None else -1
            if row != self._row:
                self._row = row
                self._place_controls()

    def _place_controls(self) -> None:
        standing = self.plan.stances[self._row].standing if 0 <= self._row < len(self.plan.stances) else {}
        for name, control in self._controls.items():
            control.visible = name in standing
            if name in standing:
                x, y, yaw = standing[name]
                control.position, control.wxyz = (x, y, Z_CONTROL), about_z(np.array(yaw))

    def _move(self, name: str, k: int, pose: Planar) -> None:
        """Move a robot; drives of its stances move along, until they are planned anew once it rests."""
        stances = list(self.plan.stances)
        old = stances[k].standing[name]

        def stays(n: int) -> bool:
            there = stances[n].standing.get(name) if 0 <= n < len(stances) else None
            return there is not None and math.dist(there, old) < SAME

        first, last = k, k
        while stays(first - 1):
            first -= 1
        while stays(last + 1):
            last += 1
        for n in range(first, last + 1):
            one = stances[n]
            shift = np.subtract(pose[:2], old[:2]) / len(one.standing)
            drive = tuple((float(x + shift[0]), float(y + shift[1])) for x, y in one.waypoints)
            stances[n] = replace(one, standing={**one.standing, name: pose}, waypoints=drive)
        self._coarse |= set(range(first, last + 1))
        self._predict(stances, first)

    def _redrive(self) -> None:
        """Plan the drives of stances that were moved anew."""
        first, coarse = min(self._coarse), self._coarse
        self._coarse = set()
        self._predict(list(self.plan.stances), first, coarse)

    def _predict(self, stances: list[PlannedStance], first: int, anew: Container[int] = ()) -> None:
        """Predict from stance `first` on, and plan the drives of the stances `anew`."""
        promises = list(self.promises[:first])
        belief = promises[-1].belief if promises else self._start
        for n in range(first, len(stances)):
            # an anchor that was dragged has stood there before
            anchored = {name: stances[n].standing[name] for name in stances[n].anchors or stances[n].standing}
            belief = replace(belief, poses={**belief.poses, **anchored})
            promise = self._predictor.of_stance(belief, stances[n])
            if n in anew:
                stances[n], promise = self._driven(belief, stances[n], promise)
            promises.append(promise)
            belief = promise.belief
        self.plan, self.promises = Plan(tuple(stances)), tuple(promises)

    def _driven(self, before: Belief, stance: PlannedStance, promise: Promise) -> tuple[PlannedStance, Promise]:
        """Plan the drive of a stance; where there is none it stays as it is."""
        belief = before
        for name, pose in stance.standing.items():
            if name not in stance.anchors and belief.poses[name] != pose:
                belief = belief.after_leap(name, pose, self._predictor.wheels)
        try:
            return best_stance(
                self._predictor, belief, dict(stance.standing), stance.anchors, stance.mover, stance.duration,
                self._goal,
            )  # fmt: skip
        except ColocError:
            return stance, promise
