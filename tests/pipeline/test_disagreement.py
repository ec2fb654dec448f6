"""Warnings name the kind of measurements that disagree, and nobody is blamed where nobody said who moved."""

from dataclasses import replace

import numpy as np
from teams import graph_of_team, team_of

from coloc_graph.backend import smooth
from coloc_graph.measurements import Odometry
from coloc_graph.pipeline.disagreement import unstated_moves, worst_kinds
from coloc_graph.pipeline.explanations import warnings_of_graph


def test_odometry_that_disagrees_is_named_and_what_to_check_of_it():
    team = team_of(4, 10, 1)
    made = [
        replace(m, covariance=m.covariance / 400) if isinstance(m, Odometry) and m.robot == "C" else m
        for m in team.measurements
    ]
    estimate = smooth(graph_of_team(team, made), reject=False)
    said = worst_kinds(estimate)
    assert said.startswith("largest in the odometry of C (") and "its clock" in said
    assert any("the measurements disagree" in one and said in one for one in warnings_of_graph(estimate, (), ()))


def without_moves(team):
    """The graph of a team in which every observer is called an anchor, as of tracks without moves."""
    stances, seen = [], set()
    for stance in team.stances:
        stances.append(replace(stance, anchors=tuple(name for name in stance.observers if name in seen)))
        seen |= set(stance.observers)
    return replace(graph_of_team(team), stances=tuple(stances))


def test_where_nobody_said_who_moved_no_robot_is_blamed_and_the_sentence_says_what_to_give():
    team = team_of(3, 6, 1, rotating=False, odometry=False, sightings=False)
    estimate = smooth(without_moves(team))
    assert estimate.rejected or estimate.bumped
    warnings = warnings_of_graph(estimate, (), (), moves_stated=False)
    (sentence,) = [one for one in warnings if "--moves" in one]
    assert " or " in sentence and "between stances 0 and 1" in sentence
    assert not any("bumped" in one or "was rejected" in one for one in warnings)


def test_anchors_that_stay_put_are_not_said_to_have_moved():
    graph = graph_of_team(team_of(3, 6, 1, rotating=False, odometry=False, sightings=False))
    assert unstated_moves(graph) is None
    assert np.isfinite(smooth(graph).chi2)
