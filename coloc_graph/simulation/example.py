"""The example run that comes with the package: `write_example`."""

from importlib.resources import files
from pathlib import Path

from coloc_graph.run.atomic_file import write_atomically

EXAMPLE = "leapfrog.mcap"  # made once by scripts/example_run.py; the same file in every version


def write_example(out: str | Path) -> None:
    """Write the example run to a file.

    Notes
    -----
    A leap-frog of 12 stances with ground truth. Marker centres were detected in rendered images; docs/data-set.md
    describes it, and what each method gets on it.
    """
    write_atomically(Path(out), (files("coloc_graph.simulation") / EXAMPLE).read_bytes())
