"""Devices of a robot: cameras, wheels, clocks, messages, coordination (knows devices; no graph).

`Create` drives wheels, and sees to it that they stop; docs/wheels.md. Its emulator is in `create_emulator`.
"""

from coloc_graph.robot_io.create import Create
from coloc_graph.robot_io.create_state import CreateState

__all__ = ["Create", "CreateState"]
