"""coloc solve RUN --out DIR."""

import argparse
from typing import TYPE_CHECKING, Any

from coloc_graph.cli.printing import counted, print_json, progress, warn

if TYPE_CHECKING:
    from coloc_graph.pipeline import Solution


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
    command.add_argument(
        "--view", action="store_true", help="see it in the browser; with --incremental, its stances enter one by one"
    )
    command.add_argument("--port", type=int, default=8080, help="of --view (8080)")
    command.add_argument("--no-browser", action="store_true", help="with --view, do not open a browser")
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
    if args.view:
        from coloc_graph.viewer.server import require_free

        require_free("127.0.0.1", args.port)
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
        return _view(args, solution) if args.view else 0
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
    return _view(args, solution) if args.view else 0


def _view(args: argparse.Namespace, solution: "Solution") -> int:
    """Show a solution until Ctrl-C; an incremental one enters again, stance by stance, slowly enough to be seen."""
    import time

    from coloc_graph.backend import replay
    from coloc_graph.cli.view import show
    from coloc_graph.viewer import LiveStance, Viewer, empty_scene, scene_of_solution

    graph, options = solution.estimate.graph, solution.options.resolved()
    final = scene_of_solution(solution)
    start = empty_scene(solution.run, options.method, options.frontend) if args.incremental else final
    pause = min(0.3, 20 / len(graph.stances))
    with Viewer(start, port=args.port) as viewer:

        def enter(*entered: Any) -> None:
            viewer.publish(LiveStance(*entered))
            time.sleep(pause)

        def work() -> None:
            replay(graph, options.method, enter)
            viewer.publish(final)

        show(viewer, browser=not args.no_browser, work=work if args.incremental else None)
    return 0
