"""What is compared with what: estimates and truth from results, runs, and TUM files of other programs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import InputError, RunError
from coloc_graph.evaluation import (
    LONGEST_TRUTH_GAP,
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
    """Estimated and true trajectories by robot, and how they are brought together.

    `reference` is the robot that defines the estimate's world, None where none does. `on_floor`: the robots stand on
    the plane z = 0 of both worlds.
    """

    estimated: Mapping[str, Trajectory]
    truth: Mapping[str, Trajectory]
    alignment: Alignment
    reference: str | None
    on_floor: bool
    longest_gap: float = LONGEST_TRUTH_GAP

    def only(self, robots: Sequence[str]) -> "Comparison":
        """The comparison of these robots alone; `InputError` for one that the estimate does not hold."""
        unknown = [robot for robot in robots if robot not in self.estimated]
        if unknown:
            raise InputError(f"the estimate does not hold robot {unknown[0]}; it holds {', '.join(self.estimated)}")
        return replace(self, estimated={robot: self.estimated[robot] for robot in robots})

    def compare(
        self, rpe: Sequence[float] = RPE_DISTANCES, pairs_from: PairsFrom = "estimate"
    ) -> tuple[Accuracy, dict[str, NDArray[np.float64]]]:
        """The accuracy, and the true poses (n, 4, 4) in the estimate's world, NaN where there is no truth."""
        true = align(
            self.estimated,
            self.truth,
            self.reference,
            on_floor=self.on_floor,
            alignment=self.alignment,
            longest_gap=self.longest_gap,
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
    """A result against the truth in its run (where `run_path` says, if it was moved), or against another truth.

    Aligned as is usual (`usual_alignment`) unless said otherwise. Raises `InputError` where the run is another or has
    no truth.
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
    """TUM files, or folders of them, against others or against the truth in a run; each as for `read_truths`.

    One file against one file is one robot, whatever their names. Aligned by the team unless said otherwise. Raises
    `InputError` where a robot is to be the reference and none is named, or one that is not there.
    """
    estimated, true = _read(estimate), read_truths(truth)
    if len(estimated) == len(true) == 1 and all("=" not in one for one in (*estimate, *truth)):
        ((robot, _),), ((_, one),) = estimated.items(), true.items()
        true = {robot: replace(one, robot=robot)}
    if reference is None and len(estimated) == 1:
        reference = next(iter(estimated))
    if alignment == "reference" and reference is None:
        raise InputError(f"which robot is the reference is not said; name one of {', '.join(estimated)}")
    return Comparison(estimated, true, alignment or "team", reference, on_floor)


def read_truths(given: Sequence[str]) -> dict[str, Trajectory]:
    """True trajectories by robot: of a run (.mcap), or as TUM: a folder of <robot>.tum, a file, or ROBOT=FILE each."""
    if len(given) == 1 and Path(given[0]).is_file() and is_mcap(Path(given[0])):
        truth = read_truth(given[0])
        if not truth:
            raise RunError(f"{given[0]}: the run holds no truth to compare with; record it on /<robot>/truth")
        return truth
    return _read(given)


def _read(given: Sequence[str]) -> dict[str, Trajectory]:
    """Trajectories by robot, in the order in which they are named."""
    found: dict[str, Trajectory] = {}
    for one in given:
        name, equals, file = one.partition("=")
        path = Path(file if equals and not Path(one).exists() else one)
        if path.is_dir():
            files = sorted(path.glob("*.tum"))
            if not files:
                raise InputError(f"{path} holds no .tum files; name them, as ROBOT=FILE each")
            several = {file.stem: read_tum(file) for file in files}
        elif path == Path(one):
            several = {path.stem: read_tum(path)}
        else:
            several = {name: read_tum(path)}
        twice = several.keys() & found.keys()
        if twice:
            raise InputError(f"robot {min(twice)} is given twice, the second time by {one}; name each robot once")
        found |= {robot: replace(trajectory, robot=robot) for robot, trajectory in several.items()}
    return _with_poses(found, ", ".join(given))


def _with_poses(trajectories: Mapping[str, Trajectory], where: str) -> dict[str, Trajectory]:
    """The trajectories, all of which must hold a pose."""
    empty = [robot for robot, one in trajectories.items() if not len(one)]
    if empty or not trajectories:
        raise InputError(
            f"{where}: there are no poses{f' of robot {empty[0]}' if empty else ''}; nothing can be compared"
        )
    return dict(trajectories)


def is_result(path: str | Path) -> bool:
    """Whether a path is to be opened as a result, and not as a folder of TUM files; what is neither says so."""
    return holds_result(path) or not any(Path(path).glob("*.tum"))
