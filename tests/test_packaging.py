"""What is shipped, and that the architecture is what it is said to be."""

import ast
import re
import runpy
import subprocess
import sys
import tomllib
from importlib import resources
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from coloc_graph._version import __version__

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "coloc_graph"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MODULES = sorted(PACKAGE.rglob("*.py"))

#: The layers from the bottom: a part imports itself and what is in the rows above it, never beside or below it.
LAYERS = [
    {"_version", "errors", "keyframes", "lie", "trajectory", "measurements"},
    {"team", "workers", "whole_file"},
    {"run", "common_view"},
    {"frontend", "backend", "robot_io", "evaluation", "calibration"},
    {"driving", "simulation", "stance_solver"},
    {"exchange", "pipeline", "inspection"},
    {"report", "online"},
    {"results"},
    {"drive_results", "experiments", "viewer", "many_runs", "comparison"},
    {"cli"},
]
RANK = {part: rank for rank, parts in enumerate(LAYERS) for part in parts}
#: Only what compares with truth, or shows it, reads it.
TRUTH = {"read_truth", "read_true_team"}
READS_TRUTH = {"run", "drive_results", "evaluation", "results", "comparison", "viewer", "cli"}


def part_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path):
    """All modules of ours that a file imports, also inside of functions, as (line, dotted name)."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}, line {node.lineno}: a relative import hides its layer"
            for alias in node.names:
                yield node.lineno, f"{node.module}.{alias.name}"


def parts_imported(path):
    for line, name in imports(path):
        words = name.split(".")
        if words[0] == "coloc_graph" and words[1] in RANK:
            yield line, words[1]


def test_requires_python_is_where_gtsam_has_wheels():
    versions = SpecifierSet(PROJECT["project"]["requires-python"])
    assert [v for v in range(8, 18) if f"3.{v}.0" in versions] == [11, 12, 13, 14]
    assert "3.14.9" in versions


def test_the_root_shows_the_three_parts():
    for name in ("frontend", "backend", "robot_io"):
        link = ROOT / name
        assert link.is_symlink() and not link.readlink().is_absolute()
        assert link.resolve() == (PACKAGE / name).resolve()


def test_types_are_shipped():
    assert resources.files("coloc_graph").joinpath("py.typed").is_file()
    assert "py.typed" in PROJECT["tool"]["setuptools"]["package-data"]["coloc_graph"]


def test_only_our_own_package_is_installed():
    """A top-level package `backend` or `frontend` would overwrite a user's own without a word."""
    from setuptools import find_packages

    found = find_packages(ROOT, include=PROJECT["tool"]["setuptools"]["packages"]["find"]["include"])
    assert "coloc_graph.backend" in found
    assert {name.split(".")[0] for name in found} == {"coloc_graph"}
    packages = {str(p.parent.relative_to(ROOT)).replace("/", ".") for p in PACKAGE.rglob("__init__.py")}
    assert set(found) == packages


def test_a_users_own_backend_folder_does_not_get_in_the_way(tmp_path):
    for name in ("backend", "frontend", "robot_io", "run", "team"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('this is the user\\'s own')")
    script = (
        "import sys; sys.path.insert(0, '.'); import coloc_graph.backend, coloc_graph.frontend; "
        "assert 'backend' not in sys.modules; print(coloc_graph.backend.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "coloc_graph.backend\n"), done.stderr


def test_every_part_has_its_layer():
    parts = {part_of(path) for path in MODULES} - {"__init__"}
    assert parts <= set(RANK), f"give {parts - set(RANK)} a layer"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_arrows_point_down_only(path):
    own = part_of(path)
    if own == "__init__":
        assert {part for _, part in parts_imported(path)} <= {"_version"}
        return
    for line, part in parts_imported(path):
        below = RANK[part] < RANK[own] or (RANK[part] == 0 and RANK[own] == 0)
        assert part == own or below, f"line {line}: {own} imports {part}, which is not below it"


def test_nothing_but_evaluation_can_come_upon_the_truth():
    for path in MODULES:
        names = {name.rsplit(".", 1)[1] for _, name in imports(path) if "." in name} & TRUTH
        assert not names or part_of(path) in READS_TRUTH, f"{path.name} reads the truth"
        parts = {part for _, part in parts_imported(path)}
        assert "simulation" not in parts or part_of(path) in {"simulation", "experiments", "cli"}, (
            f"{path.name} knows the simulation"
        )


@pytest.mark.parametrize(("part", "other"), [("frontend", "backend"), ("backend", "frontend")])
def test_importing_one_end_does_not_load_the_other(part, other):
    script = f"import sys, coloc_graph.{part}; sys.exit('coloc_graph.{other}' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == 0


def test_the_back_end_knows_no_images_and_the_front_end_no_graph():
    for path in MODULES:
        tops = {name.split(".")[0] for _, name in imports(path)}
        if part_of(path) == "backend":
            assert not tops & {"cv2", "mcap"}, path
        if part_of(path) == "frontend":
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"gtsam\.\w*(Factor|Graph|Values|ISAM|noiseModel)", text), path


def test_no_file_is_a_drawer():
    drawers = {"utils", "util", "helpers", "helper", "common", "misc"}
    everything = [*MODULES, *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    assert not [path for path in everything if {path.stem, path.parent.name} & drawers]


#: Modules that want to be two, and how long they may be until they are.
GROWN = {"coordinator.py": 555, "app.py": 480}


def test_no_module_has_grown_into_two():
    lines = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert not [name for name, length in lines.items() if length > GROWN.get(name, 420)]


def test_the_version_is_in_one_place_and_the_changelog_knows_it():
    assert PROJECT["project"]["dynamic"] == ["version"]
    top = re.search(r"(?m)^## \[(.+?)\] - (\d{4}-\d{2}-\d{2})$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert top and top[1] == __version__
    literal = re.compile(rf"""["']{re.escape(__version__)}["']""")
    files = [path for path in (*MODULES, ROOT / "pyproject.toml") if literal.search(path.read_text(encoding="utf-8"))]
    assert [path.name for path in files] == ["_version.py"]


def test_every_dependency_has_its_reason():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for dependency in PROJECT["project"]["dependencies"]:
        assert re.search(rf'"{re.escape(dependency)}",\s+# \S', text), dependency


def test_no_path_of_one_machine_is_in_the_package():
    for path in MODULES:
        assert not re.search(r"[\"'(\s]/(home|Users|root|work|tmp)/", path.read_text(encoding="utf-8")), path


@pytest.mark.parametrize(("version", "platform", "words"), [
    ((3, 10, 13), "linux", "needs CPython 3.11 to 3.14.*this is 3.10"),
    ((3, 15, 0), "linux", "needs CPython 3.11 to 3.14.*this is 3.15"),
    ((3, 12, 0), "win32", "no wheels for Windows"),
])  # fmt: skip
def test_an_unsupported_python_or_system_is_told_in_words_before_anything_is_installed(
    monkeypatch, version, platform, words
):
    monkeypatch.setattr(sys, "version_info", version)
    monkeypatch.setattr(sys, "platform", platform)
    with pytest.raises(SystemExit, match=words):
        runpy.run_path(str(ROOT / "setup.py"), run_name="__main__")
