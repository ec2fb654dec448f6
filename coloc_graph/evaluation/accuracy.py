"""Accuracy of an estimate: lengths as in the paper's Table II, ATE, RPE, heading error, and NEES."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coloc_graph.evaluation.alignment import Alignment
from coloc_graph.evaluation.nees import FREE, PLANAR, Nees, nees
from coloc_graph.evaluation.pose_errors import (
    RPE_DISTANCES,
    PairsFrom,
    RelativeError,
    Spread,
    absolute_errors,
    relative_error,
    relative_errors,
    spread,
)
from coloc_graph.evaluation.truth import first_with_truth, with_truth, without_truth
from coloc_graph.geometry.lie import yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

STANDING_DISTANCE = 0.05  # m between first and last pose, up to which a robot counts as standing


@dataclass(frozen=True)
class RobotAccuracy:
    """Accuracy of one robot.

    Parameters
    ----------
    robot : str
        Its name.
    true_length, estimated_length : float
        Straight distance from its first to its last estimated pose [m].
    end_position_error, heading_error_deg : float
        Errors of the last pose [m], [deg].
    translation, rotation_deg : Spread
        Errors over all poses (ATE) [m], [deg].
    relative : tuple of RelativeError
        Errors over distances travelled (RPE).
    nees : Nees or None
        Consistency; None without covariances.
    """

    robot: str
    true_length: float
    estimated_length: float
    end_position_error: float
    heading_error_deg: float
    translation: Spread
    rotation_deg: Spread
    relative: tuple[RelativeError, ...] = ()
    nees: Nees | None = None

    @property
    def ate(self) -> float:
        """RMS position error over all poses [m]."""
        return self.translation.rmse

    @property
    def length_error(self) -> float:
        """Estimated less true length [m]."""
        return self.estimated_length - self.true_length

    @property
    def length_error_percent(self) -> float | None:
        """Size of the length error in % of the true length; None for a standing robot."""
        return 100 * abs(self.length_error) / self.true_length if self.true_length > STANDING_DISTANCE else None


@dataclass(frozen=True)
class DistanceAccuracy:
    """True and estimated distance between two standing robots [m]."""

    robot_i: str
    robot_j: str
    true: float
    estimated: float

    @property
    def error(self) -> float:
        """Estimated less true distance [m]."""
        return self.estimated - self.true


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a team.

    Parameters
    ----------
    robots : tuple of RobotAccuracy
        Accuracy of each robot.
    alignment : Alignment
        Alignment of the truth. Where it was fitted to all poses there is no NEES, since the covariances are those in
        the world of the reference.
    translation, rotation_deg : Spread
        Errors over all poses of all robots (ATE) [m], [deg].
    relative : tuple of RelativeError
        Errors over distances travelled (RPE).
    end_position_error, heading_error_deg : float
        Largest errors of any robot's last pose [m], [deg].
    anees : float or None
        Average NEES per degree of freedom, 1 of a consistent estimate.
    nees_poses : int
        Poses that it is of.
    distances : tuple of DistanceAccuracy
        Distances between standing robots, whose lengths are meaningless.
    warnings : tuple of str
        Sentences on poses without truth.
    """

    robots: tuple[RobotAccuracy, ...]
    alignment: Alignment
    translation: Spread
    rotation_deg: Spread
    relative: tuple[RelativeError, ...]
    end_position_error: float
    heading_error_deg: float
    anees: float | None
    nees_poses: int
    distances: tuple[DistanceAccuracy, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def ate(self) -> float:
        """RMS position error over all poses [m]."""
        return self.translation.rmse


def evaluate(
    estimated: Mapping[str, Trajectory],
    true: Mapping[str, Array],
    *,
    on_floor: bool,
    alignment: Alignment = "reference",
    rpe: Sequence[float] = RPE_DISTANCES,
    pairs_from: PairsFrom = "estimate",
    reference: str | None = None,
) -> Accuracy:
    """Compare an estimate with truth.

    Parameters
    ----------
    estimated : mapping of str to Trajectory
        Estimated poses by robot.
    true : mapping of str to (n, 4, 4) float
        True poses by `align`, NaN where there is no truth: these poses are ignored and counted in the warnings. At
        least one pose has truth.
    on_floor : bool
        The NEES is that of heading, x and y.
    alignment : Alignment
        Alignment by which `true` was made.
    rpe : sequence of float
        Distances of the RPE [m].
    pairs_from : {"estimate", "truth"}
        Path by which these distances are measured.
    reference : str or None
        Robot that was aligned: where its first pose with truth is not the one that defines the world, there is no
        NEES.

    Returns
    -------
    Accuracy
        Errors of the team and of each robot.
    """
    warnings = without_truth(estimated, true)
    late = _aligned_late(estimated, true, reference) if alignment == "reference" and reference is not None else None
    warnings += (late,) if late else ()
    kept = {robot: with_truth(true[robot]) for robot in estimated}
    estimated = {robot: one.where(kept[robot]) for robot, one in estimated.items() if kept[robot].any()}
    true = {robot: true[robot][kept[robot]] for robot in estimated}
    # covariances are those of errors relative to the first pose; a fit of all poses to truth is not in them
    stated = alignment in ("reference", "none") and not late
    components = PLANAR if on_floor else FREE

    rows, absolute, pairs = [], [], []
    for robot, trajectory in estimated.items():
        T_true = true[robot]
        distance, angle = absolute_errors(trajectory.T_world_body, T_true)
        absolute.append((distance, np.rad2deg(angle)))
        pairs.append([relative_errors(trajectory.T_world_body, T_true, length, pairs_from) for length in rpe])
        turned = np.rad2deg(yaw(trajectory.T_world_body[-1]) - yaw(T_true[-1]))
        rows.append(
            RobotAccuracy(
                robot=robot,
                true_length=float(np.linalg.norm(T_true[-1, :3, 3] - T_true[0, :3, 3])),
                estimated_length=float(np.linalg.norm(trajectory.positions[-1] - trajectory.positions[0])),
                end_position_error=float(distance[-1]),
                heading_error_deg=float(abs((turned + 180) % 360 - 180)),
                translation=spread(absolute[-1][0]),
                rotation_deg=spread(absolute[-1][1]),
                relative=tuple(relative_error(length, [one]) for length, one in zip(rpe, pairs[-1], strict=True)),
                nees=nees(trajectory, T_true, components) if stated else None,
            )
        )
    stating = [row.nees for row in rows if row.nees is not None]
    nees_poses = sum(one.poses for one in stating)
    translation, rotation = (spread(np.concatenate(parts)) for parts in zip(*absolute, strict=True))
    return Accuracy(
        robots=tuple(rows),
        alignment=alignment,
        translation=translation,
        rotation_deg=rotation,
        relative=tuple(relative_error(length, parts) for length, *parts in zip(rpe, *pairs, strict=True)),
        end_position_error=max(row.end_position_error for row in rows),
        heading_error_deg=max(row.heading_error_deg for row in rows),
        anees=sum(one.mean * one.poses for one in stating) / nees_poses if nees_poses else None,
        nees_poses=nees_poses,
        distances=_distances(rows, estimated, true) if alignment != "robot" else (),
        warnings=warnings,
    )


def _aligned_late(estimated: Mapping[str, Trajectory], true: Mapping[str, Array], reference: str) -> str | None:
    """Warn of an alignment by another pose of the reference than its first; None where it is the first, or equal."""
    first = first_with_truth(estimated, true, reference)
    if first is None or (estimated[reference].T_world_body[: first + 1] == estimated[reference].T_world_body[0]).all():
        return None
    at = estimated[reference]
    where = f"stance {at.stances[first]}" if at.stances is not None else f"{at.times[first]:.3f} s"
    return (
        f"the truth of the reference robot {reference} begins after the estimate: aligned by its pose at {where}, and "
        "without NEES, since the covariances are relative to its first pose"
    )


def _distances(
    rows: Sequence[RobotAccuracy], estimated: Mapping[str, Trajectory], true: Mapping[str, Array]
) -> tuple[DistanceAccuracy, ...]:
    return tuple(
        DistanceAccuracy(
            i,
            j,
            true=float(np.linalg.norm(true[j][-1, :3, 3] - true[i][-1, :3, 3])),
            estimated=float(np.linalg.norm(estimated[j].positions[-1] - estimated[i].positions[-1])),
        )
        for i, j in itertools.combinations([row.robot for row in rows if row.true_length <= STANDING_DISTANCE], 2)
        if estimated[i].times[-1] == estimated[j].times[-1]  # not of robots at different times
    )


def accuracy_json(accuracy: Accuracy) -> dict[str, Any]:
    """Return an accuracy as in summary.json; numbers that do not exist are null."""
    return {
        "alignment": accuracy.alignment,
        "length_error_percent": {row.robot: row.length_error_percent for row in accuracy.robots},
        "ate_m": accuracy.ate,
        "end_position_error_m": accuracy.end_position_error,
        "heading_error_deg": accuracy.heading_error_deg,
        "anees": accuracy.anees,
        **_errors_json(accuracy),
        "robots": {
            row.robot: {
                "true_length_m": row.true_length,
                "estimated_length_m": row.estimated_length,
                "length_error_m": row.length_error,
                "ate_m": row.ate,
                "end_position_error_m": row.end_position_error,
                "heading_error_deg": row.heading_error_deg,
                **_errors_json(row),
                "nees": None if row.nees is None else asdict(row.nees),
            }
            for row in accuracy.robots
        },
        "distances": [
            {"robots": [row.robot_i, row.robot_j], "true_m": row.true, "estimated_m": row.estimated}
            for row in accuracy.distances
        ],
        "warnings": list(accuracy.warnings),
    }


def _errors_json(of: Accuracy | RobotAccuracy) -> dict[str, Any]:
    return {
        "translation_m": asdict(of.translation),
        "rotation_deg": asdict(of.rotation_deg),
        "rpe": [
            {
                "distance_m": one.distance,
                "pairs": one.pairs,
                "translation_m": one.translation,
                "translation_percent": one.translation_percent,
                "rotation_deg": one.rotation_deg,
            }
            for one in of.relative
        ],
    }
