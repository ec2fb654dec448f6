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


@pytest.fixture(scope="module")
def run_in_jupyter(tmp_path_factory):
    """Runs a notebook and returns its outputs; those of `make test` share a kernel, but no names."""
    import jupytext
    import nbclient
    import nbformat

    outputs, folder = {}, tmp_path_factory.mktemp("notebooks")

    def run(paths):
        notebooks = [jupytext.read(path) for path in paths]
        together = notebooks[0].copy()
        together.cells = []
        for notebook in notebooks:
            together.cells += [nbformat.v4.new_code_cell("%reset -f"), *notebook.cells]
        nbclient.NotebookClient(together, timeout=60, resources={"metadata": {"path": folder}}).execute()
        for path, notebook in zip(paths, notebooks, strict=True):
            code = [cell for cell in notebook.cells if cell.cell_type == "code"]
            outputs[path] = [output for cell in code for output in cell.outputs]
        assert not list(folder.iterdir()), "a notebook leaves files behind"

    def outputs_of(path):
        if path not in outputs:
            run([path] if path.stem in LONG else [one for one in NOTEBOOKS if one.stem not in LONG])
        return outputs[path]

    return outputs_of


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.long] * (path.stem in LONG)) for path in NOTEBOOKS],
)
def test_a_notebook_runs_and_shows_its_figure(path, run_in_jupyter):
    outputs = run_in_jupyter(path)
    assert not [output for output in outputs if output.output_type == "error"]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    if path.stem in TUTORIALS:
        assert TUTORIALS[path.stem] in printed
        return
    shown = [output.data["image/svg+xml"] for output in outputs if "image/svg+xml" in output.get("data", {})]
    assert len(shown) == 1 and shown[0].startswith("<svg")
    assert "eq. (2)" in printed and "ours" in printed
