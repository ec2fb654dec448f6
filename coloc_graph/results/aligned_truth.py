"""Truth of a result's run in the world of the result."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.evaluation import align, usual_alignment
from coloc_graph.results.folder import Result
from coloc_graph.run import read_truth


def aligned_truth(result: Result, run_path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the true poses at the times of a result's poses, in its world.

    Parameters
    ----------
    result : Result
        The result.
    run_path : Path
        Its run.

    Returns
    -------
    dict of str to (n, 4, 4) float
        T_world_body by robot, NaN where there is no truth; {} where the run holds none.

    Raises
    ------
    InputError
        The file is not the result's run, or no pose has truth.
    """
    result.require_run(run_path)
    true = read_truth(run_path, result.trajectories)
    if not true:
        return {}
    team = result.config.team
    how = "none" if result.on_map else usual_alignment(result.trajectories, true, team.reference)
    return align(result.trajectories, true, team.reference, on_floor=team.floor is not None, alignment=how)
