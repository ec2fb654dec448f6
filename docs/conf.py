"""Sphinx configuration of the site: `make docs`. The pages are Markdown that also reads well in the repository."""

import inspect
import os
import sys
import warnings
from enum import Enum
from pathlib import Path
from types import MemberDescriptorType

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "site"), str(HERE.parent)]
os.environ.setdefault("MPLBACKEND", "agg")

from api_pages import describe_constant, module_markdown, restructured, top_markdown  # noqa: E402
from command_pages import commands_markdown  # noqa: E402
from field_pages import records_markdown, team_markdown  # noqa: E402
from pygments.lexers.special import TextLexer  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

from coloc_graph import __version__  # noqa: E402

warnings.filterwarnings("ignore", category=DeprecationWarning)

project = "coloc-graph"
author = "The coloc-graph authors"
copyright = "The coloc-graph authors; BSD 3-Clause"
release = version = __version__

suppress_warnings = ["misc.highlighting_failure"]  # mermaid, which repositories draw and Pygments does not know
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "sphinx.ext.intersphinx"]
exclude_patterns = ["_build", "site"]
source_suffix = {".md": "markdown"}
nitpicky = False
html_theme = "furo"
html_title = f"coloc-graph {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"sidebar_hide_name": False}
smartquotes = False
pygments_style, pygments_dark_style = "friendly", "monokai"

# Inventories are kept here, so that a build needs no network. numpy, scipy and gtsam publish theirs on the web only.
intersphinx_mapping = {"python": ("https://docs.python.org/3", "inventories/python.inv")}
intersphinx_timeout = 1

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
autosummary_generate = False  # numpydoc loads the extension
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"undoc-members": False}

#: Text of a generated part by the word in its marker, `<!-- generated: WORD -->`.
GENERATED = {
    "commands": commands_markdown,
    "team": team_markdown,
    "records": records_markdown,
    "names": top_markdown,
}
MARKER = "<!-- generated: "


def fill(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace the markers of a page by what is generated."""
    lines = source[0].splitlines()
    for index, line in enumerate(lines):
        if line.startswith(MARKER):
            word = line.removeprefix(MARKER).removesuffix(" -->")
            if word == "scene":
                lines[index] = scene_markdown(name)
            else:
                lines[index] = module_markdown(word) if word.startswith("coloc_graph.") else GENERATED[word]()
    source[0] = "\n".join(lines) + "\n"


def scene_markdown(page: str) -> str:
    """Frame with the viewer's scene, seen from a page."""
    source = "../" * page.count("/") + SCENE.name
    frame = f'<iframe class="scene" src="{source}" title="The viewer\'s scene of a solved run" loading="lazy"></iframe>'
    return f"```{{raw}} html\n{frame}\n```\n"


def is_plain_field(app: Sphinx, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    """Return True for fields of a class, which its docstring lists under Parameters; None leaves it to autodoc."""
    described = inspect.isroutine(value) or inspect.isclass(value) or isinstance(value, property | Enum)
    return True if what == "class" and (not described or isinstance(value, MemberDescriptorType)) else None


def mend_docstring(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Make a docstring safe for reStructuredText, and describe constants by their comment."""
    if what in ("data", "module") and isinstance(value, tuple | int | float | str | frozenset | dict):
        describe_constant(name, value, lines)
    restructured(lines)


def make_scene(app: Sphinx) -> None:
    """Simulate, solve and export the run that the page of the viewer's scene shows, unless it is there."""
    from coloc_graph.cli import main

    if SCENE.exists():
        return
    run, result = SCENE.parents[1] / "run.mcap", SCENE.parents[1] / "result"
    for command in (
        ["simulate", "hallway", "--stances", "8", "--seed", "3", "--mount-sigma", "1", "--out", str(run), "--force"],
        ["solve", str(run), "--out", str(result)],
        ["view", str(result), "--export", str(SCENE)],
    ):
        if main(command) != 0:
            raise SystemExit(f"coloc {' '.join(command)} failed")


SCENE = HERE / "_build" / "scene" / "html" / "scene.html"
SCENE.parent.mkdir(parents=True, exist_ok=True)
html_extra_path = ["_build/scene/html"]


def setup(app: Sphinx) -> None:
    """Connect what is generated."""
    app.add_lexer("csv", TextLexer)
    app.connect("builder-inited", make_scene)
    app.connect("source-read", fill)
    app.connect("autodoc-skip-member", is_plain_field)
    app.connect("autodoc-process-docstring", mend_docstring, priority=100)
