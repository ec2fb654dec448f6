"""White lights of robots that blink: whose a track is, or that nobody knows."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from crowd_scene import lockstep_run

from coloc_graph.errors import InputError
from coloc_graph.frontend import FrontendOptions, StanceTracks, Track, measure_pair
from coloc_graph.frontend.tracks.blink_codes import BlinkCodes
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, render, simulate, spots
from coloc_graph.simulation.blinking import Blinking, with_codes
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team import Blink

NAMES = ("A", "B", "C", "D")
TEAM = with_codes(reference_team(names=NAMES))
CODES = BlinkCodes({one.name: one.blink.code for one in TEAM.robots}, 0.1)


def track_of(on, times, rng, missed=0.02, false=0.003):
    """A track of a light that is `on` (n,) at times (n,)."""
    seen = np.where(on, rng.uniform(size=len(times)) >= missed, rng.uniform(size=len(times)) < false)
    n = int(seen.sum())
    first, last = times[seen][[0, -1]]
    between = times[~seen & (times > first) & (times < last)]
    return Track("A", "", times[seen], np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n), missed=between)


def lit(name, times, rng, fast=0.0):
    return Blinking(TEAM[name].blink, rng.uniform(0, 10), fast).on(times)


@pytest.mark.parametrize("fps", [25.0, 100.0])
def test_a_track_of_some_seconds_says_whose_it_is_and_a_short_one_does_not(fps):
    rng = np.random.default_rng(0)
    whose = {length: [] for length in (0.5, 2.0, 8.0)}
    for name, (length, found), _ in itertools.product(NAMES, whose.items(), range(6)):
        times = 1.7e9 + rng.uniform() + np.arange(round(fps * length)) / fps
        said = CODES.robot_of([track_of(lit(name, times, rng, fast=2e-3 * rng.standard_normal()), times, rng)])
        assert said in ("", name)
        found.append(said)
    assert not any(whose[0.5])
    assert all(whose[8.0])
    assert whose[2.0].count("") < 12


def test_what_blinks_as_nobody_does_is_nobodys():
    rng = np.random.default_rng(1)
    times = np.arange(1000) / 50
    stranger = Blinking(Blink(code="1011010111"), 0.3, 0.0).on(times)
    too_slow = Blinking(Blink(code=TEAM["B"].blink.code, bit=0.11), 0.3, 0.0).on(times)
    half = np.where(times < 10, lit("A", times, rng), lit("B", times, rng))  # two lights in one track
    steady, flicker = np.ones(1000, bool), np.repeat(rng.uniform(size=200) < 0.8, 5)
    for on in (stranger, too_slow, half, steady, flicker):
        assert CODES.robot_of([track_of(on, times, rng)]) == ""
    for code in ("0110111101", "11010101", "111110110"):  # over 8 s nearly as C, B and A do with a few wrong bits
        on = Blinking(Blink(code=code), 0.3, 0.0).on(times[:400])
        assert CODES.robot_of([track_of(on, times[:400], np.random.default_rng(1))]) == ""
    hidden = lit("C", times, rng) & ((times % 4.0) > 0.25)  # a quarter of a second now and then
    assert CODES.robot_of([track_of(hidden, times, rng)]) == "C"


def test_two_lights_of_one_body_know_together_what_neither_knows_alone():
    rng = np.random.default_rng(2)
    alone = together = 0
    for _ in range(20):
        times = rng.uniform() + np.arange(33) / 25
        on = lit("A", times, rng)
        two = [replace(track_of(on, times, rng, missed=0.1), body=0) for _ in range(2)]
        each = CODES.name_tracks(two)
        alone += sum(one.mover == "A" for one in each) / 2
        together += [one.mover for one in CODES.name_bodies(each)] == ["A", "A"]
    assert together > alone + 3


def test_a_clock_that_is_off_by_what_a_clock_may_be_off_is_found_along():
    rng = np.random.default_rng(4)
    times = np.arange(1000) / 25
    for fast in (-4.5e-3, 4.5e-3):
        assert CODES.robot_of([track_of(lit("D", times, rng, fast), times, rng)]) == "D"
    assert CODES.robot_of([track_of(lit("D", times, rng, 0.03), times, rng)]) == ""


def test_as_likely_as_each_other_is_undecided():
    """Where colours are lost, two robots may blink alike."""
    rng = np.random.default_rng(3)
    times = np.arange(500) / 50
    alike = BlinkCodes({"A": "110", "B": "101"}, 0.1)
    seen = [track_of(lit("A", times, rng), times, rng)]
    assert alike.posteriors(seen) == pytest.approx([0.5, 0.5], abs=1e-3)
    assert alike.robot_of(seen) == ""


def test_white_movers_that_blink_are_told_apart_in_images_even_in_lock_step(tmp_path):
    lamps = {name: Blinking(TEAM[name].blink, began, 1e-3) for name, began in (("C", 0.03), ("D", 0.21))}

    def image(uv, k):
        on = np.repeat([lamps[name].on(np.array([0.04 * k]))[0] for name in "CD"], 2)
        return render(spots(uv[on], 1.5, 220.0), background=12.0, rng=np.random.default_rng(k))

    run, poses, lights = lockstep_run(tmp_path / "run.mcap", TEAM, image, frames=150, step=0.04)
    tracks = StanceTracks(run, run.stances[0])
    for robot in "AB":
        named = 0
        for track in tracks.of(robot):
            frames = np.rint((track.times - 101.0) / 0.04).astype(int)
            nearest = np.linalg.norm(lights[robot][frames] - track.uv[:, None], axis=2).argmin(axis=1)
            assert track.mover in ("", "CD"[nearest[0] // 2])
            assert (nearest == nearest[0]).all()
            named += len(track) * bool(track.mover)
        assert named > 400
    measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions(), tracks)
    assert measured.homography.unusable is None
    off = measured.relative_pose.T_i_j - np.linalg.inv(poses["A"]) @ poses["B"]
    assert np.abs(off[:3, 3]).max() < 0.02
    assert {span.mover for span in measured.relative_pose.spans} == {"C", "D"}


def test_a_team_of_white_movers_that_blink_is_solved_without_names_though_clocks_differ(tmp_path):
    path = tmp_path / "run.mcap"
    flaws = Imperfections(floor_sigma_deg=0.1, clock_offset=0.02)
    simulate("team", path, robots=4, at_once=2, stances=1, seed=2, blink=True, imperfections=flaws)
    run = open_run(path)
    assert not any(marker for one in run.detections("A", 0, 2e9) for marker in one.markers)
    solution = solve(run, SolveOptions())
    accuracy, _ = assess(solution)
    assert accuracy.ate < 0.02
    (measured,) = solution.measurements
    assert 0.8 < measured.homography.chi2 / measured.homography.dof < 1.25
    assert abs(abs(measured.homography.time_offset) - 0.02) < 4 * measured.homography.time_offset_sigma
    assert {span.mover for span in measured.relative_pose.spans} == set(run.stances[0].movers)


def test_too_few_images_to_see_it_are_refused(tmp_path):
    with pytest.raises(InputError, match="`points` is 100, too few to see robots blink; give at least 1600"):
        simulate("team", tmp_path / "run.mcap", blink=True, points=100)
    with pytest.raises(InputError, match="`blink` belongs to team, not to hallway"):
        simulate("hallway", tmp_path / "run.mcap", blink=True)


def test_a_large_team_has_codes_that_differ():
    codes = [one.blink.cycle for one in with_codes(reference_team(names=tuple(f"R{n}" for n in range(60)))).robots]
    assert len(set(codes)) == 60
