"""Pages in docs/: each begins with a complete example, which is run as it stands."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from coloc_graph.calibration import make_board
from coloc_graph.cli import main
from coloc_graph.simulation.boards import floor_poses, held_poses, render_boards
from coloc_graph.team import Camera, Mount

DOCS = Path(__file__).parents[1] / "docs"
#: Pages without an example, or whose example needs devices, a link in real time, or files that other tests make.
ELSEWHERE = {
    "benchmarks": "a table",
    "changelog": "CHANGELOG.md",
    "datasets": "a table",
    "design": "an overview",
    "examples": "tests/test_examples.py",
    "faq": "tests/test_site.py",
    "index": "tests/test_site.py",
    "missions": "tests/missions",
    "recording": "pictures",
    "cameras": "tests/robot_io",
    "experiments": "tests/experiments",
    "glossary": "a table",
    "import-tracks": "tests/team/test_team.py and tests/exchange/test_import_tracks.py",
    "link": "tests/robot_io",
    "online": "tests/online/test_demo.py",
    "own-recording": "tests/exchange/test_own_recording.py",
    "ros": "tests/exchange",
    "wheels": "tests/robot_io",
}
LONG = {"landmarks", "data-set", "many-runs"}  # for `make test-long`
PAGES = [
    pytest.param(path.stem, marks=[pytest.mark.long] * (path.stem in LONG))
    for path in sorted(DOCS.glob("*.md"))
    if path.stem not in ELSEWHERE
]
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def example(page):
    """Blocks of a page before its first section, each with its language."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    return BLOCK.findall(text.split("\n## ")[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder in which all examples run, with images of a board for the calibration; runs are shared by the pages."""
    folder = tmp_path_factory.mktemp("docs")
    camera = Camera(width=320, height=240, fx=301.0, fy=301.0, cx=159.5, cy=119.5)
    board, rng = make_board("7x5", 0.03), np.random.default_rng(4)
    mount = Mount(height=0.40, tilt_deg=25.0)
    for name, poses in (
        ("board", held_poses(rng, camera, board, 7)),
        ("floor", floor_poses(rng, camera, mount, board, 3, farthest=0.7)),
    ):
        (folder / name).mkdir()
        for index, image in enumerate(render_boards(rng, camera, board, poses)):
            cv2.imwrite(str(folder / name / f"{index}.png"), image)
    return folder, set()


def run(command, done):
    """Run a line of a shell block, unless another page has run the same before."""
    words = tuple(shlex.split(command, comments=True))
    if not words or words in done:
        return
    if words[0] == "mkdir":
        Path(words[-1]).mkdir(parents=True, exist_ok=True)
    elif words[0] == "printf":
        path = words[words.index(">") + 1]
        Path(path).write_text(words[1].encode().decode("unicode_escape"), encoding="utf-8")
    else:
        assert words[0] == "coloc", command
        # pages follow each other in one folder, and name their results alike
        force = ["--force"] if words[1] == "solve" else []
        done -= {other for other in done if "--out" in words and words[-1] in other}
        assert main([*words[1:], *force]) == 0, command
    done.add(words)


@pytest.mark.parametrize("page", PAGES)
def test_the_example_of_a_page_runs(page, folder, monkeypatch, capsys):
    blocks = example(page)
    assert blocks, f"docs/{page}.md does not begin with an example"
    monkeypatch.chdir(folder[0])
    for language, code in blocks:
        if language == "sh":
            for command in code.replace("\\\n", " ").splitlines():
                run(command, folder[1])
        else:
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(code, f"docs/{page}.md", "exec"), {"__name__": "__main__"})
    capsys.readouterr()


def test_links_of_the_pages_lead_somewhere():
    for path in [*DOCS.glob("*.md"), DOCS.parent / "README.md"]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", path.read_text(encoding="utf-8")):
            assert "://" in target or (path.parent / target).exists(), f"{path.name} links to {target}"
