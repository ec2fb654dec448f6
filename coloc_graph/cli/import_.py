"""coloc import tracks TEAM.toml TRACKS.csv --out RUN, coloc import mrclam DIR --out RUN."""

import argparse

from coloc_graph.cli.place import add_out, require_run_place


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("import", help="make a run of other data")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="KIND")
    tracks = kinds.add_parser("tracks", help="marker tracks from a CSV: stance,time,robot,marker,u,v[,sigma]")
    tracks.add_argument("team", metavar="TEAM.toml")
    tracks.add_argument("tracks", metavar="TRACKS.csv")
    tracks.add_argument("--planes", metavar="PLANES.csv", help="marker planes: stance,robot,nx,ny,nz,d")
    tracks.add_argument("--moves", metavar="MOVES.csv", help="who moved before which stance: stance,robot")
    add_out(tracks)
    tracks.set_defaults(run=run)
    mrclam = kinds.add_parser("mrclam", help="a UTIAS MR.CLAM dataset: range and bearing, odometry, truth")
    mrclam.add_argument("folder", metavar="DIR")
    mrclam.add_argument("--map-unknown", action="store_true", help="do not say where the landmarks are")
    add_out(mrclam)
    mrclam.set_defaults(run=run_mrclam)


def run_mrclam(args: argparse.Namespace) -> int:
    """Import a dataset and print."""
    from coloc_graph.cli.printing import counted, progress, warn
    from coloc_graph.exchange.mrclam import import_mrclam

    require_run_place(args.out, force=args.force)
    with progress("measurements imported") as report:
        summary = import_mrclam(args.folder, args.out, map_known=not args.map_unknown, progress=report)
    warn(summary.warnings)
    print(
        f"{args.out}: {counted(summary.measurements, 'measurement')} in {summary.seconds:.0f} s, "
        f"{counted(len(summary.robots), 'robot')}, {counted(len(summary.landmarks), 'landmark')}"
        f"{', whose positions are unknown' if args.map_unknown else ''}"
    )
    return 0


def run(args: argparse.Namespace) -> int:
    """Import and print."""
    from coloc_graph.cli.printing import counted, progress, warn
    from coloc_graph.exchange.tracks import import_tracks

    require_run_place(args.out, force=args.force)
    with progress("rows imported") as report:
        summary = import_tracks(
            args.team, args.tracks, args.out, planes_path=args.planes, moves_path=args.moves, progress=report
        )
    warn(summary.warnings)
    rows, stances = counted(summary.rows, "row"), counted(summary.stances, "stance")
    print(f"{args.out}: {rows}, {stances}, observers {', '.join(summary.observers)}")
    return 0
