"""Comparison of an estimate with truth, from results, runs, and TUM files of other programs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError, RunError
from coloc_graph.evaluation import (
    MAX_TRUTH_GAP,
    RPE_DISTANCES,
    Accuracy,
    Alignment,
    PairsFrom,
    align,
    evaluate,
    usual_alignment,
)
from coloc_graph.exchange.tum import read_tum
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.results.folder import holds_result, read_result
from coloc_graph.run import is_mcap, read_truth


@dataclass(frozen=True, eq=False)
class Comparison:
    """Estimated and true trajectories by robot, and the alignment between them.

    Parameters
    ----------
    estimated, truth : mapping of str to Trajectory
        Poses T_world_body by robot.
    alignment : Alignment
        Alignment of the truth with the estimate.
    reference : str or None
        Robot that defines the estimate's world; None where none does.
    on_floor : bool
        The robots stand on the plane z = 0 of both worlds.
    max_gap : float
        Longest gap over which truth is interpolated [s].
    nearest : float or None
        Compare with the true pose of the nearest stamp within this time [s] instead.
    """

    estimated: Mapping[str, Trajectory]
    truth: Mapping[str, Trajectory]
    alignment: Alignment
    reference: str | None
    on_floor: bool
    max_gap: float = MAX_TRUTH_GAP
    nearest: float | None = None

    def only(self, robots: Sequence[str]) -> "Comparison":
        """Return the comparison of these robots alone; `InputError` for one that the estimate does not hold."""
        unknown = [robot for robot in robots if robot not in self.estimated]
        if unknown:
            raise InputError(f"the estimate holds no robot {unknown[0]}: choose from {', '.join(self.estimated)}")
        return replace(self, estimated={robot: self.estimated[robot] for robot in robots})

    def compare(
        self, rpe: Sequence[float] = RPE_DISTANCES, pairs_from: PairsFrom = "estimate"
    ) -> tuple[Accuracy, dict[str, NDArray[np.float64]]]:
        """Return the accuracy, and the true poses (n, 4, 4) in the estimate's world, NaN where there is no truth."""
        true = align(
            self.estimated,
            self.truth,
            self.reference,
            on_floor=self.on_floor,
            alignment=self.alignment,
            max_gap=self.max_gap,
            nearest=self.nearest,
        )
        accuracy = evaluate(
            self.estimated,
            true,
            on_floor=self.on_floor,
            alignment=self.alignment,
            rpe=rpe,
            pairs_from=pairs_from,
            reference=self.reference,
        )
        return accuracy, true


def of_result(
    path: str | Path,
    run_path: str | Path | None = None,
    truth: Sequence[str] = (),
    alignment: Alignment | None = None,
) -> Comparison:
    """Compare a result with the truth in its run, or with another truth.

    Parameters
    ----------
    path : str or Path
        Folder of the result.
    run_path : str, Path or None
        The run, where it was moved.
    truth : sequence of str
        Truth as of `read_truths`; (): that of the run.
    alignment : Alignment or None
        None: `usual_alignment`.

    Raises
    ------
    InputError
        The run is not that of the result, or has no truth.
    """
    result = read_result(path)
    estimated = _with_poses(result.trajectories, f"{path}")
    team = result.config.team
    if truth:
        true = read_truths(truth)
    else:
        run = run_path or result.run_path
        result.require_run(run)
        true = read_truth(run, estimated)
        if not true:
            raise InputError(
                f"{run}: the run holds no truth to compare with; record it on /<robot>/truth, or give it with --truth"
            )
    alignment = alignment or ("none" if result.on_map else usual_alignment(estimated, true, team.reference))
    return Comparison(estimated, true, alignment, team.reference, team.floor is not None)


def of_files(
    estimate: Sequence[str],
    truth: Sequence[str],
    alignment: Alignment | None = None,
    *,
    reference: str | None = None,
    on_floor: bool = False,
) -> Comparison:
    """Compare TUM files, or folders of them, with others or with the truth in a run; each as for `read_truths`.

    One file against one file is one robot, whatever their names.

    Parameters
    ----------
    estimate, truth : sequence of str
        Files and folders.
    alignment : Alignment or None
        None: by the team.
    reference : str or None
        Robot that defines the estimate's world.
    on_floor : bool
        The robots stand on the plane z = 0 of both worlds.

    Raises
    ------
    InputError
        The alignment needs a reference and none is named.
    """
    estimated, true = _read(estimate), read_truths(truth)
    if len(estimated) == len(true) == 1 and all("=" not in one for one in (*estimate, *truth)):
        ((robot, _),), ((_, one),) = estimated.items(), true.items()
        true = {robot: replace(one, robot=robot)}
    if reference is None and len(estimated) == 1:
        reference = next(iter(estimated))
    if alignment == "reference" and reference is None:
        raise InputError(f"the reference robot is not named: name one of {', '.join(estimated)}")
    return Comparison(estimated, true, alignment or "team", reference, on_floor)


def read_truths(given: Sequence[str]) -> dict[str, Trajectory]:
    """Read true trajectories of a run (.mcap), or of TUM files: a folder of <robot>.tum, a file, or ROBOT=FILE each."""
    if len(given) == 1 and Path(given[0]).is_file() and is_mcap(Path(given[0])):
        truth = read_truth(given[0])
        if not truth:
            raise RunError(f"{given[0]}: the run holds no truth to compare with; record it on /<robot>/truth")
        return truth
    return _read(given)


def _read(given: Sequence[str]) -> dict[str, Trajectory]:
    """Read trajectories by robot, in the order in which they are named."""
    found: dict[str, Trajectory] = {}
    for one in given:
        name, equals, file = one.partition("=")
        path = Path(file if equals and not Path(one).exists() else one)
        if path.is_dir():
            files = sorted(path.glob("*.tum"))
            if not files:
                raise InputError(f"{path} holds no .tum files: name them, as ROBOT=FILE each")
            several = {file.stem: read_tum(file) for file in files}
        elif path == Path(one):
            several = {path.stem: read_tum(path)}
        else:
            several = {name: read_tum(path)}
        twice = several.keys() & found.keys()
        if twice:
            raise InputError(f"robot {min(twice)} is given twice, the second time by {one}: name each robot once")
        found |= {robot: replace(trajectory, robot=robot) for robot, trajectory in several.items()}
    return _with_poses(found, ", ".join(given))


def _with_poses(trajectories: Mapping[str, Trajectory], where: str) -> dict[str, Trajectory]:
    """Return the trajectories, all of which must hold a pose."""
    empty = [robot for robot, one in trajectories.items() if not len(one)]
    if empty or not trajectories:
        raise InputError(f"{where}: there are no poses{f' of robot {empty[0]}' if empty else ''} to compare")
    return dict(trajectories)


def is_result(path: str | Path) -> bool:
    """Return whether to open a path as a result, not as a folder of TUM files; true of a path that is neither."""
    return holds_result(path) or not any(Path(path).glob("*.tum"))
