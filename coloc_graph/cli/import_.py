"""coloc import images|tracks|ranges TEAM.toml FILES, mrclam DIR or ros BAG MAP.toml."""

import argparse

from coloc_graph.cli.place import add_out, require_run_place


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser("import", help="convert images, tracks, ranges, a ROS bag or MR.CLAM data to a run")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="KIND")
    tracks = kinds.add_parser("tracks", help="import marker tracks from a CSV: stance,time,robot,marker,u,v[,sigma]")
    tracks.add_argument("team", metavar="TEAM.toml", help="description of the team")
    tracks.add_argument("tracks", metavar="TRACKS.csv", help="marker centres [px]")
    tracks.add_argument("--planes", metavar="PLANES.csv", help="marker planes: stance,robot,nx,ny,nz,d")
    tracks.add_argument("--moves", metavar="MOVES.csv", help="robots that moved before a stance: stance,robot")
    tracks.add_argument("--ranges", metavar="RANGES.csv", help="ranges between robots: time,robot,target,range")
    add_out(tracks)
    tracks.set_defaults(run=run_tracks)
    ranges = kinds.add_parser("ranges", help="import ranges and odometry of robots that drive, from two CSV files")
    ranges.add_argument("team", metavar="TEAM.toml", help="description of the team")
    ranges.add_argument("ranges", metavar="RANGES.csv", help="time,robot,target,range[,bearing]: UTC s, m, rad")
    ranges.add_argument("odometry", metavar="ODOMETRY.csv", help="time,robot,x,y,yaw: UTC s, m, rad, in any frame")
    ranges.add_argument(
        "--along", type=float, default=0.02, help="odometry noise of the way, m per root of a metre (default: 0.02)"
    )
    ranges.add_argument(
        "--turn", type=float, default=0.02,
        help="odometry noise of the heading, rad per root of a radian turned or metre driven (default: 0.02)",
    )  # fmt: skip
    add_out(ranges)
    ranges.set_defaults(run=run_ranges)
    mrclam = kinds.add_parser("mrclam", help="import a UTIAS MR.CLAM dataset: ranges and bearings, odometry, truth")
    mrclam.add_argument("folder", metavar="DIR", help="folder of the dataset")
    mrclam.add_argument("--map-unknown", action="store_true", help="leave the landmarks' positions unknown")
    add_out(mrclam)
    mrclam.set_defaults(run=run_mrclam)
    ros = kinds.add_parser("ros", help="import images, odometry and truth from a ROS 1 or ROS 2 bag; needs no ROS")
    ros.add_argument("bag", metavar="BAG", help="ROS 1 .bag, ROS 2 folder, or .mcap")
    ros.add_argument("map", metavar="MAP.toml", help="topics of each robot, see docs/ros.md")
    ros.add_argument(
        "--image-format",
        choices=("jpeg", "png", "raw"),
        default="jpeg",
        help="format for images that are neither JPEG nor PNG (default: jpeg)",
    )
    ros.add_argument("--json", action="store_true", help="print the summary as JSON")
    add_out(ros)
    ros.set_defaults(run=run_ros)
    images = kinds.add_parser("images", help="import your own recording: a folder, glob or video for each robot")
    images.add_argument("team", metavar="TEAM.toml", help="description of the team")
    images.add_argument(
        "sources", nargs="+", metavar="ROBOT=SOURCE", help="such as A=images/A, B='images/*/B/*.png' or A=a.mp4"
    )
    images.add_argument("--times", metavar="CSV", help="time of each image [UTC s]: robot,file,time")
    images.add_argument("--fps", type=float, help="images a second (default for a video: its own times)")
    images.add_argument(
        "--time-pattern", metavar="NAME", help="pattern of the time in file names, such as 'frame_{ms}': s, ms, us, ns"
    )
    images.add_argument(
        "--stances",
        metavar="CSV",
        help="stance,start,end,observers,movers,anchors (default: detected from cameras at rest)",
    )
    images.add_argument(
        "--offset",
        nargs="+",
        default=[],
        metavar="ROBOT=SECONDS",
        help="by how much a recording began later than its times say (default: 0; of videos with their own times as "
        "the motion tells that both show)",
    )
    images.add_argument(
        "--image-format",
        choices=("jpeg", "png", "raw"),
        default="png",
        help="format for images that cannot be kept as they are (default: png)",
    )
    add_out(images)
    images.set_defaults(run=run_images)


def run_mrclam(args: argparse.Namespace) -> int:
    """Import a dataset and print a summary."""
    from coloc_graph.cli.printing import counted, progress, warn
    from coloc_graph.exchange.mrclam import import_mrclam

    require_run_place(args.out, force=args.force)
    with progress("measurements imported") as report:
        summary = import_mrclam(args.folder, args.out, map_known=not args.map_unknown, progress=report)
    warn(summary.warnings, kept=False)
    print(
        f"{args.out}: {counted(summary.measurements, 'measurement')} in {summary.seconds:.0f} s, "
        f"{counted(len(summary.robots), 'robot')}, {counted(len(summary.landmarks), 'landmark')}"
        f"{', whose positions are unknown' if args.map_unknown else ''}"
    )
    return 0


def run_ranges(args: argparse.Namespace) -> int:
    """Import ranges and odometry and print a summary."""
    from coloc_graph.cli.printing import counted
    from coloc_graph.exchange.ranging_csv import import_ranges

    require_run_place(args.out, force=args.force)
    found = import_ranges(args.team, args.ranges, args.odometry, args.out, along=args.along, turn=args.turn)
    print(
        f"{args.out}: {counted(found.ranges, 'range')} and {counted(found.samples, 'odometry sample')} in "
        f"{found.seconds:.0f} s of {', '.join(found.robots)}"
    )
    return 0


def run_tracks(args: argparse.Namespace) -> int:
    """Import tracks and print a summary."""
    from coloc_graph.cli.printing import counted, progress, warn
    from coloc_graph.exchange.tracks import import_tracks

    require_run_place(args.out, force=args.force)
    with progress("rows imported") as report:
        summary = import_tracks(
            args.team,
            args.tracks,
            args.out,
            planes_path=args.planes,
            moves_path=args.moves,
            ranges_path=args.ranges,
            progress=report,
        )
    warn(summary.warnings, kept=False)
    rows, stances = counted(summary.rows, "row"), counted(summary.stances, "stance")
    print(f"{args.out}: {rows}, {stances}, observers {', '.join(summary.observers)}")
    return 0


def run_ros(args: argparse.Namespace) -> int:
    """Import a bag and print a summary."""
    from dataclasses import asdict

    from coloc_graph.cli.printing import counted, print_json, progress, warn
    from coloc_graph.exchange.ros_import import import_ros

    require_run_place(args.out, force=args.force)
    with progress("messages read") as report:
        summary = import_ros(args.bag, args.map, args.out, image_format=args.image_format, progress=report)
    warn(summary.warnings, kept=False)
    if args.json:
        print_json(asdict(summary))
        return 0
    counts = ", ".join(f"{count} {what}" for what, count in summary.counts.items())
    print(f"{args.out}: {counts}; {counted(summary.stances, 'stance')}, observers {', '.join(summary.observers)}")
    for robot, (stood, known) in summary.stood.items():
        print(f"{robot} stood {stood:.1f} of {known:.1f} s")
    return 0


def run_images(args: argparse.Namespace) -> int:
    """Import images and print a summary."""
    from coloc_graph.cli.printing import counted, progress
    from coloc_graph.exchange.images import import_images

    require_run_place(args.out, force=args.force)
    with progress("images imported") as report:
        summary = import_images(
            args.team,
            args.sources,
            args.out,
            times=args.times,
            fps=args.fps,
            time_pattern=args.time_pattern,
            stances=args.stances,
            offsets=_offsets(args.offset),
            image_format=args.image_format,
            progress=report,
        )
    images = ", ".join(f"{count} of {robot}" for robot, count in summary.images.items())
    print(f"{args.out}: images {images}; {counted(len(summary.stances), 'stance')}")
    for robot, offset in summary.offsets.items():
        print(f"{robot} was moved by {offset:+.2f} s in time")
    for robot, (stood, known) in summary.stood.items():
        print(f"{robot} stood {stood:.1f} of {known:.1f} s")
    for one in summary.stances:
        anchors = f", {' '.join(one.anchors)} stayed" if one.anchors else ""
        print(
            f"stance {one.index}: {one.start:.2f} to {one.end:.2f} s, {' '.join(one.observers)} watch "
            f"{' '.join(one.movers)}{anchors}"
        )
    return 0


def _offsets(given: list[str]) -> dict[str, float]:
    """Seconds by robot, of ROBOT=SECONDS each."""
    from coloc_graph.errors import InputError

    found = {}
    for one in given:
        robot, _, text = one.partition("=")
        try:
            found[robot] = float(text)
        except ValueError:
            found[robot] = float("nan")
        if not abs(found[robot]) < 1e9:
            raise InputError(f"--offset: `{one}` is no ROBOT=SECONDS; give it as B=1.25")
    return found
