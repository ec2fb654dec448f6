"""coloc coordinate TEAM.toml."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "coordinate",
        help="lead a team of robots, and estimate their poses online",
        description="Coordinate a mission: wait for the robots' programs (`coloc robot`), lead the leap-frog, and "
        "estimate all poses online. Run it once, where all robots can reach it. Ctrl-C stops all robots.",
    )
    command.add_argument("team", metavar="TEAM.toml", help="description of the team")
    command.add_argument("--out", metavar="DIR", help="folder of the mission: record, log and result")
    command.add_argument(
        "--goal",
        action="append",
        type=waypoint,
        metavar="X,Y",
        help="waypoint of the middle of the observers [m], x ahead and y left of its start; repeat it for a path with "
        "corners (default: 7.2,0)",
    )
    command.add_argument("--stances", type=int, metavar="N", help="end after N stances (default: at the goal)")
    command.add_argument(
        "--mover",
        metavar="NAME",
        help="robot that drives before the others' cameras (default: the last; with --plan the one of which the others "
        "promise most)",
    )
    command.add_argument(
        "--speed", type=float, default=0.3, metavar="V", help="speed of the robots [m/s] (default: 0.3)"
    )
    command.add_argument(
        "--longest", type=float, default=40.0, metavar="S", help="longest duration of a stance [s] (default: 40)"
    )
    command.add_argument(
        "--plan",
        action="store_true",
        help="plan leaps, drives and their durations anew after each stance, for the least uncertainty at the goal",
    )
    command.add_argument(
        "--formation", choices=("paper", "plan"), default="paper", help="`plan` is --plan (default: paper)"
    )
    command.add_argument(
        "--pace",
        type=float,
        default=25.0,
        metavar="S",
        help="with --plan: seconds of the mission a metre, leaps included (default: 25)",
    )
    command.add_argument("--map", metavar="YAML", help="with --plan: ROS map_server map of the walls")
    command.add_argument(
        "--clock-limit",
        type=float,
        default=1.0,
        metavar="MS",
        help="largest sigma of a robot's clock [ms] (default: 1)",
    )
    command.add_argument(
        "--listen",
        default="tcp/127.0.0.1:7447",
        metavar="ADDRESS",
        help="tcp/HOST:PORT, or tls/HOST:PORT (default: %(default)s)",
    )
    command.add_argument("--tls", metavar="DIR", help="folder with its certificate, from `coloc certificates`")
    command.add_argument("--exposed", action="store_true", help="accept other machines without certificates")
    command.add_argument("--resume", action="store_true", help="continue the mission in --out")
    command.add_argument(
        "--ros2",
        nargs="?",
        const="127.0.0.1",
        metavar="ADDRESS",
        help="publish tf, poses, paths and markers to ROS 2 on the interface with this address (default: this machine "
        "only)",
    )
    command.add_argument("--view", action="store_true", help="show the mission in a browser")
    command.add_argument("--port", type=int, help="port of --view (default: 8080, or the first free one after it)")
    command.add_argument("--no-browser", action="store_true", help="with --view: do not open a browser")
    command.add_argument("--draw", action="store_true", help="print the states as a Graphviz graph, and end")
    command.set_defaults(run=run)


def waypoint(text: str) -> tuple[float, float]:
    """Parse a waypoint `X,Y` [m]."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"`{text}` is not a waypoint; give X,Y in metres, as in 7.2,0") from None
    return x, y


def run(args: argparse.Namespace) -> int:
    """Lead the team, then solve the record and print the result."""
    from pathlib import Path

    from coloc_graph.cli.mission import both, published, report, watched
    from coloc_graph.cli.running import until_signal
    from coloc_graph.errors import InputError
    from coloc_graph.online.coordinator import Coordinator
    from coloc_graph.online.mission import MissionOptions
    from coloc_graph.online.mission_states import MissionState, as_dot
    from coloc_graph.robot_io.link.zenoh_config import tls_of
    from coloc_graph.team import read_team

    if args.draw:
        print(as_dot())
        return 0
    if args.out is None:
        raise InputError("a mission needs a folder: give one with --out")
    if not 0 < args.speed <= 0.5:
        raise InputError(f"a Create drives at up to 0.5 m/s, not at {args.speed}: give --speed between 0 and 0.5")
    if not 0 < args.pace < 1e4:
        raise InputError(f"--pace is {args.pace}; give seconds of the mission a metre, above 0")
    if args.map is not None and not (args.plan or args.formation == "plan"):
        raise InputError("--map is of plans: give --plan, too")
    team = read_team(args.team)
    options = MissionOptions(
        goals=tuple(args.goal) if args.goal else MissionOptions.goals,
        stances=args.stances,
        mover=args.mover,
        speed=args.speed,
        longest=args.longest,
        clock_limit=args.clock_limit / 1e3,
        formation="plan" if args.plan else args.formation,
        pace=args.pace,
        map_path=None if args.map is None else Path(args.map),
    )
    out = Path(args.out)
    viewer = watched(team, args.port, browser=not args.no_browser, view=args.view)
    with published(team, args.ros2) as ros, until_signal() as stop, viewer as shown:
        listener = both(shown, ros)
        coordinator = Coordinator(
            team,
            out,
            options,
            listen=args.listen,
            tls=tls_of(args.tls, "coordinator") if args.tls else None,
            exposed=args.exposed,
            resume=args.resume,
            on_stance=listener.on_stance,
            on_status=listener.on_status,
            on_plan=listener.on_plan,
        )
        with coordinator:
            state = coordinator.run(stop)
    if coordinator.stances:
        report(out, stopped=stop.is_set())
    return 0 if state == MissionState.DONE else 1
