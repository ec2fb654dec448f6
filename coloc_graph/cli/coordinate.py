"""coloc coordinate TEAM.toml."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser(
        "coordinate",
        help="lead a team of robots along its way, and estimate where all are",
        description="Run once, where all robots can reach it. It waits for their programs (`coloc robot`), leads the "
        "leap-frog, and estimates where all are while they drive. Ctrl-C stops all of them.",
    )
    command.add_argument("team", metavar="TEAM.toml")
    command.add_argument("--out", metavar="DIR", help="folder for the record and the result")
    command.add_argument(
        "--goal",
        action="append",
        type=_place,
        metavar="X,Y",
        help="where the team's middle is to go [m], x ahead, y left of where it begins; more than once for a way with "
        "corners (default 7.2,0)",
    )
    command.add_argument("--stances", type=int, help="end after so many, wherever that is")
    command.add_argument("--mover", metavar="NAME", help="the robot that drives before the others (default: the last)")
    command.add_argument("--speed", type=float, default=0.3, help="of the robots [m/s] (0.3)")
    command.add_argument("--longest", type=float, default=40.0, help="a stance ends after so many seconds (40)")
    command.add_argument("--clock-limit", type=float, default=1.0, metavar="MS", help="how well clocks are known (1)")
    command.add_argument("--listen", default="tcp/127.0.0.1:7447", help="tcp/ADDRESS:PORT, or tls/ADDRESS:PORT")
    command.add_argument("--tls", metavar="DIR", help="folder with its certificate, of `coloc certificates`")
    command.add_argument(
        "--exposed", action="store_true", help="listen for others than this machine without certificates"
    )
    command.add_argument("--resume", action="store_true", help="go on with what is in --out")
    command.add_argument("--view", action="store_true", help="see it in the browser while it goes on")
    command.add_argument("--port", type=int, help="port of --view (default: 8080, or the first free one after it)")
    command.add_argument("--no-browser", action="store_true", help="with --view, do not open a browser")
    command.add_argument("--draw", action="store_true", help="print the phases as a Graphviz drawing, and end")
    command.set_defaults(run=run)


def _place(text: str) -> tuple[float, float]:
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"`{text}` is no place; give X,Y in metres, as in 7.2,0") from None
    return x, y


def run(args: argparse.Namespace) -> int:
    """Lead the team; then solve the record once more in batch, and print."""
    from pathlib import Path

    from coloc_graph.cli.mission import report, watched
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
        raise InputError("a mission is recorded: give a folder with --out")
    if not 0 < args.speed <= 0.5:
        raise InputError(f"a Create drives at up to 0.5 m/s, not at {args.speed}: give --speed between 0 and 0.5")
    team = read_team(args.team)
    options = MissionOptions(
        goals=tuple(args.goal) if args.goal else MissionOptions.goals,
        stances=args.stances,
        mover=args.mover,
        speed=args.speed,
        longest=args.longest,
        clock_limit=args.clock_limit / 1e3,
    )
    out = Path(args.out)
    viewer = watched(team, args.port, browser=not args.no_browser, view=args.view)
    with until_signal() as stop, viewer as listener:
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
        )
        with coordinator:
            state = coordinator.run(stop)
    if coordinator.stances:
        report(out, stopped=stop.is_set())
    return 0 if state == MissionState.DONE else 1
