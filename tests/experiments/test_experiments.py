"""The paper's experiments, small: what is reported is the paper's, what is counted adds up, ours is better."""

import io
import json
import operator
import os
import re
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest

from coloc_graph import experiments
from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.experiments import CELLS, Fig4, Fig5, fig4, measure_cells, require_output_folder, save, table1, table2
from coloc_graph.experiments.figures_single_step import fig4_figure, fig5_figure
from coloc_graph.experiments.paper import TABLE1_FROM_A, TABLE1_STEPS, TABLE2
from coloc_graph.experiments.pool import spread
from coloc_graph.experiments.single_step_results import estimates_of, histogram, paper_says

#: The paper's Tables I and II as they are printed.
PRINTED_1 = """
a-b	77.14 cm	77.12 cm	a-b	77.14 cm	77.12 cm
b-c	85.76 cm	85.72 cm	a-c	36.22 cm	36.23 cm
c-d	78.29 cm	78.42 cm	a-d	85.73 cm	85.21 cm
d-e	88.16 cm	87.82 cm	a-e	74.01 cm	73.98 cm
e-f	80.47 cm	80.05 cm	a-f	107.82 cm	107.4 cm
f-g	89.82 cm	89.53 cm	a-g	109.73 cm	109.36 cm
"""
PRINTED_2 = """
1	B	769cm	771.6cm	2.6cm	0.34%
1	A	730cm	728.1cm	1.9cm	0.26%
2	B	725cm	723.2cm	1.8cm	0.25%
2	A	732cm	733.5cm	1.5cm	0.20%
"""
RUNS = 20


def cells_of(printed):
    return [re.sub(r" ?(cm|%)", "", line).split("\t") for line in printed.strip().splitlines()]


@pytest.fixture(scope="module")
def single():
    """Three cells of Fig. 4, few runs."""
    return Fig4("tracks", 0, RUNS, 50, measure_cells([(0.6, 0.0), (0.6, 30.0), (1.2, 0.0)], runs=RUNS))


@pytest.fixture(scope="module")
def table_1(tmp_path_factory):
    """Table I of one seed by the command: the result, its folder, and what was printed."""
    kept, out = [], tmp_path_factory.mktemp("table1")
    printed, told = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed), redirect_stderr(told):
        patch.chdir(out)
        patch.setattr(experiments, "table1", lambda **options: kept.append(table1(**options)) or kept[0])
        assert main(["experiment", "table1", "--runs", "1", "--processes", "1"]) == 0
    return kept[0], out, printed.getvalue(), told.getvalue()


@pytest.fixture(scope="module")
def steps(table_1):
    """Table I of one seed."""
    return table_1[0]


@pytest.fixture(scope="module")
def hall():
    """Table II of two seeds, four stances."""
    return table2(runs=2, stances=4)


def test_table_1_is_the_papers_as_printed(steps):
    printed = [[*map(str, row[:3])] for row in cells_of(PRINTED_1)] + [row[3:] for row in cells_of(PRINTED_1)]
    ours = [(one.name, one.true_cm, one.estimated_cm) for one in TABLE1_STEPS + TABLE1_FROM_A]
    assert ours == [(name, float(true), float(estimated)) for name, true, estimated in printed]
    for row, (name, true, estimated) in zip(steps.rows, printed, strict=True):
        assert row[:3] == [name, f"{float(true):.2f}", f"{float(estimated):.2f}"]
        assert len(row) == len(steps.header)
        assert float(row[3]) == pytest.approx(abs(float(estimated) - float(true)), abs=1e-9)


def test_table_2_is_the_papers_as_printed(hall):
    printed = cells_of(PRINTED_2)
    assert [
        [str(row.case), row.robot, f"{row.true_cm:.0f}", *map(str, (row.estimated_cm, row.error_cm)),
         f"{row.rate_percent:.2f}"]
        for row in TABLE2
    ] == printed  # fmt: skip
    for row, shown in zip(hall.rows, printed, strict=True):
        assert [row[0][0], *row[1:5], row[5].removesuffix(" %")] == shown
        assert len(row) == len(hall.header)
    for one in TABLE2:  # what the paper calls an error is one
        assert abs(one.estimated_cm - one.true_cm) == pytest.approx(one.error_cm, abs=0.05)
        assert 100 * one.error_cm / one.true_cm == pytest.approx(one.rate_percent, abs=0.005)


def test_what_the_papers_text_says_of_fig_4(single):
    said = {cell: paper_says(SimpleNamespace(baseline=cell[0], theta_deg=cell[1])) for cell in CELLS}
    assert said[0.6, 0.0] == "0.5 cm" and said[0.8, 0.0] == said[0.8, 10.0] == "> 1 cm"
    assert {said[cell] for cell in CELLS if cell[0] > 0.8} == {"-"}
    assert list(said.values()).count("< 1 cm") == 7
    assert [row[3] for row in single.rows] == ["0.5 cm", "< 1 cm", "-"]


def test_a_histogram_has_every_run_in_its_half_centimetre():
    assert histogram(np.array([0.0, 0.49, 0.51, 2.2, np.nan])).tolist() == [2, 1, 0, 0, 1]
    assert histogram(np.array([np.nan])).tolist() == [0]


def test_the_counts_of_each_cell_sum_to_the_runs(single):
    for cell in single.numbers()["cells"]:
        for method in ("eq2", "ours"):
            assert sum(cell[method]["histogram"]) + cell[method]["without_pose"] == RUNS
            assert len(cell[method]["l_est_cm"]) == RUNS
            errors = np.abs(np.array(cell[method]["l_est_cm"], float) - cell["l_cm"])
            assert cell[method]["mean_cm"] == pytest.approx(np.nanmean(errors), abs=1e-3)


def test_ours_is_at_most_a_third_of_eq_2_on_the_same_points(single):
    for cell in single.cells:
        assert cell.recorded == 250
        assert cell.mean_cm(cell.ours) < cell.mean_cm(cell.eq2) / 3
    near, turned, far = single.cells
    assert 0.2 < near.mean_cm(near.eq2) < 1.0  # the paper: 0.5 cm
    assert far.mean_cm(far.eq2) > 4 * turned.mean_cm(turned.eq2)
    assert far.overlap_px < near.overlap_px < turned.overlap_px


def test_the_error_falls_with_the_overlap(single):
    result = Fig5(single.depth, single.seed, single.runs, single.draws, single.cells)
    assert result.rank_correlation("eq2") == pytest.approx(-1)
    assert [row[1:3] for row in result.rows] == [["120 cm", "0 deg"], ["60 cm", "0 deg"], ["60 cm", "30 deg"]]
    for cell in result.cells:
        overlap = estimates_of(cell, "ours").overlap_px
        assert np.median(overlap) == pytest.approx(cell.overlap_px, rel=0.05)


def test_images_go_the_same_road():
    (cell,) = measure_cells([(0.8, 35.0)], depth="images", runs=10)
    assert cell.recorded > 200
    assert cell.mean_cm(cell.ours) < 0.3 and cell.mean_cm(cell.eq2) < 1.0


def test_more_processes_give_the_same_cells(single):
    cells = measure_cells([(cell.baseline, cell.theta_deg) for cell in single.cells[:2]], runs=2, processes=2)
    for cell, alone in zip(cells, single.cells, strict=False):  # the first runs of those
        assert np.array_equal(cell.ours.lengths, alone.ours.lengths[:2])
        assert np.array_equal(cell.eq2.lengths, alone.eq2.lengths[:2])
    assert not np.array_equal(cells[0].eq2.lengths, cells[1].eq2.lengths)


def test_work_goes_to_a_cluster_where_one_is_named():
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1") as cluster:
        done = spread(lambda n: (n, os.getpid()), [1, 2], cluster=cluster.scheduler_address)
    assert [n for n, _ in done] == [1, 2] and os.getpid() not in {process for _, process in done}


def test_progress_is_told_and_errors_come_through():
    told = []
    assert spread(abs, [-1, 2, -3], progress=lambda done, total: told.append((done, total))) == [1, 2, 3]
    assert told == [(1, 3), (2, 3), (3, 3)]
    with pytest.raises(InputError, match="distance between the two robots"):
        measure_cells([(-1.0, 0.0), (0.6, 0.0)], runs=1)
    with pytest.raises(ZeroDivisionError):
        spread(partial(operator.truediv, 1), [0, 1], processes=2)


def test_table_1_stands_where_the_paper_stood(steps):
    for segment in TABLE1_STEPS + TABLE1_FROM_A:
        assert steps.lengths_cm(segment, "true") == pytest.approx(segment.true_cm, abs=0.02)
        assert np.abs(steps.lengths_cm(segment, "eq2") - segment.true_cm).max() < 6
        assert np.abs(steps.lengths_cm(segment, "ours") - segment.true_cm).max() < 0.6
    assert steps.mean_error_cm("ours") < steps.mean_error_cm("eq2") / 2
    assert steps.mean_error_cm("paper") == pytest.approx(0.2355, abs=1e-3)


def test_table_2_goes_down_the_hallway(hall):
    assert [outing.seed for outing in hall.outings] == [0, 1]
    for outing in hall.outings:
        assert set(outing.courses) == {"A", "B"}
        for course in outing.courses.values():
            assert course.true.shape == course.eq2.shape == course.ours.shape == (4, 2)
            assert 0.3 < course.length(course.true) < 0.9
            assert course.error_cm(course.ours) < 1.5
        assert np.linalg.norm(np.diff(outing.standing("true"), axis=0), axis=1) == pytest.approx(0.743, abs=0.06)
    assert hall.rms("ours")["end_error_cm"] < hall.rms("eq2")["end_error_cm"] / 2


@pytest.fixture(scope="module")
def saved(single, steps, hall, tmp_path_factory):
    """The paths of PNG, SVG and JSON of each experiment."""
    five = Fig5(single.depth, single.seed, single.runs, single.draws, single.cells)
    out = tmp_path_factory.mktemp("saved")
    return {result.name: save(result, out) for result in (single, five, steps, hall)}


def test_what_is_saved_is_a_picture_and_the_numbers(single, saved):
    assert list(saved) == ["fig4", "fig5", "table1", "table2"]
    for name, (png, svg, numbers) in saved.items():
        pixels = (255 * matplotlib.image.imread(png)).astype(np.int64)
        assert min(pixels.shape[:2]) > 400 and len(np.unique(pixels[..., :3] @ (1, 256, 256**2))) > 30
        assert svg.read_text().startswith("<svg") and "eq. (2)" in svg.read_text()
        held = json.loads(numbers.read_text())
        assert held["experiment"] == name and held["depth"] == "tracks"


def test_the_same_result_is_the_same_bytes(hall, saved, tmp_path):
    assert [path.read_bytes() for path in saved["table2"]] == [path.read_bytes() for path in save(hall, tmp_path)]


def test_the_figures_show_the_numbers(single):
    figure = fig4_figure(single)
    means = [line for axes in figure.axes for line in axes.lines if line.get_gid() == "mean"]
    drawn = sorted(y for line in means for y in line.get_ydata())
    assert drawn == pytest.approx(sorted(c.mean_cm(e) for c in single.cells for e in (c.eq2, c.ours)))
    counted = sum(axes.collections[0].get_array().sum() for axes in figure.axes[:4])
    assert 0 <= 6 * RUNS - counted <= 2  # but for those above the panels
    (axes,) = fig5_figure(Fig5("tracks", 0, RUNS, 50, single.cells)).axes
    clouds = [one for one in axes.collections if one.get_gid() == "runs"]
    assert [len(one.get_offsets()) for one in clouds] == [3 * RUNS, 3 * RUNS]


def test_the_command_prints_a_table_and_writes_its_files(table_1):
    _, folder, out, err = table_1
    assert out.startswith("seg") and out.count("a-b") == 2 and "seed 0" in out and "runs solved: 1 of 1" in err
    assert sorted(path.name for path in (folder / "experiment-table1").iterdir()) == [
        "table1.json", "table1.png", "table1.svg",
    ]  # fmt: skip


def test_the_commands_options_reach_the_experiment(single, tmp_path, capsys, monkeypatch):
    given = {}
    monkeypatch.setattr(experiments, "fig4", lambda **options: given.update(options) or single)
    out = tmp_path / "here"
    arguments = ["--depth", "images", "--seed", "7", "--runs", "25", "--draws", "20", "--processes", "3"]
    assert main(["experiment", "fig4", *arguments, "--json", "--out", str(out)]) == 0
    del given["progress"]
    assert given == {"depth": "images", "seed": 7, "runs": 25, "draws": 20, "processes": 3, "cluster": None}
    assert json.loads(capsys.readouterr().out) == json.loads((out / "fig4.json").read_text())


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["fig9"], "fig9"),
        (["fig4", "--runs", "0"], "`runs` is 0"),
        (["fig5", "--draws", "3"], "`draws` is 3"),
        (["fig4", "--draws", "251"], "`draws` is 251"),
        (["table1", "--draws", "50"], "--draws applies to fig4 and fig5"),
        (["table2", "--seed", "-1"], "`seed` is -1"),
        (["table2", "--processes", "0"], "`processes` is 0"),
        *(
            ([name, "--cluster", "tcp://127.0.0.1:1"], "no Dask scheduler at tcp://127.0.0.1:1")
            for name in ("fig4", "fig5", "table1", "table2")
        ),
        (["fig4", "--depth", "video"], "video"),
        (["table1", "--out", "full"], "full holds something else"),
        (["table1", "--out", "full/file"], "full/file exists and is not a folder"),
        (["table1", "--out", "full/file/x"], "is not a folder"),
    ],
)
def test_a_bad_value_is_one_sentence(arguments, what, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("coloc_graph.results.executors.CONNECT_TIMEOUT", 0.5)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    try:
        code = main(["experiment", *arguments])
    except SystemExit as ended:
        code = ended.code
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert err.startswith("coloc: ") and what in err and err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_a_place_with_experiments_takes_another(tmp_path):
    (tmp_path / "fig4.json").write_text("{}")
    require_output_folder(tmp_path, "fig5")


def test_fig_4_may_be_asked_for_a_few_cells():
    result = fig4(runs=3, cells=[(0.7, 15.0)], draws=20)
    assert result.rows[0][:2] == ["70 cm", "15 deg"] and result.rows[0][3] == "-"
