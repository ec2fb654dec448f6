"""coloc solve RUN --out DIR, of a run with ranges of robots that drive all the time."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.printing import counted, print_json, print_table, progress, warn

if TYPE_CHECKING:
    from coloc_graph.pipeline.ranging import DriveSolution
    from coloc_graph.results.ranging import DriveAssessment
    from coloc_graph.run import Run


def solve_one_drive(args: argparse.Namespace, run: "Run") -> None:
    """Solve, write, print."""
    from coloc_graph.pipeline.ranging import DriveOptions, solve_drive
    from coloc_graph.results.ranging import summarise_drive, write_drive_result
    from coloc_graph.run.output_lock import locked_output

    options = DriveOptions(incremental=args.incremental, between_robots=not args.without_robots)
    with locked_output(args.out):
        with progress("seconds of the run done") as report:
            solution = solve_drive(run, options, report)
        assessed = write_drive_result(solution, args.out)
    warn(solution.warnings)
    if args.json:
        print_json(summarise_drive(solution, assessed))
    else:
        _print(solution, assessed, args.out)


def _print(solution: "DriveSolution", assessed: "DriveAssessment | None", out: str) -> None:
    """What came out, in figures."""
    estimate = solution.estimate
    if assessed is not None:
        online = {row.robot: row for row in assessed.online.robots} if assessed.online else {}
        rows = []
        for row in assessed.accuracy.robots:
            nees = "-" if row.nees is None else f"{row.nees.mean:.2f}"
            at_its_time = f"{100 * online[row.robot].ate:.1f} cm" if row.robot in online else "-"
            rows.append(
                [
                    row.robot,
                    f"{100 * row.translation.rmse:.1f} cm",
                    f"{100 * row.translation.max:.1f} cm",
                    f"{row.rotation_deg.rmse:.2f} deg",
                    nees,
                    at_its_time,
                ]
            )
        print_table(["robot", "RMS position", "largest", "RMS heading", "NEES (1 is honest)", "RMS at its time"], rows)
    agreement = f", chi2/dof {estimate.chi2 / estimate.dof:.2f}" if estimate.dof > 0 else ""
    print(
        f"{counted(sum(map(len, estimate.drive.times)), 'keyframe')}, "
        f"{counted(len(estimate.drive.measured), 'measurement')}{agreement}, "
        f"{solution.seconds_frontend + solution.seconds_backend:.0f} s; {out} holds trajectories, landmarks.csv, "
        "team.toml and report.html"
    )
