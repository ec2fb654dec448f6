"""Figures of a result (matplotlib) and the self-contained `report.html`.

The only package that imports matplotlib; import it only where a figure is made.
"""

from coloc_graph.report.hero import hero_figure
from coloc_graph.report.html import render_report
from coloc_graph.report.plots import error_figure, figure_svg, residual_figure, trajectories_figure

__all__ = [
    "error_figure",
    "figure_svg",
    "hero_figure",
    "render_report",
    "residual_figure",
    "trajectories_figure",
]
