"""Which tracks of two cameras are the same markers: right, or said to be ambiguous."""

from dataclasses import replace

import numpy as np
import pytest
from crowd_scene import FACTS, lockstep, movers, right, seen_by_both

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend import correspond
from coloc_graph.frontend.pairing.association import MIN_POSTERIOR, Association, Unassociated, associate
from coloc_graph.frontend.pairing.correspondence import Candidates


def found(both, **options):
    return associate(Candidates(both[0][0], both[1][0], FACTS.camera, FACTS.camera, **options))


@pytest.mark.parametrize(("n", "seed"), [(1, 0), (1, 1), (2, 0), (3, 1), (4, 0), (5, 1)])
def test_however_many_robots_move_each_marker_is_found_again(n, seed):
    both = seen_by_both(movers(n, seed), seed)
    one = found(both)
    assert one.posterior > MIN_POSTERIOR
    assert right(one, both)
    assert len({both[0][1][a] for a, _ in one.chosen}) >= 2 * n - 1


@pytest.mark.parametrize("hidden", [None, 0, 1])
@pytest.mark.parametrize("seed", range(2))
def test_robots_in_lock_step_are_ambiguous_and_not_guessed(seed, hidden):
    both = seen_by_both(lockstep(seed), seed, hidden)
    one = found(both)
    assert one.posterior < MIN_POSTERIOR
    assert one.rivals
    assert one.posterior + sum(chance for _, chance in one.rivals) == pytest.approx(1.0)
    assert one.posterior >= max(chance for _, chance in one.rivals)
    with pytest.raises(DegenerateGeometry, match=r"ambiguous: \d pairings .* drive apart, or name the markers"):
        correspond(both[0][0], both[1][0], FACTS.camera, FACTS.camera)


def test_a_robot_that_only_one_camera_sees_is_left_out():
    both = seen_by_both(movers(3, 5), 5, hidden=1)
    one = found(both)
    assert one.posterior > MIN_POSTERIOR
    assert right(one, both)
    assert not {0, 1} & {both[1][1][b] for _, b in one.chosen}


def test_nothing_is_made_of_tracks_that_have_nothing_in_common():
    here, there = seen_by_both(movers(1, 3), 3), seen_by_both(movers(1, 4), 4)
    mixed = [here[0], there[1]]
    one = found(mixed)
    assert isinstance(one, Unassociated) or one.posterior < MIN_POSTERIOR or len(one.chosen) < 2


def test_the_one_robot_that_moves_is_the_one_that_both_see():
    both = seen_by_both(movers(1, 7), 7)
    assert found(both, alone=True).posterior >= found(both).posterior


def test_a_moment_that_agrees_among_much_that_does_not_is_no_pairing():
    right_, other = seen_by_both(movers(1, 7), 7), seen_by_both(movers(1, 11), 11)
    pieces = []
    for (tracks, _), (strange, _) in zip(right_, (other[0], seen_by_both(movers(1, 12), 12)[1]), strict=True):
        when = [slice(0, 16)] * len(tracks)
        short = [
            replace(t, times=t.times[w], uv=t.uv[w], covariance=t.covariance[w], peak=t.peak[w], saturated=None)
            for t, w in zip(tracks[:2], when, strict=False)
        ]
        pieces.append((short + [replace(t, body=0) for t in strange], []))
    assert isinstance(found(pieces, alone=True), Unassociated)
    assert isinstance(found([(p[0][:2], []) for p in pieces], alone=True), Association)  # by itself it is one


def cut(track, when):
    """Return the part of a track."""
    return replace(track, times=track.times[when], uv=track.uv[when], covariance=track.covariance[when],
                   peak=track.peak[when], saturated=None)  # fmt: skip


@pytest.mark.parametrize(("made", "plausible", "why"), [
    (lambda tracks: [cut(track, slice(0, 6)) for track in tracks], None,
     r"no two of them share 8 images\): keep the mover in both"),
    (lambda tracks: tracks, lambda *_: False, r"on no common floor.*: let the moving robot turn and drive further"),
], ids=["short", "implausible"])  # fmt: skip
def test_where_nothing_fits_the_message_says_why(made, plausible, why):
    (here, _), (there, _) = seen_by_both(movers(1, 7), 7)
    both = [[replace(track, body=-1) for track in made(tracks)] for tracks in (here, there)]
    with pytest.raises(DegenerateGeometry, match=rf"no pairing of the tracks of \w+ and \w+ fits one .*{why}"):
        correspond(*both, FACTS.camera, FACTS.camera, alone=True, plausible=plausible)


def test_one_light_on_a_straight_way_is_named():
    poses = np.tile(movers(1, 7)[:1], (len(movers(1, 7)), 1, 1))
    poses[:, 0, 1] = np.linspace(-0.4, 0.4, len(poses))
    both = [[replace(tracks[0], body=-1)] for tracks, _ in seen_by_both(poses, 7)]
    with pytest.raises(DegenerateGeometry, match=r"no pairing .*lie on one line .*: let it turn"):
        correspond(*both, FACTS.camera, FACTS.camera, alone=True)


def test_what_most_samples_say_is_the_reason_and_not_a_straight_piece():
    straight = np.tile(movers(1, 7)[:1], (len(movers(1, 7)), 1, 1))
    straight[:, 0, 1] = np.linspace(-0.4, 0.4, len(straight))
    pieces = zip(seen_by_both(movers(1, 7), 7), seen_by_both(straight, 7), strict=True)
    both = [
        [replace(track, body=-1) for track in (*tracks, cut(lone[0], slice(0, 16)))]
        for (tracks, _), (lone, _) in pieces
    ]
    with pytest.raises(DegenerateGeometry, match="on no common floor"):
        correspond(*both, FACTS.camera, FACTS.camera, alone=True, plausible=lambda *_: False)


def test_a_light_that_only_one_camera_sees_most_of_the_time_is_named():
    right_, other = seen_by_both(movers(1, 7), 7), seen_by_both(movers(1, 11), 11)
    both = [
        [cut(track, slice(0, 16)) for track in tracks[:2]] + [replace(track, body=0) for track in strange]
        for (tracks, _), (strange, _) in zip(right_, (other[0], seen_by_both(movers(1, 12), 12)[1]), strict=True)
    ]
    with pytest.raises(DegenerateGeometry, match=r"explains \d+ % of what a camera saw\): look for reflections"):
        correspond(*both, FACTS.camera, FACTS.camera, alone=True)


def test_bodies_are_robots():
    both = seen_by_both(movers(4, 2), 2)
    for tracks, lights in both:
        robots = [{lights[n] // 2 for n, t in enumerate(tracks) if t.body == body} for body in {t.body for t in tracks}]
        assert all(len(robot) == 1 for robot in robots)
        assert len(robots) >= 4
        assert np.min([t.body for t in tracks]) >= 0
