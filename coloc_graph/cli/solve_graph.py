"""coloc solve GRAPH.g2o|GRAPH.pyfg|GRAPH.jrl --out DIR."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.printing import counted, print_json, warn

if TYPE_CHECKING:
    from coloc_graph.pipeline.pose_graph import PoseGraphSolution

#: Options of `coloc solve` that apply to runs only.
OF_RUNS = (
    "method",
    "scale",
    "incremental",
    "lag",
    "without_odometry",
    "without_robots",
    "processes",
    "tracking",
    "config",
)


def solve_ranges(args: argparse.Namespace) -> int:
    """Solve a range graph, write it and print a summary."""
    from coloc_graph.pipeline.range_graph import solve_range_graph
    from coloc_graph.results.earlier import require_replaceable_graph
    from coloc_graph.results.folder import require_output_folder
    from coloc_graph.results.range_graph import summarise_range_graph, write_range_graph_result
    from coloc_graph.run.output_lock import locked_output

    _require_none(args, "a range graph", (*OF_RUNS, "lenient", "view"))
    require_output_folder(args.out)
    require_replaceable_graph(args.run_path, args.out, force=args.force)
    with locked_output(args.out):
        solution = solve_range_graph(args.run_path)
        write_range_graph_result(solution, args.out)
    if args.json:
        print_json(summarise_range_graph(solution))
        return 0
    if solution.rejected:
        worst, sigmas = max(solution.rejected, key=lambda one: one[1])
        warn([
            f"{len(solution.rejected)} of {len(solution.graph.ranges)} ranges were rejected as outliers, the worst "
            f"that of {worst.first} and {worst.second} ({sigmas:.0f} sigmas)"
        ])  # fmt: skip
    graph = solution.graph
    agreement = f", chi2/dof {solution.chi2 / solution.dof:.3f}" if solution.dof > 0 else ""
    print(
        f"{counted(len(solution.values), 'variable')}, {counted(len(graph.relatives), 'relative pose')}, "
        f"{counted(len(graph.ranges), 'range')}{agreement}; {solution.seconds:.1f} s; {args.out} holds graph.pyfg and "
        "summary.json"
    )
    if (errors := solution.errors) is not None:
        by_robot = ", ".join(f"{robot} {100 * error:.1f} cm" for robot, error in errors.by_robot.items())
        marks = "" if errors.landmarks is None else f"; landmarks {100 * errors.landmarks:.1f} cm"
        print(
            f"RMS position error after one alignment of the team {100 * errors.position:.1f} cm ({by_robot}){marks}; "
            f"NEES per degree of freedom {errors.nees:.2f}"
        )
    return 0


def _require_none(args: argparse.Namespace, what: str, names: tuple[str, ...]) -> None:
    """Raise `InputError` where an option is given that does not apply."""
    from coloc_graph.errors import InputError

    given = [name for name in names if getattr(args, name)]
    if given:
        raise InputError(f"{args.run_path} is {what}: --{given[0].replace('_', '-')} applies to runs only")


def solve_graph(args: argparse.Namespace) -> int:
    """Solve a pose graph, write it and print a summary."""
    from coloc_graph.pipeline.pose_graph import solve_pose_graph
    from coloc_graph.results.earlier import require_replaceable_graph
    from coloc_graph.results.folder import require_output_folder
    from coloc_graph.results.pose_graph import summarise_pose_graph, write_pose_graph_result
    from coloc_graph.run.output_lock import locked_output

    _require_none(args, "a pose graph", OF_RUNS)
    require_output_folder(args.out)
    require_replaceable_graph(args.run_path, args.out, force=args.force)
    with locked_output(args.out):
        solution = solve_pose_graph(args.run_path, lenient=args.lenient)
        write_pose_graph_result(solution, args.out)
    graph = solution.graph
    if graph.projected or graph.left_out:
        edges = graph.factors.size() - len(graph.fixed) + graph.left_out
        warn([
            f"{args.run_path}: the information of {graph.projected + graph.left_out} of {edges} edges is not positive "
            f"definite: {graph.projected} were projected, {graph.left_out} without any information left out"
        ])  # fmt: skip
    if args.json:
        print_json(summarise_pose_graph(solution))
    else:
        _print(solution, args.out)
    if args.view:
        from coloc_graph.cli.view import show, take_port
        from coloc_graph.viewer import Viewer, scene_of_pose_graph

        with take_port(args.port) as listener, Viewer(scene_of_pose_graph(args.out), listener=listener) as viewer:
            show(viewer, browser=not args.no_browser)
    return 0


def _print(solution: "PoseGraphSolution", out: str) -> None:
    graph = solution.graph
    agreement = f", chi2/dof {solution.chi2 / solution.dof:.3f}" if solution.dof > 0 else ""
    print(
        f"{counted(graph.values.size(), 'pose')} in {'2D' if graph.planar else '3D'}, "
        f"{counted(graph.factors.size() - len(graph.fixed), 'edge')}: chi2 {solution.chi2_before:.6g} before and "
        f"{solution.chi2:.6g} after {counted(solution.iterations, 'iteration')}{agreement}; {solution.seconds:.1f} s; "
        f"{out} holds graph.g2o and summary.json"
    )
