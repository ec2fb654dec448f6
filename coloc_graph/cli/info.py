"""coloc info RUN."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser(
        "info",
        help="what is in a run, and what is wrong with it",
        description="What is in a run, and what is wrong with it, without looking into its images. The exit code is 0 "
        "also where problems are found (count them in --json), and 2 where the run cannot be read.",
    )
    command.add_argument("run_path", metavar="RUN", help="the run (.mcap)")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Look and print."""
    from coloc_graph.cli.printing import counted, print_json, print_table
    from coloc_graph.inspection import inspect
    from coloc_graph.run import open_run, read_truth
    from coloc_graph.run.schemas import topic_of

    opened = open_run(args.run_path)
    findings = inspect(opened)
    truth = {robot: len(poses) for robot, poses in sorted(read_truth(args.run_path).items())}
    topics = opened.topics | {topic_of(robot, "truth"): count for robot, count in truth.items()}
    seconds = (opened.end - opened.start) if opened.start is not None and opened.end is not None else 0.0
    if args.json:
        print_json(
            {
                "robots": list(opened.team.names),
                "reference": opened.team.reference,
                "stances": len(opened.stances),
                "seconds": seconds,
                "topics": topics,
                "truth": list(truth),
                "problems": [{"where": finding.where, "what": finding.what} for finding in findings],
            }
        )
        return 0
    print(f"{args.run_path}: {counted(len(opened.stances), 'stance')} in {seconds:.1f} s")
    print(f"team: {', '.join(opened.team.names)}; reference {opened.team.reference}")
    print(f"truth: {', '.join(truth) if truth else 'none'}")
    print_table(["topic", "messages"], [[topic, str(count)] for topic, count in sorted(topics.items())])
    if not findings:
        print("nothing wrong was found")
    for finding in findings:
        print(f"problem: {finding.where}: {finding.what}")
    return 0
