"""A messy world: lamps and windows that saturate, a floor that mirrors, mains that flicker, a person who walks by."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.run.messages import Image
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rendering import Field, Sensor, add_spots, expose, fill, pixel_noise, spots
from coloc_graph.simulation.scenery import Scenery, bright, dark, others_in_view, with_robots
from coloc_graph.simulation.world import Capture, World, stream
from coloc_graph.team import Camera

MAINS = 100.0  # Hz, frequency of mains flicker
FLICKER = 0.35  # fraction of the light that flickers
BRIGHTER = 3.0  # factor by which lamps, windows and specks are brighter than in a tidy world
BRIGHTEST = 400.0  # grey levels, limit of their brightness
#: What the floor mirrors of an LED, relative to it.
MIRRORED = 0.6
#: A person: the width of a leg and of the body, where the body begins [m], the step [m], pace [m/s], grey level; and a
#: bright strip at each ankle, its height and radius [m].
LEG = 0.16
BODY = 0.45
HIP = 0.8
STRIDE = 0.6
PACE = 1.2
DARK = 9.0
ANKLE = 0.12
STRIP = 0.015
#: How high the person is, and how bright the strips are.
TALL = 1.8
SHINING = 220.0


@dataclass(frozen=True)
class Person:
    """Walks to and fro across the x axis at `x` [m], `wide` [m] to either side of it, from the instant `begins` [s]."""

    x: float
    wide: float
    begins: float

    def legs(self, time: float) -> Array:
        """Positions of both feet on the floor (2, 2) [m]."""
        way = PACE * (time - self.begins)
        y = self.wide - abs((way % (4 * self.wide)) - 2 * self.wide)
        swing = STRIDE / 2 * math.sin(2 * math.pi * way / (2 * STRIDE))
        return np.array([[self.x + 0.06, y + swing], [self.x - 0.06, y - swing]])


def messy(scenery: Scenery) -> Scenery:
    """The same things, brighter."""
    return replace(
        scenery,
        levels=np.minimum(BRIGHTER * scenery.levels, BRIGHTEST),
        window_levels=np.minimum(BRIGHTER * scenery.window_levels, BRIGHTEST),
    )


def flicker(time: float) -> float:
    """Brightness of mains lighting at an instant [s], 1 on average."""
    return 1 + FLICKER * math.sin(2 * math.pi * MAINS * time)


def paint(field: Field, camera: Camera, T_world_camera: Array, person: Person, time: float) -> None:
    """Paint a person over a field (height, width), and add the strips at the ankles."""
    T_camera_world = se3_inverse(T_world_camera)
    legs = person.legs(time)
    side = T_world_camera[:2, 0] / max(float(np.hypot(*T_world_camera[:2, 0])), 1e-9)
    middle = legs.mean(axis=0)
    parts = [(leg, LEG, 0.0, HIP) for leg in legs] + [(middle, BODY, HIP, TALL)]
    for (x, y), width, low, high in parts:
        across = width / 2 * side
        corners = np.array(
            [
                (x - across[0], y - across[1], low),
                (x + across[0], y + across[1], low),
                (x + across[0], y + across[1], high),
                (x - across[0], y - across[1], high),
            ]
        )
        ends = corners @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        if camera.model == "fisheye":
            if np.linalg.norm(ends, axis=1).min() > 0.1 and np.isfinite(uv := camera.project(ends)[0]).all():
                fill(field, uv, DARK)
        elif ends[:, 2].min() > 0.1:
            # without the lens, whose polynomial ends within the image of somebody so near
            uv = ends[:, :2] / ends[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
            fill(field, np.clip(uv, -5000, 5000), DARK)
    strips = np.column_stack([legs, np.full(2, ANKLE)]) @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    depth = np.linalg.norm(strips, axis=1) if camera.model == "fisheye" else strips[:, 2]
    uv, inside = camera.project(strips)
    there = (depth > 0.1) & inside
    add_spots(field, spots(uv[there], camera.fx * STRIP / depth[there], SHINING))


def messy_frames(world: World, k: int, capture: Capture, scenery: Scenery) -> Iterator[Image]:
    """`scenery.frames` of a messy world: a person walks to and fro where the mover drives."""
    sensor, camera, T_world_camera = Sensor(), capture.view.camera, capture.view.T_world_camera
    index = world.team.names.index(capture.robot)
    rng, of_person = stream(world.seed, "sensor", k * len(world.team.names) + index), stream(world.seed, "person", k)
    unlit = dark(camera, rng)
    lights = bright(unlit.copy(), camera, T_world_camera, messy(scenery)) - unlit
    others = others_in_view(world, capture, sensor, MIRRORED)
    x, _ = world.scenario.middle(k)
    person = Person(
        x + of_person.uniform(0.8, 2.5), of_person.uniform(1.0, 2.0), capture.times[0] - of_person.uniform(0, 5)
    )
    for i, stamp in enumerate(capture.stamps.tolist()):
        time = float(capture.times[i])
        field = with_robots(np.asarray(unlit + np.float32(flicker(time)) * lights, np.float32), others, i)
        paint(field, camera, T_world_camera, person, time)
        yield Image(capture.robot, stamp, expose(field, sensor, pixel_noise(rng, field.shape)))
