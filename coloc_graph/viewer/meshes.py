"""Meshes: a robot with its markers and its camera, a disc, a ring, a wedge."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from coloc_graph.geometry.lie import rotation_x, se3
from coloc_graph.report.hero import BODY_RADIUS
from coloc_graph.team import Robot
from coloc_graph.viewer.palette import Colours

Array = NDArray[np.float64]

BODY_HEIGHT = 0.09  # m, height of a robot's body
BAND = 0.03  # m, height of the band in the robot's colour
LED_RADIUS = 0.014  # m, radius of a marker as drawn
_DARK = (46, 50, 57)
_PLATE = (226, 229, 233)
LED = (255, 244, 190)
PLAIN_CAMERA_HEIGHT = 0.25  # m, of a robot that is not described


def robot_mesh(robot: Robot | None, colour: Colours) -> trimesh.Trimesh:
    """A robot in its body frame: a round base with a band of its colour, a nose, markers on posts, a camera's mast."""
    tint = tuple(int(value) for value in colour)
    parts = [
        painted(cylinder(BODY_RADIUS, 0.02, BODY_HEIGHT - 0.02), _DARK),
        painted(cylinder(BODY_RADIUS + 0.004, BODY_HEIGHT - 0.02 - BAND, BAND), tint),
        painted(cylinder(BODY_RADIUS - 0.012, BODY_HEIGHT - 0.02, 0.004), _PLATE),
        painted(_nose(BODY_HEIGHT - 0.012), tint),
    ]
    for side in (-1, 1):
        T_wheel = se3(rotation_x(np.pi / 2), np.array([0, side * 0.125, 0.032]))
        wheel = trimesh.creation.cylinder(0.032, 0.03, sections=24)
        wheel.apply_transform(T_wheel)
        parts.append(painted(wheel, (28, 30, 34)))
    markers = None if robot is None else robot.markers
    for x, y, z in np.zeros((0, 3)) if markers is None else markers.p_body:
        parts.append(painted(cylinder(0.005, BODY_HEIGHT - 0.02, max(z - BODY_HEIGHT + 0.02, 0.01), (x, y)), _DARK))
        led = trimesh.creation.icosphere(2, LED_RADIUS)
        led.apply_translation((x, y, z))
        parts.append(painted(led, LED))
    parts += _camera(robot)
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def T_body_camera(robot: Robot | None) -> Array:
    """Extrinsics of a robot's camera, (4, 4); ahead and a little up if they are not known."""
    if robot is not None and robot.mount_if_any is not None:
        return robot.mount_if_any.T_body_camera
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[2, 3] = PLAIN_CAMERA_HEIGHT
    return T


def disc(sections: int = 28) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices and faces of a unit disc in x, y, its face up."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(sections)], axis=1)
    n = np.arange(sections)
    faces = np.stack([np.full(sections, sections), n, (n + 1) % sections], axis=1)
    return np.vstack([rim, np.zeros(3)]).astype(np.float32), faces.astype(np.uint32)


def ring(inner: float, outer: float, sections: int = 32) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices and faces of a flat ring between two radii [m], its face up."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(sections)], axis=1)
    a = np.arange(sections)
    b = (a + 1) % sections
    faces = np.concatenate([np.stack([a, a + sections, b], 1), np.stack([b, a + sections, b + sections], 1)])
    return np.vstack([inner * circle, outer * circle]).astype(np.float32), faces.astype(np.uint32)


def wedge() -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices and faces of a triangle with its point at the origin, that opens to x = 1 and y from -1 to 1."""
    return np.array([[0, 0, 0], [1, -1, 0], [1, 1, 0]], np.float32), np.array([[0, 1, 2]], np.uint32)


def _camera(robot: Robot | None) -> list[trimesh.Trimesh]:
    T = T_body_camera(robot)
    x, y, z = T[:3, 3]
    box = trimesh.creation.box((0.07, 0.05, 0.04))
    box.apply_translation((0, 0, -0.022))  # the optical centre is in its face
    box.apply_transform(T)
    lens = trimesh.creation.cylinder(0.014, 0.012, sections=24)
    lens.apply_transform(T)
    top = max(z - 0.02, BODY_HEIGHT)
    mast = cylinder(0.009, BODY_HEIGHT - 0.02, top - BODY_HEIGHT + 0.02, (x - 0.02, y))
    return [painted(mast, (120, 126, 134)), painted(box, _DARK), painted(lens, (12, 14, 18))]


def cylinder(radius: float, z: float, height: float, at: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    """An upright cylinder that begins at a height [m]."""
    mesh: trimesh.Trimesh = trimesh.creation.cylinder(radius, height, sections=40)
    mesh.apply_translation((*at, z + height / 2))
    return mesh


def _nose(z: float) -> trimesh.Trimesh:
    """An arrow on the plate that points ahead."""
    outline = np.array([[0.13, 0.0], [0.03, 0.055], [0.055, 0.0], [0.03, -0.055]])
    low, high = (np.column_stack([outline, np.full(4, height)]) for height in (z - 0.004, z))
    sides = [face for a in range(4) for b in [(a + 1) % 4] for face in ((a, b, a + 4), (b, b + 4, a + 4))]
    faces = [*sides, (4, 5, 6), (4, 6, 7), (0, 2, 1), (0, 3, 2)]
    mesh = trimesh.Trimesh(np.vstack([low, high]), faces)
    mesh.fix_normals()
    return mesh


def painted(mesh: trimesh.Trimesh, colour: tuple[int, ...]) -> trimesh.Trimesh:
    """The mesh, all of one colour."""
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.tile([*colour, 255], (len(mesh.vertices), 1)))
    return mesh
