"""coloc export g2o|tum|dot|ros2 DIR --out PATH."""

import argparse

FORMATS = "g2o and dot are a file, tum a file a robot, ros2 a bag (.mcap) with tf, poses and paths"


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("export", help="a result in other people's formats")
    command.add_argument("format", choices=("g2o", "tum", "dot", "ros2"), help=FORMATS)
    command.add_argument("result", metavar="DIR", help="the folder that `coloc solve --out` wrote")
    command.add_argument("--out", required=True, metavar="PATH", help="the file; for tum the folder")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Copy what `solve` wrote, or make a bag of it, where nothing is yet."""
    import os
    import shutil
    from pathlib import Path

    from coloc_graph.errors import InputError
    from coloc_graph.results.folder import read_result
    from coloc_graph.run.atomic_file import write_atomically

    result, out = read_result(args.result), Path(args.out)
    if os.path.lexists(out):
        raise InputError(f"{out} exists; give another path, or remove it")
    if args.format == "ros2":
        from coloc_graph.exchange.ros_export import write_ros2

        if out.suffix != ".mcap":
            raise InputError(f"{out}: is no name of a ROS 2 bag; give one that ends in .mcap")
        out.parent.mkdir(parents=True, exist_ok=True)
        poses = write_ros2(result.trajectories, result.team, out)
        print(f"wrote {out}: {poses} poses of {len(result.trajectories)} robots")
        return 0
    source = result.path / ("trajectories" if args.format == "tum" else f"graph.{args.format}")
    if result.is_ranging and args.format in ("g2o", "dot"):
        raise InputError(
            f"{result.path} is of a ranging run, whose ranges and bearings {args.format} files of coloc-graph do not "
            "hold yet: export tum or ros2"
        )
    if not source.exists():
        raise InputError(f"{result.path} does not hold {source.name}; solve the run again with this version")
    out.parent.mkdir(parents=True, exist_ok=True)
    if args.format == "tum":
        shutil.copytree(source, out)
    else:
        write_atomically(out, source.read_bytes())
    print(f"wrote {out}")
    return 0
