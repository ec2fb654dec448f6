"""What is shipped, and that the architecture is what it is said to be."""

import ast
import io
import re
import runpy
import subprocess
import sys
import tokenize
import tomllib
from importlib import resources

import pytest
from architecture import (
    DRAWING,
    LAYERS,
    MODULES,
    PACKAGE,
    RANK,
    ROOT,
    circles,
    drawing,
    imported_names,
    module_imports,
    room_of,
)
from packaging.specifiers import SpecifierSet

from coloc_graph._version import __version__

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

#: Rooms that read truth: to write it, to compare with it, or to show it.
READS_TRUTH = {"run", "evaluation", "results", "viewer", "cli", "__init__"}
TRUTH = {"read_truth", "read_true_team"}


def rooms_imported(path):
    for line, name in imported_names(path):
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


def test_a_users_own_backend_folder_does_not_get_in_the_way_nor_is_the_front_end_loaded_with_ours(tmp_path):
    for name in ("backend", "frontend", "robot_io", "run", "team"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('this is the user\\'s own')")
    script = (
        "import sys; sys.path.insert(0, '.'); import coloc_graph.backend; "
        "assert 'coloc_graph.frontend' not in sys.modules; import coloc_graph.frontend; "
        "assert 'backend' not in sys.modules; print(coloc_graph.backend.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "coloc_graph.backend\n"), done.stderr


def test_every_room_has_a_layer():
    rooms = {room_of(module) for module in MODULES}
    assert rooms == set(RANK), f"without a layer, or gone: {rooms ^ set(RANK)}"
    assert sum(len(rooms) for _, rooms in LAYERS) == len(RANK), "a room has two layers"


def test_imports_point_down_only():
    for module, path in MODULES.items():
        own = room_of(module)
        for line, room in rooms_imported(path):
            below = RANK[room] < RANK[own] or RANK[room] == RANK[own] == 0
            assert room == own or below, f"{path}, line {line}: {own} imports {room}, which is not below it"


def test_no_modules_import_each_other_in_a_circle():
    assert not circles(module_imports())


def test_a_circle_is_found():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set(), "e": {"a"}}
    assert circles(graph) == [{"b", "c"}]


def test_only_what_compares_with_truth_reads_it():
    for module, path in MODULES.items():
        names = {name.rsplit(".", 1)[1] for _, name in imported_names(path) if "." in name} & TRUTH
        assert not names or room_of(module) in READS_TRUTH, f"{module} reads the truth"
        rooms = {room for _, room in rooms_imported(path)}
        assert "simulation" not in rooms or room_of(module) in {
            "simulation",
            "experiments",
            "missions",
            "cli",
            "__init__",
        }, f"{module} knows the simulation"


def test_the_front_end_loads_no_back_end_and_experiments_no_plots():
    script = (
        "import sys, coloc_graph.frontend; assert 'coloc_graph.backend' not in sys.modules; "
        "import coloc_graph.experiments; assert 'matplotlib' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_back_end_knows_no_images_and_the_front_end_no_graph():
    for module, path in MODULES.items():
        tops = {name.split(".")[0] for _, name in imported_names(path)}
        if room_of(module) == "backend":
            assert not tops & {"cv2", "mcap"}, path
        if room_of(module) == "frontend":
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"gtsam\.\w*(Factor|Graph|Values|ISAM|noiseModel)", text), path


def test_no_file_is_a_drawer():
    drawers = {"utils", "util", "helpers", "helper", "common", "misc"}
    everything = [*MODULES.values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    assert not [path for path in everything if {path.stem, path.parent.name} & drawers]


MAX_MODULE_LINES = 340  # lines of code of a module, without docstrings, comments and blanks


def lines_of_code(text):
    """Number of lines with code, without docstrings."""
    code, skipped = set(), {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skipped:
            code |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node):
            code -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(code)


def test_no_module_has_grown_into_two():
    texts = {path.name: path.read_text(encoding="utf-8") for path in MODULES.values()}
    long = {name: text for name, text in texts.items() if text.count("\n") > MAX_MODULE_LINES}
    lengths = {name: lines_of_code(text) for name, text in long.items()}
    assert not {name: length for name, length in lengths.items() if length > MAX_MODULE_LINES}


def test_the_version_is_in_one_place_and_the_changelog_knows_it():
    assert PROJECT["project"]["dynamic"][0] == "version"
    top = re.search(r"(?m)^## \[(.+?)\] - (\d{4}-\d{2}-\d{2})$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert top and top[1] == __version__
    literal = re.compile(rf"""["']{re.escape(__version__)}["']""")
    files = [
        path
        for path in (*MODULES.values(), ROOT / "pyproject.toml")
        if literal.search(path.read_text(encoding="utf-8"))
    ]
    assert [path.name for path in files] == ["_version.py"]


def test_every_dependency_has_its_reason():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for dependency in PROJECT["project"]["dependencies"]:
        assert re.search(rf'"{re.escape(dependency)}",\s+# \S', text), dependency


def test_no_path_of_one_machine_is_in_the_package():
    for path in MODULES.values():
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


def test_the_drawing_of_the_architecture_is_up_to_date():
    assert DRAWING.read_text(encoding="utf-8") == drawing(), "run python scripts/architecture.py"


@pytest.mark.parametrize("url", ["https://example.org/team/coloc", ""])
def test_links_of_the_package_page_lead_to_the_repository_or_are_text(url, monkeypatch):
    given = {}
    monkeypatch.setattr("setuptools.setup", given.update)
    monkeypatch.setenv("PROJECT_URL", url)
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"), run_name="__main__")
    page, links = given["long_description"], given["project_urls"]
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert targets and all("://" in target for target in targets)
    assert any(target.startswith(f"{url}/blob/main/docs/") for target in targets) == bool(url)
    assert all(link.startswith(url) for link in links.values()) and bool(links) == bool(url)


def test_the_source_distribution_has_every_folder():
    manifest = (ROOT / "MANIFEST.in").read_text(encoding="utf-8")
    named = set(re.findall(r"[\w.-]+", manifest)) | {"coloc_graph"}
    here = {path for path in ROOT.iterdir() if path.is_dir() and not path.is_symlink()}
    made = {".git", ".venv", "build", "dist", "demo-out", "htmlcov"}
    folders = {path.name for path in here} - made
    missing = {name for name in folders if not name.startswith((".", "__")) and not name.endswith(".egg-info")} - named
    assert not missing, f"MANIFEST.in leaves out {missing}"
