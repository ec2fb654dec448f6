"""Contents of a run: the kind of its solution, unused data, and applicable options."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from coloc_graph.errors import InputError
from coloc_graph.frontend.stance_ranges import StanceRanges
from coloc_graph.pipeline.options import SolveOptions
from coloc_graph.run import Run

#: Kind of measurements that a run is solved by: leap-frog stances, or ranges and bearings of driving robots.
Kind = Literal["stances", "ranges"]

#: Topics of measurements by kind, each with the noun for one message.
NOUNS = {
    "image": "image",
    "detections": "detection record",
    "odometry": "odometry sample",
    "ranges": "range record",
}


@dataclass(frozen=True)
class Unused:
    """Recorded data that a solve does not use.

    Parameters
    ----------
    kind : str
        The topic's kind (`ranges`, `odometry`, `image`, `detections`), `bearings`, `stances`, `planes`, `landmarks`, or
        `tolerances` of mounts.
    count : int
        Number of messages; of landmarks, how many the team has.
    what : str
        Count with its noun.
    reason : str
        Why they are not used.
    requested : bool
        The options exclude this kind: no warning is needed.
    """

    kind: str
    count: int
    what: str
    reason: str
    requested: bool = False

    def __str__(self) -> str:
        return f"{self.what} not used: {self.reason}"


def kind_of(run: Run) -> Kind:
    """Return the kind of measurements that a run is solved by.

    Stances if at least two robots observe in one of them, otherwise ranges.

    Raises
    ------
    InputError
        The run holds nothing that can be solved.
    """
    if any(len(stance.observers) >= 2 for stance in run.stances):
        return "stances"
    if run.has_ranges:
        return "ranges"
    if run.stances:
        raise InputError(
            f"{run.path}: stance {run.stances[0].index} has one observer only, as has every other: "
            "at least two robots must stand and watch the same mover"
        )
    held = [_noun(count, noun) for kind, noun in NOUNS.items() if (count := _count(run, kind, run.team.names))]
    only = f"only {_joined(held)}" if held else "no measurement"
    raise InputError(
        f"{run.path}: there is nothing to solve: the run holds no stances and no ranges ({only}); record stances, or "
        "ranges to other robots and landmarks"
    )


def unused_in(run: Run, options: SolveOptions | None = None) -> tuple[Unused, ...]:
    """Return the recorded data that a solve of a run with these options does not use.

    Raises `InputError` as `kind_of` does.
    """
    options = (options or SolveOptions()).resolved()
    return tuple(_beside_ranges(run) if kind_of(run) == "ranges" else _beside_stances(run, options))


def unused_ranges(found: StanceRanges) -> tuple[Unused, ...]:
    """Return the ranges and bearings of a run with stances that its estimate does not use, by reason."""
    unused = [Unused("ranges", count, _noun(count, "range"), why) for why, count in found.unused.items()]
    if count := found.unused_bearings:
        why = "bearings count while both ends stand, if their ranges do and the team states their noise"
        unused.append(Unused("bearings", count, _noun(count, "bearing"), why))
    return tuple(unused)


def repeated_in(run: Run) -> tuple[Unused, ...]:
    """Return the images and detections that were left out as a run was read: each has the stamp of one before."""
    unused = []
    for topic, count in run.repeated.items():
        _, robot, kind = topic.split("/")
        why = f"of messages of {robot} with the same stamp the first counts; see that each is recorded once"
        unused.append(Unused(kind, count, _noun(count, NOUNS[kind]), why))
    return tuple(unused)


def require_applicable(run: Run, options: SolveOptions) -> Kind:
    """Return the kind of measurements that a run is solved by; `InputError` where an option does not apply to it."""
    kind = kind_of(run)
    what, inapplicable = "holds stances", {"between_robots=False (--without-robots)": not options.between_robots}
    if kind == "ranges":
        what = "is solved by its ranges"
        inapplicable = {
            f"method={options.method!r} (--method)": options.method is not None,
            "a frontend (--scale)": options.frontend is not None,
            "odometry=False (--without-odometry)": not options.odometry,
        }
    for option, given in inapplicable.items():
        if given:
            raise InputError(f"{option} does not apply to {run.path}, which {what}: leave it out")
    return kind


def _beside_stances(run: Run, options: SolveOptions) -> Iterable[Unused]:
    """Unused data of a run that is solved by its stances."""
    names = run.team.names
    found: list[Unused | None] = []
    if options.method != "joint":
        found.append(_unused(run, "ranges", names, f"`{options.method}` calibrates no range sensors; use `joint`"))
    elif run.team.floor is None:
        found.append(_unused(run, "ranges", names, "the team states no floor, and ranges are those along a floor"))
    else:
        without = (one.name for one in run.team.robots if one.ranging is None)
        found += [_unused(run, "ranges", [name], f"the team states no [robots.ranging] of {name}") for name in without]
    if options.method != "joint":
        mounts = ((one.name, one.mount_if_any) for one in run.team.robots)
        loose = [name for name, mount in mounts if mount and (mount.yaw_sigma_deg or mount.position_sigma)]
        if loose:
            what = f"tolerances of yaw and position of the camera of {_joined(loose)}"
            found.append(Unused("tolerances", len(loose), what, f"`{options.method}` takes them as exact; use `joint`"))
    detected = [robot for robot in names if run.has_detections(robot)]
    found.append(_unused(run, "image", detected, "their markers are recorded as detections"))
    if options.method == "chain":
        found.append(_unused(run, "odometry", names, "a chain composes relative poses alone"))
        if landmarks := run.team.landmarks:
            what = _noun(len(landmarks), "landmark")
            found.append(Unused("landmarks", len(landmarks), what, "a chain composes relative poses alone"))
    elif run.team.floor is None:
        found.append(_unused(run, "odometry", names, "the team states no floor, and wheels measure on a floor only"))
    elif not options.odometry:
        found.append(_unused(run, "odometry", names, "the options leave odometry out", requested=True))
    return [one for one in found if one is not None]


def _beside_ranges(run: Run) -> Iterable[Unused]:
    """Unused data of a run that is solved by its ranges."""
    names = run.team.names
    found = [
        _unused(run, "image", names, "no stance with two observers says who stood while they were taken"),
        _unused(run, "detections", names, "no stance with two observers says who stood while they were made"),
    ]
    if run.stances:
        what = _noun(len(run.stances), "stance")
        found.append(Unused("stances", len(run.stances), what, "fewer than two robots observe in each"))
    if run.planes:
        what = _noun(len(run.planes), "record of planes", "records of planes")
        found.append(Unused("planes", len(run.planes), what, "planes are stated for stances"))
    return [one for one in found if one is not None]


def _unused(run: Run, kind: str, robots: Iterable[str], reason: str, *, requested: bool = False) -> Unused | None:
    count = _count(run, kind, robots)
    return Unused(kind, count, _noun(count, NOUNS[kind]), reason, requested) if count else None


def _count(run: Run, kind: str, robots: Iterable[str]) -> int:
    return sum(run.topics.get(f"/{robot}/{kind}", 0) for robot in robots)


def _noun(count: int, one: str, many: str | None = None) -> str:
    return f"{count} {one if count == 1 else many or one + 's'}"


def _joined(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
