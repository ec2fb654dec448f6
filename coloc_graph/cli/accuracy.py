"""Print accuracy as in the paper's Table II, last poses with their uncertainty, and calibrations."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from coloc_graph.cli.printing import counted, print_table
from coloc_graph.evaluation import Accuracy, Alignment, RobotAccuracy

if TYPE_CHECKING:
    from coloc_graph.backend import Calibration
    from coloc_graph.frontend.learnt_noise import NoiseRow
    from coloc_graph.geometry.trajectory import Trajectory

#: Alignments in words.
ALIGNED: dict[Alignment, str] = {
    "reference": "aligned by the reference robot's first pose",
    "team": "aligned by all poses of the team",
    "robot": "aligned by the poses of each robot on its own",
    "none": "not aligned",
}


def print_accuracy(accuracy: Accuracy) -> None:
    """Print true and estimated path length and errors of each robot, the team's figures, and distances at rest."""
    rows = []
    for row in accuracy.robots:
        percent = row.length_error_percent
        rows.append(
            [
                row.robot,
                f"{100 * row.true_length:.1f} cm",
                f"{100 * row.estimated_length:.1f} cm",
                f"{1000 * abs(row.length_error):.1f} mm",
                "-" if percent is None else f"{percent:.3f} %",
                f"{1000 * row.end_position_error:.1f} mm",
                f"{row.heading_error_deg:.2f} deg",
            ]
        )
    print_table(["robot", "true", "estimated", "error", "error rate", "end position", "heading"], rows)
    poses = counted(accuracy.nees_poses, "pose")
    anees = "-" if accuracy.anees is None else f"{accuracy.anees:.2f} over {poses}{_intervals(accuracy)}"
    print(f"RMS position error of all poses {1000 * accuracy.ate:.1f} mm; NEES per degree of freedom {anees}")
    if accuracy.distances:
        print_table(
            ["distance", "true", "estimated", "error"],
            [
                [
                    f"{row.robot_i} to {row.robot_j}",
                    f"{100 * row.true:.1f} cm",
                    f"{100 * row.estimated:.1f} cm",
                    f"{100 * abs(row.error):.2f} cm",
                ]
                for row in accuracy.distances
            ],
        )


def _intervals(accuracy: Accuracy) -> str:
    """NEES of each robot with its 95 % interval, in brackets."""
    rows = [(row.robot, row.nees) for row in accuracy.robots if row.nees is not None]
    texts = [f"{robot} {one.mean:.2f}, 95 % interval {one.low:.2f} to {one.high:.2f}" for robot, one in rows]
    return f" ({'; '.join(texts)})" if texts else ""


def print_online(accuracy: Accuracy) -> None:
    """Print the RMS error of each robot's poses as they were estimated at their time."""
    errors = [f"{row.robot} {100 * row.ate:.1f} cm" for row in accuracy.robots]
    print(f"RMS position error of each pose as estimated at its time: {', '.join(errors)}")


def print_errors(accuracy: Accuracy) -> None:
    """Print errors of each robot and of the team over all poses (ATE) with NEES, and over path segments (RPE)."""
    whose: list[tuple[str, Accuracy | RobotAccuracy]] = [(row.robot, row) for row in accuracy.robots]
    if len(whose) > 1:
        whose.append(("team", accuracy))
    rows = []
    for name, of in whose:
        t, r = of.translation, of.rotation_deg
        translation = [f"{100 * value:.2f}" for value in (t.rmse, t.mean, t.median, t.max)]
        rotation = [f"{value:.2f}" for value in (r.rmse, r.mean, r.median, r.max)]
        rows.append([name, *translation, *rotation, *_nees_cells(of)])
    head = ["all poses", "RMSE [cm]", "mean", "median", "max", "RMSE [deg]", "mean", "median", "max"]
    print(f"\n{ALIGNED[accuracy.alignment]}:")
    print_table([*head, "NEES", "95 % interval"], rows)
    rows = [
        [
            name,
            f"{one.distance:g} m",
            str(one.pairs),
            _or_dash(one.translation, "m"),
            _or_dash(one.translation_percent, "%"),
            _or_dash(one.rotation_deg, "deg"),
        ]
        for name, of in whose
        for one in of.relative
        if one.pairs
    ]
    if rows:
        print()
        print_table(["relative (RPE)", "over", "pairs", "translation", "of it", "rotation"], rows)
    missing = [f"{one.distance:g} m" for one in accuracy.relative if not one.pairs]
    if missing:
        print(f"no two poses of a robot are {' or '.join(missing)} apart along its path")


def _nees_cells(of: Accuracy | RobotAccuracy) -> list[str]:
    if isinstance(of, Accuracy):  # errors of robots are correlated to an unknown degree: no interval of their mean
        return ["-" if of.anees is None else f"{of.anees:.2f}", ""]
    if of.nees is None:
        return ["-", ""]
    effective = f"{of.nees.effective:.0f} of {of.nees.poses}"
    return [f"{of.nees.mean:.2f}", f"{of.nees.low:.2f} to {of.nees.high:.2f} ({effective} independent)"]


def _or_dash(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {unit}"


def print_calibration(calibration: "Calibration") -> None:
    """Print stated and estimated calibration parameters, each with its standard deviation."""

    def value(number: float, sigma: float, unit: str) -> str:
        if unit == "m":
            return f"{1000 * number:.1f} +- {1000 * sigma:.2f} mm"
        return f"{number:.2f} +- {sigma:.3f} {unit}"

    rows = [
        [
            row.robot,
            row.what,
            value(row.stated, row.stated_sigma, row.unit),
            value(row.found, row.found_sigma, row.unit),
            f"{row.sigmas:.1f} sigma",
        ]
        for row in calibration.rows
    ]
    if rows:
        print_table(["robot", "parameter", "stated", "estimated", "difference"], rows)


def print_noise(rows: "Sequence[NoiseRow]") -> None:
    """Print the noise of a typical marker centre of each camera, as stated and as learnt."""
    typical = [
        f"{row.robot} {row.stated:.3f} px stated, {row.learnt:.3f} px learnt (a factor of {row.learnt_factor:.2f})"
        for row in rows
        if row.what == "typical centre"
    ]
    if typical:
        print(f"noise of marker centres: {'; '.join(typical)}")


def print_promised(trajectories: "Mapping[str, Trajectory]") -> None:
    """Print the standard deviations of each robot's last pose in one line."""
    promised = []
    for robot, trajectory in trajectories.items():
        sigmas = last_sigmas(trajectory)
        if sigmas is not None:
            promised.append(f"{robot} {1000 * math.hypot(*sigmas[:2]):.1f} mm, {math.degrees(sigmas[2]):.2f} deg")
    if promised:
        print("predicted 1-sigma at the end: " + "; ".join(promised))


def print_last_poses(trajectories: "Mapping[str, Trajectory]") -> None:
    """Print each robot's path length and its last pose in the world frame with standard deviations."""
    import numpy as np

    from coloc_graph.geometry.lie import yaw

    rows = []
    for robot, trajectory in trajectories.items():
        length = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum()
        x, y = 100 * trajectory.positions[-1, :2]
        heading = math.degrees(float(yaw(trajectory.T_world_body[-1])))
        sigmas = last_sigmas(trajectory)
        of_x, of_y, of_heading = ("", "", "")
        if sigmas is not None:
            of_x, of_y = (f" +- {100 * sigma:.2f}" for sigma in sigmas[:2])
            of_heading = f" +- {math.degrees(sigmas[2]):.2f}"
        rows.append(
            [
                robot,
                f"{100 * length:.1f} cm",
                f"{x:.1f}{of_x} cm",
                f"{y:.1f}{of_y} cm",
                f"{heading:.2f}{of_heading} deg",
            ]
        )
    print_table(["robot", "path length", "x at the end", "y", "heading"], rows)


def last_sigmas(trajectory: "Trajectory") -> tuple[float, float, float] | None:
    """Standard deviations of x, y [m] in the world and heading [rad] of the last pose; None without covariance."""
    import numpy as np

    if trajectory.covariances is None:
        return None
    R, covariance = trajectory.T_world_body[-1, :3, :3], trajectory.covariances[-1]
    of_x, of_y, _ = np.sqrt(np.diag(R @ covariance[3:, 3:] @ R.T))
    # but for the unevenness of the floor, the body's z is the world's
    return float(of_x), float(of_y), math.sqrt(covariance[2, 2])
