"""coloc replay MISSION."""

import argparse


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "replay",
        help="estimate a mission again from its record, as online",
        description="Give the estimator what entered it during a mission, in the same order and to the same extent, "
        "and compare the estimates with those of online, bit for bit. Exit code 1 if one differs: another version of "
        "coloc-graph, of GTSAM or of the processor may compute otherwise. See docs/missions.md.",
    )
    command.add_argument("mission", metavar="MISSION", help="folder of a mission: run.mcap and mission.jsonl")
    command.add_argument("--json", action="store_true", help="print poses and comparison as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Replay and print."""
    import json

    from coloc_graph.online.replay import replay

    words = {True: "as online", False: "differs from online", None: "not in the log"}
    rows = []
    for one in replay(args.mission):
        stance, poses = one.entered.stance, one.entered.estimate.poses
        rows.append(
            {
                "stance": stance.index,
                "same": one.same,
                "poses": {name: pose.matrix().tolist() for name, pose in poses.items()},
            }
        )
        if not args.json:
            text = "  ".join(f"{name} {pose.x():+.4f} {pose.y():+.4f} m" for name, pose in poses.items())
            print(f"stance {stance.index:3d}  {words[one.same]:20s} {text}")
    if args.json:
        print(json.dumps(rows))
    return 1 if any(row["same"] is False for row in rows) else 0
