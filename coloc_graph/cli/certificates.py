"""coloc certificates DIR TEAM.toml."""

import argparse

from coloc_graph.cli.place import add_force


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "certificates",
        help="make certificates for the link between the coordinator and the robots",
        description="Make a certificate authority for the team, and a certificate and a private key for the "
        "coordinator and each robot. Copy ca.pem, NAME.pem and NAME.key to robot NAME, keep ca.key off the robots, and "
        "give the folder to `coloc coordinate` and `coloc robot` with --tls.",
    )
    command.add_argument("folder", metavar="DIR", help="folder to write")
    command.add_argument("team", metavar="TEAM.toml", help="description of the team")
    command.add_argument("--days", type=int, default=365, help="validity of the certificates [days] (default: 365)")
    add_force(command)
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the certificates and print which files each robot needs."""
    from coloc_graph.robot_io.link.certificates import make_certificates
    from coloc_graph.team import read_team

    team = read_team(args.team)
    make_certificates(args.folder, team.names, args.days, force=args.force)
    for name in ("coordinator", *team.names):
        print(f"for {name}: ca.pem, {name}.pem, {name}.key")
    print(f"ca.key in {args.folder} signs new certificates: keep it off the robots")
    return 0
