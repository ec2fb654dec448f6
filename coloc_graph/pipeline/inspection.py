"""Inspection of a run: every reason for which a solve would use less than all of it.

Detections that name their markers are measured as a solve does; images are not decoded.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from coloc_graph.backend import KeyframeGraph, diagnose
from coloc_graph.errors import DegenerateGeometry, InputError
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.frontend.landmarks import describe_unused, sight_landmarks
from coloc_graph.frontend.learnt_noise import measure_alone
from coloc_graph.frontend.pairing.correspondence import PAIRING_WINDOW, correspond_roughly, pair_by_time
from coloc_graph.frontend.pairing.plane_check import implausible
from coloc_graph.frontend.stance import little_in_common
from coloc_graph.frontend.stance_tracks import StanceTracks, stance_plane
from coloc_graph.pipeline.contents import kind_of, repeated_in, unused_in, unused_ranges
from coloc_graph.pipeline.ranges import unusable_ranges
from coloc_graph.run import Detections, Run, Stance
from coloc_graph.team import Landmark


@dataclass(frozen=True)
class Finding:
    """A problem of a run: `where` it is (a stance, a robot), and `what` it is with its remedy, in words."""

    where: str
    what: str


@dataclass(frozen=True)
class LandmarkSeen:
    """A landmark of the team, with the stances and observers whose detections name it."""

    landmark: Landmark
    stances: tuple[int, ...]
    observers: tuple[str, ...]

    @property
    def what(self) -> str:
        """Description of its markers."""
        if self.landmark.tag is not None:
            return f"tag {self.landmark.tag.family} {self.landmark.tag.id}"
        return "no camera sees it" if self.landmark.markers is None else "two lights"


def landmarks_seen(run: Run) -> list[LandmarkSeen]:
    """Return the landmarks of a team with the stances and observers that see them; images are not decoded."""
    stances: dict[str, dict[int, None]] = {landmark.name: {} for landmark in run.team.landmarks}
    observers: dict[str, dict[str, None]] = {landmark.name: {} for landmark in run.team.landmarks}
    observed = [(stance, robot) for stance in run.stances for robot in stance.observers] if stances else []
    for stance, robot in observed:
        for name in {name for one in run.detections(robot, stance.start, stance.end) for name in _bodies(one)}:
            if name in stances:
                stances[name][stance.index] = observers[name][robot] = None
    return [LandmarkSeen(one, tuple(stances[one.name]), tuple(observers[one.name])) for one in run.team.landmarks]


def _bodies(one: Detections) -> Iterable[str]:
    return {marker.rpartition("/")[0] for marker in one.markers}


def inspect(run: Run) -> list[Finding]:
    """Find everything that is wrong with a run, and the data that a solve would not use, without decoding images."""
    findings = [Finding("file", warning) for warning in run.warnings]
    try:
        findings += [Finding("run", str(one)) for one in unused_in(run)]
        if kind_of(run) == "ranges":
            return [*findings, *_ranging_findings(run)]
        findings += [Finding("run", f"at least {one}") for one in unused_ranges(unusable_ranges(run))]
    except InputError as why:
        findings.append(Finding("run", str(why).removeprefix(f"{run.path}: ")))
    if run.stances and run.team.reference not in run.stances[0].observers:
        findings.append(
            Finding("stance 0", f"the reference {run.team.reference} does not observe: name an observer as reference")
        )
    for before, stance in zip((None, *run.stances), run.stances, strict=False):
        findings += _stance_findings(run, before, stance)
    return [*findings, *(Finding("run", str(one)) for one in repeated_in(run))]


def _ranging_findings(run: Run) -> list[Finding]:
    """Find the problems of a ranging run."""
    findings = []
    for robot in run.team.names:
        if run.topics.get(f"/{robot}/ranges") and not run.topics.get(f"/{robot}/odometry"):
            findings.append(Finding(robot, "it measured ranges and has no odometry: record its odometry, too"))
        elif run.topics.get(f"/{robot}/ranges") and run.team[robot].ranging is None:
            findings.append(Finding(robot, "the team states no range sensor: give the robot a [robots.ranging]"))
    if not findings:
        try:
            keyframes = keyframes_of(run)
            said = [*keyframes.warnings, *map(str, diagnose(KeyframeGraph(run.team, keyframes)))]
        except InputError as why:
            said = [str(why)]
        findings += [Finding("run", one.removeprefix(f"{run.path}: ")) for one in said]
    if not any(landmark.position is not None for landmark in run.team.landmarks):
        findings.append(
            Finding("team", "no landmark's position is stated: the world is the reference robot's first pose")
        )
    return findings


def _stance_findings(run: Run, before: Stance | None, stance: Stance) -> list[Finding]:
    where = f"stance {stance.index}"
    findings = []
    if len(stance.observers) < 2:
        findings.append(Finding(where, "one observer only: at least two robots must stand and watch"))
    if before is not None:
        if not stance.anchors:
            findings.append(Finding(where, "no anchor: nothing ties it to the stance before; let one robot stay put"))
        findings += [
            Finding(where, f"{robot} is named as an anchor, but moved since stance {before.index}")
            for robot in stance.anchors
            if any(motion.moving for motion in run.motions(robot, before.end, stance.start))
        ]
    times, named, measurable = {}, {}, True
    for number, robot in enumerate(stance.observers):
        seen: list[Detections] = []
        if run.has_detections(robot):
            seen = list(run.detections(robot, stance.start, stance.end))
            times[robot] = np.array([d.time for d in seen])
        else:
            times[robot] = np.array([image.time for image in run.images(robot, stance.start, stance.end)])
        if seen and all(marker for one in seen for marker in one.markers):
            named[robot] = seen
        if not len(times[robot]):
            findings.append(Finding(where, f"{robot} recorded neither detections nor images: check its camera"))
            measurable = False
        if number == len(stance.observers) - 1 and number > 0:
            continue  # a pair needs the plane of its first observer
        try:
            stance_plane(run, stance, robot)
        except DegenerateGeometry as why:
            findings.append(Finding(where, f"{robot}: {why}"))
            measurable = False
    if not measurable:
        return findings
    tracks = StanceTracks(run, stance)
    try:
        landmarks = [(robot, tracks.landmarks(robot)) for robot in named]
    except InputError as why:  # of an unknown marker
        return [*findings, Finding(where, str(why).removeprefix(f"{run.path}: {where}: "))]
    for sentence in describe_unused(sight_landmarks(run, stance, landmarks)[1]):
        findings.append(Finding(where, sentence.removeprefix(f"{where}: ")))
    for i, j in itertools.combinations(stance.observers, 2):
        if run.team.clock_sigma == 0 and not len(pair_by_time(times[i], times[j])):
            nearest = np.abs(times[i][:, None] - times[j][None]).min()
            findings.append(
                Finding(
                    where,
                    f"{i} and {j} share no instant within {1e3 * PAIRING_WINDOW:.0f} ms (the nearest are "
                    f"{1e3 * nearest:.1f} ms apart): synchronise their clocks",
                )
            )
        elif i in named and j in named:
            findings += [Finding(where, what) for what in _of_detections(run, stance, i, j, tracks)]
    return list(dict.fromkeys(findings))  # two pairs may find the same


def _of_detections(run: Run, stance: Stance, i: str, j: str, tracks: StanceTracks) -> list[str]:
    """Find the problems of the named detections of two observers."""
    sigma = run.team.clock_sigma
    if sigma > 0:  # only a solve estimates the clocks' offset
        tracks_i, tracks_j = (tracks.of(robot) for robot in (i, j))
        camera_i, camera_j = (run.team[robot].camera for robot in (i, j))
        try:
            found = correspond_roughly(tracks_i, tracks_j, camera_i, camera_j, 0.0, sigma)[1]
        except DegenerateGeometry as why:
            return [f"{i} and {j}: {why}"]
        unlikely = implausible(run, stance, i, found)
        return [unlikely] if unlikely else []
    measured = measure_alone(run, stance, i, j, tracks=tracks)
    what = []
    if measured.homography.unusable and not little_in_common(measured.homography, stance):
        what.append(f"{i} and {j}: {measured.homography.unusable}")
    if measured.correspondences is not None:
        unlikely = implausible(run, stance, i, measured.correspondences)
        what += [unlikely] if unlikely else []
    return what
