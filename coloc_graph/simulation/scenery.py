"""Depth images: what an observer's camera sees of the world, frame by frame: LEDs, bodies, and bright things
that are no LEDs."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.run.messages import Image
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rendering import Field, Sensor, Spots, add_spots, expose, fill, spots
from coloc_graph.simulation.tours import View
from coloc_graph.simulation.world import Capture, World, stream

#: An LED is a disc of this radius [m]; a body is a dark cylinder, radius and height [m], at a grey level.
LED_RADIUS = 0.005
BODY_RADIUS, BODY_HEIGHT, BODY_LEVEL = 0.17, 0.12, 6.0

#: An LED's mirror image in the floor: its level relative to the LED's, its radius and blur relative to it.
MIRROR_LEVEL, MIRROR_RADIUS, MIRROR_BLUR = 0.28, 2.0, 2.0

#: Height of the ceiling's lamps above the floor [m].
CEILING = 2.6

#: Beyond this distance from the axis (normalised coordinates) a lens polynomial is not to be trusted.
_FIELD_LIMIT = 1.3


@dataclass(frozen=True, eq=False)
class Scenery:
    """Bright things fixed in the world: their places (n, 3) [m], radii (n,) [m], levels and blurs [px] (n,).

    `windows` (w, 4, 3) [m] are bright rectangles at `window_levels` (w,).
    """

    places: Array
    radii: Array
    levels: Array
    blurs: Array
    windows: Array
    window_levels: Array


def make_scenery(world: World) -> Scenery:
    """Ceiling lamps mirrored in the floor, shining specks on it, and windows; drawn by the world's seed."""
    rng = stream(world.seed, "scenery")
    first = min(pose[0] for pose in world.scenario.poses)
    last = max(pose[0] for pose in world.scenario.poses)
    lamps_x = np.arange(first + 3.5, last + 12.0, 2.2)
    n = len(lamps_x)
    lamps = np.column_stack([lamps_x + rng.normal(0, 0.2, n), rng.uniform(-1.2, 1.2, n), np.full(n, -CEILING)])
    m = int(2.0 * (last - first + 4.0))
    specks = np.column_stack([rng.uniform(first, last + 4.0, m), rng.uniform(-1.5, 1.5, m), np.zeros(m)])
    sides = np.arange(first + 3.0, last + 9.0, 3.0)
    windows = []
    for i, x in enumerate(sides):
        y, z = (1.9 if i % 2 else -1.9), 0.15
        windows.append([(x, y, z), (x + 0.5, y, z), (x + 0.5, y, 1.6), (x, y, 1.6)])
    return Scenery(
        places=np.concatenate([lamps, specks]),
        radii=np.concatenate([rng.uniform(0.05, 0.10, n), rng.uniform(0.003, 0.006, m)]),
        levels=np.concatenate([rng.uniform(50, 110, n), rng.uniform(30, 70, m)]),
        blurs=np.concatenate([np.full(n, 2.5), np.full(m, 0.9)]),
        windows=np.array(windows).reshape(-1, 4, 3),
        window_levels=rng.uniform(70, 140, len(sides)),
    )


def backdrop(view: View, scenery: Scenery, rng: np.random.Generator) -> Field:
    """The field (height, width) of a camera at rest with no robot before it: dark, and bright things."""
    camera = view.camera
    x, y = np.linspace(-1, 1, camera.width), np.linspace(-1, 1, camera.height)[:, None]
    a, b, c = rng.uniform(-1, 1, 3)
    field = (19 - (5 + b) * y + 2.5 * a * x - (2 + c) * x**2).astype(np.float32)
    for corners, level in zip(scenery.windows, scenery.window_levels, strict=True):
        uv, _, ok = _image_of(view, corners)
        if ok.all():
            fill(field, uv, float(level))
    field = np.asarray(cv2.GaussianBlur(field, (0, 0), 1.2), np.float32)
    uv, depth, ok = _image_of(view, scenery.places)
    radius = camera.fx * scenery.radii[ok] / depth[ok]
    add_spots(field, spots(uv[ok], radius, scenery.levels[ok], psf_sigma=scenery.blurs[ok]))
    return field


def _image_of(view: View, points_world: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Pixels (..., 2), depths (...) [m], and which points (..., 3) [m] are in the image or near it."""
    R_world_camera, p_world = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
    points = (points_world - p_world) @ R_world_camera
    depth = points[..., 2]
    ok = (depth > 0.05) & (np.hypot(points[..., 0], points[..., 1]) < _FIELD_LIMIT * depth)
    return view.camera.project(points)[0], depth, np.asarray(ok)


def frames(world: World, k: int, capture: Capture, scenery: Scenery, sensor: Sensor | None = None) -> Iterator[Image]:
    """Render the images of one observer in stance k, in time order; about 1.5 ms each."""
    sensor = sensor or Sensor()
    index = world.team.names.index(capture.robot)
    rng = stream(world.seed, "sensor", k * len(world.team.names) + index)
    field = backdrop(capture.view, scenery, rng)
    others = [_Other(world, name, capture, sensor) for name in world.team.names if name != capture.robot]
    for i, stamp in enumerate(capture.stamps.tolist()):
        image = field.copy()
        for other in others:
            other.add_mirrored(image, i)
        # the far ones first: a near body hides what is behind it
        for other in sorted(others, key=lambda other: -float(other.distance[i])):
            other.paint(image, i)
        yield Image(capture.robot, stamp, expose(image, sensor, rng))


class _Other:
    """One robot as another's camera sees it, over all captures of a stance."""

    def __init__(self, world: World, name: str, capture: Capture, sensor: Sensor) -> None:
        times, view = capture.times, capture.view
        T_world_body = world.paths[name].pose_at(times)
        self.distance = np.linalg.norm(T_world_body[:, :3, 3] - view.T_world_camera[:3, 3], axis=-1)
        angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        circle = BODY_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
        hull = np.concatenate([np.column_stack([circle, np.full(24, z)]) for z in (0.0, BODY_HEIGHT)])
        hull_world = np.einsum("nij,mj->nmi", T_world_body[:, :3, :3], hull) + T_world_body[:, None, :3, 3]
        self._hull, _, hull_ok = _image_of(view, hull_world)
        self._visible = np.atleast_1d(hull_ok.all(axis=1))
        half = sensor.exposure / 2
        leds = [world.markers_world(name, times + shift) for shift in (0.0, -half, half)]
        self._leds = self._spots(view, leds, 1.0, sensor.led_level, 1.0, sensor)
        mirrored = [led * (1.0, 1.0, -1.0) for led in leds]
        self._mirrored = self._spots(
            view, mirrored, MIRROR_RADIUS, MIRROR_LEVEL * sensor.led_level, MIRROR_BLUR, sensor
        )  # fmt: skip

    @staticmethod
    def _spots(view: View, places: list[Array], widen: float, level: float, blur: float, sensor: Sensor) -> list[Spots]:
        """The spots of each capture, of LEDs (n, m, 3) in the middle, at the beginning and the end of it."""
        uv, depth, ok = _image_of(view, places[0])
        motion = _image_of(view, places[2])[0] - _image_of(view, places[1])[0]
        radius = widen * view.camera.fx * LED_RADIUS / depth
        psf = blur * sensor.psf_sigma
        return [
            spots(uv[i][ok[i]], radius[i][ok[i]], level, motion[i][ok[i]], psf) for i in range(len(uv))
        ]  # fmt: skip

    def add_mirrored(self, field: Field, i: int) -> None:
        """Add what the floor mirrors of its LEDs."""
        add_spots(field, self._mirrored[i])

    def paint(self, field: Field, i: int) -> None:
        """Paint its body over what is behind it, and add its LEDs."""
        if self._visible[i]:
            outline = np.asarray(cv2.convexHull(self._hull[i].astype(np.float32)))[:, 0]
            fill(field, outline, BODY_LEVEL)
        add_spots(field, self._leds[i])
