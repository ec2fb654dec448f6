"""The site in docs/: tutorials run as they stand, the reference is complete, examples run, links lead somewhere."""

import argparse
import ast
import inspect
import json
import re
import sys
from importlib import import_module, util
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest
from mrclam_folder import make
from page_commands import run_line, run_script

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MAX_EXAMPLE_LINES = 40
FEWEST_EXAMPLES = 8
FEWEST_QUESTIONS = 30
ROUNDING = 0.25  # relative difference from the figures of docs/data-set.md above which the page is out of date
SHELL = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Examples that take more than a few seconds of CPU, and what pages that use them.
LONG_EXAMPLES = {"best_formation", "many_runs", "two_videos", "honest_covariances"}
LONG_PAGES = {"first-result", "evo", "two-videos", "covariances", "plan", "dask"}
#: Pages with the same first commands, which run in one folder and run these once.
TOGETHER = {"first-result", "evo"}
TUTORIALS = [*sorted((DOCS / "start").glob("*.md")), *sorted((DOCS / "concepts").glob("*.md"))]
TUTORIALS += sorted((DOCS / "tutorials").glob("*.md"))
WITH_COMMANDS = [path for path in TUTORIALS if SHELL.search(path.read_text(encoding="utf-8"))]


def marked(paths, long):
    return [pytest.param(path, id=path.stem, marks=[pytest.mark.long] * (path.stem in long)) for path in paths]


@pytest.fixture
def reference(monkeypatch):
    """Modules that make the reference, by name."""
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    yield lambda name: import_module(name)
    for name in ("public_names", "command_pages", "field_pages", "api_pages"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def shared_folder(tmp_path_factory):
    """Folder of pages that begin alike, and the commands that were run in it."""
    return tmp_path_factory.mktemp("pages"), set()


@pytest.fixture
def quiet_plots():
    matplotlib.use("agg")
    yield
    plt.close("all")


@pytest.mark.parametrize("page", marked(WITH_COMMANDS, LONG_PAGES))
def test_the_commands_of_a_page_run_as_they_stand(page, shared_folder, tmp_path, monkeypatch, capsys, quiet_plots):
    folder, done = shared_folder if page.stem in TOGETHER else (tmp_path, set())
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    if page.stem == "mrclam":
        make(tmp_path / "MRCLAM_Dataset6", seconds=8.0, robots=(1, 2))
    monkeypatch.chdir(folder)
    for block in SHELL.findall(page.read_text(encoding="utf-8")):
        for command in block.replace("\\\n", " ").splitlines():
            run_line(command, done)
    assert done
    capsys.readouterr()


@pytest.mark.long
def test_the_data_set_gives_what_its_page_says(shared_folder, monkeypatch, capsys):
    folder, done = shared_folder
    monkeypatch.chdir(folder)
    first = (DOCS / "start" / "first-result.md").read_text(encoding="utf-8")
    for command in "\n".join(SHELL.findall(first)).splitlines():
        run_line(command, done)
    page = (DOCS / "data-set.md").read_text(encoding="utf-8")
    for method, result in (("chain", "chain"), ("smooth", "smooth"), ("joint", "result")):
        row = re.search(rf"^\| [*`]+{method}`[^|]*\| ([\d.]+), ([\d.]+) % \| [^|]* \| [*]*([\d.]+) mm", page, re.M)
        accuracy = json.loads((folder / result / "summary.json").read_text(encoding="utf-8"))["accuracy"]
        assert 1e3 * accuracy["ate_m"] == pytest.approx(float(row[3]), rel=ROUNDING), method
        for robot, stated in zip("AB", row.groups(), strict=False):
            assert accuracy["length_error_percent"][robot] == pytest.approx(float(stated), rel=ROUNDING), method
    capsys.readouterr()


@pytest.mark.parametrize("script", marked(EXAMPLES, LONG_EXAMPLES))
def test_an_example_runs_and_draws_its_picture(script, tmp_path, monkeypatch, quiet_plots):
    monkeypatch.chdir(tmp_path)
    run_script(script)
    assert (tmp_path / f"{script.stem}.png").stat().st_size > 1000


def test_examples_are_short_many_and_on_the_site():
    page = (DOCS / "examples.md").read_text(encoding="utf-8")
    assert len(EXAMPLES) >= FEWEST_EXAMPLES
    for script in EXAMPLES:
        assert len(script.read_text(encoding="utf-8").splitlines()) < MAX_EXAMPLE_LINES, script.name
        assert f"images/examples/{script.stem}.png" in page and f"../examples/{script.name}" in page
        assert (DOCS / "images" / "examples" / f"{script.stem}.png").is_file()


def test_every_page_is_in_a_table_of_contents():
    listed = set()
    for path in DOCS.rglob("*.md"):
        for block in re.findall(r"^```\{toctree\}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.M | re.S):
            names = [line for line in block.splitlines() if line and not line.startswith(":")]
            listed |= {(path.parent / f"{name}.md").resolve() for name in names}
    pages = {path.resolve() for path in DOCS.rglob("*.md") if "_build" not in path.parts} - {
        (DOCS / "index.md").resolve()
    }
    assert pages == listed, {path.name for path in pages ^ listed}


def test_links_of_all_pages_lead_somewhere():
    for path in DOCS.rglob("*.md"):
        if "_build" in path.parts:
            continue
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text(encoding="utf-8")):
            assert "://" in target or (path.parent / target).exists(), f"{path.relative_to(DOCS)} links to {target}"


def test_every_public_name_is_in_the_reference_and_described(reference):
    names = reference("public_names")
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "reference").rglob("*.md"))
    for path, here in names.homes().items():
        assert not here or f"<!-- generated: {path} -->" in pages, f"{path} is in no page of docs/reference"
        module = import_module(path)
        for name in here:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert (inspect.getdoc(value) or "").strip(), f"{path}.{name} has no docstring"
    for name in import_module("coloc_graph").__all__:
        assert name.startswith("_") or names.home_of(name)


def test_a_constant_is_described_by_its_comment(reference):
    """Whatever is imported besides, a module that is compiled too."""
    for name in ("frontend.compiled", "robot_io.deadlines"):
        import_module(f"coloc_graph.{name}")
    lines = [(float.__doc__ or "").strip().splitlines()[0]]
    reference("api_pages").describe_constant("coloc_graph.robot_io.deadlines.PERMISSION_LEASE", 0.18, lines)
    assert lines[0].startswith("a robot gives up its drive") and "``0.18``" in lines[2]


def test_modules_that_pages_name_are_public_or_files_that_exist(reference):
    """Every `import` of an example or page comes from a module of the reference, or is named in a page as internal."""
    public = set(reference("public_names").MODULES) | {"coloc_graph"}
    shown = "\n".join(path.read_text(encoding="utf-8") for path in EXAMPLES)
    for module in re.findall(r"^\s*from (coloc_graph[\w.]*) import", shown, re.MULTILINE):
        assert any(module == one or module.startswith(f"{one}.") for one in public | {"coloc_graph.planning"}), module


def test_questions_quote_messages_of_the_program():
    constants = [(ROOT / "setup.py").read_text(encoding="utf-8")]
    for path in (ROOT / "coloc_graph").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                constants.append("".join(v.value if isinstance(v, ast.Constant) else "{}" for v in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                constants.append(node.value)
    messages = "\n".join(" ".join(text.split()) for text in constants)
    headings = re.findall(r"^### (.*)$", (DOCS / "faq.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(headings) >= FEWEST_QUESTIONS
    quoted = [part for heading in headings for part in re.findall(r'"([^"]+)"', heading)]
    parts = [part.strip(" ,:;") for message in quoted for part in message.split("...")]
    assert not [part for part in parts if part and part not in messages]


def test_every_option_is_in_the_reference(reference):
    pages = reference("command_pages")
    text = pages.commands_markdown()
    for one in pages.parsers():
        assert f"## {one.prog}\n" in text
        section = text.split(f"## {one.prog}\n")[1].split("\n## ")[0]
        for action in one._actions:
            if isinstance(action, argparse._HelpAction) or action.help is argparse.SUPPRESS:
                continue
            for option in action.option_strings or action.choices or [action.metavar or action.dest]:
                assert str(option) in section, f"{one.prog} {option}"


def test_every_field_of_a_team_and_of_a_record_is_described(reference):
    pages = reference("field_pages")
    for text in (pages.team_markdown(), pages.records_markdown()):
        rows = re.findall(r"^\| `(\w+)` \| (.*?) \| .*? \| (.*) \|$", text, re.MULTILINE)
        assert len(rows) > 20
        assert not [name for name, kind, meaning in rows if not meaning.strip()], text


@pytest.mark.long
def test_the_site_builds_without_a_warning(tmp_path):
    if util.find_spec("sphinx") is None or util.find_spec("furo") is None:
        pytest.skip("Sphinx is not installed: pip install '.[docs]'")
    from sphinx.cmd.build import build_main

    assert build_main(["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(tmp_path / "html")]) == 0
    inventory = (tmp_path / "html" / "objects.inv").read_bytes()
    assert len(inventory) > 1000 and (tmp_path / "html" / "scene.html").is_file()
