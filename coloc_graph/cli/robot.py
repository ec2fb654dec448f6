"""coloc robot NAME TEAM.toml."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser(
        "robot",
        help="a robot's own program: its camera and wheels, led by the coordinator",
        description="Run on each robot. It sees, counts its wheels, and drives where the coordinator sends it; without "
        "the coordinator it stands. Ctrl-C stops the wheels and ends it.",
    )
    command.add_argument("name", metavar="NAME", help="which robot of the team this is")
    command.add_argument("team", metavar="TEAM.toml")
    command.add_argument("--out", required=True, metavar="DIR", help="folder for what it records")
    command.add_argument("--connect", default="tcp/127.0.0.1:7447", help="where the coordinator listens")
    command.add_argument("--camera", help="v4l2:/dev/video0, video:PATH, world:SOCKET (default: as the team says)")
    command.add_argument("--wheels", metavar="PORT", help="serial port of the Create (default: as the team says)")
    command.add_argument("--model", type=int, choices=(1, 2), help="Create 1 or 2 (default: found out)")
    command.add_argument("--tls", metavar="DIR", help="folder with its certificate, of `coloc certificates`")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run it until a signal comes."""
    from coloc_graph.cli.running import until_signal
    from coloc_graph.online.robot import RobotProgram
    from coloc_graph.robot_io.link.zenoh_config import tls_of
    from coloc_graph.team import read_team

    with until_signal() as stop:
        program = RobotProgram(
            args.name,
            read_team(args.team),
            connect=args.connect,
            folder=args.out,
            camera=args.camera,
            wheels=args.wheels,
            model=args.model,
            tls=tls_of(args.tls, args.name) if args.tls else None,
        )
        with program:
            program.run(stop)
    return 0
