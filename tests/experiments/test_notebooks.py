"""The notebooks: they convert to .ipynb, run from top to bottom, and show what their text speaks of."""

from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.py"))
#: For `make test-long`: statistics, and the experiments whose functions and figures test_experiments.py runs.
LONG = {"honest_covariances", "fig4", "fig5", "table1"}
EXPERIMENTS = ("fig4", "fig5", "table1", "table2")
#: Notebooks of tutorials, and what each prints.
TUTORIALS = {
    "honest_covariances": "joint: NEES",
    "own_measurements": "the whole graph: is connected",
    "own_recording": "B in A: estimated",
}

# the warnings of the machinery that runs a notebook are not ours
pytestmark = pytest.mark.filterwarnings("default")


def test_there_is_one_for_each_experiment():
    assert [path.stem for path in NOTEBOOKS] == sorted([*EXPERIMENTS, *TUTORIALS])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_comes_back_from_jupyter_as_it_was(path):
    import jupytext  # takes seconds, which every process that collects tests would spend

    notebook = jupytext.read(path)
    assert notebook.metadata["jupytext"]["text_representation"]["format_name"] == "percent"
    kinds = [cell.cell_type for cell in notebook.cells]
    assert kinds[0] == "markdown" and notebook.cells[0].source.startswith("# ") and kinds.count("code") >= 2
    # what is edited in Jupyter comes back as the same cells
    back = jupytext.reads(jupytext.writes(notebook, "ipynb"), "ipynb")
    assert [(cell.cell_type, cell.source) for cell in back.cells] == [
        (cell.cell_type, cell.source) for cell in notebook.cells
    ]


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.long] * (path.stem in LONG)) for path in NOTEBOOKS],
)
def test_a_notebook_runs_and_shows_its_figure(path, tmp_path):
    import jupytext
    import nbclient

    notebook = jupytext.read(path)
    nbclient.NotebookClient(notebook, timeout=60, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    assert not list(tmp_path.iterdir()), "a notebook leaves files behind"
    if path.stem in TUTORIALS:
        assert TUTORIALS[path.stem] in printed
        return
    shown = [output.data["image/svg+xml"] for output in outputs if "image/svg+xml" in output.get("data", {})]
    assert len(shown) == 1 and shown[0].startswith("<svg")
    assert "eq. (2)" in printed and "ours" in printed
