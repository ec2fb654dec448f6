"""coloc demo: simulate the hallway from rendered images, solve it and print the paper's Table II, or lead it online."""

import argparse

from coloc_graph.cli.place import add_force, require_run_place

#: Standard deviations of mounts [deg, m], of the markers' span [m] and of the floor [deg] in the demo.
IMPERFECTIONS = {"mount_sigma_deg": 1.0, "height_sigma": 5e-3, "span_sigma": 1e-4, "floor_sigma_deg": 0.1}

PACE = 17.0  # duration of a planned mission online [s/m]


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "demo",
        help="simulate the paper's hallway from rendered images, solve it and show it",
        description="Simulate the paper's hallway from rendered images, with mounts that differ from their stated "
        "values, solve it, print the accuracy, and show it in the browser.",
    )
    command.add_argument(
        "--out", default="demo-out", metavar="DIR", help="folder for run and result (default: demo-out)"
    )
    command.add_argument("--stances", type=int, default=40, help="number of stances (default: 40)")
    command.add_argument("--seed", type=int, default=0, help="seed of the simulation (default: 0)")
    command.add_argument("--no-browser", action="store_true", help="do not open the viewer")
    command.add_argument(
        "--online",
        action="store_true",
        help="run the online system instead: three robot programs with simulated wheels and cameras drive the hallway",
    )
    command.add_argument(
        "--plan",
        action="store_true",
        help="with --online: replan the remaining stances after each one, over the same distance",
    )
    command.add_argument(
        "--formation", choices=("paper", "plan"), default="paper", help="with --online: `plan` is --plan"
    )
    command.add_argument(
        "--port", type=int, help="port of the viewer with --online (default: 8080, or the first free one after it)"
    )
    add_force(command)
    command.set_defaults(run=lambda args: online(args) if args.online else run(args))


def run(args: argparse.Namespace) -> int:
    """Simulate, solve, print and show."""
    import sys
    from contextlib import suppress
    from pathlib import Path

    from coloc_graph.cli.accuracy import print_accuracy, print_calibration, print_promised
    from coloc_graph.cli.printing import progress, warn
    from coloc_graph.errors import InputError
    from coloc_graph.pipeline.batch import solve
    from coloc_graph.report import hero_figure
    from coloc_graph.results.folder import holds_result, require_output_folder
    from coloc_graph.results.writer import assess, write_result
    from coloc_graph.run import open_run
    from coloc_graph.simulation import Imperfections, simulate

    out = Path(args.out)
    run_path = out / "hallway.mcap"
    require_output_folder(out / "result")
    require_run_place(str(run_path), force=args.force)
    if not args.force and holds_result(out / "result"):
        raise InputError(f"{out / 'result'} is an earlier result; replace it with --force, or give another folder")
    out.mkdir(parents=True, exist_ok=True)
    try:
        with progress("stances rendered") as report:
            simulate(
                *("hallway", run_path),
                depth="images",
                seed=args.seed,
                stances=args.stances,
                imperfections=Imperfections(**IMPERFECTIONS),
                progress=report,
            )
    except BaseException:
        with suppress(OSError):  # remove the folder again if it is empty
            out.rmdir()
        raise
    with progress("stances measured from the images") as report:
        solution = solve(open_run(run_path), progress=report)
    accuracy = write_result(solution, out / "result")
    picture = out / "hallway.png"
    assessed = assess(solution)
    hero_figure(solution.estimate, assessed[1] if assessed else None).savefig(picture, dpi=130)
    warn(solution.warnings)
    assert accuracy is not None  # a simulated run contains the truth
    print_accuracy(accuracy)
    print_promised(solution.estimate.trajectories)
    print_calibration(solution.estimate.calibration)
    html = out / "result" / "report.html"
    print(f"report: {html}; picture: {picture}; viewer: `coloc view {out / 'result'}`")
    if not args.no_browser and sys.stdout.isatty():
        from coloc_graph.cli.view import show
        from coloc_graph.viewer import Viewer, scene_of_solution

        with Viewer(scene_of_solution(solution), host="127.0.0.1", port=0) as viewer:  # any port that is free
            show(viewer, browser=True)
    return 0


def online(args: argparse.Namespace) -> int:
    """Lead a simulated team down the hallway and print the result."""
    import shutil
    import time
    from pathlib import Path

    from coloc_graph.cli.mission import report, watched
    from coloc_graph.cli.running import until_signal
    from coloc_graph.errors import InputError
    from coloc_graph.online.coordinator import Coordinator
    from coloc_graph.online.mission import MissionOptions
    from coloc_graph.online.mission_states import MissionState
    from coloc_graph.planning.formation import PAPER
    from coloc_graph.simulation.simulated_team import SimulatedTeam, field_team, free_address

    out = Path(args.out) / "online"
    if out.exists():
        if not args.force or not (out / "mission").is_dir():
            raise InputError(f"{out} exists; replace an earlier demo with --force, or give another folder with --out")
        shutil.rmtree(out)
    team, address = field_team(), free_address()
    if args.plan or args.formation == "plan":
        way = max(args.stances * PAPER.leap, 2 * PAPER.leap)
        options = MissionOptions(goals=((way, 0.0),), speed=0.4, formation="plan", pace=PACE)
    else:
        options = MissionOptions(goals=((100.0, 0.0),), stances=args.stances, speed=0.4)
    with (
        until_signal() as stop,
        watched(team, args.port, browser=not args.no_browser) as listener,
        SimulatedTeam(team, out / "field", connect=address, seed=args.seed) as field,
    ):
        field.start()
        began = time.monotonic()
        coordinator = Coordinator(
            team,
            out / "mission",
            options,
            listen=address,
            on_stance=listener.on_stance,
            on_status=listener.on_status,
            on_plan=listener.on_plan,
        )
        with coordinator:
            state = coordinator.run(stop)
    if coordinator.stances == 0:
        return 1
    if not report(out / "mission", field.truth_path, stopped=stop.is_set()):
        return 1
    slowest = max(coordinator.latencies)
    print(
        f"{coordinator.stances} stances in {time.monotonic() - began:.0f} s; delay from the last image of a stance to "
        f"its estimate: at most {slowest:.2f} s; truth: {field.truth_path}"
    )
    return 0 if state == MissionState.DONE else 1
