"""The paper's experiments, simulated: Figs. 4 and 5, Tables I and II.

Each shows the paper's own figures, eq. (2) as the paper computes it, and our estimate, side by side. `fig4`, `fig5`,
`table1`, `table2` run one and return its result, which `save` writes as PNG, SVG and JSON. A run is simulated to a
file, opened, and measured by the front end.
"""

from coloc_graph.experiments.multi_step_results import Table1, Table2, table1, table2
from coloc_graph.experiments.output import Experiment, draw, require_output_folder, save
from coloc_graph.experiments.single_step import CELLS, Cell, measure_cells
from coloc_graph.experiments.single_step_results import Fig4, Fig5, fig4, fig5

__all__ = [
    "CELLS",
    "Cell",
    "Experiment",
    "Fig4",
    "Fig5",
    "Table1",
    "Table2",
    "draw",
    "fig4",
    "fig5",
    "measure_cells",
    "require_output_folder",
    "save",
    "table1",
    "table2",
]
