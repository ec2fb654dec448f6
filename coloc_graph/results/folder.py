"""The folder of a result: atomic writing, and reading.

A folder holds summary.json, trajectories/<robot>.tum (and .cov.csv), measurements.csv, config.toml and report.html;
of a run with stances also graph.g2o, graph.dot and factors.zip; where there are ranges, graph.jrl; of an incremental
estimate of a ranging run online/<robot>.tum; where landmarks were measured, landmarks.csv; and team.toml, the
calibrated team, where anything was calibrated.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from coloc_graph._version import __version__
from coloc_graph.errors import InputError
from coloc_graph.exchange.tum import read_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.input_file import convert, read_json
from coloc_graph.results.config import Config, read_config
from coloc_graph.run import run_id
from coloc_graph.run.output_lock import locked_output
from coloc_graph.team import Team, read_team
from coloc_graph.team.landmark import require_name

FORMAT = 1  # of summary.json, measurements.csv, landmarks.csv and config.toml, together
SUMMARY = "summary.json"
LANDMARKS = "landmarks.csv"
MEASUREMENTS = "measurements.csv"
GTSAM_FACTORS = "factors.zip"
RANGING_GRAPH = "graph.jrl"
CALIBRATED_TEAM = "team.toml"
REMEDY = "solve the run again"


def holds_result(out: str | Path) -> bool:
    """Return whether there is a result in a folder, of any format."""
    return (Path(out) / SUMMARY).is_file()


def require_output_folder(out: str | Path) -> None:
    """Raise `InputError` where a result cannot be written to `out`."""
    out = Path(out)
    if out.exists() and not holds_result(out) and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not a result: give another folder, or remove it")
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir():
        raise InputError(f"{out} cannot be made, since {above} is not a folder: give another folder")
    if not os.access(above, os.W_OK):
        raise InputError(f"{out} cannot be written, since {above} is not writable: give another folder")


@contextmanager
def atomic_result(out: str | Path) -> Iterator[Path]:
    """Yield a folder to write a result to, with trajectories/ in it, and move it to `out` at the end.

    An earlier result there is replaced, or kept as it was after an exception.
    """
    require_output_folder(out)
    target = Path(out).resolve()  # "." has no name, and of a link the target is replaced
    with locked_output(target):
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        part, old = work / "new", work / "old"
        (part / "trajectories").mkdir(parents=True)
        try:
            yield part
            if target.exists():
                target.rename(old)
            part.rename(target)
        except BaseException:
            if old.exists() and not target.exists():
                old.rename(target)
            raise
        finally:
            shutil.rmtree(work, ignore_errors=True)


def write_summary(summary: dict[str, Any], run: Path, out: str | Path, part: Path) -> None:
    """Write summary.json into `part` of the result `out`, with its format and the path and id of its run."""
    named = {"format": FORMAT, "version": __version__, **summary}
    named |= {"run": os.path.relpath(run.absolute(), Path(out).absolute()), "run_id": run_id(run)}
    (part / SUMMARY).write_text(json.dumps(named, indent=2) + "\n", encoding="utf-8")


def read_summary(path: str | Path) -> dict[str, Any]:
    """Return the summary of a result in a folder.

    Raises
    ------
    InputError
        The folder is no result, is damaged, or has another format than this version writes.
    """
    path = Path(path)
    if not (path / SUMMARY).exists():
        raise InputError(f"{path} is not a result, for want of {SUMMARY}: give a folder that `coloc solve --out` wrote")
    summary = read_json(path / SUMMARY, REMEDY)
    if not isinstance(summary, dict):
        raise InputError(f"{path / SUMMARY} is damaged (it holds no fields); {REMEDY}")
    if summary.get("kind") == "pose graph":
        raise InputError(f"{path} is a solved pose graph, without robots and times: use its graph.g2o")
    number = summary.get("format")
    if number != FORMAT:
        had = "an earlier version of coloc-graph wrote it" if number is None else f"its format is {number}"
        raise InputError(f"{path} is a result that this version does not read ({had}): {REMEDY}")
    return summary


@dataclass(frozen=True, eq=False)
class Result:
    """A result read back.

    Parameters
    ----------
    path : Path
        Its folder.
    summary : dict
        summary.json.
    trajectories : mapping of str to Trajectory
        Estimated poses by robot.
    run_path : Path
        Recorded path of its run.
    run_id : str or None
        That run's id.
    config : Config
        Version, options and team.
    """

    path: Path
    summary: dict[str, Any]
    trajectories: Mapping[str, Trajectory]
    run_path: Path
    run_id: str | None
    config: Config

    @property
    def is_ranging(self) -> bool:
        """True if it is of a ranging run."""
        return self.summary.get("method") == "ranging"

    @property
    def on_map(self) -> bool:
        """True if its world is the map of the landmarks."""
        return self.summary.get("world") == "map"

    @property
    def team(self) -> Team:
        """The calibrated team where there is one, otherwise the team as stated.

        Raises `TeamError` where its file is damaged.
        """
        return self.calibrated_team or self.config.team

    @property
    def calibrated_team(self) -> Team | None:
        """The team with its calibrated mounts, markers, wheels and sensors; None where nothing was calibrated."""
        found = self.path / CALIBRATED_TEAM
        return read_team(found) if found.exists() else None

    def require_run(self, path: str | Path) -> None:
        """Raise `InputError` where the file at `path` is not the run that this result was made of."""
        if not Path(path).exists():
            raise InputError(f"{self.path}: its run is no longer at {path}: give --run RUN")
        if self.run_id is not None and run_id(path) != self.run_id:
            raise InputError(
                f"{path} is not the run of the result {self.path}: give that one with --run, or solve this one"
            )


def read_result(path: str | Path) -> Result:
    """Read the result in a folder.

    Parameters
    ----------
    path : str or Path
        The folder that `coloc solve --out`, or `write_result`, wrote.

    Returns
    -------
    Result
        Summary, trajectories and configuration.

    Raises
    ------
    InputError
        It is no result, is damaged, or has another format than this version writes.
    """
    path = Path(path)
    summary = read_summary(path)
    fields = convert(path / SUMMARY, summary, _Fields, REMEDY)
    trajectories = {robot: read_tum(path / "trajectories" / f"{robot}.tum") for robot in fields.robots}
    where = Path(os.path.normpath(path / fields.run))
    return Result(path, summary, trajectories, where, fields.run_id, read_config(path))


class _Fields(msgspec.Struct):
    """Fields of summary.json by which a result is read."""

    robots: tuple[str, ...]
    run: str
    run_id: str | None = None
    method: str = ""
    world: str = ""
    bumped: tuple[tuple[str, int, int], ...] = ()

    def __post_init__(self) -> None:
        for robot in self.robots:
            require_name(robot)
        if "\0" in self.run:
            raise ValueError("`run` is no path")
