"""An estimate against truth in figures: lengths as in the paper's Table II, ATE, RPE, heading, and NEES."""

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
from coloc_graph.evaluation.truth import first_with_truth, left_out, with_truth
from coloc_graph.geometry.lie import yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

#: A robot that got no further than this stayed where it was [m].
STAYED = 0.05


@dataclass(frozen=True)
class RobotAccuracy:
    """One robot's row of Table II, and its errors. Lengths are straight from its first to its last estimated pose [m].

    `translation` [m] and `rotation_deg` are over all poses (ATE), `relative` over stretches of the way (RPE). `nees`
    is None where no covariances say what the errors should be.
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
        """Size of the length error in % of the true length; None for a robot that did not get anywhere."""
        return 100 * abs(self.length_error) / self.true_length if self.true_length > STAYED else None


@dataclass(frozen=True)
class DistanceAccuracy:
    """The distance between two robots that stayed where they were [m]."""

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
    """A team's accuracy: errors over all poses of all robots, the largest end errors of any robot, and the average
    NEES per degree of freedom (1 where the covariances tell the truth) over `nees_poses` poses.

    `distances` are those of the pairs of robots that stayed where they were, of which lengths say nothing. `warnings`
    say which poses had no truth. `alignment` says what was made to agree; where it was fitted to the errors there is
    no NEES, since the covariances are those in the world of the reference.
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
    """Compare an estimate with the true poses (n, 4, 4) of `align`, by the alignment that it was asked for.

    Poses without truth are left out, and so are robots without any; `Accuracy.warnings` counts them. At least one pose
    has truth. `on_floor`: the NEES is that of heading, x and y, since the floor decides the rest. `rpe` are the
    distances of the RPE [m], of the robots' paths in the estimate or in the truth (`pairs_from`). `reference` is the
    robot that was aligned: where its first pose with truth is not the one that defines the world, there is no NEES.
    """
    warnings = left_out(estimated, true)
    late = _aligned_late(estimated, true, reference) if alignment == "reference" and reference is not None else None
    warnings += (late,) if late else ()
    kept = {robot: with_truth(true[robot]) for robot in estimated}
    estimated = {robot: one.where(kept[robot]) for robot, one in estimated.items() if kept[robot].any()}
    true = {robot: true[robot][kept[robot]] for robot in estimated}
    # covariances are in the body's tangent, which no alignment turns; but they are of errors from the world's beginning
    # on, and what a fit took from all poses together they do not know
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
    """Sentence on an alignment by another pose of the reference than its first; None where it is the first, or held."""
    first = first_with_truth(estimated, true, reference)
    if first is None or (estimated[reference].T_world_body[: first + 1] == estimated[reference].T_world_body[0]).all():
        return None
    at = estimated[reference]
    where = f"stance {at.stances[first]}" if at.stances is not None else f"{at.times[first]:.3f} s"
    return (
        f"the truth of the reference robot {reference} begins after the estimate: aligned by its pose at {where}; "
        "there is no NEES, since the covariances are of errors since the estimate begins"
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
        for i, j in itertools.combinations([row.robot for row in rows if row.true_length <= STAYED], 2)
        if estimated[i].times[-1] == estimated[j].times[-1]  # not where one drove by
    )


def accuracy_json(accuracy: Accuracy) -> dict[str, Any]:
    """An accuracy as in summary.json; numbers that do not exist are null."""
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
