"""coloc solve FOLDER --out DIR: solve every run in a folder."""

import argparse
from typing import TYPE_CHECKING, Any

from coloc_graph.cli.printing import counted, note, print_json, print_table

if TYPE_CHECKING:
    from coloc_graph.pipeline.batch import SolveOptions
    from coloc_graph.results.many_runs import Outcome


def solve_folder(args: argparse.Namespace, options: "SolveOptions") -> int:
    """Solve all runs and print a line for each; return 1 if one of them failed."""
    import os
    from functools import partial

    from coloc_graph.errors import InputError
    from coloc_graph.results.executors import workers
    from coloc_graph.results.many_runs import result_folders, runs_in, solve_runs
    from coloc_graph.run.output_lock import locked_output

    if args.view:
        raise InputError("--view shows one run: solve the folder without it, and view one of its results")
    runs = runs_in(args.run_path)
    places = result_folders(runs, args.run_path, args.out)
    processes = min(os.cpu_count() or 1 if args.processes is None else args.processes, len(runs))
    done = 0

    def on_outcome(outcome: "Outcome") -> None:
        nonlocal done
        done += 1
        what = outcome.failed or ("solved before" if outcome.resumed else "solved")
        named = what if what.startswith(str(outcome.run)) else f"{outcome.run}: {what}"
        note(f"{done} of {len(runs)}: {named}")

    executors = partial(workers, processes, args.cluster)
    with locked_output(args.out):
        outcomes = solve_runs(runs, places, options, executors=executors, force=args.force, on_outcome=on_outcome)
    failed = [one for one in outcomes if one.failed]
    if args.json:
        print_json([_as_json(one) for one in outcomes])
    else:
        header = ("run", "used", "chi2/dof", "length error", "ATE")
        print_table(header, [_row(str(one.run.relative_to(args.run_path)), one) for one in outcomes])
        resumed = sum(one.resumed for one in outcomes)
        print(
            f"{counted(len(runs), 'run')}: {len(runs) - len(failed) - resumed} solved, {resumed} solved before, "
            f"{len(failed)} failed; results are in {args.out}"
        )
    return 1 if failed else 0


def _as_json(one: "Outcome") -> dict[str, Any]:
    state = "failed" if one.failed else "resumed" if one.resumed else "solved"
    return {"run": str(one.run), "out": str(one.out), "state": state, "why": one.failed, "summary": one.summary}


def _row(name: str, one: "Outcome") -> tuple[str, ...]:
    if one.failed:
        return name, "", "", "", "failed"
    summary = one.summary
    used = summary["measurements"]["used"]
    fit = f"{summary['chi2'] / summary['dof']:.2f}" if summary["dof"] else ""
    accuracy = summary.get("accuracy")
    if accuracy is None:
        return name, str(used), fit, "", ""
    errors = [abs(error) for error in accuracy["length_error_percent"].values() if error is not None]
    return (
        name,
        str(used),
        fit,
        f"{max(errors):.2f} %" if errors else "",
        f"{1000 * accuracy['ate_m']:.1f} mm" if accuracy["ate_m"] is not None else "",
    )
