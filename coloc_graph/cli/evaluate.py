"""coloc evaluate DIR, or --estimate ROBOT=FILE ... --truth ROBOT=FILE ...: compare an estimate with the truth."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_force

if TYPE_CHECKING:
    from coloc_graph.results.comparison import Comparison

#: As in coloc_graph.evaluation, which is too heavy for --help.
ALIGNMENTS = ("reference", "team", "robot", "none")

#: Largest difference of the stamps of two poses that evo associates by default [s].
EVO_DIFFERENCE = 0.01


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "evaluate",
        help="compare a result, or TUM files, with the truth",
        description="Compare a result with the truth in its run, or trajectories of any program (TUM) with others: "
        "lengths, ATE, RPE, NEES, per robot and for the team. See docs/evaluation.md.",
    )
    command.add_argument("dir", metavar="DIR", nargs="?", help="result of `coloc solve`, or folder of <robot>.tum")
    command.add_argument(
        "--truth",
        nargs="+",
        default=[],
        metavar="RUN|DIR|ROBOT=FILE",
        help="run with truth, or TUM files (default: the result's own run)",
    )
    command.add_argument("--run", dest="run_path", metavar="RUN", help="the result's run, if it has moved")
    command.add_argument(
        "--align",
        choices=ALIGNMENTS,
        help="align by the reference robot's first pose, by all poses of the team, each robot on its own, or not at "
        "all (default: reference for results with stances, else team)",
    )
    command.add_argument("--robots", metavar="A,B", help="compare these robots only (default: all)")
    command.add_argument("--rpe", metavar="M,M", type=_distances, help="distances of the RPE [m] (default: 1,2,5,10)")
    command.add_argument(
        "--pairs-from-truth", action="store_true", help="measure the distances of the RPE along the true path"
    )
    command.add_argument(
        "--nearest",
        type=_seconds,
        nargs="?",
        const=EVO_DIFFERENCE,
        metavar="S",
        help="compare with the true pose of the nearest stamp within S seconds, as evo does, instead of interpolating "
        f"(default: {EVO_DIFFERENCE})",
    )
    command.add_argument(
        "--max-gap", type=_seconds, metavar="S", help="longest gap over which truth is interpolated [s] (default: 0.25)"
    )
    command.add_argument("--plot", metavar="FILE|DIR", help="draw one picture (.png, .svg, .pdf), or a folder of three")
    add_force(command)
    command.add_argument("--json", action="store_true", help="print figures as JSON")
    files = command.add_argument_group("TUM files of any program")
    files.add_argument(
        "--estimate", nargs="+", default=[], metavar="ROBOT=FILE", help="TUM files, or a folder of them, instead of DIR"
    )
    files.add_argument("--reference", metavar="ROBOT", help="robot of `--align reference`")
    files.add_argument("--planar", action="store_true", help="take the robots as standing on the plane z = 0")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare, draw and print."""
    from dataclasses import replace

    from coloc_graph.cli.accuracy import print_accuracy, print_errors, print_promised
    from coloc_graph.cli.printing import print_json, warn
    from coloc_graph.errors import InputError
    from coloc_graph.evaluation import RPE_DISTANCES, accuracy_json

    if args.plot:
        from coloc_graph.report.comparison import comparison_drawings, require_plot_path, write_plots

        require_plot_path(args.plot, force=args.force)  # before the work
    comparison = _comparison(args)
    if args.robots:
        comparison = comparison.only([robot for robot in args.robots.split(",") if robot])
    if args.nearest is not None:
        if args.max_gap is not None:
            raise InputError("--max-gap is of interpolation, which --nearest replaces: give one of the two")
        comparison = replace(comparison, nearest=args.nearest)
    if args.max_gap is not None:
        comparison = replace(comparison, max_gap=args.max_gap)
    accuracy, true = comparison.compare(args.rpe or RPE_DISTANCES, "truth" if args.pairs_from_truth else "estimate")
    warn(accuracy.warnings)
    written = []
    if args.plot:
        drawings = comparison_drawings(comparison.estimated, true, accuracy, on_floor=comparison.on_floor)
        written = write_plots(args.plot, drawings, force=args.force)
    if args.json:
        print_json(accuracy_json(accuracy))
        return 0
    print_accuracy(accuracy)
    print_errors(accuracy)
    print_promised(comparison.estimated)
    if written:
        print("written: " + ", ".join(str(path) for path in written))
    return 0


def _comparison(args: argparse.Namespace) -> "Comparison":
    """Return the comparison that the arguments describe."""
    from coloc_graph.errors import InputError
    from coloc_graph.results import comparison

    if bool(args.dir) == bool(args.estimate):
        raise InputError("nothing to compare: give either the folder of a result, or --estimate with TUM files")
    if args.dir and comparison.is_result(args.dir):
        if args.reference or args.planar:
            raise InputError("--reference and --planar apply to TUM files only: a result has them in its team")
        return comparison.of_result(args.dir, args.run_path, args.truth, args.align)
    if args.run_path or not args.truth:
        raise InputError("TUM files need --truth: give a run with truth, or TUM files")
    given = [args.dir] if args.dir else args.estimate
    return comparison.of_files(given, args.truth, args.align, reference=args.reference, on_floor=args.planar)


def _distances(text: str) -> tuple[float, ...]:
    """Parse `1,2,5` as distances [m]."""
    distances = sorted({_positive(part, "distances in metres, as 1,2,5") for part in text.split(",")})
    return tuple(distances)


def _seconds(text: str) -> float:
    return _positive(text, "a time in seconds, as 0.25")


def _positive(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"`{text}` is not positive; give {what}")
    return value
