"""Public names of the package by module, for the API reference and the test of its coverage."""

import inspect
from importlib import import_module
from types import ModuleType

#: Public modules in the order of the reference, with the names of those that have no `__all__`.
MODULES: dict[str, tuple[str, ...]] = {
    "coloc_graph.team": (),
    "coloc_graph.run": (),
    "coloc_graph.measurements": (),
    "coloc_graph.frontend": (),
    "coloc_graph.backend": (),
    "coloc_graph.pipeline.options": (),
    "coloc_graph.pipeline.batch": (),
    "coloc_graph.pipeline.solution": (),
    "coloc_graph.evaluation": (),
    "coloc_graph.results.folder": ("Config", "Result", "read_config", "read_result", "read_summary"),
    "coloc_graph.results.writer": ("write_result",),
    "coloc_graph.results.many_runs": ("Outcome", "result_folders", "runs_in", "solve_runs"),
    "coloc_graph.simulation": (),
    "coloc_graph.calibration": (),
    "coloc_graph.planning.plan": ("Plan", "PlannedStance", "read_plan", "write_plan"),
    "coloc_graph.exchange.tracks": ("import_tracks",),
    "coloc_graph.viewer": (),
    "coloc_graph.report": (),
    "coloc_graph.experiments": (),
    "coloc_graph.geometry.lie": (),
    "coloc_graph.geometry.se2": (),
    "coloc_graph.geometry.trajectory": ("Trajectory",),
    "coloc_graph.robot_io": (),
    "coloc_graph.robot_io.link.coordinator_link": ("CoordinatorLink",),
    "coloc_graph.robot_io.link.robot_link": ("RobotLink",),
    "coloc_graph.robot_io.link.messages": (),
    "coloc_graph.robot_io.create.emulator": ("CreateEmulator",),
    "coloc_graph.robot_io.create.physics": ("Physics", "Wall"),
    "coloc_graph.online.coordinator": ("Coordinator",),
    "coloc_graph.online.robot": ("RobotProgram",),
    "coloc_graph.errors": (),
}


def public_names(module: ModuleType) -> list[str]:
    """Public names of a module: those listed, those of its `__all__`, or the classes and functions it defines."""
    listed = MODULES.get(module.__name__) or getattr(module, "__all__", None)
    if listed:
        return sorted(listed)
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(value) or inspect.isfunction(value))
        and value.__module__ == module.__name__
    )


def homes() -> dict[str, list[str]]:
    """Names by the module in whose page they are described: the first that offers the same object."""
    seen: set[int] = set()
    found: dict[str, list[str]] = {}
    for path in MODULES:
        module = import_module(path)
        found[path] = []
        for name in public_names(module):
            value = getattr(module, name)
            described = inspect.isclass(value) or inspect.isfunction(value)
            if described and id(value) in seen:
                continue
            seen.add(id(value))
            found[path].append(name)
    return found


def home_of(name: str) -> str:
    """Module in whose page a name of `coloc_graph` itself is described."""
    value = getattr(import_module("coloc_graph"), name)
    for path, names in homes().items():
        module = import_module(path)
        if any(getattr(module, other) is value for other in names):
            return path
    raise LookupError(f"coloc_graph.{name} is in no module of docs/site/public_names.py")
