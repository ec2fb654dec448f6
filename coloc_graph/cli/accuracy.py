"""The table of the paper's Table II."""

from coloc_graph.cli.printing import print_table
from coloc_graph.evaluation import Accuracy


def print_accuracy(accuracy: Accuracy) -> None:
    """Per robot true length, estimated length, error in cm and %; then the team's figures."""
    rows = []
    for row in accuracy.robots:
        percent = row.length_error_percent
        rows.append(
            [
                row.robot,
                f"{100 * row.true_length:.1f} cm",
                f"{100 * row.estimated_length:.1f} cm",
                f"{100 * abs(row.length_error):.2f} cm",
                "-" if percent is None else f"{percent:.2f} %",
                f"{100 * row.end_position_error:.2f} cm",
                f"{row.heading_error_deg:.2f} deg",
            ]
        )
    print_table(["robot", "true", "estimated", "error", "error rate", "end position", "heading"], rows)
    anees = "-" if accuracy.anees is None else f"{accuracy.anees:.2f} over {accuracy.nees_poses} poses (1 is honest)"
    print(f"RMS position error of all poses {100 * accuracy.ate:.2f} cm; average NEES per degree of freedom {anees}")
