"""When a robot moved, by its odometry, and the stances of a team whose movements are known."""

import numpy as np
import pytest

from coloc_graph.exchange.stances import MotionThresholds, Movements, derive_stances, movements
from coloc_graph.run import Motion

LIMITS = MotionThresholds()
#: Nothing is left aside: what happens when is exact.
EXACT = MotionThresholds(settle=0.0, pause=0.0, shortest=0.0)


def drive(*legs, rate=20.0):
    """Times and poses (n, 3) of a robot: legs of (seconds, v [m/s], w [rad/s])."""
    times, poses = [0.0], [(0.0, 0.0, 0.0)]
    for seconds, v, w in legs:
        for _ in range(round(seconds * rate)):
            x, y, yaw = poses[-1]
            poses.append((x + v * np.cos(yaw) / rate, y + v * np.sin(yaw) / rate, yaw + w / rate))
            times.append(times[-1] + 1 / rate)
    return np.array(times), np.array(poses)


def wrapped(poses):
    return np.column_stack([poses[:, :2], np.remainder(poses[:, 2] + np.pi, 2 * np.pi) - np.pi])


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.0), (-0.2, 0.0), (0.0, 0.5), (0.0, -0.5)])
def test_a_movement_begins_and_ends_within_half_a_window_of_when_it_does(v, w):
    found = movements("A", *drive((5, 0, 0), (3, v, w), (4, 0, 0)), LIMITS)
    ((begin, end),) = found.moved
    assert 5 - LIMITS.window / 2 - 0.05 <= begin <= 5 and 8 <= end <= 8 + LIMITS.window / 2 + 0.05
    assert (found.start, found.end, found.crept) == (0.0, pytest.approx(12.0), ())
    assert found.motions() == [Motion("A", begin, True), Motion("A", end, False)]
    assert found.standing(0.3) == [(0.0, begin), (end + 0.3, found.end)]


def test_a_robot_that_turns_on_and_on_stands_nowhere_on_its_way_round():
    times, poses = drive((20, 0.0, 0.7))  # more than twice around
    found = movements("A", times, wrapped(poses), LIMITS)
    assert found.moved == ((0.0, pytest.approx(20.0)),)
    standing_astride = np.tile([0.0, 0.0, np.pi], (len(times), 1)) + 1e-4 * np.random.default_rng(1).normal(
        size=(len(times), 3)
    )
    assert movements("A", times, wrapped(standing_astride), LIMITS).moved == ()


def test_noise_below_the_thresholds_is_no_movement_and_noise_above_is(rng):
    times, poses = drive((20, 0, 0))
    assert movements("A", times, poses + rng.normal(size=poses.shape) * (5e-4, 5e-4, 1e-3), LIMITS).moved == ()
    jumpy = movements("A", times, poses + rng.normal(size=poses.shape) * (0.01, 0.01, 0), LIMITS)
    assert sum(end - begin for begin, end in jumpy.moved) > 10


def test_who_creeps_counts_as_moving_and_is_told_of():
    found = movements("A", *drive((5, 0.005, 0.0), (5, 0.2, 0.0), (5, 0.0, 0.0)), LIMITS)
    assert found.crept == ((0.0, pytest.approx(5.0, abs=0.3)),)
    assert found.moved == ((0.0, pytest.approx(10.2, abs=0.1)),)


def test_between_samples_far_apart_a_robot_moved_if_they_differ_and_stood_if_not():
    times = [0.0, 1.0, 60.0, 61.0, 120.0]
    found = movements("A", times, [(0, 0, 0), (0, 0, 0), (0.02, 0, 0), (0.02, 0, 0), (0.02, 0, 0)], LIMITS)
    ((begin, end),) = found.moved
    assert (begin, end) == (1.0, 60.0)  # 0.3 mm/s on average, and yet
    one = movements("A", [3.0], [(1, 2, 3)], LIMITS)
    assert (one.moved, one.start, one.end, one.standing()) == ((), 3.0, 3.0, [])


def test_odometry_that_is_told_only_while_it_drives_stands_in_between():
    times, poses = drive((2, 0.2, 0.0))
    later = np.concatenate([times, times + 60])
    found = movements("A", later, np.concatenate([poses, poses + poses[-1]]), LIMITS)
    assert [(round(begin), round(end)) for begin, end in found.moved] == [(0, 2), (60, 62)]


@pytest.mark.parametrize(
    ("field", "value"), [("speed", 0.0), ("turn_deg", -1.0), ("window", 0.0), ("settle", -0.1), ("pause", np.nan)]
)
def test_thresholds_that_are_none_are_refused(field, value):
    with pytest.raises(ValueError, match=f"`{field}` is"):
        MotionThresholds(**{field: value})


def team(until=100.0, **moved):
    """Robots by the stretches in which they move; the time is known from 0 to `until`."""
    return [Movements(robot, 0.0, until, tuple(spans)) for robot, spans in moved.items()]


def stances(robots, cameras="AB", marked="ABC", limits=EXACT):
    images = {robot: np.arange(0.0, 100.0, 0.1) for robot in cameras}
    return [
        (one.start, one.end, "".join(one.observers), "".join(one.movers), "".join(one.anchors))
        for one in derive_stances(robots, images, marked, limits)
    ]


#: A and B leap-frog, C drives about in between.
LEAP_FROG = {"A": [(12, 20)], "B": [(30, 38)], "C": [(1, 10), (21, 29), (39, 49)]}


def test_a_leap_frog_has_a_stance_whenever_the_mover_drives_and_its_anchor_is_who_stayed():
    assert stances(team(**LEAP_FROG)) == [
        (1, 10, "AB", "C", ""),
        (21, 29, "AB", "C", "B"),
        (39, 49, "AB", "C", "A"),
    ]


def test_where_all_have_cameras_and_markers_who_leaps_is_watched_too():
    found = stances(team(**LEAP_FROG), cameras="ABC")
    assert found[:3] == [(1, 10, "AB", "C", ""), (12, 20, "BC", "A", "B"), (21, 29, "AB", "C", "B")]
    assert stances(team(**LEAP_FROG), cameras="ABC", marked="C") == stances(team(**LEAP_FROG))


def test_a_pause_of_the_mover_is_no_end_unless_it_is_long_or_an_observer_used_it():
    pausing = {"A": [], "B": [], "C": [(1, 10), (11.5, 20)]}
    limits = MotionThresholds(settle=0.0, pause=2.0, shortest=0.0)
    assert stances(team(**pausing), limits=limits) == [(1, 20, "AB", "C", "")]
    assert stances(team(**pausing)) == [(1, 10, "AB", "C", ""), (11.5, 20, "AB", "C", "AB")]
    shifted = pausing | {"B": [(10.2, 10.8)]}
    assert stances(team(**shifted), limits=limits) == [(1, 10, "AB", "C", ""), (11.5, 20, "AB", "C", "A")]


def test_nobody_observes_before_it_has_settled_nor_where_it_is_not_known_to_stand():
    limits = MotionThresholds(settle=0.5, pause=0.0, shortest=0.0)
    robots = team(A=[], B=[(0, 5)], C=[(1, 10)])
    assert stances(robots, limits=limits) == [(5.5, 10, "AB", "C", "")]
    known_late = [Movements("A", 7.0, 9.0, ()), *robots[1:]]
    assert stances(known_late) == [(7, 9, "AB", "C", "")]


def test_who_takes_no_images_observes_nothing_and_who_has_no_markers_is_not_watched():
    robots = team(A=[], B=[], C=[(1, 10)], D=[])
    assert stances(robots, cameras="AD") == [(1, 10, "AD", "C", "")]
    assert stances(robots, cameras="A") == [] == stances(robots, marked="AB")
    few = {"A": np.arange(0, 100, 0.1), "B": np.array([5.0])}
    assert derive_stances(robots, few, "C", EXACT) == []


def test_a_robot_that_joins_in_moving_ends_the_stance_and_begins_the_next():
    robots = team(A=[], B=[], C=[(1, 20)], D=[(8, 25)])
    assert stances(robots, cameras="ABD", marked="CD") == [
        (1, 8, "ABD", "C", ""),
        (8, 20, "AB", "CD", "AB"),
        (20, 25, "AB", "D", "AB"),
    ]


def test_what_is_shorter_than_a_stance_is_none_and_stances_are_numbered_without_it():
    robots = team(A=[(12, 12.2)], B=[], C=[(1, 1.5), (5, 10), (13, 20)])
    limits = MotionThresholds(settle=0.0, pause=0.5, shortest=1.0)
    images = {robot: np.arange(0.0, 100.0, 0.1) for robot in "AB"}
    found = derive_stances(robots, images, "C", limits)
    assert [(one.index, one.start, one.anchors) for one in found] == [(0, 5, ()), (1, 13, ("B",))]


def test_a_push_that_no_wheel_felt_is_not_seen():
    """What is said of it in the documentation: A is called an anchor, and the estimate has to find out."""
    assert stances(team(A=[], B=[(12, 20)], C=[(1, 10), (21, 29)]))[1][4] == "A"
