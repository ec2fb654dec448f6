"""coloc info RUN."""

import argparse
import dataclasses


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "info",
        help="list the contents of a run and its problems",
        description="List the contents of a run and its problems; only --lights decodes images. The exit code is 0 "
        "even if there are problems (count them with --json), and 2 if the run cannot be read.",
    )
    command.add_argument("run_path", metavar="RUN", help="run (.mcap)")
    command.add_argument(
        "--lights", action="store_true", help="also look for lights in some images: LEDs, and reflections or lamps"
    )
    command.add_argument("--json", action="store_true", help="print the contents as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Inspect a run and print its contents."""
    from coloc_graph.cli.printing import counted, print_json, print_table
    from coloc_graph.pipeline.clock_table import HEADER, clock_table
    from coloc_graph.pipeline.inspection import inspect, landmarks_seen
    from coloc_graph.pipeline.light_table import LIGHTS_HEADER, light_table
    from coloc_graph.run import open_run, truth_counts
    from coloc_graph.run.schemas import topic_of

    opened = open_run(args.run_path)
    findings, landmarks = inspect(opened), landmarks_seen(opened)
    truth = dict(sorted(truth_counts(args.run_path).items()))
    topics = opened.topics | {topic_of(robot, "truth"): count for robot, count in truth.items()}
    clocks = clock_table(opened)
    lights = light_table(opened) if args.lights else []
    seconds = (opened.end - opened.start) if opened.start is not None and opened.end is not None else 0.0
    if args.json:
        print_json(
            {
                "robots": list(opened.team.names),
                "reference": opened.team.reference,
                "stances": len(opened.stances),
                "seconds": seconds,
                "topics": topics,
                "truth": list(truth),
                "landmarks": [
                    {
                        "name": one.landmark.name,
                        "what": one.what,
                        "on_map": one.landmark.on_map,
                        "stances": list(one.stances),
                        "observers": list(one.observers),
                    }
                    for one in landmarks
                ],
                "clocks": [dataclasses.asdict(row) for row in clocks],
                **({"lights": [dataclasses.asdict(row) for row in lights]} if args.lights else {}),
                "problems": [{"where": finding.where, "what": finding.what} for finding in findings],
            }
        )
        return 0
    print(f"{args.run_path}: {counted(len(opened.stances), 'stance')} in {seconds:.1f} s")
    print(f"team: {', '.join(opened.team.names)}; reference {opened.team.reference}")
    print(f"truth: {', '.join(truth) if truth else 'none'}")
    print_table(["topic", "messages"], [[topic, str(count)] for topic, count in sorted(topics.items())])
    if clocks:
        print_table(list(HEADER), [list(dataclasses.astuple(row)) for row in clocks])
    if lights:
        print_table(list(LIGHTS_HEADER), [row.cells() for row in lights])
    if landmarks:
        in_images = any(opened.has_images(robot) and not opened.has_detections(robot) for robot in opened.team.names)
        print_table(
            ["landmark", "kind", "on the map", "stances", "seen by"],
            [
                [
                    one.landmark.name,
                    one.what,
                    "yes" if one.landmark.on_map else "no",
                    "?" if in_images and not one.stances else str(len(one.stances)),
                    ", ".join(one.observers),
                ]
                for one in landmarks
            ],
        )
        if in_images:
            print("images are not decoded: landmarks in them are found when the run is solved")
    if not findings:
        print("no problem found")
    for finding in findings:
        print(f"problem: {finding.where}: {finding.what}")
    return 0
