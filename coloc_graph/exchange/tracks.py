"""Import a user's own marker tracks from CSV files: `import_tracks`, explained in docs/import-tracks.md."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coloc_graph.errors import TracksError
from coloc_graph.exchange.csv_table import Table, first, read_table, require_other_file
from coloc_graph.exchange.ranges_csv import read_ranges
from coloc_graph.run import Detections, Motion, Planes, RunWriter, Stance, atomic_run
from coloc_graph.run.schemas import to_ns, to_seconds
from coloc_graph.team import Team, read_team

Array = NDArray[np.float64]

TRACKS_HEADER = ("stance", "time", "robot", "marker", "u", "v")
PLANES_HEADER = ("stance", "robot", "nx", "ny", "nz", "d")
PLANES_SIGMAS = ("normal_sigma_deg", "d_sigma")
MOVES_HEADER = ("stance", "robot")

LATEST = 9e9  # s; later times are milliseconds or nanoseconds (a run counts nanoseconds in 63 bits)
UNIT_TOLERANCE = 1e-3  # error of a normal's length, as three decimals leave it
IMAGE_MARGIN = 1.0  # px outside of the image where a sub-pixel fit may still put a centre


@dataclass(frozen=True)
class ImportSummary:
    """Summary of an import: numbers of stances and rows, observers in the team's order, and `warnings`."""

    stances: int
    rows: int
    observers: tuple[str, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Rows in the order of the file: `robot` is the index in the team, `uv` and `sigma` are pixels."""

    table: Table
    stance: NDArray[np.int64]
    ns: NDArray[np.int64]
    robot: NDArray[np.int64]
    marker: list[str]
    uv: Array
    sigma: Array


def import_tracks(
    team_path: str | Path,
    tracks_path: str | Path,
    out: str | Path,
    *,
    planes_path: str | Path | None = None,
    moves_path: str | Path | None = None,
    ranges_path: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ImportSummary:
    """Write a run from a team.toml and marker tracks in a CSV file.

    A stance's observers are the robots with rows in it, its movers the other robots with markers. A mover has moved.

    Parameters
    ----------
    team_path
        Description of the team.
    tracks_path
        CSV with stance, time [UTC s], robot (whose camera saw the marker), marker (any name; the same name in two
        cameras is the same marker), u, v [px], and optionally sigma [px], the standard deviation along each axis
        (default: `Camera.noise_px`).
    out
        Run to write.
    planes_path
        CSV with stance, robot, nx, ny, nz, d: the marker plane N . X = d in the robot's camera frame, N a unit normal
        from the camera to the plane, d > 0 [m]; and optionally normal_sigma_deg, d_sigma [m], with which the joint
        estimate corrects it.
    moves_path
        CSV with stance, robot: the robot moved since the stance before; other observers stayed put. By default all
        observers are taken to have stayed put, with a warning.
    ranges_path
        CSV of `read_ranges`: ranges between robots, or to landmarks.
    progress
        Called with (rows written, their number).

    Raises
    ------
    TracksError, TeamError
        In one sentence that names file and line. Nothing is written, and an existing file is kept.
    RunError
        The run cannot be written.
    """
    tracks_path, out = Path(tracks_path), Path(out)
    require_other_file(out, team_path, tracks_path, planes_path, moves_path, ranges_path)
    team = read_team(team_path)
    tracks = _read_tracks(tracks_path, team)
    observers = _observers(tracks, team)
    moved = _read_moves(Path(moves_path), team, tracks) if moves_path is not None else {}
    planes = _read_planes(Path(planes_path), team, tracks) if planes_path is not None else {}
    stances = _stances(tracks, team, observers, moved)
    _require_planes(tracks_path, stances, planes)

    ranges = [] if ranges_path is None else read_ranges(ranges_path, team, stances[0].start, stances[-1].end)
    with atomic_run(out, team) as writer:
        for one in ranges:
            writer.write(one)
        _write(writer, tracks, stances, planes, moved, progress)
    return ImportSummary(
        stances=len(stances),
        rows=len(tracks.ns),
        observers=tuple(name for name in team.names if any(name in stance.observers for stance in stances)),
        warnings=tuple(_warnings(tracks, team, stances, moves_known=moves_path is not None)),
    )


def _read_tracks(path: Path, team: Team) -> _Tracks:
    table = read_table(path, "tracks", TRACKS_HEADER, optional=("sigma",))
    if not len(table):
        raise TracksError(f"{path}: has a header and no rows; add one row for each marker in each image")
    robot = table.robots(team)
    marker = table.columns["marker"]
    if "" in marker:
        raise table.error(marker.index(""), "`marker` is empty; give the marker a name, the same in every camera")
    tracks = _Tracks(
        table=table,
        stance=table.stances(),
        ns=_nanoseconds(table),
        robot=robot,
        marker=marker,
        uv=np.stack([table.numbers("u"), table.numbers("v")], axis=-1),
        sigma=_sigma(table, robot, team),
    )
    _require_ascending(tracks, team)
    _require_stances_in_order(tracks)
    return tracks


def _nanoseconds(table: Table) -> NDArray[np.int64]:
    times = table.numbers("time")
    row = first((times < 0) | (times > LATEST))
    if row is not None:
        given = table.columns["time"][row]
        raise table.error(row, f"`time` is {given}; give UTC seconds that are not negative and not above {LATEST:.0f}")
    return np.array([to_ns(time) for time in times.tolist()], np.int64)


def _sigma(table: Table, robot: NDArray[np.int64], team: Team) -> Array:
    if "sigma" not in table.columns:
        return np.array([one.camera_if_any.noise_px if one.camera_if_any else np.nan for one in team.robots])[robot]
    sigma = table.numbers("sigma")
    row = first(sigma <= 0)
    if row is not None:
        given = table.columns["sigma"][row]
        raise table.error(row, f"`sigma` is {given}; give the standard deviation of u and of v in pixels, above 0")
    return sigma


def _require_ascending(tracks: _Tracks, team: Team) -> None:
    """Raise `TracksError` unless the times of a marker in a camera and stance ascend in the order of the rows."""
    _, marker = np.unique(np.array(tracks.marker), return_inverse=True)
    keys = np.stack([tracks.stance, tracks.robot, marker])
    order = np.lexsort(keys)  # stable: the rows of one track stay in their order
    same = (np.diff(keys[:, order]) == 0).all(axis=0)
    late = np.zeros(len(order), bool)
    late[order[1:]] = same & (np.diff(tracks.ns[order]) <= 0)
    row = first(late)
    if row is None:
        return
    before = int(order[np.flatnonzero(order == row)[0] - 1])
    where = f"marker `{tracks.marker[row]}` in robot `{team.names[tracks.robot[row]]}` at stance {tracks.stance[row]}"
    time, time_before = tracks.table.columns["time"][row], tracks.table.columns["time"][before]
    if tracks.ns[row] == tracks.ns[before]:
        raise tracks.table.error(
            row,
            f"{where} is there twice at {time} s (also in line {tracks.table.lines[before]}); "
            "give each marker a name of its own, and one row in each image",
        )
    raise tracks.table.error(
        row,
        f"the time of {where} runs backwards, from {time_before} s (line {tracks.table.lines[before]}) to {time} s; "
        "sort the rows by time",
    )


def _require_stances_in_order(tracks: _Tracks) -> None:
    for before, after in itertools.pairwise(np.unique(tracks.stance)):
        rows, earlier = np.flatnonzero(tracks.stance == after), np.flatnonzero(tracks.stance == before)
        row = int(rows[tracks.ns[rows].argmin()])
        last = int(earlier[tracks.ns[earlier].argmax()])
        if tracks.ns[row] <= tracks.ns[last]:
            time = tracks.table.columns["time"]
            raise tracks.table.error(
                row,
                f"stance {after} begins at {time[row]} s, not after stance {before} ends at {time[last]} s "
                f"(line {tracks.table.lines[last]}); number the stances in the order of time, without overlap",
            )


def _observers(tracks: _Tracks, team: Team) -> dict[int, tuple[str, ...]]:
    """Observers of each stance, in the team's order; `TracksError` if no stance has two."""
    observers = {
        stance: tuple(team.names[place] for place in np.unique(tracks.robot[tracks.stance == stance]))
        for stance in np.unique(tracks.stance).tolist()
    }
    if max(map(len, observers.values())) < 2:
        stance, (robot,) = next(iter(observers.items()))
        raise TracksError(
            f"{tracks.table.path}: every stance has only one observer (stance {stance} has `{robot}`); "
            "at least two robots must observe the same markers in one stance"
        )
    return observers


def _read_moves(path: Path, team: Team, tracks: _Tracks) -> dict[int, tuple[str, ...]]:
    """Robots that moved since the stance before, by stance; no rows mean that none ever moved."""
    table = read_table(path, "moves", MOVES_HEADER)
    places, stances = table.robots(team), table.stances()
    known = set(tracks.stance.tolist())
    moved: dict[int, tuple[str, ...]] = {}
    for row, (stance, place) in enumerate(zip(stances.tolist(), places.tolist(), strict=True)):
        if stance == min(known):
            raise table.error(row, f"stance {stance} is the first, and nobody moved before it; remove the row")
        if stance not in known:
            if stance < max(known):
                raise TracksError(
                    f"{tracks.table.path}: has no rows of stance {stance} and some of later ones, while "
                    f"{table.path}, line {table.lines[row]}, has it; number the stances 0, 1, 2, ... without gaps"
                )
            raise table.error(row, f"{_no_stance(stance, tracks)}; correct the number or remove the row")
        moved[stance] = tuple(dict.fromkeys((*moved.get(stance, ()), team.names[place])))
    return moved


def _no_stance(stance: int, tracks: _Tracks) -> str:
    return f"there is no stance {stance} in {tracks.table.path}"


@dataclass(frozen=True)
class _Plane:
    """Plane N . X = d, and its standard deviations of the normal [rad] and of d [m], None if none are given."""

    plane: tuple[float, float, float, float]
    sigmas: tuple[float, float] | None


def _read_planes(path: Path, team: Team, tracks: _Tracks) -> dict[int, dict[str, _Plane]]:
    """Read planes by stance and robot; normals are normalised."""
    table = read_table(path, "planes", PLANES_HEADER, optional=PLANES_SIGMAS)
    if not len(table):
        raise TracksError(
            f"{path}: has a header and no rows; add one row for each stance and observer, or leave it out"
        )
    places, stances = table.robots(team), table.stances()
    N = np.stack([table.numbers(name) for name in ("nx", "ny", "nz")], axis=-1)
    d = table.numbers("d")
    length = np.linalg.norm(N, axis=1)
    row = first(np.abs(length - 1) > UNIT_TOLERANCE)
    if row is not None:
        what = f"the normal (nx, ny, nz) has length {length[row]:.6g}; give a unit normal"
        raise table.error(row, what + (" (divide it by its length)" if length[row] else ""))
    row = first(d <= 0)
    if row is not None:
        raise table.error(
            row,
            f"`d` is {table.columns['d'][row]}; give the distance from the camera to the plane in metres, above 0, "
            "with the normal pointing from the camera to the plane",
        )
    sigmas = _plane_sigmas(table)
    planes: dict[int, dict[str, _Plane]] = {}
    for row, (stance, place) in enumerate(zip(stances.tolist(), places.tolist(), strict=True)):
        robot = team.names[place]
        _require_seen_in_front(table, row, tracks, stance, place, N[row], team)
        if robot in planes.setdefault(stance, {}):
            raise table.error(row, f"the plane of robot `{robot}` at stance {stance} is there twice; state it once")
        nx, ny, nz = (N[row] / length[row]).tolist()
        planes[stance][robot] = _Plane((nx, ny, nz, float(d[row])), None if sigmas is None else sigmas[row])
    return planes


def _plane_sigmas(table: Table) -> list[tuple[float, float]] | None:
    if PLANES_SIGMAS[0] not in table.columns:
        return None
    given = [table.numbers(name) for name in PLANES_SIGMAS]
    for name, values in zip(PLANES_SIGMAS, given, strict=True):
        row = first(values < 0)
        if row is not None:
            what = f"`{name}` is {table.columns[name][row]}; give a standard deviation, 0 for what is exact"
            raise table.error(row, what)
    return list(zip(np.deg2rad(given[0]).tolist(), given[1].tolist(), strict=True))


def _require_seen_in_front(
    table: Table, row: int, tracks: _Tracks, stance: int, place: int, N: Array, team: Team
) -> None:
    """Raise `TracksError` unless a plane's robot and stance have rows, most of them where its normal points."""
    in_stance = tracks.stance == stance
    if not in_stance.any():
        raise table.error(row, f"{_no_stance(stance, tracks)}; correct the number or remove the row")
    seen = tracks.uv[in_stance & (tracks.robot == place)]
    robot = team.robots[place]
    if not len(seen):
        raise table.error(
            row,
            f"robot `{robot.name}` has no rows at stance {stance} in {tracks.table.path}; "
            "correct the name or remove the row",
        )
    if (robot.camera.rays(seen) @ N <= 0).mean() > 0.5:
        raise table.error(
            row,
            f"most markers that robot `{robot.name}` saw at stance {stance} are behind this normal; "
            "it must point from the camera to the plane (turn its sign), x right, y down, z forward",
        )


def _stances(
    tracks: _Tracks, team: Team, observers: Mapping[int, tuple[str, ...]], moved: Mapping[int, tuple[str, ...]]
) -> list[Stance]:
    """Stances in order of time; anchors are robots that still stand where they observed before."""
    stances: list[Stance] = []
    standing: set[str] = set()
    for index, watching in observers.items():
        ns = tracks.ns[tracks.stance == index]
        movers = tuple(robot.name for robot in team.robots if robot.markers and robot.name not in watching)
        standing -= {*moved.get(index, ()), *movers}
        anchors = tuple(name for name in team.names if name in standing)
        stances.append(Stance(index, to_seconds(int(ns.min())), to_seconds(int(ns.max())), watching, movers, anchors))
        standing |= set(watching)
    return stances


def _require_planes(path: Path, stances: list[Stance], planes: Mapping[int, dict[str, _Plane]]) -> None:
    """Raise `TracksError` if no stance has a marker plane: no mover carries markers, and no plane is stated."""
    if planes or any(stance.movers for stance in stances):
        return
    raise TracksError(
        f"{path}: there is no marker plane, since no robot with markers moves and no plane is stated: "
        "add the robot that carries the markers to the team, or state the planes with --planes"
    )


def _write(
    writer: RunWriter,
    tracks: _Tracks,
    stances: list[Stance],
    planes: Mapping[int, dict[str, _Plane]],
    moved: Mapping[int, tuple[str, ...]],
    progress: Callable[[int, int], None] | None,
) -> None:
    done = 0
    for before, stance in zip((None, *stances), stances, strict=False):
        for robot in moved.get(stance.index, ()):
            assert before is not None, "nobody moves before the first stance"
            writer.write(Motion(robot, before.end, True))
            writer.write(Motion(robot, stance.start, False))
        writer.write(stance)
        if stance.index in planes:
            here = planes[stance.index]
            sigmas = {robot: one.sigmas for robot, one in here.items() if one.sigmas is not None}
            writer.write(Planes(stance.index, stance.start, {robot: one.plane for robot, one in here.items()}, sigmas))
        for detections in _detections(tracks, stance.index, writer.team):
            writer.write(detections)
            done += len(detections.uv)
        if progress is not None:
            progress(done, len(tracks.ns))


def _detections(tracks: _Tracks, stance: int, team: Team) -> Iterator[Detections]:
    """Yield the rows of each robot and time of a stance together, in order of time."""
    rows = np.flatnonzero(tracks.stance == stance)
    rows = rows[np.lexsort((tracks.robot[rows], tracks.ns[rows]))]
    begins = np.flatnonzero(np.diff(tracks.ns[rows]) | np.diff(tracks.robot[rows])) + 1
    for image in np.split(rows, begins):
        n = len(image)
        yield Detections(
            robot=team.names[tracks.robot[image[0]]],
            time=to_seconds(int(tracks.ns[image[0]])),
            uv=tracks.uv[image],
            covariance=tracks.sigma[image, None, None] ** 2 * np.eye(2),
            markers=tuple(tracks.marker[row] for row in image),
            flags=np.zeros(n, np.uint8),
            peak=np.zeros(n),  # not known of tracks from elsewhere
            area=np.zeros(n),
        )


def _warnings(tracks: _Tracks, team: Team, stances: list[Stance], *, moves_known: bool) -> Iterator[str]:
    path = tracks.table.path
    if len(stances) > 1 and not moves_known:
        yield (
            f"{path}: {len(stances)} stances and no moves: the observers are taken to have stayed put throughout; "
            "list the robots that moved in a CSV and give it with --moves"
        )
    alone = [stance for stance in stances if len(stance.observers) < 2]
    if alone:
        yield (
            f"{path}: {len(alone)} of {len(stances)} stances have only one observer and give no measurement (the first "
            f"is stance {alone[0].index}, with `{alone[0].observers[0]}`)"
        )
    cameras = [robot.camera_if_any for robot in team.robots]
    size = np.array([(one.width, one.height) if one else (0, 0) for one in cameras])[tracks.robot]
    beyond = np.maximum(-0.5 - tracks.uv, tracks.uv - (size - 0.5)).max(axis=1)
    far = beyond > IMAGE_MARGIN
    row = first(far)
    if row is not None:
        u, v = tracks.uv[row]
        yield (
            f"{path}: {far.sum()} of {len(far)} rows are outside of their robot's image (the first is "
            f"line {tracks.table.lines[row]}, ({u:g}, {v:g}) in {size[row][0]} x {size[row][1]} px); "
            "check the camera's width and height in the team, and that u goes right and v down in pixels"
        )
