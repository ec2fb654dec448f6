"""Small runs and their solutions, made once for the whole suite."""

import dataclasses
import gc
import os
import signal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `coloc` does, before numpy is there: the tests are parallel

import numpy as np
import pytest

from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import write_result
from coloc_graph.run import RunWriter, open_run, read_true_team, read_truth
from coloc_graph.simulation import simulate

# Under `nohup` or in the background of a script SIGHUP or SIGINT are ignored, which the programs that tests start would
# inherit. A handler that does nothing ignores them as well, and is not inherited.
for _number in (signal.SIGHUP, signal.SIGINT):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda *_: None)


def pytest_addoption(parser):
    """Add --whole, for `make test-long`."""
    parser.addoption("--whole", action="store_true", help="run tests marked long, and a mission of 12 stances")


def pytest_ignore_collect(collection_path, config):
    """Import only the files that have tests in real time where only these are asked for."""
    if config.option.markexpr == "realtime" and collection_path.name.startswith("test_"):
        return True if "mark.realtime" not in collection_path.read_text(encoding="utf-8") else None
    return None


#: Files that take longest, which begin first: a process that begins one of them last would be waited for.
DEAREST = (
    "test_missions.py",
    "test_experiments.py",
    "test_notebooks.py",
    "test_many_runs.py",
    "test_teams.py",
    "test_cli.py",
    "test_ranging_runs.py",
    "test_estimator.py",
    "test_ranges.py",
    "test_outputs.py",
    "test_joint.py",
    "test_docs.py",
    "test_horizon.py",
    "test_many_robots.py",
    "test_benchmarks.py",
    "test_ros_import.py",
    "test_link.py",
    "test_link_network.py",
    "test_landmark_sightings.py",
    "test_import_tracks.py",
    "test_coordinator_process.py",
    # with a browser, which takes a higher priority than its parent's where it may: after the tests in real time
    "test_viewer_browser.py",
    "test_viewer.py",
    "test_site.py",
)
ALLOCATIONS = 50_000  # objects more than freed, after which the garbage collector looks at the youngest


def pytest_collection_finish(session):
    """Keep what was imported and collected out of garbage collections, which took a fifth of the time of tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(ALLOCATIONS, 20, 50)


def pytest_collection_modifyitems(config, items):
    """Begin with the files that take longest; skip the long tests unless asked for."""
    rank = {name: n for n, name in enumerate(DEAREST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
    if not config.getoption("--whole"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason="long statistics: make test-long"))


def copy_run(source, to, *, change=lambda record: record, stances=None, team=None, truth=False, more=()):
    """The run `source` written anew to `to`, without its truth unless asked for (or with another: by robot).

    `change` is given each record and returns what is written instead (None: nothing); `more` are written besides.
    """
    run = open_run(source)
    records = [*(run.stances if stances is None else stances), *run.planes.values()]
    for robot in run.team.names:
        records += [*run.detections(robot), *run.images(robot), *run.odometry(robot), *run.motions(robot)]
    records = [changed for record in records if (changed := change(record)) is not None]
    records += more
    with RunWriter(to, team or run.team, image_format="raw") as writer:
        if truth:
            writer.write_true_team(read_true_team(source) or run.team)
            for robot, true in (read_truth(source) if truth is True else truth).items():
                for time, T in zip(true.times.tolist(), true.T_world_body, strict=True):
                    writer.write_truth(robot, time, T)
        for record in sorted(records, key=lambda one: one.start if hasattr(one, "anchors") else one.time):
            writer.write(record)
    return to


def on_a_line(detections):
    """The same detections with all markers moved onto one line of the image."""
    uv = detections.uv.copy()
    uv[:, 1] = 100 + 0.2 * uv[:, 0]
    return dataclasses.replace(detections, uv=uv)


@pytest.fixture(scope="session")
def copied():
    """The function `copy_run`."""
    return copy_run


@pytest.fixture(scope="session")
def collinear():
    """The function `on_a_line`."""
    return on_a_line


@pytest.fixture(scope="session")
def hallway(tmp_path_factory):
    """Path of a hallway of 8 stances, as tracks."""
    path = tmp_path_factory.mktemp("hallway") / "hallway.mcap"
    simulate("hallway", path, stances=8, seed=3)
    return path


@pytest.fixture(scope="session")
def short(tmp_path_factory):
    """Path of a hallway of 3 stances with few points: quick to solve."""
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    simulate("hallway", path, stances=3, seed=1, points=40)
    return path


class Solutions(dict):
    """Solutions of a run by method, each solved when it is first asked for."""

    def __init__(self, path):
        super().__init__()
        self._path = path

    def __missing__(self, method):
        self[method] = solve(open_run(self._path), SolveOptions(method=method))
        return self[method]


@pytest.fixture(scope="session")
def solutions(hallway):
    """The solutions of the hallway by method."""
    return Solutions(hallway)


@pytest.fixture(scope="session")
def short_solution(short):
    """The solution of the short run."""
    return solve(open_run(short))


@pytest.fixture(scope="session")
def short_result(short_solution, short):
    """The result of the short run on disk; tests read it, or copy it, and leave it alone."""
    write_result(short_solution, short.parent / "result")
    return short.parent / "result"


@pytest.fixture(scope="session")
def result(solutions, hallway):
    """A result on disk beside the hallway; tests read it and leave it alone."""
    out = hallway.parent / "result"
    write_result(solutions["joint"], out)
    return out


@pytest.fixture
def rng():
    """The same random numbers in each test."""
    return np.random.default_rng(7)
