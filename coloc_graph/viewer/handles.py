"""Handles of a scene in a viser server: made once, few for any size of the graph, and updated in place."""

from collections.abc import Mapping

import numpy as np
import viser
from numpy.typing import NDArray

from coloc_graph.geometry.lie import quaternion
from coloc_graph.viewer import meshes, palette
from coloc_graph.viewer.frame import NO_LINES, Batch, Frame, Lines, ViewState
from coloc_graph.viewer.landmarks import landmark_mesh, landmark_of
from coloc_graph.viewer.motion import extent
from coloc_graph.viewer.prepared import about_z
from coloc_graph.viewer.scene import TRUE, Scene

FLOOR_MARGIN = 2.0  # m of floor around the data
FINE_GRID_LIMIT = 60.0  # m, side of the largest floor with lines every half metre
FRUSTUM = 0.14  # m, depth of a camera's frustum
MAX_FRUSTUM_ANGLE = 2.4  # rad, at which the frustum of a fisheye ends: at pi it has no end
MAX_NAMES = 16  # robots; of larger teams no names are written
ONE_LABEL_SIZE = 8.0  # factor above which enlarged robots share one label
ESTIMATE_PX = 5.0  # px, width of the estimated trajectory
OTHER_PX = 2.0  # px, width of other methods' trajectories
TRUTH_PX = 1.3  # px, width of the true trajectory

Image = NDArray[np.uint8]


class GraphView:
    """Owner of every handle of a scene, used by the render thread alone.

    Unchanged values are not sent again.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, dark: bool = False) -> None:
        self.server = server
        self.names: tuple[str, ...] = ()
        self._sent: dict[str, NDArray[np.generic]] = {}
        self._places: dict[int, NDArray[np.float64]] = {}
        self._images: dict[str, Image | None] = {}
        self._labels: dict[str, str] = {}
        self._visible: dict[str, bool] = {}
        self._dark: bool | None = None
        self._reach = 0.0
        with server.atomic():
            self._floor = server.scene.add_grid("/floor", plane="xy", plane_opacity=1.0, shadow_opacity=0.2)
            self._make_robots(scene)
            self._make_graph()
            self.adopt(scene)
        self.fit_floor(scene, dark)

    def _make_robots(self, scene: Scene) -> None:
        add = self.server.scene
        self.robots, self._frustums, self._names, self._anchors, self._bodies = [], {}, [], [], []
        self.size = 1.0
        self._landmarks: dict[str, tuple[viser.FrameHandle, viser.MeshHandle | viser.GlbHandle, viser.LabelHandle]] = {}
        for name, colour in zip(scene.robots, palette.robot_colours(len(scene.robots)), strict=True):
            robot = scene.team[name] if scene.team is not None else None
            path, tint = f"/robots/{name}", np.asarray(colour)
            self.robots.append(add.add_frame(path, show_axes=False, visible=False))
            self._bodies.append(
                add.add_mesh_trimesh(f"{path}/body", meshes.robot_mesh(robot, colour), receive_shadow=False)
            )
            vertices, faces = meshes.ring(0.19, 0.215)
            self._anchors.append(
                add.add_mesh_simple(
                    f"{path}/anchor", vertices, faces, color=palette.flat(colour), position=(0, 0, 0.007),
                    visible=False, side="double", cast_shadow=False, receive_shadow=False,
                )
            )  # fmt: skip
            top = meshes.T_body_camera(robot)[2, 3]
            self._names.append(
                add.add_label(
                    f"{path}/name", name, position=(0, 0, max(top, 0.2) + 0.1), anchor="bottom-center",
                    visible=len(scene.robots) <= MAX_NAMES,
                )
            )  # fmt: skip
            if robot is not None and robot.camera_if_any is not None:
                T, camera = robot.mount.T_body_camera, robot.camera
                down = min(camera.field_of_view[1], MAX_FRUSTUM_ANGLE)
                self._frustums[name] = add.add_camera_frustum(
                    f"{path}/camera", fov=down,
                    aspect=camera.width / camera.height, scale=FRUSTUM, color=tint, thickness=2.0,
                    thickness_units="screen", wxyz=quaternion(T[:3, :3]), position=T[:3, 3], visible=False,
                    cast_shadow=False, receive_shadow=False,
                )  # fmt: skip

    def _make_graph(self) -> None:
        add, none = self.server.scene, NO_LINES
        self._lines: dict[str, viser.LineSegmentsHandle] = {}
        for name, thickness in (("edges", 2.0), ("edges_now", 4.0), ("rejected", 2.0), ("picked", 7.0),
                                ("sightings", 1.5), ("odometry", 1.5), ("planned", 2.0), ("markers_observed", 1.2),
                                ("markers_estimated", 2.5)):  # fmt: skip
            self._lines[name] = add.add_line_segments(
                f"/{name}", none.points, none.colours, thickness=thickness, thickness_units="screen"
            )
        nowhere = np.zeros((1, 3), np.float32)
        self._batches = {
            name: add.add_batched_meshes_simple(
                f"/{name}", *mesh, about_z(np.zeros(1)), nowhere, batched_scales=nowhere + 1e-6,
                opacity=opacity, lod="off", side="double", visible=False,
                cast_shadow=False, receive_shadow=False,
            )
            for name, mesh, opacity in (
                ("ellipses", meshes.disc(), 0.5),
                ("wedges", meshes.wedge(), 0.45),
                ("rings", meshes.ring(0.178, 0.186), 0.9),
            )
        }  # fmt: skip

    def adopt(self, scene: Scene) -> None:
        """Add handles for new layers and landmarks of a scene of the same robots."""
        for name in (layer.name for layer in scene.layers):
            if name not in self.names:
                self._lines[f"trajectory {name}"] = self.server.scene.add_line_segments(
                    f"/trajectories/{len(self.names)}", NO_LINES.points, NO_LINES.colours,
                    thickness=TRUTH_PX if name == TRUE else OTHER_PX if self.names else ESTIMATE_PX,
                    thickness_units="screen",
                )  # fmt: skip
                self.names += (name,)
        for number, name in enumerate(scene.landmarks.names):
            if name not in self._landmarks:
                self._add_landmark(scene, name)
            x, y = scene.landmarks.xy[number].tolist()
            self._landmarks[name][0].position = (x, y, 0.0)
            self._landmarks[name][0].wxyz = about_z(scene.landmarks.yaw[number])

    def _add_landmark(self, scene: Scene, name: str) -> None:
        add, path = self.server.scene, f"/landmarks/{name}"
        landmark = landmark_of(scene.team, name)
        body = add.add_mesh_trimesh(f"{path}/body", landmark_mesh(landmark), receive_shadow=False)
        label = add.add_label(f"{path}/name", name, position=(0, 0, 0.4), anchor="bottom-center")
        self._landmarks[name] = add.add_frame(path, show_axes=False), body, label

    def fit_floor(self, scene: Scene, dark: bool, aside: float = 0.0) -> None:
        """Fit the floor to a scene, with another result moved `aside` [m], in light or dark colours."""
        low, high = extent(scene)
        high = high + np.array([0.0, aside])
        size = high - low + 2 * FLOOR_MARGIN
        if dark == self._dark and size.max() <= self._reach:
            return
        self._dark, self._reach = dark, float(size.max()) * 1.3  # room to grow, so that it rarely grows
        middle = (low + high) / 2
        fine = size.max() < FINE_GRID_LIMIT
        cell = 0.5 if fine else float(10 ** np.floor(np.log10(size.max() / 20)))
        sides = np.ceil(np.maximum(size, self._reach * (0.5 if fine else 1.0)) / (2 * cell)) * 2 * cell
        corner = np.round(middle / cell) * cell
        with self.server.atomic():
            floor = self._floor
            floor.width, floor.height = float(sides[0]), float(sides[1])
            floor.position = (float(corner[0]), float(corner[1]), -0.002)
            floor.cell_size, floor.section_size = cell, 2 * cell if fine else 10 * cell
            floor.fade_distance = max(100.0, 3 * self._reach)
            floor.plane_color = (38, 42, 48) if dark else (250, 250, 252)
            floor.cell_color = (58, 63, 71) if dark else (226, 230, 236)
            floor.section_color = (84, 91, 101) if dark else (196, 203, 213)

    def _show(self, handle: viser.SceneNodeHandle, visible: bool) -> None:
        if self._visible.get(handle.name) is not visible:  # to ask viser costs more than to remember
            self._visible[handle.name] = handle.visible = visible

    def _assign_image(self, name: str, image: Image | None) -> None:
        frustum = self._frustums.get(name)
        if frustum is None or self._images.get(name) is image:
            return
        self._show(frustum, image is not None)
        if image is not None:
            frustum.image = image
        self._images[name] = image

    def apply(
        self,
        frame: Frame,
        state: ViewState,
        images: Mapping[str, Image | None] | None = None,
        markers_observed: Lines = NO_LINES,
        markers_estimated: Lines = NO_LINES,
    ) -> None:
        """Show a frame; `images` are by robot, None for a robot that sees nothing."""
        trajectories = {f"trajectory {name}": frame.trajectories.get(name, NO_LINES) for name in self.names}
        lines = trajectories | {
            "edges": frame.edges, "edges_now": frame.edges_now, "rejected": frame.rejected, "picked": frame.picked,
            "sightings": frame.sightings, "odometry": frame.odometry, "planned": frame.planned,
            "markers_observed": markers_observed, "markers_estimated": markers_estimated,
        }  # fmt: skip
        converted = {name: (one.points, palette.linear(one.colours)) for name, one in lines.items()}
        batches = {"ellipses": frame.ellipses, "wedges": frame.wedges, "rings": frame.rings}
        tints = {name: palette.linear(palette.flat(one.colours)) for name, one in batches.items()}
        with self.server.atomic():  # only assignments from here on
            self.move_robots(frame.poses)
            first = int(np.isfinite(frame.poses).all(axis=1).argmax())  # that is somewhere
            for number, handle in enumerate(self.robots):
                role = frame.roles[number]
                self._show(self._anchors[number], role == "anchor" and state.stays)
                text = handle.name.rsplit("/", 1)[1] + (f"  {role}" if role else "")
                if together := self.size > ONE_LABEL_SIZE:
                    text = ", ".join(one.name.rsplit("/", 1)[1] for one in self.robots)
                self._show(self._names[number], len(self.robots) <= MAX_NAMES and (number == first or not together))
                if self._labels.get(handle.name) != text:
                    self._names[number].text = self._labels[handle.name] = text
            for name, image in (images or {}).items():
                self._assign_image(name, image)
            for name, (points, colours) in converted.items():
                self._assign_lines(name, points, colours)
            for name, one in batches.items():
                self._assign_batch(name, one, tints[name])

    def enlarge(self, size: float) -> None:
        """Draw the robots `size` times as large as they are."""
        if size == self.size:
            return
        share, self.size = size / self.size, size
        with self.server.atomic():
            for body, anchor, name in zip(self._bodies, self._anchors, self._names, strict=True):
                body.scale = anchor.scale = size
                name.position = share * name.position
            for _, standing, name in self._landmarks.values():
                standing.scale, name.position = size, share * name.position
            for frustum in self._frustums.values():
                frustum.scale, frustum.position = FRUSTUM * size, share * frustum.position

    def move_robots(self, poses: NDArray[np.float64]) -> None:
        """Show the robots at poses (r, 4) of x, y, z, heading; hide those with NaN."""
        turned = about_z(np.nan_to_num(poses[:, 3]))
        for number, (handle, pose) in enumerate(zip(self.robots, poses, strict=True)):
            there = bool(np.isfinite(pose).all())
            self._show(handle, there)
            before = self._places.get(number)
            if not there or (before is not None and np.array_equal(before, pose)):
                continue
            self._places[number] = pose
            if before is None or not np.array_equal(before[:3], pose[:3]):
                handle.position = pose[:3]
            if before is None or before[3] != pose[3]:
                handle.wxyz = turned[number]

    def _assign_lines(self, name: str, points: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        handle = self._lines[name]
        self._show(handle, bool(len(points)))
        if len(points):
            self._send(handle, name, points=points, colors=colours)

    def _assign_batch(self, name: str, one: Batch, colours: NDArray[np.uint8]) -> None:
        handle = self._batches[name]
        self._show(handle, bool(len(one.wxyz)))
        if len(one.wxyz):
            self._send(
                handle, name, batched_wxyzs=one.wxyz, batched_positions=one.positions,
                batched_scales=one.scales, batched_colors=colours,
            )  # fmt: skip

    def _send(self, handle: viser.SceneNodeHandle, name: str, **parts: NDArray[np.generic]) -> None:
        """Assign changed arrays; comparing costs a tenth of sending."""
        for part, value in parts.items():
            key = f"{name} {part}"
            before = self._sent.get(key)
            if before is None or before.shape != value.shape or not (before == value).all():
                setattr(handle, part, value)
                self._sent[key] = value
