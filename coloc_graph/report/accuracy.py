"""Tables of a report on the accuracy of an estimate."""

import dataclasses
from html import escape

from coloc_graph.evaluation import Accuracy, RelativeError
from coloc_graph.report.page import DASH, many, number, table


def accuracy_section(accuracy: Accuracy) -> str:
    """Return the tables of an accuracy as HTML."""
    head = ["Robot", "True [cm]", "Est. [cm]", "Error [cm]", "Error [%]", "ATE [cm]", "End [cm]", "Heading [°]"]
    rows = [
        [
            escape(row.robot),
            number(100 * row.true_length, 1),
            number(100 * row.estimated_length, 1),
            number(100 * abs(row.length_error), 2),
            number(row.length_error_percent, 2),
            number(100 * row.ate, 2),
            number(100 * row.end_position_error, 2),
            number(row.heading_error_deg, 2),
        ]
        for row in accuracy.robots
    ]
    team = [number(100 * accuracy.ate, 2), number(100 * accuracy.end_position_error, 2)]
    foot = ["Team", *[""] * 4, *team, number(accuracy.heading_error_deg, 2)]
    note = (
        "Lengths are straight from the first to the last pose, as in the paper's Table II. ATE is the RMS position "
        "error over all poses; end and heading are those of the last pose, the team's its worst."
    )
    if accuracy.anees is not None:
        note += (
            f" NEES per degree of freedom: {number(accuracy.anees, 2)} over {many(accuracy.nees_poses, 'pose')}, "
            "expected 1."
        )
    first = f'<h2>Accuracy</h2>\n{table(head, rows, [0], foot)}\n<p class="soft">{note}</p>'
    return f"{first}\n{_errors_table(accuracy)}\n{_relative_table(accuracy)}"


def _errors_table(accuracy: Accuracy) -> str:
    """Return the table of errors over all poses, and each robot's NEES with its 95 % interval."""
    head = ["All poses", *("RMSE [cm]", "Mean", "Median", "Max"), *("RMSE [°]", "Mean", "Median", "Max"), "NEES",
            "95 % interval"]  # fmt: skip
    rows = []
    for row in accuracy.robots:
        spreads = [number(100 * value, 2) for value in dataclasses.astuple(row.translation)]
        spreads += [number(value, 2) for value in dataclasses.astuple(row.rotation_deg)]
        nees = [DASH, DASH]
        if row.nees is not None:
            interval = f"{number(row.nees.low, 2)}&nbsp;to&nbsp;{number(row.nees.high, 2)}"
            value = number(row.nees.mean, 2)
            nees = [value if row.nees.consistent else f'<span class="bad">{value}</span>', interval]
        rows.append([escape(row.robot), *spreads, *nees])
    note = (
        "Position and rotation over all poses. The NEES of a consistent estimate is in the interval in 95 % of runs; "
        "the interval is wide, since the errors of neighbouring poses are correlated."
    )
    return f'{table(head, rows, [0])}\n<p class="soft">{note}</p>'


def _relative_table(accuracy: Accuracy) -> str:
    """Return the table of relative errors, of the distances that some robot travelled."""
    which = [k for k, one in enumerate(accuracy.relative) if one.pairs]
    if not which:
        return ""
    head = ["Relative (RPE)", *(f"{accuracy.relative[k].distance:g} m" for k in which)]
    whose = [*((row.robot, row.relative) for row in accuracy.robots), ("Team", accuracy.relative)]
    rows = [[escape(name), *(_relative_cell(relative[k]) for k in which)] for name, relative in whose]
    note = "RMS error of translation, in % of the distance travelled, and of rotation between two poses that far apart."
    return f'{table(head, rows[:-1], [0], rows[-1])}\n<p class="soft">{note}</p>'


def _relative_cell(one: RelativeError) -> str:
    if not one.pairs:
        return DASH
    return f"{number(one.translation_percent, 2)}&nbsp;%, {number(one.rotation_deg, 2)}°"
