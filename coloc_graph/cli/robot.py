"""coloc robot NAME TEAM.toml."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "robot",
        help="run a robot: its camera and wheels, led by the coordinator",
        description="Run a robot's program, on the robot: detect markers, count the wheels, and drive on the "
        "coordinator's command. Without the coordinator it stands. Ctrl-C stops the wheels and ends it.",
    )
    command.add_argument("name", metavar="NAME", help="name of this robot in the team")
    command.add_argument("team", metavar="TEAM.toml", help="description of the team")
    command.add_argument("--out", required=True, metavar="DIR", help="folder for its record")
    command.add_argument(
        "--connect",
        default="tcp/127.0.0.1:7447",
        metavar="ADDRESS",
        help="address of the coordinator (default: %(default)s)",
    )
    command.add_argument("--camera", help="v4l2:/dev/video0, video:PATH, world:SOCKET (default: as in TEAM.toml)")
    command.add_argument("--wheels", metavar="PORT", help="serial port of the Create (default: as in TEAM.toml)")
    command.add_argument("--model", type=int, choices=(1, 2), help="model of the Create (default: detected)")
    command.add_argument("--tls", metavar="DIR", help="folder with its certificate, from `coloc certificates`")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the robot until a signal arrives."""
    from coloc_graph.cli.running import until_signal
    from coloc_graph.online.robot import RobotProgram
    from coloc_graph.robot_io.link.zenoh_config import tls_of
    from coloc_graph.robot_io.service_manager import ServiceManager
    from coloc_graph.team import read_team

    with until_signal() as stop, ServiceManager() as manager:
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
            manager.ready()
            program.run(stop, on_step=manager.alive)
    return 0
