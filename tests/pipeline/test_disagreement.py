"""Warnings name the kind of measurements that disagree."""

from dataclasses import replace

from teams import graph_of_team, team_of

from coloc_graph.backend import smooth
from coloc_graph.measurements import Odometry
from coloc_graph.pipeline.disagreement import worst_kinds
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
