"""coloc info RUN."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("info", help="what is in a run, and what is wrong with it")
    command.add_argument("run_path", metavar="RUN", help="the run (.mcap)")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Look and print."""
    from coloc_graph.cli.printing import print_json, print_table
    from coloc_graph.inspection import inspect
    from coloc_graph.run import open_run, read_truth

    opened = open_run(args.run_path)
    findings = inspect(opened)
    truth = sorted(read_truth(args.run_path))
    seconds = (opened.end - opened.start) if opened.start is not None and opened.end is not None else 0.0
    if args.json:
        print_json(
            {
                "robots": list(opened.team.names),
                "reference": opened.team.reference,
                "stances": len(opened.stances),
                "seconds": seconds,
                "topics": opened.topics,
                "truth": truth,
                "problems": [{"where": finding.where, "what": finding.what} for finding in findings],
            }
        )
        return 0
    print(f"{args.run_path}: {len(opened.stances)} stances in {seconds:.1f} s")
    print(f"team: {', '.join(opened.team.names)}; reference {opened.team.reference}")
    print(f"truth: {', '.join(truth) if truth else 'none'}")
    print_table(["topic", "messages"], [[topic, str(count)] for topic, count in sorted(opened.topics.items())])
    if not findings:
        print("nothing wrong was found")
    for finding in findings:
        print(f"problem: {finding.where}: {finding.what}")
    return 0
