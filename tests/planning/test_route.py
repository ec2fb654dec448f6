"""Ways round robots and walls, checked by distances of segments instead of the sampled places they are found by."""

import itertools

import numpy as np
import pytest

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import segment_distance
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.room import TO_ROBOT, TO_WALL
from coloc_graph.planning.route import clear_way, polyline_length, reachable, route

CELL = 0.05
WALL = (2.0, -2.0), (2.0, 1.0)  # a wall from the lower end of the map


def map_with_wall():
    x, y = np.meshgrid(np.arange(-1.0, 5.0, CELL), np.arange(-2.0, 3.0, CELL))
    return FloorMap.of_cells(~((np.abs(x - 2.0) < 0.06) & (y < 1.0)), CELL, (-1.0, -2.0))


def test_a_clear_way_is_straight():
    assert route((0, 0), (3, 1), [(1.5, 2.0)]) == [(3.0, 1.0)]


@pytest.mark.parametrize("robot", [(1.5, 0.1), (1.5, -0.3), (2.6, 0.0)])
def test_a_way_goes_round_a_robot_and_hardly_further(robot):
    way = [(0.0, 0.0), *route((0, 0), (3, 0), [robot])] if robot[0] < 2.5 else [(0, 0), *route((0, 0), (4, 0), [robot])]
    assert len(way) > 2
    assert all(segment_distance(a, b, robot, robot) > TO_ROBOT - 0.02 for a, b in itertools.pairwise(way))
    assert polyline_length(way) < 1.15 * np.hypot(*np.subtract(way[-1], way[0]))


def test_a_way_goes_round_a_wall_and_between_it_and_a_robot():
    free = map_with_wall().clear
    for robots in ([], [(2.0, 2.1)]):
        way = [(0.0, 0.0), *route((0, 0), (4, 0), robots, free)]
        for a, b in itertools.pairwise(way):
            assert segment_distance(a, b, *WALL) > TO_WALL - 0.08
            assert all(segment_distance(a, b, robot, robot) > TO_ROBOT - 0.02 for robot in robots)


def test_where_there_is_no_way_it_says_from_where_to_where():
    with pytest.raises(InputError, match=r"no way for a robot from 0.0, 0.0 to 4.0, 0.0"):
        route((0, 0), (4, 0), [(2.0, 1.5), (2.0, 2.4)], map_with_wall().clear)


def test_a_robot_leaves_a_place_that_is_too_near_but_passes_through_nothing():
    free = map_with_wall().clear
    assert clear_way([(1.8, 0.0), (0.0, 0.0)], [], free)
    assert not clear_way([(1.8, 0.0), (3.0, 0.0)], [], free)
    assert clear_way([(0.0, 0.0), (-1.0, 0.0)], [(0.3, 0.0)])
    assert not clear_way([(0.0, 0.0), (1.0, 0.0)], [(0.3, 0.0)])


def test_no_way_leads_to_a_place_in_another_robot():
    # where a way begins a robot may be near to others, where it ends not
    beside = [(3.0, 0.15)]
    assert not reachable((0, 0), [(3, 0)], beside).any()
    with pytest.raises(InputError, match=r"no way for a robot from 0.0, 0.0 to 3.0, 0.0"):
        route((0, 0), (3, 0), beside)
    assert len(route((3, 0), (0, 0), beside)) >= 1


def test_a_step_aside_may_come_nearer_to_robots_than_a_leap():
    assert route((0, 0), (0.3, 0), [(0.3, 0.4)]) == [(0.3, 0.0)]
    with pytest.raises(InputError, match="no way"):
        route((0, 0), (3, 0), [(3.0, 0.4)])
