"""coloc simulate SCENARIO --out RUN."""

import argparse
import math
from typing import TYPE_CHECKING

from coloc_graph.cli.place import add_out, require_run_place
from coloc_graph.cli.printing import progress

if TYPE_CHECKING:
    from coloc_graph.planning.formation import Gait

#: Scenarios with a gait, and the leap of each [m].
GAITS = {"hallway": 0.185, "six-step": 0.185, "landmarks": 0.25, "team": 0.45}

#: Options that do not apply to the scenario drives.
WITH_STANCES = (
    *("stances", "points", "fisheye", "noise", "mount_sigma", "mount_yaw_sigma", "height_sigma", "span_sigma"),
    *("floor_sigma", "clock_offset", "time_jitter", "l", "theta", "leap", "plan", "map", "team", "at_once", "blink"),
    *("length", "laps", "landmark_every", "fps", "image_format", "messy"),
)


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command and its arguments."""
    command = commands.add_parser(
        "simulate",
        help="simulate a team and write its run, with ground truth",
        description="Simulate a team in a scenario and write its run, with ground truth.",
    )
    command.add_argument("scenario", help="single-step, six-step, hallway, team, landmarks, or drives (ranges alone)")
    add_out(command)
    command.add_argument(
        "--depth", choices=("tracks", "images"), default="tracks",
        help="write marker centres, or rendered images (default: tracks)",
    )  # fmt: skip
    command.add_argument("--seed", type=int, default=0, help="seed of all random numbers (default: 0)")
    command.add_argument("--stances", type=int, help="number of stances (default: hallway 40, team 30, six-step 6)")
    command.add_argument(
        "--points", type=int,
        help="correspondences a stance, at least 6 (default: 100; images and single-step 250; --blink 2000)",
    )  # fmt: skip

    command.add_argument("--fisheye", type=float, metavar="DEG", help="cameras are fisheyes of DEG across (not team)")

    errors = command.add_argument_group("errors of the simulated world (standard deviations; default: 0)")
    errors.add_argument("--noise", type=float, help="noise of a marker centre, px, with --depth tracks (default: 0.3)")
    errors.add_argument("--mount-sigma", type=float, default=0.0, help="tilt and roll of the mounts, deg")
    errors.add_argument("--mount-yaw-sigma", type=float, default=0.0, help="yaw of the mounts, deg")
    errors.add_argument("--height-sigma", type=float, default=0.0, help="height of the mounts, m")
    errors.add_argument("--span-sigma", type=float, default=0.0, help="distance between a robot's markers, m")
    errors.add_argument("--floor-sigma", type=float, default=0.0, help="unevenness of the floor, deg")
    errors.add_argument("--clock-offset", type=float, default=0.0, help="offset of the other robots' clocks, s")
    errors.add_argument("--time-jitter", type=float, default=0.0, help="jitter of the instants of capture, s")

    uwb = command.add_argument_group("ranges between robots (UWB, 10 Hz a pair)")
    uwb.add_argument("--uwb-sigma", type=float, default=0.0, help="noise of a range, m (default: 0, no ranges)")
    uwb.add_argument("--uwb-offset", type=float, default=0.0, help="offsets of the sensors (1 sigma), m (default: 0)")
    uwb.add_argument("--uwb-nlos", type=float, default=0.0, help="share without line of sight, 0 to 1 (default: 0)")
    uwb.add_argument("--uwb-landmarks", type=int, metavar="N", help="landmarks that are ranged, unknown to the team "
                     "without --known (default: 0; drives 4)")  # fmt: skip
    uwb.add_argument("--seconds", type=float, help="duration of drives, s (default: 60)")

    single = command.add_argument_group("formation, or a plan instead")
    single.add_argument("-l", type=float, help="distance between the observers, m (default: 0.8; hallway 0.74)")
    single.add_argument("--theta", type=float, help="angle between the observers, deg (default: 35; hallway 34)")
    single.add_argument(
        "--leap", type=float, help="advance a stance, m (default: 0.185; landmarks 0.25; rows of team 0.45)"
    )
    single.add_argument("--plan", metavar="CSV", help="follow a plan that `coloc plan --poses` wrote")
    single.add_argument("--map", metavar="YAML", help="with --plan: ROS map_server map of walls that hide the mover")
    single.add_argument("--team", metavar="TEAM.toml", help="with --plan: its robots (default: those of the reference)")

    team = command.add_argument_group("scenario team")
    team.add_argument("--robots", type=int, help="number of robots (default: 10; drives 3)")
    team.add_argument("--at-once", type=int, help="number of robots that move at once (default: a quarter)")
    team.add_argument("--blink", action="store_true", help="robots are told apart by blinking; markers have no names")

    landmarks = command.add_argument_group("scenario landmarks")
    landmarks.add_argument("--length", type=float, help="length of the whole course, m (default: 100)")
    landmarks.add_argument("--laps", type=int, help="number of laps of the square course (default: 4)")
    landmarks.add_argument("--landmark-every", type=float, help="distance between landmarks, m (default: 10)")
    landmarks.add_argument("--known", action="store_true", help="the team knows the landmarks' positions")

    images = command.add_argument_group("with --depth images")
    images.add_argument("--fps", type=float, help="images a second (default: 10)")
    images.add_argument("--image-format", choices=("jpeg", "png", "raw"), help="format of the images (default: jpeg)")
    images.add_argument("--messy", action="store_true", help="add glare, mirrors, flicker, and a person in the way")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate a scenario and write its run."""
    from coloc_graph.errors import InputError
    from coloc_graph.planning.floor_map import read_floor_map
    from coloc_graph.planning.plan import read_plan
    from coloc_graph.simulation import Imperfections, simulate
    from coloc_graph.team import read_team

    require_run_place(args.out, force=args.force)
    if args.scenario == "drives":
        return _drives(args)
    if args.seconds is not None:
        raise InputError(f"--seconds belongs to drives, not to {args.scenario}; leave it out")
    other = {"tracks": ("fps", "image_format"), "images": ("noise",)}[args.depth]
    for name in other:
        if getattr(args, name) is not None and not (name == "fps" and args.plan is not None):
            raise InputError(f"--{name.replace('_', '-')} does not apply with --depth {args.depth}; leave it out")
    imperfections = Imperfections(
        mount_sigma_deg=args.mount_sigma,
        mount_yaw_sigma_deg=args.mount_yaw_sigma,
        height_sigma=args.height_sigma,
        span_sigma=args.span_sigma,
        floor_sigma_deg=args.floor_sigma,
        clock_offset=args.clock_offset,
        time_jitter=args.time_jitter,
        uwb_sigma=args.uwb_sigma,
        uwb_offset_sigma=args.uwb_offset,
        uwb_nlos=args.uwb_nlos,
        noise_px=0.3 if args.noise is None else args.noise,
    )
    with progress("stances simulated") as report:
        simulate(
            args.scenario,
            args.out,
            depth=args.depth,
            seed=args.seed,
            points=args.points,
            stances=args.stances,
            imperfections=imperfections,
            l=args.l if args.scenario not in GAITS else None,
            theta_deg=args.theta if args.scenario not in GAITS else None,
            gait=gait_of(args),
            plan=None if args.plan is None else read_plan(args.plan),
            floor_map=None if args.map is None else read_floor_map(args.map),
            team=None if args.team is None else read_team(args.team),
            robots=args.robots,
            at_once=args.at_once,
            length=args.length,
            landmark_every=args.landmark_every,
            laps=args.laps,
            known=args.known,
            blink=args.blink,
            fps=10.0 if args.fps is None else args.fps,
            image_format=args.image_format or "jpeg",
            messy=args.messy,
            uwb_landmarks=args.uwb_landmarks or 0,
            fisheye_deg=args.fisheye,
            progress=report,
        )
    print(args.out)
    return 0


def _drives(args: argparse.Namespace) -> int:
    """Simulate robots that range while they drive."""
    from coloc_graph.errors import InputError
    from coloc_graph.simulation.drives import simulate_drives

    for name in WITH_STANCES:
        if getattr(args, name):
            raise InputError(f"--{name.replace('_', '-')} does not apply to drives, without stances; leave it out")
    if args.depth != "tracks":
        raise InputError("drives have no cameras: leave out --depth")
    simulate_drives(
        args.out,
        seed=args.seed,
        robots=3 if args.robots is None else args.robots,
        seconds=60.0 if args.seconds is None else args.seconds,
        sigma=args.uwb_sigma or 0.05,
        offset_sigma=args.uwb_offset,
        nlos=args.uwb_nlos,
        landmarks=4 if args.uwb_landmarks is None else args.uwb_landmarks,
        known=args.known,
    )
    print(args.out)
    return 0


def gait_of(args: argparse.Namespace) -> "Gait | None":
    """Return the gait that the arguments describe; None if they leave all of it out, or the scenario has none."""
    from coloc_graph.errors import InputError
    from coloc_graph.planning.formation import Gait

    if args.scenario not in GAITS:
        if args.leap is not None:
            raise InputError(f"{args.scenario} has no leap: leave --leap out")
        return None
    given = {"l": args.l, "theta_deg": args.theta, "leap": args.leap}
    if all(value is None for value in given.values()):
        return None
    leap = GAITS[args.scenario] if args.leap is None else args.leap
    # without a distance the lanes stay where they are
    lanes = 0.8 if args.scenario == "team" else 0.72
    apart = math.hypot(leap, lanes) if args.l is None else args.l
    return Gait.of_paper(apart, 34.0 if args.theta is None else args.theta, leap)
