"""Depth images: what a camera sees of the world, frame by frame: LEDs, bodies, and bright things that are no LEDs.

`frames` are those of a simulated run; `backdrop`, `RobotInView` and `draw` make one of any poses, as a live world does.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from coloc_graph.run.messages import Image
from coloc_graph.simulation.paths import Array
from coloc_graph.simulation.rendering import (
    Field,
    Pixels,
    Sensor,
    add_spot,
    add_spots,
    expose,
    fill,
    pixel_noise,
    spots,
)
from coloc_graph.simulation.tags import paint_tag
from coloc_graph.simulation.world import Capture, World, stream
from coloc_graph.team import Camera, fisheye

#: Arguments of `add_spot`: centre, radius, level, motion, blur.
_Spot = tuple[float, float, float, float, tuple[float, float], float]

#: An LED is a disc of this radius [m]; a body is a dark cylinder, radius and height [m], at a grey level.
LED_RADIUS = 0.005
BODY_RADIUS = 0.17
BODY_HEIGHT = 0.12
BODY_LEVEL = 6.0

#: An LED's mirror image in the floor: its level relative to the LED's, its radius and blur relative to it.
MIRROR_LEVEL = 0.28
MIRROR_RADIUS = 2.0
MIRROR_BLUR = 2.0

#: Height of the ceiling's lamps above the floor [m].
CEILING = 2.6

#: Beyond this distance from the axis (normalised coordinates) a lens polynomial is not to be trusted.
_FIELD_LIMIT = 1.3


FOLD_MARGIN = 0.02  # rad, from the angle at which a fisheye's image ends, within which nothing is drawn


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
    """The scenery of a simulated run, drawn by its seed."""
    ahead = [pose[0] for pose in world.scenario.poses]
    return scenery_along(min(ahead), max(ahead), stream(world.seed, "scenery"))


def scenery_along(first: float, last: float, rng: np.random.Generator) -> Scenery:
    """Make scenery for robots that drive from x = `first` to `last` [m].

    Ceiling lamps mirrored in the floor, shining specks on it, and windows.
    """
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


def backdrop(camera: Camera, T_world_camera: Array, scenery: Scenery, rng: np.random.Generator) -> Field:
    """The field (height, width) of a camera with no robot before it: dark, and bright things."""
    return bright(dark(camera, rng), camera, T_world_camera, scenery)


def dark(camera: Camera, rng: np.random.Generator) -> Field:
    """The field (height, width) of a camera in the dark."""
    x, y = np.linspace(-1, 1, camera.width), np.linspace(-1, 1, camera.height)[:, None]
    a, b, c = rng.uniform(-1, 1, 3)
    return np.asarray(19 - (5 + b) * y + 2.5 * a * x - (2 + c) * x**2, np.float32)


def bright(field: Field, camera: Camera, T_world_camera: Array, scenery: Scenery) -> Field:
    """The same with bright things in it."""
    w = len(scenery.windows)
    uv, depth, ok = _image_of(camera, T_world_camera, np.concatenate([scenery.windows.reshape(-1, 3), scenery.places]))
    corners, whole = uv[: 4 * w].reshape(w, 4, 2), ok[: 4 * w].reshape(w, 4).all(axis=1)
    for outline, level in zip(corners[whole], scenery.window_levels[whole].tolist(), strict=True):
        fill(field, outline, level)
    field = np.asarray(cv2.GaussianBlur(field, (0, 0), 1.2), np.float32)
    uv, depth, ok = uv[4 * w :], depth[4 * w :], ok[4 * w :]
    radius = camera.fx * scenery.radii[ok] / depth[ok]
    add_spots(field, spots(uv[ok], radius, scenery.levels[ok], psf_sigma=scenery.blurs[ok]))
    return field


def _image_of(camera: Camera, T_world_camera: Array, points_world: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Pixels (..., n, 2), depths (..., n) [m], and which points (..., n, 3) [m] are in the image or near it.

    The depth is that by which things look smaller: along the axis of a pinhole, along the ray of a fisheye.

    The camera stands at one pose (4, 4), or at as many as there are sets of points.
    """
    points = (points_world - T_world_camera[..., None, :3, 3]) @ T_world_camera[..., :3, :3]
    if camera.model == "fisheye":
        distance = np.linalg.norm(points, axis=-1)
        limit = np.cos(fisheye.largest_angle(camera.distortion) - FOLD_MARGIN)
        return camera.project(points)[0], distance, (distance > 0.05) & (points[..., 2] > limit * distance)
    depth = points[..., 2]
    ok = np.asarray((depth > 0.05) & (np.hypot(points[..., 0], points[..., 1]) < _FIELD_LIMIT * depth))
    return camera.project(points)[0], depth, ok


def frames(world: World, k: int, capture: Capture, scenery: Scenery, sensor: Sensor | None = None) -> Iterator[Image]:
    """Render the images of one observer in stance k, in time order."""
    sensor = sensor or Sensor()
    index = world.team.names.index(capture.robot)
    rng = stream(world.seed, "sensor", k * len(world.team.names) + index)
    field = backdrop(capture.view.camera, capture.view.T_world_camera, scenery, rng)
    paint_landmarks(field, world, capture)
    others, place = others_in_view(world, capture, sensor), np.empty_like(field)
    for i, stamp in enumerate(capture.stamps.tolist()):
        seen = with_robots(field, others, i, place)
        yield Image(capture.robot, stamp, expose(seen, sensor, pixel_noise(rng, field.shape)))


def paint_landmarks(field: Field, world: World, capture: Capture) -> None:
    """Paint the tags of a world's landmarks as an observer sees them, in place."""
    for landmark in world.true_team.landmarks:
        if landmark.tag is not None:
            T_world_landmark = world.T_world_landmark[landmark.name]
            paint_tag(field, capture.view.camera, capture.view.T_world_camera, T_world_landmark, landmark.tag)


def others_in_view(
    world: World, capture: Capture, sensor: Sensor, mirrored: float = MIRROR_LEVEL
) -> list["RobotInView"]:
    """All other robots as an observer sees them."""
    half, camera, T_world_camera = sensor.exposure / 2, capture.view.camera, capture.view.T_world_camera
    others = []
    for name in world.team.names:
        if name != capture.robot:
            T_world_body = [world.paths[name].pose_at(capture.times + shift) for shift in (0.0, -half, half)]
            markers = world.true_team[name].markers
            p_body = np.zeros((0, 3)) if markers is None else markers.p_body
            others.append(RobotInView(camera, [T_world_camera] * 3, T_world_body, p_body, sensor, mirrored))
    return others


def draw(field: Field, others: Sequence["RobotInView"], i: int, sensor: Sensor, noise: Field | None) -> Pixels:
    """The image (height, width) of capture i: a backdrop with other robots before it, and noise of variance 1."""
    return expose(with_robots(field, others, i), sensor, noise)


def with_robots(field: Field, others: Sequence["RobotInView"], i: int, place: Field | None = None) -> Field:
    """A backdrop with other robots before it, at capture i; in `place` if there is one."""
    image = np.empty_like(field) if place is None else place
    image[:] = field
    for other in others:
        other.add_mirrored(image, i)
    # the far ones first: a near body hides what is behind it
    for other in sorted(others, key=lambda other: -float(other.distance[i])):
        other.paint(image, i)
    return image


class RobotInView:
    """One robot as another's camera sees it, over n captures.

    `T_world_camera`, each (4, 4) or (n, 4, 4), and `T_world_body`, each (n, 4, 4), are in the middle, at the beginning
    and at the end of the exposures. `p_body` (m, 3) [m] are its LEDs, of whose light the floor mirrors a part.
    """

    def __init__(
        self,
        camera: Camera,
        T_world_camera: Sequence[Array],
        T_world_body: Sequence[Array],
        p_body: Array,
        sensor: Sensor,
        mirrored: float = MIRROR_LEVEL,
    ) -> None:
        middle = T_world_body[0]
        #: How far it is from the camera (n,) [m].
        self.distance = np.linalg.norm(middle[:, :3, 3] - T_world_camera[0][..., :3, 3], axis=-1)
        leds = np.stack([_placed(T, p_body) for T in T_world_body])
        hull = np.broadcast_to(_placed(middle, _HULL), (3, len(middle), *_HULL.shape))
        points = np.concatenate([leds, leds * (1.0, 1.0, -1.0), hull], axis=2)
        cameras = np.stack([np.broadcast_to(T, (len(middle), 4, 4)) for T in T_world_camera])
        uv, depth, ok = _image_of(camera, cameras, points)  # (3, n, 2 m + hull)
        motion = uv[2] - uv[1]
        m = len(p_body)
        self._hull, self._visible = uv[0, :, 2 * m :], np.atleast_1d(ok[0, :, 2 * m :].all(axis=1))
        radius = camera.fx * LED_RADIUS / depth[0]

        def seen(which: slice, widen: float, level: float, blur: float) -> list[list[_Spot]]:
            columns = uv[0, :, which], widen * radius[:, which], motion[:, which], ok[0, :, which]
            psf = blur * sensor.psf_sigma
            return [
                [(*at, size, level, way, psf) for at, size, way, there in zip(*rows, strict=True) if there]
                for rows in zip(*(column.tolist() for column in columns), strict=True)
            ]

        self._leds = seen(slice(m), 1.0, sensor.led_level, 1.0)
        self._mirrored = seen(slice(m, 2 * m), MIRROR_RADIUS, mirrored * sensor.led_level, MIRROR_BLUR)

    def add_mirrored(self, field: Field, i: int) -> None:
        """Add what the floor mirrors of its LEDs."""
        for spot in self._mirrored[i]:
            add_spot(field, *spot)

    def paint(self, field: Field, i: int) -> None:
        """Paint its body over what is behind it, and add its LEDs."""
        if self._visible[i]:
            outline = np.asarray(cv2.convexHull(self._hull[i].astype(np.float32)))[:, 0]
            fill(field, outline, BODY_LEVEL)
        for spot in self._leds[i]:
            add_spot(field, *spot)


def _hull() -> Array:
    """The rim of a body at its bottom and its top, (48, 3) [m]."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = BODY_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([np.column_stack([circle, np.full(24, z)]) for z in (0.0, BODY_HEIGHT)])


_HULL = _hull()


def _placed(T_world_body: Array, p_body: Array) -> Array:
    """Points (n, m, 3) in the world [m] of points (m, 3) of bodies at poses (n, 4, 4)."""
    return np.asarray(np.einsum("nij,mj->nmi", T_world_body[:, :3, :3], p_body) + T_world_body[:, None, :3, 3])
