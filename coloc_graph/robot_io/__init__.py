"""Devices of a robot (no graph): wheels (docs/wheels.md), cameras (docs/cameras.md), the link (docs/link.md).

`create` has the driver `Create`, its watchdog and an emulator; `camera` has `open_camera`; `link` has the two ends of
the link, `CoordinatorLink` and `RobotLink`.
"""

from coloc_graph.robot_io.camera.open import open_camera
from coloc_graph.robot_io.camera.source import CameraSource, Frame
from coloc_graph.robot_io.create.driver import Create
from coloc_graph.robot_io.create.state import CreateState

__all__ = ["CameraSource", "Create", "CreateState", "Frame", "open_camera"]
