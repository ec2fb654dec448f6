"""coloc solve RUN|FOLDER|GRAPH.g2o|GRAPH.pyfg --out DIR."""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_force
from coloc_graph.cli.printing import counted, print_json, progress, warn

if TYPE_CHECKING:
    from socket import socket

    from coloc_graph.backend.planar import Latest
    from coloc_graph.evaluation import Accuracy
    from coloc_graph.frontend import TrackerOptions
    from coloc_graph.pipeline.batch import EnteredStance, Solution, SolveOptions
    from coloc_graph.run import Run
    from coloc_graph.team import Team


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "solve",
        help="estimate the poses of a run, of each run in a folder, or of a pose graph",
        description="Estimate the poses of all robots of a run and write them, with covariances, measurements and a "
        "report, to a folder.",
    )
    command.add_argument(
        "run_path",
        metavar="RUN|FOLDER|GRAPH",
        help="run (.mcap), folder of runs, pose graph (.g2o) or range graph (.pyfg, .jrl)",
    )
    command.add_argument("--out", required=True, metavar="DIR", help="folder for the result, or for those of all runs")
    add_force(command)
    command.add_argument(
        "--config",
        metavar="TOML",
        help="take the options from config.toml of a result; those given here replace them",
    )
    command.add_argument("--incremental", action="store_true", help="solve stance by stance, as online")
    command.add_argument(
        "--lag",
        type=float,
        metavar="N",
        help="with --incremental: number of last stances, or seconds of a ranging run, whose poses stay variables "
        "(default: 50 stances, 40 s)",
    )
    command.add_argument(
        "--tracking",
        nargs="+",
        metavar="NAME=VALUE",
        help="of runs with stances: options of the tracking of markers, as speed=400 (see [tracking] in docs/team.md; "
        "default: as the team states, or as usual)",
    )
    command.add_argument("--json", action="store_true", help="print the summary as JSON")
    viewer = command.add_argument_group("viewer")
    viewer.add_argument(
        "--view", action="store_true", help="show the result in the browser; with --incremental, while solving"
    )
    viewer.add_argument("--port", type=int, help="port of --view (default: 8080, or the first free one after it)")
    viewer.add_argument("--no-browser", action="store_true", help="do not open a browser with --view")
    stances = command.add_argument_group("runs with stances")
    stances.add_argument(
        "--method",
        choices=("chain", "smooth", "joint"),
        help="chain: the paper's method; smooth: pose graph; joint: also calibrate mounts (default: joint)",
    )
    stances.add_argument(
        "--scale",
        choices=("heights", "span"),
        help="take the marker plane's distance from the heights of camera and markers, or from the markers' span "
        "(default: heights)",
    )
    stances.add_argument("--without-odometry", action="store_true", help="ignore wheel odometry")
    ranges = command.add_argument_group("runs with ranges and bearings")
    ranges.add_argument("--without-robots", action="store_true", help="ignore measurements between robots")
    folder = command.add_argument_group("folder of runs")
    folder.add_argument("--processes", type=int, metavar="N", help="number of worker processes (default: CPU count)")
    folder.add_argument("--cluster", metavar="ADDRESS", help="use the Dask scheduler at tcp://HOST:PORT instead")
    graph = command.add_argument_group("pose graph")
    graph.add_argument(
        "--lenient",
        action="store_true",
        help="project information matrices that are not positive definite, and report their number",
    )
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Solve, write and print, and show the result with --view."""
    from contextlib import nullcontext

    if Path(args.run_path).suffix.lower() == ".g2o":
        from coloc_graph.cli.solve_graph import solve_graph

        return solve_graph(args)
    if Path(args.run_path).suffix.lower() in (".pyfg", ".jrl"):
        from coloc_graph.cli.solve_graph import solve_ranges

        return solve_ranges(args)
    from coloc_graph.cli.view import take_port

    with take_port(args.port) if args.view else nullcontext() as listener:  # before the work, not after it
        return _run(args, listener)


def _run(args: argparse.Namespace, listener: "socket | None") -> int:
    from coloc_graph.cli.solve_many import solve_folder
    from coloc_graph.cli.view import announce, show
    from coloc_graph.errors import InputError
    from coloc_graph.pipeline.batch import EnteredStance
    from coloc_graph.pipeline.contents import require_applicable
    from coloc_graph.results.config import require_same_team
    from coloc_graph.results.earlier import require_replaceable
    from coloc_graph.results.folder import require_output_folder
    from coloc_graph.run import open_run

    options, team = _options(args)
    if args.lenient:
        raise InputError(f"{args.run_path} is not a pose graph (.g2o): --lenient applies to pose graphs only")
    if Path(args.run_path).is_dir():
        return solve_folder(args, options)
    if args.processes is not None or args.cluster is not None:
        raise InputError(f"{args.run_path} is not a folder of runs: --processes and --cluster apply to folders only")
    require_output_folder(args.out)  # before the work
    with _earlier_result_named(args.out):
        logged = open_run(args.run_path)
        if team is not None:
            require_same_team(team, logged.team, args.config, args.run_path)
        kind = require_applicable(logged, options)
    require_replaceable(args.run_path, args.out, options, force=args.force)
    if not args.view:
        _solved(args, logged, options)
        return 0

    from coloc_graph.viewer import LiveStance, Viewer, empty_scene, scene_of_solution

    if not options.incremental or kind == "ranges":
        solution = _solved(args, logged, options)
        with Viewer(scene_of_solution(solution), listener=listener) as viewer:
            show(viewer, browser=not args.no_browser)
        return 0
    resolved = options.resolved()
    assert resolved.method is not None  # resolved
    with Viewer(empty_scene(logged, resolved.method, resolved.frontend), listener=listener) as viewer:

        def on_update(one: "EnteredStance | Latest") -> None:
            assert isinstance(one, EnteredStance)  # the run is solved by its stances
            viewer.publish(LiveStance(one.stance, one.estimate, one.measurements, one.pairs))

        announce(viewer, browser=not args.no_browser)
        solution = _solved(args, logged, options, on_update)
        with suppress(KeyboardInterrupt):  # the result is written: Ctrl-C ends the viewer only
            viewer.publish(scene_of_solution(solution))
            viewer.wait_closed()
    return 0


def _options(args: argparse.Namespace) -> "tuple[SolveOptions, Team | None]":
    """Options of --config, replaced by those given; and the team that they were used with, if the file states it."""
    from dataclasses import replace

    from coloc_graph._version import __version__
    from coloc_graph.pipeline.options import SolveOptions

    options, team, version = SolveOptions(), None, __version__
    if args.config is not None:
        from coloc_graph.results.config import read_options

        options, team, version = read_options(args.config)
    if version != __version__:
        warn([f"{args.config} is of version {version}: this version may give another result"])
    if args.method is not None and args.method != options.method:
        # the front end of another method is not that of this one
        options = replace(options, method=args.method, frontend=None)
    options = replace(
        options,
        odometry=options.odometry and not args.without_odometry,
        incremental=options.incremental or args.incremental,
        between_robots=options.between_robots and not args.without_robots,
        lag=options.lag if args.lag is None else args.lag,
    )
    if args.scale is not None or args.tracking:
        frontend = options.resolved().frontend
        assert frontend is not None  # resolved
        scale = frontend.scale if args.scale is None else args.scale
        tracker = _tracker(args.tracking) if args.tracking else frontend.tracker
        options = replace(options, frontend=replace(frontend, scale=scale, tracker=tracker))
    return options, team


def _tracker(given: list[str]) -> "TrackerOptions":
    """Options of the tracker, of NAME=VALUE each."""
    import msgspec

    from coloc_graph.errors import InputError
    from coloc_graph.frontend import TrackerOptions
    from coloc_graph.team import Tracking

    fields = dict(one.partition("=")[::2] for one in given)
    try:
        stated = msgspec.convert(fields, Tracking, strict=False)
    except msgspec.ValidationError as error:
        known = ", ".join(one.name for one in msgspec.structs.fields(Tracking))
        raise InputError(f"--tracking: {error}; give NAME=VALUE of {known}") from error
    chosen = {name: value for name, value in msgspec.structs.asdict(stated).items() if value is not None}
    return TrackerOptions(**chosen)


@contextmanager
def _earlier_result_named(out: str) -> Iterator[None]:
    """Mention in errors that an earlier result is still there, so that it is not taken for the new one."""
    from coloc_graph.errors import ColocError
    from coloc_graph.results.folder import holds_result

    try:
        yield
    except ColocError as error:
        if holds_result(out):
            raise type(error)(f"{error}; {out} still holds an earlier result") from error
        raise


def _solved(
    args: argparse.Namespace,
    run: "Run",
    options: "SolveOptions",
    on_update: "Callable[[EnteredStance | Latest], None] | None" = None,
) -> "Solution":
    """Solve, write and print."""
    from coloc_graph.pipeline.batch import solve
    from coloc_graph.pipeline.contents import kind_of
    from coloc_graph.results.writer import summarise, with_truth_warning, write_result
    from coloc_graph.run.output_lock import locked_output

    label = "stances measured" if kind_of(run) == "stances" else "seconds of the run done"
    with _earlier_result_named(args.out), locked_output(args.out):
        with progress(label) as report:
            solution = solve(run, options, report, on_update)
        accuracy = write_result(solution, args.out)
    if accuracy is None:
        solution = with_truth_warning(solution)
    warn([*solution.warnings, *(accuracy.warnings if accuracy else ())])
    if args.json:
        print_json(summarise(solution, accuracy))
    else:
        _print(solution, accuracy, args.out)
    sys.stdout.flush()  # a pipe must not wait until the viewer is closed
    return solution


def _print(solution: "Solution", accuracy: "Accuracy | None", out: str) -> None:
    """Print accuracy or last poses, calibration, and the numbers of measurements."""
    import statistics

    from coloc_graph.cli.accuracy import (
        print_accuracy,
        print_calibration,
        print_last_poses,
        print_noise,
        print_online,
        print_promised,
    )
    from coloc_graph.results.writer import assess_online

    estimate = solution.estimate
    if accuracy is not None:
        print_accuracy(accuracy)
        print_promised(estimate.trajectories)
    compared = set() if accuracy is None else {row.robot for row in accuracy.robots}
    if uncompared := {robot: one for robot, one in estimate.trajectories.items() if robot not in compared}:
        print_last_poses(uncompared)
    if (online := assess_online(solution)) is not None:
        print_online(online)
    print_calibration(estimate.calibration)
    if solution.noise is not None:
        print_noise(solution.noise.rows(solution.run.team))
    if solution.seconds_updates:
        median, longest = 1000 * statistics.median(solution.seconds_updates), 1000 * max(solution.seconds_updates)
        what = "a second of the run" if estimate.is_ranging else "a stance"
        print(f"update time for {what}: median {median:.1f} ms, maximum {longest:.1f} ms")
    agreement = f", chi2/dof {estimate.chi2 / estimate.dof:.2f}" if estimate.dof > 0 else ""
    count = solution.count
    others = [
        f", {one.rejected} of {counted(one.used + one.rejected, f'{kind} measurement')} rejected"
        for kind, one in list(solution.counts.items())[1:]
        if one.rejected
    ]
    print(
        f"{count.used} of {counted(count.used + count.rejected, 'measurement')} used{''.join(others)}{agreement}; "
        f"{out} holds trajectories, measurements.csv and report.html"
    )
