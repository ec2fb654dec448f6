"""Planned stances as lines and sentences, beside what came of them."""

import json
import math
from pathlib import Path

import numpy as np

from coloc_graph.viewer import palette
from coloc_graph.viewer.palette import Colours
from coloc_graph.viewer.prepared import Float32, about_z, ellipse_axes
from coloc_graph.viewer.scene import Array, Scene, ShownPlan

Z_PLANNED = 0.012  # m over the floor
OUTLINE = 40  # segments of the outline of an ellipse, of which every other one is drawn
FOOTPRINT = 0.17  # m, radius of a robot's footprint
LOOK = 0.45  # m, length of the line along which a planned robot looks
MAX_PLANNED = 60  # stances whose promised ellipses are drawn, the newest ones
PLANNED = "planned"  # name of the layer of a plan of which nothing came yet
LOG = "mission.jsonl"  # log of a mission, beside the folder of its result


def read_plans(log: Path) -> tuple[ShownPlan, ...]:
    """Read the planned stances of a mission's log; of several plans of a stance the last one."""
    found: dict[int, ShownPlan] = {}
    if not log.is_file():
        return ()
    for line in log.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            if row["what"] == "planned" and "promise" in row:
                found[int(row["stance"])] = plan_of_row(row)
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # a coordinator that was killed leaves half a line behind
    return tuple(found[index] for index in sorted(found))


def plan_of_row(row: dict[str, object]) -> ShownPlan:
    """Make a planned stance of a row of a mission's log.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the row is none.
    """
    promise, leap = row["promise"], row["leap"]
    if not isinstance(promise, dict):
        raise TypeError(f"a promise is not {promise!r}")
    return ShownPlan(
        stance=int(row["stance"]),  # type: ignore[call-overload]
        standing={name: np.array(pose, float).reshape(3) for name, pose in promise["standing"].items()},
        covariances={name: np.array(C, float).reshape(3, 3) for name, C in promise["covariances"].items()},
        drive=np.array(row["patrol"], float).reshape(-1, 2),
        leaper=str(leap[0]) if isinstance(leap, list | tuple) else None,
        reason=str(promise["reason"]),
    )


def planned_lines(scene: Scene, row: int, colours: Colours, k_sigma: float, dark: bool) -> tuple[Float32, Colours]:
    """Draw the plans up to the stance after a row: promised ellipses, and of the newest its footprints and drive.

    Returns
    -------
    tuple
        Segments (n, 2, 3) [m] and their colours (n, 2, 3).
    """
    points: list[Array] = []
    tints: list[Colours] = []

    def add(segments: Array, colour: Colours) -> None:
        points.append(segments)
        tints.append(np.broadcast_to(colour, (len(segments), 2, 3)))

    plans = _plans_until(scene, row)[-MAX_PLANNED:]
    number = {robot: n for n, robot in enumerate(scene.robots)}
    for plan in plans:
        newest = plan is plans[-1]
        for robot, (x, y, yaw) in plan.standing.items():
            if robot not in number or not (newest or plan.leaper in (robot, None)):
                continue
            colour = palette.faded(colours[number[robot]], dark, 0.0 if newest else 0.3)
            middle = np.array([x, y])
            outline = middle + _ellipse(plan.covariances[robot][:2, :2], k_sigma)
            add(np.stack([outline[:-1:2], outline[1::2]], axis=1), colour)
            if newest:
                ring = middle + FOOTPRINT * _circle()
                add(np.stack([ring[:-1:2], ring[1::2]], axis=1), colour)
                look = np.array([[x, y], [x + LOOK * math.cos(yaw), y + LOOK * math.sin(yaw)]])
                add(look[None], colour)
        if newest and len(plan.drive) > 1:
            movers = [n for robot, n in number.items() if robot not in plan.standing]
            colour = colours[movers[-1]] if movers else palette.ink(dark)
            add(np.stack([plan.drive[:-1], plan.drive[1:]], axis=1), palette.faded(colour, dark, 0.2))
    if not points:
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    flat = np.concatenate(points)
    raised = np.full((*flat.shape[:2], 3), Z_PLANNED, np.float32)
    raised[..., :2] = flat
    return raised, np.concatenate(tints).astype(np.uint8)


def planned_note(scene: Scene, row: int) -> str:
    """Say of the stance of a row what was promised and what came, and why the next one stands where it is planned."""
    if not scene.plans or not 0 <= row < len(scene):
        return ""
    now, notes = scene.stances[row].index, []
    by_stance = {plan.stance: plan for plan in scene.plans}
    if (plan := by_stance.get(now)) is not None and scene.layers and scene.layers[0].name != PLANNED:
        for n, robot in enumerate(scene.robots):
            came = scene.layers[0].covariance[n, row]
            if robot in plan.covariances and np.isfinite(came).all():
                promised = math.sqrt(np.trace(plan.covariances[robot][:2, :2]))
                notes.append(
                    f"{robot}: {1e3 * promised:.1f} mm promised, {1e3 * math.sqrt(np.trace(came)):.1f} mm came"
                )
    text = f"plan of stance {now}: " + ", ".join(notes) if notes else ""
    newest = _plans_until(scene, row)[-1:]
    for plan in newest:
        who = f"{plan.leaper} leaps" if plan.leaper else "nobody leaps"
        text += f"{'; ' if text else ''}stance {plan.stance}: {who}; {plan.reason}"
    return text


def _plans_until(scene: Scene, row: int) -> list[ShownPlan]:
    """Plans up to the stance after a row, in their order."""
    last = scene.stances[row].index + 1 if 0 <= row < len(scene) else 0
    return [plan for plan in scene.plans if plan.stance <= last]


def _circle() -> Array:
    angle = np.linspace(0.0, 2 * np.pi, OUTLINE + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ellipse(covariance: Array, k_sigma: float) -> Array:
    """Outline (n, 2) of the ellipse of a covariance (2, 2) [m^2], about 0 [m]."""
    axes, direction = ellipse_axes(covariance)
    w, *_, z = about_z(direction).astype(float)
    c, s = w * w - z * z, 2 * w * z
    return np.asarray(k_sigma * (_circle() * axes) @ np.array([[c, s], [-s, c]]))
