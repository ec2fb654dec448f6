"""Track a complete stance in a batch if causal tracks broke.

A lone mover with two equal lights is found as a rigid body in each image, its lights are ordered with both cameras.
Tracks of several movers are kept where tracking forward and backward in time agree.
"""

from collections.abc import Iterator, Sequence

from coloc_graph.frontend.homography.plane_tilts import plausible_planes
from coloc_graph.frontend.pairing.rigid_alignment import align_paths
from coloc_graph.frontend.stance_tracks import StanceTracks, stance_plane
from coloc_graph.frontend.tracks.rigid_path import RigidPath, rigid_path
from coloc_graph.frontend.tracks.track import Track

MIN_SAMPLES = 25  # mean length of causal tracks below which they broke often
MIN_SEEN = 0.5  # share of the images with both lights below which the mover was out of view
FAST = 0.35  # step of a light from image to image, as a share of the distance between both, that is large

#: Tracks of two observers.
Both = tuple[list[Track], list[Track]]


def track_choices(tracks: StanceTracks, robot_i: str, robot_j: str, end: float, window: float) -> Iterator[Both]:
    """Yield alternative tracks of two observers up to a time, the most probable first.

    Parameters
    ----------
    tracks
        Tracks of the stance.
    robot_i, robot_j
        The observers.
    end
        The instant [UTC s].
    window
        Time difference up to which two images are of one instant [s].
    """
    causal = tracks.of(robot_i, end), tracks.of(robot_j, end)
    if any(track.marker for side in causal for track in side):
        yield causal
        return
    if not _moves_alone(tracks):
        yield causal
        yield tracks.checked(robot_i), tracks.checked(robot_j)
        return
    broken = any(map(_broken, causal))
    if not broken:
        yield causal
    paths = align_paths(_path(tracks, robot_i, end), _path(tracks, robot_j, end), window)
    (mover,) = tracks.stance.movers
    found = paths[0].tracks(mover), paths[1].tracks(mover)
    if all(found):
        yield found
    if broken:
        yield causal


def why_broken(tracks: StanceTracks, robot_i: str, robot_j: str, end: float) -> str | None:
    """Reason why two observers' tracks of a lone mover broke, with what they saw; None where they did not."""
    robots = robot_i, robot_j
    causal = [tracks.of(robot, end) for robot in robots]
    if not _moves_alone(tracks) or not any(map(_broken, causal)) or any(t.marker for side in causal for t in side):
        return None
    paths = [_path(tracks, robot, end) for robot in robots]
    shares = [float((path.lights >= 2).mean()) if len(path.lights) else 0.0 for path in paths]
    saw = [
        f"{path.robot} saw 2 lights or more in {100 * share:.0f} % of its {len(path.lights)} images"
        + (
            f", {path.apart:.0f} px apart, median step {path.step:.0f} px, and its tracks broke "
            f"{max(path.pieces, (len(own) + 1) // 2) - 1} times"
            if len(path) > 1
            else ""
        )
        for path, share, own in zip(paths, shares, causal, strict=True)
    ]
    if min(shares) < MIN_SEEN:
        remedy = "keep the mover in both fields of view, and check exposure and threshold of the lights"
    elif any(path.step > FAST * path.apart for path in paths):
        remedy = "record more images a second, or let the mover drive and turn slower"
    elif min(len(path.lights) for path in paths) < MIN_SAMPLES:
        remedy = "let the mover drive further and turn, or record for longer"
    elif any(len(path) < MIN_SEEN * (path.lights >= 2).sum() for path in paths):
        remedy = (
            "keep the mover in both fields of view, and check heights, tilt, span and units in the team: on the marker "
            "plane few lights are a span apart"
        )
    else:
        remedy = "let the mover drive further and turn, or record for longer"
    return f"{'; '.join(saw)}: {remedy}"


def _moves_alone(tracks: StanceTracks) -> bool:
    """True if one robot with two markers moves, and no other."""
    movers = tracks.stance.movers
    markers = tracks.run.team[movers[0]].markers if len(movers) == 1 else None
    return markers is not None and len(markers.positions) == 2


def _broken(tracks: Sequence[Track]) -> bool:
    return sum(map(len, tracks)) < MIN_SAMPLES * max(len(tracks), 2)


def _path(tracks: StanceTracks, robot: str, end: float) -> RigidPath:
    made = tracks.paths.get(robot)
    if made is None or made[0] != end:
        run, (mover,) = tracks.run, tracks.stance.movers
        markers = run.team[mover].markers
        assert markers is not None and markers.span is not None
        planes = plausible_planes(stance_plane(run, tracks.stance, robot), run.team[robot].mount)
        seen = list(tracks.detections(robot, end))
        tracks.paths[robot] = made = end, rigid_path(robot, seen, run.team[robot].camera, planes, markers.span)
    return made[1]
