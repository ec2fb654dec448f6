"""What an experiment's result can do, and how it is written: NAME.png, NAME.svg and NAME.json in a folder."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from coloc_graph._version import __version__
from coloc_graph.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Experiment(Protocol):
    """A measured experiment: a table of text, a sentence, all numbers, and a figure."""

    @property
    def name(self) -> str:
        """What it reproduces, as the command names it."""

    @property
    def header(self) -> Sequence[str]:
        """The table's columns."""

    @property
    def rows(self) -> Sequence[Sequence[str]]:
        """The table's rows, as wide as the header."""

    @property
    def summary(self) -> str:
        """The result in a sentence."""

    def numbers(self) -> dict[str, Any]:
        """Everything that the figure and the table show, for JSON."""

    def figure(self) -> "Figure":
        """The picture."""


def as_json(experiment: Experiment) -> dict[str, Any]:
    """An experiment's numbers, with what made them."""
    return {"experiment": experiment.name, "version": __version__, **experiment.numbers()}


def require_place(out: str | Path, name: str) -> None:
    """Raise `InputError` where an experiment's files cannot go to `out`, or something else is there."""
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} exists and is not a folder; give another place, or remove it")
    if out.is_dir() and any(out.iterdir()) and not any(out.glob("*.json")):
        raise InputError(f"{out} holds something else than experiments; give another folder, or empty it")
    above = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    if not above.is_dir():
        raise InputError(f"{out} cannot be made, since {above} is not a folder; give another folder")
    if not os.access(above, os.W_OK):
        raise InputError(f"{out} cannot be written, since {above} is not yours to write to; give another folder")


def save(experiment: Experiment, out: str | Path) -> tuple[Path, Path, Path]:
    """Write the figure as PNG and SVG and the numbers as JSON to the folder `out`; returns the three paths.

    Earlier files of the same experiment are replaced, others are left alone.
    """
    from coloc_graph.experiments.style import png_bytes
    from coloc_graph.report import figure_svg

    out = Path(out)
    require_place(out, experiment.name)
    png, svg, numbers = (out / f"{experiment.name}.{kind}" for kind in ("png", "svg", "json"))
    figure = experiment.figure()
    picture, text = png_bytes(figure), figure_svg(figure, experiment.name)
    out.mkdir(parents=True, exist_ok=True)
    png.write_bytes(picture)
    svg.write_text(text + "\n", encoding="utf-8")
    numbers.write_text(json.dumps(as_json(experiment), indent=1) + "\n", encoding="utf-8")
    return png, svg, numbers
