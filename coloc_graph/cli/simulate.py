"""coloc simulate SCENARIO --out RUN."""

import argparse

from coloc_graph.cli.place import add_out, require_run_place
from coloc_graph.cli.printing import progress


def add(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """The command's arguments."""
    command = commands.add_parser("simulate", help="write a run of a simulated team, with truth in it")
    command.add_argument("scenario", help="single-step, six-step, hallway, team or landmarks")
    add_out(command)
    command.add_argument("--depth", choices=("tracks", "images"), default="tracks", help="marker centres, or images")
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--stances", type=int, help="how many stances (hallway: 40, team: 30)")
    command.add_argument("--points", type=int, help="correspondences a stance, at least 6")
    command.add_argument("--noise", type=float, help="of a marker centre, px (tracks; default 0.3)")
    command.add_argument("--mount-sigma", type=float, default=0.0, help="tilt and roll of the mounts, deg")
    command.add_argument("--height-sigma", type=float, default=0.0, help="height of the mounts, m")
    command.add_argument("--span-sigma", type=float, default=0.0, help="distance between a robot's markers, m")
    command.add_argument("--floor-sigma", type=float, default=0.0, help="unevenness of the floor, deg")
    command.add_argument("--clock-offset", type=float, default=0.0, help="of the other robots' clocks, s")
    command.add_argument("--time-jitter", type=float, default=0.0, help="of the instants of capture, s")
    command.add_argument("-l", type=float, help="single-step: distance between the observers, m")
    command.add_argument("--theta", type=float, help="single-step: angle between the observers, deg")
    command.add_argument("--robots", type=int, help="team: how many robots; default 10")
    command.add_argument("--at-once", type=int, help="team: how many of them move at once; default a quarter")
    command.add_argument("--blink", action="store_true", help="team: markers have no names, and tell them by blinking")
    command.add_argument("--length", type=float, help="landmarks: how far the team goes in all, m; default 100")
    command.add_argument("--laps", type=int, help="landmarks: in how many laps of a square course; default 4")
    command.add_argument("--landmark-every", type=float, help="landmarks: so far apart along the course, m; default 10")
    command.add_argument("--known", action="store_true", help="landmarks: the team is told where they are")
    command.add_argument("--fps", type=float, help="images a second (images; default 10)")
    command.add_argument("--image-format", choices=("jpeg", "png", "raw"), help="images; default jpeg")
    command.add_argument(
        "--messy", action="store_true", help="images: glare, mirrors, flicker, and a person in the way"
    )
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate."""
    from coloc_graph.errors import InputError
    from coloc_graph.simulation import Imperfections, simulate

    require_run_place(args.out, force=args.force)
    other = {"tracks": ("fps", "image_format"), "images": ("noise",)}[args.depth]
    for name in other:
        if getattr(args, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} says nothing at depth {args.depth}; leave it out")
    imperfections = Imperfections(
        mount_sigma_deg=args.mount_sigma,
        height_sigma=args.height_sigma,
        span_sigma=args.span_sigma,
        floor_sigma_deg=args.floor_sigma,
        clock_offset=args.clock_offset,
        time_jitter=args.time_jitter,
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
            l=args.l,
            theta_deg=args.theta,
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
            progress=report,
        )
    print(args.out)
    return 0
