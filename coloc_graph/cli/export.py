"""coloc export g2o|gtsam|tum|dot|ros2 DIR --out PATH."""

import argparse

FORMATS = (
    "g2o and dot: one file; gtsam: a folder with the serialised factors and a script; tum: a file for each robot; "
    "ros2: a bag (.mcap) with tf, poses and paths"
)


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser("export", help="export a result as g2o, GTSAM, TUM, Graphviz or a ROS 2 bag")
    command.add_argument("format", choices=("g2o", "gtsam", "tum", "dot", "ros2"), help=FORMATS)
    command.add_argument("result", metavar="DIR", help="result of `coloc solve`")
    command.add_argument("--out", required=True, metavar="PATH", help="file to write; for tum and gtsam a folder")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Copy the files of a result, or write a bag of it, to a new path."""
    import os
    import shutil
    from pathlib import Path

    from coloc_graph.errors import InputError
    from coloc_graph.exchange.gtsam_files import unpack_gtsam
    from coloc_graph.results.folder import GTSAM_FACTORS, read_result
    from coloc_graph.run.atomic_file import write_atomically

    result, out = read_result(args.result), Path(args.out)
    if os.path.lexists(out):
        raise InputError(f"{out} exists; give another path, or remove it")
    if args.format == "ros2":
        from coloc_graph.exchange.ros_export import write_ros2

        if out.suffix != ".mcap":
            raise InputError(f"{out} is not the name of a ROS 2 bag: give one that ends in .mcap")
        out.parent.mkdir(parents=True, exist_ok=True)
        poses = write_ros2(result.trajectories, result.team, out)
        print(f"wrote {out}: {poses} poses of {len(result.trajectories)} robots")
        return 0
    files = {"tum": "trajectories", "gtsam": GTSAM_FACTORS, "g2o": "graph.g2o", "dot": "graph.dot"}
    source = result.path / files[args.format]
    if result.is_ranging and args.format in ("g2o", "gtsam", "dot"):
        raise InputError(
            f"{result.path} is the result of a ranging run, whose measurements are not exported to {args.format} yet: "
            "export tum or ros2"
        )
    if not source.exists():
        raise InputError(f"{result.path} does not contain {source.name}: solve the run again with this version")
    out.parent.mkdir(parents=True, exist_ok=True)
    if args.format == "tum":
        shutil.copytree(source, out)
    elif args.format == "gtsam":
        unpack_gtsam(source, out)
    else:
        write_atomically(out, source.read_bytes())
    print(f"wrote {out}")
    return 0
