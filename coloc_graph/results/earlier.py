"""Earlier results at an output: kept where they are the same, replaced only on request."""

from pathlib import Path
from typing import Any

from coloc_graph._version import __version__
from coloc_graph.errors import ColocError, InputError
from coloc_graph.input_file import read_json
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.results.config import read_config
from coloc_graph.results.folder import SUMMARY, holds_result, read_summary
from coloc_graph.run import run_id


def same_result(run: Path, out: Path, options: SolveOptions) -> dict[str, Any] | None:
    """Return the summary of a result of this very run by these options and this version; None where there is none."""
    return _summary(out) if holds_result(out) and not _difference(run, out, options) else None


def require_replaceable(run: str | Path, out: str | Path, options: SolveOptions, *, force: bool) -> None:
    """Raise `InputError` where a folder holds another result than the one to come, unless `force` is given.

    Parameters
    ----------
    run : str or Path
        Run to solve.
    out : str or Path
        Folder of the result.
    options : SolveOptions
        Options of the result to come.
    force : bool
        Replace any earlier result.
    """
    if not force and holds_result(out) and (difference := _difference(Path(run), Path(out), options)):
        raise InputError(f"{out} holds {difference}; replace it with --force, or give another folder")


def require_replaceable_graph(graph: str | Path, out: str | Path, *, force: bool) -> None:
    """Raise `InputError` where a folder holds a result that is not of this pose graph, unless `force` is given."""
    if not force and holds_result(out) and _summary(Path(out)).get("graph") != str(graph):
        raise InputError(
            f"{out} holds a result that is not of {graph}; replace it with --force, or give another folder"
        )


def _summary(out: Path) -> dict[str, Any]:
    """Return summary.json of any format; {} where it is damaged or missing."""
    try:
        found = read_json(out / SUMMARY, "solve the run again")
    except (OSError, ColocError):
        return {}
    return found if isinstance(found, dict) else {}


def _difference(run: Path, out: Path, options: SolveOptions) -> str:
    """Describe the result in a folder by its difference from the one to come; "" where there is none."""
    try:
        summary, config = read_summary(out), read_config(out)
    except (OSError, ValueError, ColocError):
        return "an earlier result that this version does not read"
    if summary.get("run_id") != run_id(run):
        return f"the result of another run ({summary.get('run')})"
    if config.version != __version__:
        return f"a result of version {config.version}"
    had, wanted = config.options, options
    if summary.get("method") != "ranging":
        had, wanted = had.resolved(), wanted.resolved()
    if had == wanted:
        return ""
    if had.method != wanted.method:
        return f"a result of method {had.method}"
    return "a result of other options (see its config.toml)"
