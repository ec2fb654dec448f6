"""The viewer: a team, its graph and its uncertainty in a browser. `Viewer` shows a `Scene`.

`scene`, `sources`, `motion`, `frame`, `plots`, `inspect` and `live` use numpy alone; the other modules use viser.
"""

from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.live import LivePoses, LiveStance
from coloc_graph.viewer.plan_editor import PlanEditor
from coloc_graph.viewer.plan_scene import scene_of_plan
from coloc_graph.viewer.pose_graphs import is_pose_graph, scene_of_pose_graph
from coloc_graph.viewer.scene import Edges, Layer, Scene, ShownPlan
from coloc_graph.viewer.sources import (
    empty_scene,
    is_run,
    scene_of_estimate,
    scene_of_result,
    scene_of_run,
    scene_of_solution,
    with_other,
)

__all__ = [
    "Edges", "Layer", "LivePoses", "LiveStance", "PlanEditor", "Scene", "ShownPlan", "Viewer", "empty_scene",
    "is_pose_graph", "is_run", "scene_of_estimate", "scene_of_plan", "scene_of_pose_graph", "scene_of_result",
    "scene_of_run", "scene_of_solution", "with_other",
]  # fmt: skip
