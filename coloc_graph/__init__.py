"""Cooperative localisation of robots from cameras and LED markers, as a factor graph.

`solve` makes an estimate of a run: `frontend` measures homographies in images, `backend` optimises the graph.
`PoseGraph` takes measurements of your own. The names below are imported when they are first asked for; what begins
with an underscore, and every module that docs/ does not name, is internal.
"""

from typing import TYPE_CHECKING

from coloc_graph._lazy import lazy_names
from coloc_graph._version import __version__

if TYPE_CHECKING:
    from coloc_graph.backend import Estimate, Estimator, PoseGraph, StanceEstimate, chain, joint, smooth
    from coloc_graph.errors import ColocError, ColocWarning
    from coloc_graph.evaluation import align, evaluate
    from coloc_graph.measurements import Odometry, RelativePose, Sighting
    from coloc_graph.pipeline.batch import Solution, SolveOptions, solve
    from coloc_graph.results.folder import read_result
    from coloc_graph.results.writer import write_result
    from coloc_graph.run import Run, RunWriter, Stance, open_run
    from coloc_graph.simulation import scenario, simulate
    from coloc_graph.team import Floor, Robot, Team, read_team, write_team

__all__ = [
    "ColocError",
    "ColocWarning",
    "Estimate",
    "Estimator",
    "Floor",
    "Odometry",
    "PoseGraph",
    "RelativePose",
    "Robot",
    "Run",
    "RunWriter",
    "Sighting",
    "Solution",
    "SolveOptions",
    "Stance",
    "StanceEstimate",
    "Team",
    "__version__",
    "align",
    "chain",
    "evaluate",
    "joint",
    "open_run",
    "read_result",
    "read_team",
    "scenario",
    "simulate",
    "smooth",
    "solve",
    "write_result",
    "write_team",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "backend": "Estimate Estimator PoseGraph StanceEstimate chain joint smooth",
        "errors": "ColocError ColocWarning",
        "evaluation": "align evaluate",
        "measurements": "Odometry RelativePose Sighting",
        "pipeline.batch": "Solution SolveOptions solve",
        "results.folder": "read_result",
        "results.writer": "write_result",
        "run": "Run RunWriter Stance open_run",
        "simulation": "scenario simulate",
        "team": "Floor Robot Team read_team write_team",
    },
)
