import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gtsam
import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import NDArray

from coloc_graph.backend import Estimate, PoseGraph
from coloc_graph.errors import InputError
from coloc_graph.evaluation import Accuracy, evaluate
from coloc_graph.frontend import PairMeasurement
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.measurements import HomographyMeasurement, RelativePose
from coloc_graph.pipeline.batch import Solution, SolveOptions
from coloc_graph.report import (
    error_figure,
    figure_svg,
    hero_figure,
    render_report,
    residual_figure,
    trajectories_figure,
)
from coloc_graph.report.drawing import ellipse_points, held_poses, position_sigmas, world_covariances
from coloc_graph.run import Run, Stance

Truth = dict[str, NDArray[np.float64]]


def leapfrog(stances: int, seed: int = 0) -> tuple[Estimate, Truth]:
    """A and B leap-frog along x, one anchor a stance; the estimate is the truth with growing errors."""
    graph_stances: list[Stance] = []
    poses: dict[str, list[NDArray[np.float64]]] = {"A": [], "B": []}
    true: dict[str, list[NDArray[np.float64]]] = {"A": [], "B": []}
    places = {"A": 0, "B": 1}
    for k in range(stances):
        if k:
            places["A" if k % 2 == 0 else "B"] += 2
        anchors = () if k == 0 else (("B",) if k % 2 == 0 else ("A",))
        graph_stances.append(Stance(k, 10.0 * k, 10.0 * k + 5, ("A", "B"), ("C",), anchors))
        for robot, place in places.items():
            T = floor_pose(0.2 * place, 0.36 if robot == "A" else -0.36, 0.3)
            off = np.random.default_rng([seed, place]).normal(size=3) * 0.002 * (1 + place)
            true[robot].append(T)
            poses[robot].append(T @ floor_pose(*off))
    trajectories = {
        robot: Trajectory(
            robot=robot,
            times=np.array([one.start for one in graph_stances]),
            T_world_body=np.array(poses[robot]),
            stances=np.arange(stances),
            covariances=np.array([np.diag([1e-8, 1e-8, 1e-4, 4e-4, 1e-4, 1e-8]) * (k + 1) for k in range(stances)]),
        )
        for robot in poses
    }
    graph = PoseGraph("A", ("A", "B", "C"), tuple(graph_stances), ())
    return Estimate("smooth", graph, trajectories, chi2=3.0, dof=4), {r: np.array(T) for r, T in true.items()}


def homography(stance: int, unusable: str | None = None, **fields: Any) -> HomographyMeasurement:
    nan = float("nan")
    chi2, dof, overlap = (nan, 0, nan) if unusable else (180.0, 192, 31000.0)
    values: dict[str, Any] = {"points": 100, "inliers": 0 if unusable else 97, "robot_i": "A", "robot_j": "B"} | fields
    return HomographyMeasurement(
        stance=stance, H_j_i=np.eye(3), information=np.eye(8), chi2=chi2, dof=dof, overlap_px=overlap,
        unusable=unusable, **values,
    )  # fmt: skip


def measured(stance: int, unusable: str | None = None) -> PairMeasurement:
    pose = RelativePose(stance, "A", "B", gtsam.Pose3(), np.eye(6), gtsam.Pose3(), 1, np.deg2rad(0.25))
    return PairMeasurement(homography(stance, unusable), None if unusable else pose, None)


def solution_of(estimate: Estimate, refused: dict[int, str] | None = None, **fields: Any) -> Solution:
    refused = refused or {}
    run = cast(Run, SimpleNamespace(path=Path("somewhere") / "hall.mcap", stances=estimate.graph.stances))
    return replace(
        Solution(
            run=run,
            options=SolveOptions().resolved(),
            estimate=estimate,
            measurements=tuple(measured(s.index, refused.get(s.index)) for s in estimate.graph.stances),
            warnings=tuple(f"stance {k}: {why}" for k, why in refused.items()),
            seconds_frontend=123.456,
            seconds_backend=77.789,
        ),
        **fields,
    )


def accuracy_of(estimate: Estimate, truth: Truth) -> Accuracy:
    return evaluate(estimate.trajectories, truth, on_floor=True)


class Page(HTMLParser):
    """Tags that are open must be closed, and nothing may be fetched or executed."""

    VOID = frozenset(("meta", "br", "link", "img", "hr"))

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.references: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self._attributes(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._attributes(attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data

    def _attributes(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            assert not name.startswith("on")
            if name in ("src", "href", "xlink:href", "data", "action"):
                self.references.append(value or "")
            if name == "id":
                self.ids.append(value or "")


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_ellipse_has_the_axes_of_its_covariance(angle: float) -> None:
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = ellipse_points([1.0, 2.0], R @ np.diag([9.0, 4.0]) @ R.T, k=2.0)
    local = (points - (1.0, 2.0)) @ R
    np.testing.assert_allclose((local / (6.0, 4.0)) ** 2 @ [1, 1], 1.0)
    np.testing.assert_allclose(abs(local).max(axis=0), (6.0, 4.0), rtol=1e-2)
    np.testing.assert_allclose(points[0], points[-1], atol=1e-12)


def test_ellipses_are_drawn_of_many_covariances_and_of_none_at_all() -> None:
    assert ellipse_points(np.zeros((5, 2)), np.tile(np.eye(2), (5, 1, 1))).shape == (5, 49, 2)
    assert ellipse_points(np.zeros((0, 2)), np.zeros((0, 2, 2))).shape == (0, 49, 2)
    np.testing.assert_array_equal(ellipse_points([3.0, 4.0], np.zeros((2, 2))), np.tile([3.0, 4.0], (49, 1)))


def test_covariance_is_turned_from_the_body_into_the_world() -> None:
    covariance = np.diag([1.0, 2.0, 3.0, 9.0, 1.0, 0.5])[None]
    turned = Trajectory("A", np.zeros(1), floor_pose(0, 0, np.pi / 2)[None], np.zeros(1, int), covariance)
    position, rotation = world_covariances(turned)
    np.testing.assert_allclose(position[0], np.diag([1.0, 9.0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(rotation[0], np.diag([2.0, 1.0, 3.0]), atol=1e-12)
    np.testing.assert_allclose(position_sigmas(turned), 3.0)


def test_a_place_held_over_two_stances_is_ringed_once() -> None:
    estimate, _ = leapfrog(5)
    # A holds at stances 1 and 3, B at 2 and 4: the places they took at 0 and 2, and at 1 and 3
    assert held_poses(estimate, estimate.trajectories["A"]).tolist() == [0, 2]
    assert held_poses(estimate, estimate.trajectories["B"]).tolist() == [1, 3]


def test_trajectories_figure_shows_estimate_truth_ellipses_headings_and_held_places() -> None:
    estimate, truth = leapfrog(6)
    (axes,) = trajectories_figure(estimate, truth).axes
    assert axes.get_aspect() == 1.0
    named = {line.get_label() for line in axes.lines}
    assert {"A", "B"} <= named
    gids = [line.get_gid() for line in axes.lines]
    assert gids.count("truth") == 2
    assert gids.count("held") == 2
    kinds = [type(one) for one in axes.collections]
    assert kinds.count(PolyCollection) == 2
    assert kinds.count(LineCollection) == 2
    assert {"A start", "B start"} == {text.get_text() for text in axes.texts}
    (path,) = [line for line in axes.lines if line.get_label() == "A"]
    np.testing.assert_array_equal(path.get_xydata(), estimate.trajectories["A"].positions[:, :2])


def test_error_figure_shows_the_error_in_its_band_and_only_the_band_without_truth() -> None:
    estimate, truth = leapfrog(6)
    position, heading = error_figure(estimate, truth).axes
    assert position.get_ylabel() == "position error [cm]"
    (line,) = [line for line in position.lines if line.get_label() == "B"]
    off = estimate.trajectories["B"].positions - truth["B"][:, :3, 3]
    np.testing.assert_allclose(np.asarray(line.get_ydata(), float), 100 * np.linalg.norm(off[:, :2], axis=1))
    assert len(position.collections) == len(heading.collections) == 2
    blind, _ = error_figure(estimate).axes
    assert blind.get_ylabel() == "position predicted 2σ [cm]"
    assert {line.get_gid() for line in blind.lines} == {"sigma"}


def test_heading_error_does_not_jump_where_the_heading_turns_over() -> None:
    estimate, _ = leapfrog(1)
    poses = floor_pose(0, 0, np.pi - 0.01)[None]
    one = replace(estimate.trajectories["A"], T_world_body=poses)
    figure = error_figure(replace(estimate, trajectories={"A": one}), {"A": floor_pose(0, 0, -np.pi + 0.01)[None]})
    (line,) = [line for line in figure.axes[1].lines if line.get_label() == "A"]
    np.testing.assert_allclose(np.asarray(line.get_ydata(), float), -np.rad2deg(0.02))


def test_residual_figure_marks_the_unusable() -> None:
    figure = residual_figure([homography(0), homography(1, "no common view"), homography(2)])
    above, _ = figure.axes
    at = [np.asarray(one.get_offsets()).tolist() for one in above.collections if not isinstance(one, LineCollection)]
    assert at[0] == [[0.0, pytest.approx(np.sqrt(180 / 192))], [2.0, pytest.approx(np.sqrt(180 / 192))]]
    assert at[1] == [[1.0, 0.0]]


@pytest.mark.parametrize(("stances", "with_truth"), [(1, True), (2, False), (3000, True)])
def test_figures_of_tiny_and_huge_runs_are_drawn_and_stay_small(stances: int, with_truth: bool) -> None:
    estimate, every = leapfrog(stances)
    truth = every if with_truth else None
    for figure in (trajectories_figure(estimate, truth), error_figure(estimate, truth), hero_figure(estimate, truth)):
        assert len(figure_svg(figure)) < 3_000_000
    assert len(figure_svg(residual_figure([homography(k) for k in range(stances)]))) < 3_000_000


def test_figures_of_partial_results_are_drawn() -> None:
    estimate, truth = leapfrog(4)
    a, b = estimate.trajectories["A"], estimate.trajectories["B"]
    none = replace(b, times=b.times[:0], T_world_body=b.T_world_body[:0], stances=None, covariances=None)
    covariances = cast(NDArray[np.float64], b.covariances).copy()
    covariances[1] = np.nan
    for parts in (
        {},
        {"A": a},
        {"A": a, "B": none},
        {"A": replace(a, covariances=None), "B": replace(b, covariances=covariances)},
    ):
        partial = replace(estimate, trajectories=parts)
        true = {"A": truth["A"]} if len(parts) == 1 else None
        for draw in (trajectories_figure, error_figure, hero_figure):
            assert figure_svg(draw(partial, true)).startswith("<svg")
    for draw in (trajectories_figure, error_figure, hero_figure):
        assert figure_svg(draw(replace(estimate, trajectories={"A": a, "B": none}), {"A": truth["A"]}))
    assert figure_svg(residual_figure([])).startswith("<svg")
    assert figure_svg(residual_figure([homography(3, "dark")])).startswith("<svg")


def test_truth_of_another_length_is_refused() -> None:
    estimate, truth = leapfrog(4)
    for draw in (trajectories_figure, error_figure, hero_figure):
        with pytest.raises(InputError, match="robot A has 4 estimated poses"):
            draw(estimate, {"A": truth["A"][:3]})


def test_figures_do_not_depend_on_the_users_settings_nor_change_them() -> None:
    estimate, truth = leapfrog(4)
    plain = figure_svg(trajectories_figure(estimate, truth))
    with matplotlib.rc_context({"font.size": 30, "svg.fonttype": "path", "axes.grid": False}):
        before = dict(matplotlib.rcParams)
        assert figure_svg(trajectories_figure(estimate, truth)) == plain
        assert dict(matplotlib.rcParams) == before


def test_hero_is_twice_as_wide_as_high_and_states_the_length_error() -> None:
    estimate, truth = leapfrog(10)
    figure = hero_figure(estimate, truth)
    assert figure.get_figwidth() == 2 * figure.get_figheight()
    assert sum("length error" in text.get_text() for text in figure.texts) == 2


@pytest.fixture(scope="module")
def plain() -> str:
    """Report of a run of six stances."""
    estimate, truth = leapfrog(6)
    return render_report(solution_of(estimate), accuracy_of(estimate, truth), truth)


def test_report_is_one_file_that_fetches_and_executes_nothing(plain: str) -> None:
    page = Page(plain)
    assert page.tags.count("svg") == 3
    assert not {"script", "link", "img", "iframe", "object"} & set(page.tags)
    assert page.references
    assert all(reference.startswith("#") and reference[1:] in page.ids for reference in page.references)
    assert len(page.ids) == len(set(page.ids))


def test_report_has_the_same_bytes_however_long_it_took(plain: str) -> None:
    again, truth = leapfrog(6)
    assert render_report(solution_of(again, seconds_frontend=9.0), accuracy_of(again, truth), truth) == plain
    assert "123.4" not in plain
    assert not re.search(r"20\d\d-\d\d-\d\d", plain)


def test_report_says_lengths_counts_options_and_reasons() -> None:
    estimate, truth = leapfrog(6)
    accuracy = accuracy_of(estimate, truth)
    solution = solution_of(estimate, {2: "the moving robot drove a straight line: let it turn"})
    page = Page(render_report(solution, accuracy, truth))
    row = accuracy.robots[0]
    for said in (
        "hall.mcap",
        f"A: {100 * row.true_length:.1f} cm true, {100 * row.estimated_length:.1f} cm estimated, ",
        f"{row.length_error_percent:.2f} %",
        "5 measurements used, 1 rejected",
        "frontend.criterion",
        "reprojection",
        "let it turn",
        "–",
    ):
        assert said in page.text
    assert "nan" not in page.text.lower()
    assert "details" in page.tags


def test_report_says_errors_over_all_poses_and_over_stretches_of_the_way() -> None:
    estimate, truth = leapfrog(20)
    accuracy = accuracy_of(estimate, truth)
    text = Page(render_report(solution_of(estimate), accuracy, truth)).text
    row = accuracy.robots[0]
    assert row.nees is not None
    over = next(one for one in accuracy.relative if one.pairs)
    for said in (
        f"{100 * row.translation.max:.2f}",
        f"{row.rotation_deg.median:.2f}",
        f"{row.nees.low:.2f}\xa0to\xa0{row.nees.high:.2f}",
        f"{over.distance:g} m",
        f"{over.translation_percent:.2f}\xa0%, {over.rotation_deg:.2f}°",
    ):
        assert said in text, said


def test_report_of_a_run_whose_truth_ends_early_says_so_and_draws_the_rest() -> None:
    estimate, truth = leapfrog(6)
    truth["A"][3:] = np.nan
    text = Page(render_report(solution_of(estimate), accuracy_of(estimate, truth), truth)).text
    assert "robot A: 3 of 6 poses are not evaluated" in text and "nan" not in text.lower()


def test_report_escapes_what_others_wrote() -> None:
    estimate, truth = leapfrog(3)
    nasty = "<script>alert('x')</script> & \"quotes\" <img src=http://bad>"
    solution = solution_of(estimate, {1: nasty})
    run = cast(Run, SimpleNamespace(path=Path("<b>run<b>.mcap"), stances=estimate.graph.stances))
    a = replace(estimate.trajectories["A"], robot="<i>$A_1$")
    named = replace(estimate, trajectories={"<i>$A_1$": a})
    solution = replace(solution, run=run, estimate=named)
    page = Page(render_report(solution, accuracy_of(named, {"<i>$A_1$": truth["A"]}), {"<i>$A_1$": truth["A"]}))
    assert not {"script", "img", "i"} & set(page.tags)
    for said in (nasty, "<b>run<b>.mcap", "<i>$A_1$"):
        assert said in page.text


@pytest.mark.parametrize("stances", [1, 2])
def test_report_of_a_tiny_run_with_and_without_truth(stances: int) -> None:
    estimate, truth = leapfrog(stances)
    Page(render_report(solution_of(estimate), accuracy_of(estimate, truth), truth))
    blind = Page(render_report(solution_of(estimate), None, None))
    assert "Accuracy" not in blind.text
    assert "no truth to compare with" in blind.text


def test_report_of_a_robot_that_never_moved_gives_no_percentage() -> None:
    estimate, truth = leapfrog(1)
    page = Page(render_report(solution_of(estimate), accuracy_of(estimate, truth), truth))
    assert "A: standing" in page.text
