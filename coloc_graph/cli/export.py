"""coloc export g2o|gtsam|pyfg|jrl|tum|dot|ros2|foxglove DIR --out PATH."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_force

if TYPE_CHECKING:
    from coloc_graph.exchange.range_graph import RangeGraph
    from coloc_graph.results.folder import Result

FORMATS = (
    "g2o, pyfg, jrl and dot: one file; gtsam: a folder with the serialised factors and a script; tum: a file for each "
    "robot; ros2: a bag (.mcap) with tf, poses and paths; foxglove: an .mcap with frames, cameras, poses, truth and a "
    "3D scene"
)

#: Endings of the files in an exported folder, by format.
FOLDERS = {"tum": (".tum", ".cov.csv"), "gtsam": ("graph.txt", "values.txt", "keys.csv", "solve.py")}


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "export", help="export a result for g2o, GTSAM, PyFG, JRL, TUM, Graphviz, ROS 2 or Foxglove"
    )
    command.add_argument(
        "format", choices=("g2o", "gtsam", "pyfg", "jrl", "tum", "dot", "ros2", "foxglove"), help=FORMATS
    )
    command.add_argument(
        "result", metavar="DIR", help="result of `coloc solve`; pyfg, jrl: or a graph (.pyfg, .jrl, .g2o)"
    )
    command.add_argument("--out", required=True, metavar="PATH", help="file to write; for tum and gtsam a folder")
    command.add_argument("--truth", action="store_true", help="tum: the truth of the run, not the estimate; ros2: both")
    command.add_argument("--layout", action="store_true", help="foxglove: write a layout (.json) beside the file, too")
    command.add_argument(
        "--tracks",
        action="store_true",
        help="foxglove: annotate the images with the tracks of all markers, followed again (takes as long as solving)",
    )
    command.add_argument("--run", dest="run_path", metavar="RUN", help="the result's run, if it has moved")
    add_force(command)
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Copy the files of a result, or write a bag of it, to a new path."""
    import os
    import shutil

    from coloc_graph.errors import InputError
    from coloc_graph.exchange.gtsam_files import unpack_gtsam
    from coloc_graph.results.folder import GTSAM_FACTORS, read_result
    from coloc_graph.run.atomic_file import require_replaceable_folder, require_writable, write_atomically

    out = Path(args.out)
    if args.format in FOLDERS:
        require_replaceable_folder(out, FOLDERS[args.format], force=args.force)
    elif os.path.lexists(out):
        require_writable(out, force=args.force)
    if args.truth and args.format not in ("tum", "ros2"):
        raise InputError(f"--truth applies to tum and ros2, not to {args.format}: leave it out")
    for option in ("layout", "tracks"):
        if getattr(args, option) and args.format != "foxglove":
            raise InputError(f"--{option} applies to foxglove, not to {args.format}: leave it out")
    if args.format in ("pyfg", "jrl") and Path(args.result).is_file():
        return _range_graph(args, out)
    if Path(args.result).suffix in (".pyfg", ".jrl", ".g2o") and Path(args.result).is_file():
        raise InputError(f"{args.result} is exported to pyfg or jrl only: give the result of `coloc solve`")
    result = read_result(args.result)
    if result.is_ranging and args.format in ("g2o", "dot", "pyfg", "jrl"):
        return _ranging(result, args.format, out)
    if args.format in ("pyfg", "jrl"):
        return _range_graph(args, out, result)
    if args.truth and args.format == "tum":
        return _truth(result, args.run_path, out)
    if args.format == "foxglove":
        return _foxglove(result, args, out)
    if args.format == "ros2":
        from coloc_graph.exchange.ros_export import write_ros2
        from coloc_graph.results.aligned_truth import aligned_truth

        if out.suffix != ".mcap":
            raise InputError(f"{out} is not the name of a ROS 2 bag: give one that ends in .mcap")
        out.parent.mkdir(parents=True, exist_ok=True)
        truth = None
        if args.truth:
            truth = aligned_truth(result, path := Path(args.run_path or result.run_path))
            if not truth:
                raise InputError(f"{path}: the run holds no truth to export; leave --truth out")
        poses = write_ros2(result.trajectories, result.team, out, truth)
        print(f"wrote {out}: {poses} poses of {len(result.trajectories)} robots")
        return 0
    files = {"tum": "trajectories", "gtsam": GTSAM_FACTORS, "g2o": "graph.g2o", "dot": "graph.dot"}
    source = result.path / files[args.format]
    if not source.exists():
        raise InputError(f"{result.path} does not contain {source.name}: solve the run again with this version")
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.is_dir():
        shutil.rmtree(out)  # an earlier export, as was checked
    if args.format == "tum":
        shutil.copytree(source, out)
    elif args.format == "gtsam":
        unpack_gtsam(source, out)
    else:
        write_atomically(out, source.read_bytes())
    print(f"wrote {out}{_left_out(source) if args.format == 'g2o' else ''}")
    return 0


def _left_out(pose_graph: Path) -> str:
    """Return what a result's graph.g2o does not hold, as it says itself; "" where it holds all."""
    lines = pose_graph.read_text(encoding="utf-8").splitlines()
    return "".join(f"; {line.removeprefix('# ')}" for line in lines if line.startswith("# left out: "))


def _ranging(result: "Result", form: str, out: Path) -> int:
    """Write the graph of a ranging run."""
    from coloc_graph.errors import InputError
    from coloc_graph.exchange.jrl import read_jrl
    from coloc_graph.exchange.pyfg import write_pyfg
    from coloc_graph.exchange.range_graph_files import letters_of
    from coloc_graph.exchange.ranging_graph import planar_dot, planar_g2o, without_bearings
    from coloc_graph.results.folder import RANGING_GRAPH
    from coloc_graph.run.atomic_file import write_atomically

    source = result.path / RANGING_GRAPH
    if not source.exists():
        raise InputError(f"{result.path} does not contain {source.name}: solve the run again with this version")
    graph, team = read_jrl(source), result.config.team
    robots = {letter: robot for robot, letter in letters_of(team.names).items()}
    landmarks = [one.name for one in team.landmarks]
    out.parent.mkdir(parents=True, exist_ok=True)
    said = ""
    match form:
        case "jrl":
            write_atomically(out, source.read_bytes())
            said = "errors of wheels and sensors are as estimated and exact; gtsam holds them with their uncertainty"
        case "pyfg":
            graph, said = without_bearings(graph)
            write_pyfg(graph, out)
        case "g2o":
            text, said = planar_g2o(graph, robots)
            write_atomically(out, text)
        case "dot":
            write_atomically(out, planar_dot(graph, robots, landmarks))
            said = "one box is all poses of a robot, and the edges are counts"
    names = ", ".join(f"{letter} = {robot}" for letter, robot in robots.items()) if form in ("pyfg", "jrl") else ""
    print("; ".join(part for part in (f"wrote {out}", said, names and f"robots {names}") if part))
    return 0


def _range_graph(args: argparse.Namespace, out: Path, result: "Result | None" = None) -> int:
    """Write the graph of a result, or of a file, in a format of the field's benchmarks."""
    from coloc_graph.cli.printing import counted
    from coloc_graph.exchange.range_graph_files import WRITERS, read_range_graph
    from coloc_graph.results.folder import RANGING_GRAPH

    said = ""
    if result is None:
        graph = read_range_graph(args.result)
    elif (result.path / RANGING_GRAPH).exists():
        graph, said = _with_ranges(result)
    else:
        graph, said = _without_ranges(result)
    out.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[args.format](graph, out)
    relative = f"{len(graph.relatives)} relative poses and positions"
    print(
        f"wrote {out}: {counted(len(graph.names), 'variable')}, {counted(len(graph.priors), 'prior')}, {relative}, "
        f"{counted(len(graph.ranges), 'range')}, {counted(len(graph.bearings), 'bearing')}{said}"
    )
    return 0


def _with_ranges(result: "Result") -> "tuple[RangeGraph, str]":
    """Return the graph of a result with stances and ranges, the letters of its robots, and what it does not hold."""
    from coloc_graph.cli.printing import counted
    from coloc_graph.exchange.jrl import read_jrl
    from coloc_graph.exchange.range_graph import is_landmark
    from coloc_graph.exchange.stance_graph import group_letters
    from coloc_graph.results.folder import MEASUREMENTS, RANGING_GRAPH
    from coloc_graph.results.measurement_table import read_measurements

    graph, team = read_jrl(result.path / RANGING_GRAPH), result.config.team
    there = {name[0] for name in graph.initial}
    letters = ", ".join(f"{letter} = {group}" for group, letter in group_letters(team).items() if letter in there)
    points = ", ".join(f"{name} = {team.landmarks[int(name[1:])].name}" for name in graph.initial if is_landmark(name))
    said = f"; robots {letters}" + (f"; landmarks {points}" if points else "")
    rows = read_measurements(result.path / MEASUREMENTS, ["range"])
    rejected, bearings = (sum(row["used"] == used and bool(row[cell]) for row in rows)
                          for used, cell in (("no", "kind"), ("yes", "bearing")))  # fmt: skip
    lost = [counted(rejected, "rejected pair")] if rejected else []
    lost += [f"{counted(bearings, 'mean bearing')}, which ranges do not hold"] if bearings else []
    return graph, said + (f"; left out: {' and '.join(lost)}" if lost else "")


def _without_ranges(result: "Result") -> "tuple[RangeGraph, str]":
    """Return the graph of a result with stances alone, the letters of its robots, and what it does not hold."""
    from coloc_graph.exchange.g2o import read_g2o
    from coloc_graph.exchange.range_graph_files import of_pose_graph

    times = {
        (robot, int(stance)): float(time)
        for robot, one in result.trajectories.items()
        if one.stances is not None
        for stance, time in zip(one.stances, one.times, strict=True)
    }
    poses = result.path / "graph.g2o"
    graph, letters = of_pose_graph(read_g2o(poses), times)
    robots = "; robots " + ", ".join(f"{letter} = {robot}" for robot, letter in letters.items())
    return graph, robots + _left_out(poses)


def _truth(result: "Result", run_path: str | None, out: Path) -> int:
    """Write the true trajectories of a result's run as TUM files, in the world of the run."""
    import shutil

    from coloc_graph.errors import InputError
    from coloc_graph.exchange.tum import write_tum
    from coloc_graph.run import read_truth

    path = Path(run_path or result.run_path)
    result.require_run(path)
    truth = read_truth(path)
    if not truth:
        raise InputError(f"{path}: the run holds no truth to export; leave --truth out")
    if out.is_dir():
        shutil.rmtree(out)  # an earlier export, as was checked
    out.mkdir(parents=True)
    for robot, trajectory in truth.items():
        write_tum(trajectory, out / f"{robot}.tum")
    print(f"wrote {out}: true poses of {len(truth)} robots")
    return 0


def _foxglove(result: "Result", args: argparse.Namespace, out: Path) -> int:
    """Write a result for Foxglove, with a layout beside it."""
    import os
    from contextlib import nullcontext

    from coloc_graph.cli.printing import progress, warn
    from coloc_graph.errors import InputError
    from coloc_graph.exchange.foxglove_export import LAYOUT
    from coloc_graph.results.foxglove import export_foxglove
    from coloc_graph.run.atomic_file import require_writable, write_atomically

    if out.suffix != ".mcap":
        raise InputError(f"{out} is not the name of an MCAP file: give one that ends in .mcap")
    beside = out.with_suffix(".json")
    if args.layout and os.path.lexists(beside):
        require_writable(beside, force=args.force)
    out.parent.mkdir(parents=True, exist_ok=True)
    with progress("stances tracked") if args.tracks else nullcontext() as report:
        messages, warnings = export_foxglove(result, out, Path(args.run_path) if args.run_path else None, report)
    warn(warnings)
    print(f"wrote {out}: {messages} messages of {len(result.trajectories)} robots")
    if args.layout:
        write_atomically(beside, LAYOUT.read_bytes())
        print(f"wrote {beside}: import it as a layout in Foxglove")
    return 0
