"""coloc plan TEAM.toml."""

import argparse
from typing import TYPE_CHECKING

from coloc_graph.cli.coordinate import waypoint
from coloc_graph.cli.place import add_force
from coloc_graph.cli.printing import print_json, print_table, warn

if TYPE_CHECKING:
    from coloc_graph.planning.formation import Gait
    from coloc_graph.planning.mission import Mission
    from coloc_graph.planning.prediction import Predictor

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


_HEADER = ["", "leap", "abreast", "toe-in", "stances", "a stance", "images", "mission", "end", "heading"]


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "plan",
        help="choose where the robots of a team stand and drive, and what accuracy this promises",
        description="Choose the formation of a leap-frog, its leaps, and the mover's drives, for the least uncertainty "
        "at the end of a straight way. Prints what the best plan and the paper's formation promise.",
    )
    command.add_argument("team", metavar="TEAM.toml", help="description of the team")
    command.add_argument("--length", type=float, default=7.2, metavar="M", help="length of the way [m] (default: 7.2)")
    wanted = command.add_mutually_exclusive_group()
    wanted.add_argument("--sigma-end", type=_length, metavar="S", help="wanted sigma of the last positions, as in 5mm")
    wanted.add_argument(
        "--time", type=_time, metavar="T",
        help="duration of the mission, as in 10min (default: as many images as the paper's formation takes in 5 s a "
        "stance)",
    )  # fmt: skip
    command.add_argument(
        "--goal", action="append", type=waypoint, metavar="X,Y",
        help="instead of --length: waypoint of the middle of the observers [m], from 0,0 on, x ahead; repeat it for "
        "corners",
    )  # fmt: skip
    command.add_argument(
        "--pace", type=float, default=40.0, metavar="S",
        help="with --goal: seconds of the mission a metre, leaps included, unless there is --time (default: 40)",
    )  # fmt: skip
    command.add_argument("--map", metavar="YAML", help="with --goal: ROS map_server map of the walls")
    command.add_argument("--mover", metavar="NAME", help="robot that drives before the others' cameras (default: last)")
    command.add_argument("--speed", type=float, default=0.2, metavar="V", help="speed of robots [m/s] (default: 0.2)")
    command.add_argument("--fps", type=float, help="images a second (default: those of the slowest camera)")
    command.add_argument(
        "--noise", type=float, metavar="PX",
        help="noise of marker centres [px] (default: that learnt by a calibrated team, or its noise_px)",
    )  # fmt: skip
    command.add_argument("--without-odometry", action="store_true", help="ignore wheel odometry")
    command.add_argument("--poses", metavar="CSV", help="write the plan, for `coloc simulate hallway --plan CSV`")
    command.add_argument("--draw", metavar="PNG", help="draw the plan and the paper's formation")
    add_force(command)
    command.add_argument(
        "--view", action="store_true",
        help="show the plan in the browser, where robots can be dragged; --poses writes it as it was left",
    )  # fmt: skip
    command.add_argument("--port", type=int, help="port of --view (default: 8080, or the first free one after it)")
    command.add_argument("--no-browser", action="store_true", help="with --view: do not open a browser")
    command.add_argument("--json", action="store_true", help="print figures as JSON")
    command.set_defaults(run=run)


def _quantity(text: str, units: tuple[str, ...], example: str) -> float:
    for unit in sorted(units, key=len, reverse=True):
        if text.endswith(unit):
            number = text.removesuffix(unit)
            break
    else:
        raise argparse.ArgumentTypeError(f"`{text}` has no unit; give it as in {example}")
    try:
        value = float(number) * UNITS[unit]
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"`{text}` is not a quantity above 0; give it as in {example}")
    return value


def _length(text: str) -> float:
    return _quantity(text, ("mm", "cm", "m"), "5mm")


def _time(text: str) -> float:
    return _quantity(text, ("s", "min", "h"), "10min")


def run(args: argparse.Namespace) -> int:
    """Search the gaits, plan the best one's drives, print, and write what is asked for."""
    from coloc_graph.errors import InputError
    from coloc_graph.planning.belief import WHEELS
    from coloc_graph.planning.formation import PAPER
    from coloc_graph.planning.gaits import PAPER_SECONDS, GaitSearch
    from coloc_graph.planning.least_time import least_time
    from coloc_graph.planning.mission import stances_of
    from coloc_graph.planning.plan import write_plan
    from coloc_graph.planning.prediction import Predictor
    from coloc_graph.planning.roles import best_roles, roles_of
    from coloc_graph.run.atomic_file import require_writable
    from coloc_graph.team import read_team

    for path in (args.poses, args.draw):
        if path is not None:
            require_writable(path, force=args.force)
    team = read_team(args.team)
    for name, value in (("speed", args.speed), ("fps", args.fps), ("noise", args.noise)):
        if value is not None and not 0 < value < 1e6:
            raise InputError(f"--{name} is {value}; give a number above 0")
    if args.map is not None and args.goal is None:
        raise InputError("a map needs a goal on it: give --goal X,Y")
    rates = [robot.camera.fps for robot in team.robots if robot.camera_if_any is not None]
    fps = args.fps or min(rates, default=1.0)
    predictor = Predictor(team, fps, args.noise, None if args.without_odometry else WHEELS, args.speed)
    observers, mover, left = best_roles(predictor) if args.mover is None else roles_of(team, args.mover)
    if left:
        warn([f"{', '.join(left)} stay out of this plan"])
    if args.goal is not None or len(observers) > 2:
        return _along(args, predictor, observers, mover)
    pair = observers[0], observers[1]
    search = GaitSearch(predictor, args.length, pair, mover)
    if args.sigma_end is not None:
        gait, best = least_time(
            lambda time: search.planned(search.ranked(time=time)), args.sigma_end, search.shortest(args.sigma_end)
        )
        if best.end_sigma > args.sigma_end:
            raise search.unreached(args.sigma_end, best.end_sigma, best.duration, gait)
        paper = search.of_paper(time=best.duration)
    else:
        # without a time, as many images as the paper's formation takes
        capture = PAPER_SECONDS * stances_of(PAPER, args.length) if args.time is None else None
        gait, best = search.planned(search.ranked(time=args.time, capture=capture))
        paper = search.of_paper(time=args.time, capture=capture)
    if args.sigma_end is not None:
        asked = f"the end known to {1e3 * args.sigma_end:g} mm"
    else:
        asked = f"{args.time / 60:.1f} min" if args.time is not None else f"{best.capture_time:.0f} s of images"
    rows = [("the best plan", gait, best)] + ([("the paper's formation", PAPER, paper)] if paper is not None else [])
    if args.json:
        print_json({name: figures(one, mission) for name, one, mission in rows})
    else:
        print(f"{args.length:g} m with {asked}; {pair[0]} and {pair[1]} observe, {mover} moves")
        print_table(
            _HEADER,
            [_row(name, one, mission, fps) for name, one, mission in rows],
        )
        print("end and heading: promised standard deviations of the observers' last poses")
        if paper is None:
            print(f"the paper's formation takes longer than {best.duration / 60:.1f} min with its leaps alone")
    if args.poses is not None:
        write_plan(best.plan, args.poses)
    if args.draw is not None:
        from coloc_graph.report.plan import plan_figure

        plan_figure([(name, mission) for name, _, mission in rows]).savefig(args.draw, dpi=130)
    if args.view:
        _edit(args, predictor, best, (args.length, 0.0))
    return 0


def _along(args: argparse.Namespace, predictor: "Predictor", observers: tuple[str, ...], mover: str) -> int:
    """Plan a mission along goals by the receding horizon."""
    from dataclasses import replace

    from coloc_graph.errors import InputError
    from coloc_graph.planning.belief import Belief
    from coloc_graph.planning.course import Course
    from coloc_graph.planning.floor_map import read_floor_map
    from coloc_graph.planning.gaits import GaitSearch
    from coloc_graph.planning.horizon import Horizon
    from coloc_graph.planning.least_time import least_time
    from coloc_graph.planning.plan import write_plan

    if not 0 < args.pace < 1e4:
        raise InputError(f"--pace is {args.pace}; give seconds of the mission a metre, above 0")
    if args.map is not None:
        predictor = replace(predictor, floor_map=read_floor_map(args.map))
    course = Course(((0.0, 0.0), *(args.goal or [(args.length, 0.0)])))

    def planned(time: float) -> "tuple[Gait, Mission]":
        horizon = Horizon(predictor, course, observers, mover, time, timed=True)
        start = {**horizon.starts(), mover: (1.5, 0.0, 0.0)}
        return horizon.gait, horizon.mission(Belief.start(predictor.team, start))

    if args.sigma_end is not None:
        search = GaitSearch(predictor, course.length, (observers[0], observers[1]), mover)
        gait, best = least_time(planned, args.sigma_end, search.shortest(args.sigma_end))
        if best.end_sigma > args.sigma_end:
            raise search.unreached(args.sigma_end, best.end_sigma, best.duration, gait)
        asked = f"the end known to {1e3 * args.sigma_end:g} mm"
    else:
        seconds = args.pace * course.length if args.time is None else args.time
        gait, best = planned(seconds)
        asked = f"{seconds / 60:.1f} min"
    if args.json:
        print_json({"the plan": figures(gait, best)})
    else:
        print(f"{course.length:.1f} m with {asked}; {', '.join(observers)} observe, {mover} moves")
        print_table(_HEADER, [_row("the plan", gait, best, predictor.fps)])
        print("leap, abreast and toe-in: those by which the rest of the way is expected to go")
    if args.poses is not None:
        write_plan(best.plan, args.poses)
    if args.draw is not None:
        from coloc_graph.report.plan import plan_figure

        plan_figure([("the plan", best)], predictor.floor_map).savefig(args.draw, dpi=130)
    if args.view:
        _edit(args, predictor, best, course.points[-1])
    return 0


def _edit(args: argparse.Namespace, predictor: "Predictor", mission: "Mission", goal: tuple[float, float]) -> None:
    """Show a plan, have its robots dragged, and write what is left of it."""
    from coloc_graph.cli.view import show, take_port
    from coloc_graph.planning.plan import write_plan
    from coloc_graph.viewer import PlanEditor, Viewer

    editor = PlanEditor(predictor, mission.start, mission.plan, goal, mission.reasons)
    with take_port(args.port) as listener, Viewer(editor.scene, listener=listener) as viewer:
        editor.attach(viewer)
        try:
            show(viewer, browser=not args.no_browser)
        finally:
            editor.close()
    if args.poses is not None and editor.updates:
        write_plan(editor.plan, args.poses)
        print(f"{args.poses}: {1e3 * editor.end_sigma:.1f} mm promised at the end")


def figures(gait: "Gait", mission: "Mission") -> dict[str, float]:
    """Return what a plan is and promises, in SI units and degrees."""
    import math

    return {
        "leap": gait.leap,
        "abreast": gait.abreast,
        "toe_in_deg": gait.toe_in_deg,
        "stances": len(mission.plan.stances),
        "capture_seconds": mission.capture_time,
        "points": mission.points,
        "mission_seconds": mission.duration,
        "end_sigma": mission.end_sigma,
        "heading_sigma_deg": math.degrees(mission.heading_sigma),
    }


def _row(name: str, gait: "Gait", mission: "Mission", fps: float) -> list[str]:
    f = figures(gait, mission)
    return [
        name,
        f"{f['leap']:.2f} m",
        f"{f['abreast']:.2f} m",
        f"{f['toe_in_deg']:.0f} deg",
        f"{f['stances']:.0f}",
        f"{f['capture_seconds'] / f['stances']:.1f} s",
        f"{f['capture_seconds'] * fps:.0f}",
        f"{f['mission_seconds']:.0f} s",
        f"{1e3 * f['end_sigma']:.1f} mm",
        f"{f['heading_sigma_deg']:.3f} deg",
    ]
