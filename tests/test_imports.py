"""What an import loads: a robot's computer needs no graph, and a package's face loads nothing."""

import subprocess
import sys

import pytest

from coloc_graph import frontend


def loaded_by(statement: str) -> set[str]:
    """The modules that a new interpreter has loaded after a statement."""
    shown = subprocess.run(
        [sys.executable, "-c", f"import sys; {statement}; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(shown.stdout.split())


def test_a_robot_loads_no_graph_and_no_pictures():
    loaded = loaded_by("import coloc_graph.online.robot")
    assert "coloc_graph.frontend.images.detection" in loaded
    unwanted = ("gtsam", "scipy.stats", "scipy.optimize", "matplotlib", "viser", "coloc_graph.backend")
    assert not [name for name in loaded if name.startswith(unwanted)]


def test_below_the_back_end_nothing_loads_gtsam():
    below = ("measurements", "team", "run", "frontend.stance", "frontend.stance_sightings")
    assert "gtsam" not in loaded_by(f"import {', '.join(f'coloc_graph.{module}' for module in below)}")


def test_the_names_of_the_front_end_are_there_when_asked_for():
    assert set(frontend.__all__) <= set(dir(frontend))
    for name in frontend.__all__:
        assert getattr(frontend, name).__module__.startswith("coloc_graph.frontend") or name == "Scale"
    with pytest.raises(AttributeError, match=r"module 'coloc_graph.frontend' has no attribute 'nothing'"):
        frontend.nothing  # noqa: B018
