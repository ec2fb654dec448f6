"""coloc fetch-example --out RUN."""

import argparse

from coloc_graph.cli.place import add_out, require_run_place


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "fetch-example",
        help="write the example run that comes with the package: a leap-frog with ground truth",
        description="Write the example run that comes with the package: three robots leap-frog over 2.2 m, seen by "
        "rendered cameras, with ground truth. It needs no network. docs/data-set.md describes it.",
    )
    add_out(command)
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Copy the run out of the package."""
    from coloc_graph.run.atomic_file import require_writable
    from coloc_graph.simulation.example import write_example

    require_run_place(args.out, force=args.force)
    require_writable(args.out, force=args.force, what="a run")
    write_example(args.out)
    print(args.out)
    return 0
