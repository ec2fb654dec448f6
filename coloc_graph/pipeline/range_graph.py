"""Solving of a range graph file (PyFG, JRL) from its measurements alone."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.solver import optimise, with_stack
from coloc_graph.errors import EstimationError, InputError
from coloc_graph.exchange.range_graph import (
    RangeGraph,
    RangeValue,
    factors_of,
    is_landmark,
    is_pose,
    key_of,
    values_of,
)
from coloc_graph.exchange.range_graph_files import read_range_graph
from coloc_graph.geometry.se2 import wrap
from coloc_graph.pipeline.range_graph_start import initial_values

Array = NDArray[np.float64]

GAUGE_SIGMA = 1e-6  # m, rad: of the first pose, which is the world
OUTLIER_SIGMAS = 5.0  # residual in standard deviations above which a range is an outlier
ROBUST_SIGMAS = 3.0  # parameter of Geman and McClure's weights, by which outliers are found
NEGLIGIBLE = 1e-4  # half chi2 below which a step gains nothing: 0.01 standard deviations
MAX_OUTLIERS = 0.5  # share of the ranges, above which they are no outliers
NEES_POSES = 200  # poses whose NEES is evaluated, evenly spread


@dataclass(frozen=True, eq=False)
class GraphErrors:
    """Errors against the true vertices of a file, which the estimate does not read.

    `position` [m] is the RMS error of all poses after one rigid alignment of the team, `by_robot` that of each robot,
    `landmarks` that of the landmarks; `nees` the mean NEES per degree of freedom of poses in the first one.
    """

    position: float
    by_robot: Mapping[str, float]
    landmarks: float | None
    nees: float


@dataclass(frozen=True, eq=False)
class RangeGraphSolution:
    """Optimum of a range graph.

    Parameters
    ----------
    path, graph
        The file and its graph.
    values : mapping of str to pose or position
        In the first robot's first pose.
    rejected : tuple of (RangeValue, float)
        Ranges that are outliers, with their residual in standard deviations.
    chi2, dof, iterations, seconds
        Squared residuals of the others, degrees of freedom, iterations, and duration [s].
    errors : GraphErrors or None
        Where the file has true vertices.
    """

    path: Path
    graph: RangeGraph
    values: Mapping[str, Any]
    rejected: tuple[tuple[RangeValue, float], ...]
    chi2: float
    dof: int
    iterations: int
    seconds: float
    errors: GraphErrors | None


def solve_range_graph(path: str | Path) -> RangeGraphSolution:
    """Solve a planar range graph: odometry of robots, ranges between them and to landmarks.

    Robust weights find the outliers among the ranges; the estimate is without them.

    Raises
    ------
    InputError
        The file is no range graph in 2D, or a robot's odometry has gaps.
    EstimationError
        The ranges leave robots open or mirrored, or the optimiser did not converge.
    """
    path, began = Path(path), time.perf_counter()
    graph = read_range_graph(path)
    try:
        placed, free = _as_priors_say(graph, initial_values(graph))
    except (InputError, EstimationError) as error:
        raise type(error)(f"{path}: {error}") from error
    start, measured = values_of(placed), factors_of(graph)
    first = next(name for name in graph.names if not is_landmark(name))
    gauge = gtsam.PriorFactorPose2(
        key_of(first), start.atPose2(key_of(first)), gtsam.noiseModel.Diagonal.Sigmas(np.where(free, GAUGE_SIGMA, 1e4))
    )
    is_range = [isinstance(measured.at(n), _RANGES) for n in range(measured.size())]

    def robustly() -> tuple[gtsam.Values, int]:
        robust = gtsam.NonlinearFactorGraph()
        robust.add(gauge)
        weight = gtsam.noiseModel.mEstimator.GemanMcClure.Create(ROBUST_SIGMAS)
        for n, ranges in enumerate(is_range):
            factor: Any = measured.at(n)
            noise = gtsam.noiseModel.Robust.Create(weight, factor.noiseModel()) if ranges else factor.noiseModel()
            robust.add(factor.cloneWithNewNoiseModel(noise))
        return optimise(robust, start, rough_above=0.0, negligible=NEGLIGIBLE)

    values, used = with_stack(start.size(), robustly)
    kept = gtsam.NonlinearFactorGraph()
    kept.add(gauge)
    off = [float(np.sqrt(2 * measured.at(n).error(values))) for n in range(measured.size())]
    outliers = {n for n, ranges in enumerate(is_range) if ranges and off[n] > OUTLIER_SIGMAS}
    if len(outliers) > MAX_OUTLIERS * len(graph.ranges):
        raise EstimationError(
            f"{path}: {len(outliers)} of {len(graph.ranges)} ranges contradict the others, and it is not known which "
            "are wrong; check their noise, who ranged whom, and the odometry"
        )
    for n in range(measured.size()):
        if n not in outliers:
            kept.add(measured.at(n))
    values, more = with_stack(start.size(), lambda: optimise(kept, values, negligible=NEGLIGIBLE))
    rows = sum(int(kept.at(n).dim()) for n in range(kept.size()))
    found = {
        name: values.atPoint2(key_of(name)) if is_landmark(name) else values.atPose2(key_of(name))
        for name in graph.names
    }
    ranges = dict(zip((n for n, one in enumerate(is_range) if one), graph.ranges, strict=True))
    return RangeGraphSolution(
        path=path,
        graph=graph,
        values=found,
        rejected=tuple((ranges[n], off[n]) for n in sorted(outliers)),
        chi2=2 * kept.error(values),
        dof=rows - sum(2 if is_landmark(name) else 3 for name in found),
        iterations=used + more,
        seconds=time.perf_counter() - began,
        errors=_errors(graph, found, kept, values, first),
    )


def _as_priors_say(graph: RangeGraph, start: Mapping[str, Any]) -> tuple[dict[str, Any], NDArray[np.bool_]]:
    """Move initial values to where priors of poses or landmarks put them.

    Returns them with what is still free of x, y and heading of the world, (3,).
    """
    posed = next((one for one in graph.priors if is_pose(one.value)), None)
    points = [one for one in graph.priors if not is_pose(one.value)]
    T, free = gtsam.Pose2(), np.ones(3, bool)
    if posed is not None:
        T, free = posed.value.compose(start[posed.name].inverse()), np.zeros(3, bool)
    elif points:
        here = np.array([start[one.name] for one in points])
        true = np.array([one.value for one in points])
        R, t = _aligned(here, true) if len(points) > 1 else (np.eye(2), (true - here)[0])
        T, free = gtsam.Pose2(gtsam.Rot2.fromCosSin(R[0, 0], R[1, 0]), t), np.array([False, False, len(points) == 1])
    moved = {name: T.compose(one) if is_pose(one) else T.transformFrom(one) for name, one in start.items()}
    return moved, free


_RANGES = (gtsam.RangeFactorPose2, gtsam.RangeFactor2D)


def _errors(
    graph: RangeGraph, found: Mapping[str, Any], kept: gtsam.NonlinearFactorGraph, values: gtsam.Values, first: str
) -> GraphErrors | None:
    poses = [name for name in found if not is_landmark(name)]
    if not all(name in graph.truth for name in poses):
        return None
    marks = [name for name in found if is_landmark(name) and name in graph.truth]
    here = np.array([found[name].translation() for name in poses])
    true = np.array([graph.truth[name].translation() for name in poses])
    R, t = _aligned(here, true)
    off = np.linalg.norm(here @ R.T + t - true, axis=1)
    robots = np.array([name[0] for name in poses])
    of_marks = [np.linalg.norm(R @ found[name] + t - graph.truth[name]) for name in marks]
    marginals = gtsam.Marginals(kept, values)
    nees = []
    for name in poses[1 :: max(1, len(poses) // NEES_POSES)]:
        T = graph.truth[first].between(graph.truth[name])
        error = found[name].localCoordinates(T)
        error[2] = wrap(float(error[2]))
        nees.append(float(error @ np.linalg.solve(marginals.marginalCovariance(key_of(name)), error)) / 3)
    return GraphErrors(
        position=float(np.sqrt((off**2).mean())),
        by_robot={str(robot): float(np.sqrt((off[robots == robot] ** 2).mean())) for robot in np.unique(robots)},
        landmarks=float(np.sqrt(np.square(of_marks).mean())) if of_marks else None,
        nees=float(np.mean(nees)),
    )


def _aligned(here: Array, true: Array) -> tuple[Array, Array]:
    """Rotation (2, 2) and translation (2,) that take points here to the true ones."""
    a, b = here - here.mean(axis=0), true - true.mean(axis=0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R, true.mean(axis=0) - R @ here.mean(axis=0)
