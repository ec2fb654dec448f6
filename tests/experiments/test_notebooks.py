"""The notebooks: they convert to .ipynb, run from top to bottom, and show what their text speaks of."""

from pathlib import Path

import jupytext
import nbclient
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))

# the warnings of the machinery that runs a notebook are not ours
pytestmark = pytest.mark.filterwarnings("default")


def test_there_is_one_for_each_experiment():
    assert [path.stem for path in NOTEBOOKS] == ["fig4", "fig5", "table1", "table2"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_its_figure(path, tmp_path):
    notebook = jupytext.read(path)
    assert notebook.metadata["jupytext"]["text_representation"]["format_name"] == "percent"
    kinds = [cell.cell_type for cell in notebook.cells]
    assert kinds[0] == "markdown" and notebook.cells[0].source.startswith("# ") and kinds.count("code") >= 3
    # what is edited in Jupyter comes back as the same cells
    back = jupytext.reads(jupytext.writes(notebook, "ipynb"), "ipynb")
    assert [(cell.cell_type, cell.source) for cell in back.cells] == [
        (cell.cell_type, cell.source) for cell in notebook.cells
    ]

    nbclient.NotebookClient(notebook, timeout=60, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    shown = [output.data["image/svg+xml"] for output in outputs if "image/svg+xml" in output.get("data", {})]
    assert len(shown) == 1 and shown[0].startswith("<svg")
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    assert "eq. (2)" in printed and "ours" in printed
    assert not list(tmp_path.iterdir()), "a notebook leaves files behind"
