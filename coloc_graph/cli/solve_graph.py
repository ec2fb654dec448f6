"""coloc solve GRAPH.g2o --out DIR."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.printing import counted, print_json, warn

if TYPE_CHECKING:
    from coloc_graph.pipeline.pose_graph import PoseGraphSolution


def solve_graph(args: argparse.Namespace) -> int:
    """Solve a pose graph, write it and print a summary."""
    from coloc_graph.errors import InputError
    from coloc_graph.pipeline.pose_graph import solve_pose_graph
    from coloc_graph.results.earlier import require_replaceable_graph
    from coloc_graph.results.folder import require_output_folder
    from coloc_graph.results.pose_graph import summarise_pose_graph, write_pose_graph_result
    from coloc_graph.run.output_lock import locked_output

    given = [
        name
        for name in (
            "method",
            "scale",
            "incremental",
            "without_odometry",
            "without_robots",
            "processes",
            "tracking",
            "config",
        )
        if getattr(args, name)
    ]
    if given:
        raise InputError(f"{args.run_path} is a pose graph: --{given[0].replace('_', '-')} applies to runs only")
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
