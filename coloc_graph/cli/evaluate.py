"""coloc evaluate DIR."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("evaluate", help="compare a result with the truth in its run")
    command.add_argument("dir", metavar="DIR", help="a result of `coloc solve`")
    command.add_argument("--run", dest="run_path", metavar="RUN", help="the run, if it is no longer where it was")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Evaluate and print."""
    from coloc_graph.cli.accuracy import print_accuracy, print_promised
    from coloc_graph.cli.printing import print_json
    from coloc_graph.errors import InputError
    from coloc_graph.evaluation import align, evaluate
    from coloc_graph.results import accuracy_json, read_result
    from coloc_graph.run import open_run, read_truth

    result = read_result(args.dir)
    run_path = args.run_path or result.run_path
    result.require_run(run_path)
    team = open_run(run_path).team
    truth = read_truth(run_path)
    if not truth:
        raise InputError(f"{run_path}: the run holds no truth to compare with; record it on /<robot>/truth")
    on_floor = team.floor is not None
    true = align(result.trajectories, truth, team.reference, on_floor=on_floor)
    accuracy = evaluate(result.trajectories, true, on_floor=on_floor)
    if args.json:
        print_json(accuracy_json(accuracy))
    else:
        print_accuracy(accuracy)
        print_promised(result.trajectories)
    return 0
