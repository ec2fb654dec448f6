import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from mrclam_folder import LANDMARKS, SCALE, make

from coloc_graph.cli import main
from coloc_graph.errors import InputError
from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.run import open_run, read_true_team, read_truth


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make(tmp_path_factory.mktemp("mrclam") / "data", seconds=20.0)


@pytest.fixture
def copy(made, tmp_path):
    """A copy of the dataset to spoil."""
    return Path(shutil.copytree(made.path, tmp_path / "data"))


def add(path, *lines):
    path.write_text(path.read_text() + "\n".join(lines) + "\n")


def test_a_dataset_becomes_a_run_with_all_that_was_measured(made, tmp_path):
    out = tmp_path / "run.mcap"
    summary = import_mrclam(made.path, out)
    run = open_run(out)
    rows = sum(len(np.loadtxt(made.path / f"Robot{n}_Measurement.dat")) for n in (1, 2, 3))
    ranges = [one for name in run.team.names for one in run.ranges(name)]
    assert summary.measurements == rows == sum(len(one.targets) for one in ranges)
    assert run.team.names == ("R1", "R2", "R3") == summary.robots
    assert [one.name for one in run.team.landmarks] == [f"L{n}" for n in LANDMARKS]
    assert {target for one in ranges for target in one.targets} <= {*run.team.names, *summary.landmarks}
    truth = read_truth(out)["R2"]
    at = np.searchsorted(made.times, truth.times - 1e-6)
    assert np.allclose(truth.positions[:, :2], made.true[2][at, :2], atol=1e-6)


def test_commands_are_followed_to_where_they_lead(made, tmp_path):
    import_mrclam(made.path, tmp_path / "run.mcap")
    samples = list(open_run(tmp_path / "run.mcap").odometry("R1"))
    way = np.hypot(*np.diff([one.pose[:2] for one in samples], axis=0).T).sum()
    true = np.hypot(*np.diff(made.true[1][::19, :2], axis=0).T).sum()  # to the last; noise goes to and fro
    assert way * SCALE == pytest.approx(true, rel=0.1)
    assert all(one.covariance[0, 0] > 0 for one in samples[1:])


def test_without_a_map_the_landmarks_positions_are_in_the_truth_alone(made, tmp_path):
    command = ["import", "mrclam", str(made.path), "--out", str(tmp_path / "run.mcap")]
    assert main(command) == 0
    assert all(one.position for one in open_run(tmp_path / "run.mcap").team.landmarks)
    assert main([*command, "--map-unknown", "--force"]) == 0
    assert all(one.position is None for one in open_run(tmp_path / "run.mcap").team.landmarks)
    true = read_true_team(tmp_path / "run.mcap")
    assert true.landmarks[0].position == pytest.approx(LANDMARKS[6])


def test_what_is_nobodys_or_out_of_order_is_counted_and_said(copy, tmp_path):
    path = copy / "Robot1_Measurement.dat"
    first = path.read_text().splitlines()[1].split()
    add(path, f"{first[0]} 99 2.0 0.1", f"{first[0]} 5 2.0 0.1")  # nobody's, and its own
    summary = import_mrclam(copy, tmp_path / "run.mcap")
    assert any("2 measurements are of unknown barcodes (5, 99)" in one for one in summary.warnings)
    assert any("time runs backwards 1 times" in one for one in summary.warnings)


def test_a_barcode_of_two_is_nobodys(copy, tmp_path):
    add(copy / "Barcodes.dat", "7 63")
    summary = import_mrclam(copy, tmp_path / "run.mcap")
    assert any("barcode 63 belongs to subjects 6, 7" in one for one in summary.warnings)
    ranges = [one for name in ("R1", "R2", "R3") for one in open_run(tmp_path / "run.mcap").ranges(name)]
    targets = [target for one in ranges for target in one.targets]
    of_7 = sum((np.loadtxt(copy / f"Robot{n}_Measurement.dat")[:, 1] == 81).sum() for n in (1, 2, 3))
    assert "L6" not in targets and targets.count("L7") == of_7 > 0


@pytest.mark.parametrize(("name", "line", "words"), [
    ("Robot2_Odometry.dat", "1248444100.0 0.1", "has 2 columns and not 3 .the file was cut off there"),
    ("Robot2_Measurement.dat", "1248444100.0 63 two 0.1", "`two` is not a number"),
    ("Robot2_Measurement.dat", "1248444100.0 63 -1.0 0.1", "the range is not above 0"),
    ("Robot3_Groundtruth.dat", "1248444100.0 nan 1.0 0.1", "not finite"),
    ("Landmark_Groundtruth.dat", "6 1.0 1.0 0.1 0.1", "subject 6 appears twice"),
])  # fmt: skip
def test_a_wrong_row_is_named_by_file_and_line_and_nothing_is_written(copy, tmp_path, capsys, name, line, words):
    path = copy / name
    path.write_text(path.read_text() + line)
    number = len(path.read_text().splitlines())
    with pytest.raises(InputError, match=rf"{name}, line {number}: .*{words}"):
        import_mrclam(copy, tmp_path / "run.mcap")
    assert main(["import", "mrclam", str(copy), "--out", str(tmp_path / "run.mcap")]) == 2
    assert capsys.readouterr().err.startswith("coloc: ")
    assert not list(tmp_path.glob("run.mcap*"))


@pytest.mark.parametrize(("missing", "words"), [
    ("Robot1_Odometry.dat", "Robot1_Odometry.dat: cannot be read"),
    ("Barcodes.dat", "Barcodes.dat: cannot be read"),
])  # fmt: skip
def test_a_missing_file_is_named(copy, tmp_path, missing, words):
    (copy / missing).unlink()
    with pytest.raises(InputError, match=words):
        import_mrclam(copy, tmp_path / "run.mcap")


def test_a_folder_that_is_no_dataset_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no Robot1_Measurement\.dat"):
        import_mrclam(tmp_path, tmp_path / "run.mcap")
    with pytest.raises(InputError, match="is not a folder"):
        import_mrclam(tmp_path / "nothing", tmp_path / "run.mcap")


@pytest.mark.slow
@pytest.mark.skipif("COLOC_DATA" not in os.environ, reason="COLOC_DATA does not say where mrclam6 is")
def test_the_real_dataset_is_as_good_as_it_is_said_to_be(tmp_path):
    from coloc_graph.pipeline.batch import solve
    from coloc_graph.results.writer import assess

    import_mrclam(Path(os.environ["COLOC_DATA"]) / "mrclam6", tmp_path / "run.mcap")
    assessed = assess(solve(open_run(tmp_path / "run.mcap")))
    assert max(row.translation.rmse for row in assessed[0].robots) < 0.06
