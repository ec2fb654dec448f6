"""Drawing an experiment, and writing it as NAME.png, NAME.svg and NAME.json to a folder."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coloc_graph._version import __version__
from coloc_graph.errors import InputError
from coloc_graph.experiments.multi_step_results import Table1, Table2
from coloc_graph.experiments.single_step_results import Fig4, Fig5

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: A measured experiment: `name`, a table of text (`header`, `rows`), a sentence (`summary`) and `numbers()` for JSON.
Experiment = Fig4 | Fig5 | Table1 | Table2


def draw(experiment: Experiment) -> "Figure":
    """Draw the figure of an experiment, laid out as in the paper."""
    from coloc_graph.experiments.figures_multi_step import table1_figure, table2_figure
    from coloc_graph.experiments.figures_single_step import fig4_figure, fig5_figure

    match experiment:
        case Fig4():
            return fig4_figure(experiment)
        case Fig5():
            return fig5_figure(experiment)
        case Table1():
            return table1_figure(experiment)
        case Table2():
            return table2_figure(experiment)


def as_json(experiment: Experiment) -> dict[str, Any]:
    """An experiment's numbers, with what made them."""
    return {"experiment": experiment.name, "version": __version__, **experiment.numbers()}


def require_output_folder(out: str | Path, name: str, *, force: bool = True) -> None:
    """Raise `InputError` where an experiment's files cannot go to `out`, or exist there and `force` is not given."""
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} exists and is not a folder; give another place, or remove it")
    if out.is_dir() and any(out.iterdir()) and not any(out.glob("*.json")):
        raise InputError(f"{out} holds something else than experiments; give another folder, or empty it")
    if not force and (there := [path for path in _paths(out, name) if path.exists()]):
        raise InputError(f"{there[0]} exists; replace it with --force, or give another folder")
    above = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    if not above.is_dir():
        raise InputError(f"{out} cannot be made, since {above} is not a folder; give another folder")
    if not os.access(above, os.W_OK):
        raise InputError(f"{out} cannot be written, since {above} is not yours to write to; give another folder")


def _paths(out: Path, name: str) -> tuple[Path, Path, Path]:
    """Return the paths of an experiment's picture, drawing and numbers."""
    return out / f"{name}.png", out / f"{name}.svg", out / f"{name}.json"


def save(experiment: Experiment, out: str | Path) -> tuple[Path, Path, Path]:
    """Write the figure as PNG and SVG and the numbers as JSON to the folder `out`; returns the three paths.

    Earlier files of the same experiment are replaced, others are left alone.
    """
    from coloc_graph.experiments.style import png_bytes
    from coloc_graph.report import figure_svg

    out = Path(out)
    require_output_folder(out, experiment.name)
    png, svg, numbers = _paths(out, experiment.name)
    figure = draw(experiment)
    picture, text = png_bytes(figure), figure_svg(figure, experiment.name)
    out.mkdir(parents=True, exist_ok=True)
    png.write_bytes(picture)
    svg.write_text(text + "\n", encoding="utf-8")
    numbers.write_text(json.dumps(as_json(experiment), indent=1) + "\n", encoding="utf-8")
    return png, svg, numbers
