"""coloc solve RUN --out DIR."""

import argparse

from coloc_graph.cli.printing import counted, print_json, progress, warn


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("solve", help="estimate the poses of a run")
    command.add_argument("run_path", metavar="RUN", help="the run (.mcap)")
    command.add_argument("--out", required=True, metavar="DIR", help="folder for the result")
    command.add_argument(
        "--method",
        choices=("chain", "smooth", "joint"),
        default="joint",
        help="chain is the paper's, joint calibrates mounts along",
    )
    command.add_argument(
        "--scale",
        choices=("heights", "span"),
        default="heights",
        help="the plane's distance from the heights of camera and markers, or from the markers' span",
    )
    command.add_argument("--incremental", action="store_true", help="feed it stance by stance, as in the field")
    command.add_argument("--without-odometry", action="store_true", help="leave out what the wheels say")
    command.add_argument("--json", action="store_true", help="print the summary as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Solve, write, print."""
    import statistics
    from dataclasses import replace

    from coloc_graph.cli.accuracy import print_accuracy, print_calibration, print_last_poses, print_promised
    from coloc_graph.errors import ColocError
    from coloc_graph.pipeline import SolveOptions, solve
    from coloc_graph.results import holds_result, require_place, summarise, write_result
    from coloc_graph.run import open_run

    require_place(args.out)  # before the work, not after it
    options = SolveOptions(
        method=args.method, odometry=not args.without_odometry, incremental=args.incremental
    ).resolved()
    assert options.frontend is not None
    options = replace(options, frontend=replace(options.frontend, scale=args.scale))
    try:
        with progress("measurements made") as report:
            solution = solve(open_run(args.run_path), options, report)
        accuracy = write_result(solution, args.out)
    except ColocError as error:
        if holds_result(args.out):
            raise type(error)(f"{error}; {args.out} still holds an earlier result") from error
        raise
    warn(solution.warnings)
    if args.json:
        print_json(summarise(solution, accuracy))
        return 0
    estimate = solution.estimate
    if accuracy is None:
        print_last_poses(estimate.trajectories)
    else:
        print_accuracy(accuracy)
        print_promised(estimate.trajectories)
    print_calibration(estimate.calibration)
    if solution.seconds_updates:
        median, longest = 1000 * statistics.median(solution.seconds_updates), 1000 * max(solution.seconds_updates)
        print(f"a stance entered in {median:.1f} ms (median; at most {longest:.1f} ms)")
    agreement = f", chi2/dof {estimate.chi2 / estimate.dof:.2f}" if estimate.dof > 0 else ""
    print(
        f"{solution.used} of {counted(len(solution.measurements), 'measurement')} used{agreement}; "
        f"{args.out} holds trajectories, measurements.csv and report.html"
    )
    return 0
