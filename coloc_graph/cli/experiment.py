"""coloc experiment fig4|fig5|table1|table2: simulate the paper's experiments and compare with its figures."""

import argparse
from typing import Any

from coloc_graph.cli.place import add_force
from coloc_graph.cli.printing import print_json, print_table, progress

NAMES = ("fig4", "fig5", "table1", "table2")


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser("experiment", help="reproduce a figure or table of the paper")
    command.add_argument("name", choices=NAMES, help="figure or table of the paper")
    command.add_argument(
        "--depth",
        choices=("tracks", "images"),
        default="tracks",
        help="simulate marker centres, or render images (default: tracks)",
    )
    command.add_argument("--seed", type=int, default=0, help="seed; tables use the following ones too (default: 0)")
    command.add_argument(
        "--runs",
        type=int,
        metavar="N",
        help="draws for each cell of fig4 and fig5 (default: 500), or seeds (default: table1 10, table2 2)",
    )
    command.add_argument(
        "--draws", type=int, metavar="N", help="points drawn for each run of fig4 and fig5 (default: 50 of 250)"
    )
    command.add_argument("--out", metavar="DIR", help="folder for figure and numbers (default: experiment-NAME)")
    command.add_argument(
        "--processes", type=int, default=2, metavar="N", help="number of worker processes (default: 2)"
    )
    command.add_argument("--cluster", metavar="ADDRESS", help="use the Dask scheduler at tcp://HOST:PORT instead")
    add_force(command)
    command.add_argument("--json", action="store_true", help="print all numbers as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the experiment, write and print its results."""
    from coloc_graph import experiments
    from coloc_graph.errors import InputError
    from coloc_graph.experiments.output import as_json

    out = args.out or f"experiment-{args.name}"
    experiments.require_output_folder(out, args.name, force=args.force)  # before the work
    options: dict[str, Any] = {key: getattr(args, key) for key in ("depth", "seed", "processes", "cluster")}
    options |= {key: value for key in ("runs", "draws") if (value := getattr(args, key)) is not None}
    single_step = args.name in ("fig4", "fig5")
    if "draws" in options and not single_step:
        raise InputError(f"--draws applies to fig4 and fig5, not to {args.name}: omit it")
    with progress("cells measured" if single_step else "runs solved") as report:
        result = getattr(experiments, args.name)(**options, progress=report)
    paths = experiments.save(result, out)
    if args.json:
        print_json(as_json(result))
        return 0
    print_table(result.header, result.rows)
    print(result.summary)
    print("written: " + ", ".join(str(path) for path in paths))
    return 0
