"""Estimator whose old poses are marginalised: as accurate as with all of them, at the cost of the last ones."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from coloc_graph.backend import Estimator
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.errors import EstimationError, MeasurementError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Odometry, Sighting
from coloc_graph.pipeline.batch import solve
from coloc_graph.run import open_run
from coloc_graph.simulation import Imperfections, simulate

WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, span_sigma=1e-4, floor_sigma_deg=0.1)
LAG = 5
STANCES = 14


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    """Graph of a hallway whose mounts are wrong."""
    path = tmp_path_factory.mktemp("lag") / "hallway.mcap"
    simulate("hallway", path, stances=STANCES, seed=4, points=80, imperfections=WRONG)
    return solve(open_run(path)).estimate.graph


def fed(graph, lag, late=(), stances=STANCES, **options):
    """Estimator of a graph's stances in their order; measurements in `late` are left out."""
    by_stance = defaultdict(list)
    for one in graph.measurements:
        if one not in late:
            by_stance[max(stance for _, stance in one.ends)].append(one)
    estimator = Estimator(
        graph.reference, graph.robots, graph.floor, graph.slips, graph.robot_models, graph.landmarks, lag, **options
    )
    before = None
    for stance in graph.stances[:stances]:
        here = stance if before is not None else replace(stance, anchors=())
        estimator.add(here, by_stance[stance.index], after=before)
        before = stance.index
    return estimator


@pytest.fixture(scope="module")
def short(graph):
    return fed(graph, LAG)


@pytest.fixture(scope="module")
def whole(graph):
    return fed(graph, STANCES)


def in_sigmas(one, other, robot):
    """Distance of a robot's last poses, in the standard deviations of the second."""
    off = np.asarray(other.pose(robot).localCoordinates(one.pose(robot)))
    return float(np.sqrt(off @ np.linalg.solve(other.covariance(robot), off) / 6))


def test_the_last_poses_are_those_of_all_poses(short, whole):
    for robot in "AB":
        assert in_sigmas(short, whole, robot) < 0.1
        np.testing.assert_allclose(
            np.sqrt(short.covariance(robot).diagonal()), np.sqrt(whole.covariance(robot).diagonal()), rtol=0.03
        )


def test_no_more_poses_stay_variables_than_the_lag_has(graph, short, whole):
    half = fed(graph, LAG, stances=STANCES // 2)
    sizes = [one._live.isam.calculateEstimate().size() for one in (half, short)]
    assert max(sizes) < 3 * (1.5 * LAG + 2) + len(short.estimate().calibration.values)
    assert abs(sizes[1] - sizes[0]) <= 3 * LAG
    # all poses are there, and a batch estimate has all measurements
    assert {node for node in graph.nodes if node[0] in "AB"} <= {
        (robot, stance.index) for robot in "AB" for stance in graph.stances if short.pose(robot, stance.index)
    }
    assert short.estimate().chi2 == pytest.approx(whole.estimate().chi2, abs=0.01)


def test_a_late_measurement_of_an_old_pose_counts(graph):
    late = [one for one in graph.measurements if isinstance(one, Odometry | Sighting) and one.ends[1][1] == 3]
    estimator = fed(graph, LAG, late=late)
    assert any(estimator._is_marginalised(one) for one in late)
    before = estimator.pose("A")
    estimator.insert(*late)
    assert not estimator.rejected
    assert not before.equals(estimator.pose("A"), 1e-9)
    whole = fed(graph, STANCES)
    assert all(in_sigmas(estimator, whole, robot) < 0.1 for robot in "AB")


def test_a_checkpoint_resumes_to_the_bit(graph, short, tmp_path):
    short.save(tmp_path / "point.json")
    resumed = Estimator.resume(tmp_path / "point.json")
    assert resumed.lag == LAG
    for node in graph.nodes:
        np.testing.assert_array_equal(resumed.pose(*node).matrix(), short.pose(*node).matrix())
        np.testing.assert_array_equal(resumed.covariance(*node), short.covariance(*node))


def test_a_stance_is_withdrawn_and_comes_again(graph):
    estimator = fed(graph, LAG)
    expected = estimator.pose("A")
    taken = [one for one in graph.measurements if max(index for _, index in one.ends) == graph.stances[-1].index]
    stance = estimator.withdraw()
    estimator.add(stance, taken, after=graph.stances[-2].index)
    off = np.asarray(expected.localCoordinates(estimator.pose("A")))
    assert np.sqrt(off @ np.linalg.solve(estimator.covariance("A"), off) / 6) < 0.1


def test_two_robots_are_composed_by_what_ties_them_before_each_by_its_own_odometry(graph):
    def by_odometry(**options):
        return [step.to for step in spanning_tree(graph, graph.links, **options) if isinstance(step.link, Odometry)]

    others = [link for link in graph.links if not isinstance(link, Odometry)]
    reached = {step.to for step in spanning_tree(graph, others)}
    assert not reached & set(by_odometry(odometry_last=True))
    assert reached & set(by_odometry())


def test_a_lag_of_nothing_is_refused(graph):
    with pytest.raises(EstimationError, match="a lag of 0 stances"):
        fed(graph, 0)


def test_a_shift_of_metres_at_once_is_followed(graph):
    """A kilometre away, after 2 m more of odometry: bodies tilted by half a milliradian would move along their tilt."""
    first, second = graph.stances[:2]
    robot = first.observers[0]

    def driven(x, y, sigma):
        covariance = np.diag(np.square([1e-3, sigma, sigma]))
        return Odometry(robot, first.index, first.index + 1, floor_pose(x, y, 0.0), covariance)

    def measured(stance):
        return [one for one in graph.measurements if max(index for _, index in one.ends) == stance.index]

    def later(stance):
        here = replace(stance, index=stance.index + 1, start=stance.start + 1000.0, end=stance.end + 1000.0)
        return here, [
            replace(one, before=one.before + 1, after=one.after + 1) if isinstance(one, Odometry)
            else replace(one, stance=one.stance + 1) for one in measured(stance)
        ]  # fmt: skip

    estimator = Estimator(graph.reference, graph.robots, graph.floor, graph.slips, graph.robot_models)
    estimator.add(first, measured(first))
    here, taken = later(first)
    estimator.add(here, [*taken, driven(1000.0, 0.0, 2.0)], after=first.index)
    estimator.insert(driven(1002.0, 2.0, 0.01))
    estimator.add(*later(second), after=here.index)
    batch = estimator.estimate()
    assert not estimator.rejected and not batch.rejected
    for name in "AB":
        T, C = batch.pose(name, second.index + 1), batch.covariance(name, second.index + 1)
        off = np.asarray(T.localCoordinates(estimator.pose(name)))
        assert np.sqrt(off @ np.linalg.solve(C, off) / 6) < 0.1


@pytest.mark.parametrize("method", ["joint", "smooth"])
def test_what_is_older_than_the_lag_can_be_forgotten_and_changes_no_pose(graph, short, method, tmp_path):
    if method == "smooth":
        graph = replace(graph, robot_models={})
        short = fed(graph, LAG)
    found = fed(graph, LAG, forgets=True)
    assert len(found.stances) < 2 * LAG and len(found.measurements) < 0.6 * len(graph.measurements)
    robots = graph.robots
    before = {robot: found.pose(robot).matrix() for robot in robots}
    for robot in robots:
        if method == "joint":  # the same numbers, with and without what was forgotten
            np.testing.assert_array_equal(before[robot], short.pose(robot).matrix())
            np.testing.assert_array_equal(found.covariance(robot), short.covariance(robot))
        assert in_sigmas(found, short, robot) < 0.02
    last = graph.stances[-1]
    wrong = [replace(m, covariance=-m.covariance) for m in graph.measurements if isinstance(m, Odometry)][-1]
    following = replace(last, index=last.index + 1, anchors=last.observers[:1])
    failing = found._live
    failing.enter = lambda _: 1 / 0
    with pytest.raises(EstimationError, match="was restored"):
        found.add(following, after=last.index)
    assert found._live is not failing  # it was made anew, from where it forgot last
    for robot in robots:
        np.testing.assert_allclose(before[robot], found.pose(robot).matrix(), atol=1e-12)
    with pytest.raises(MeasurementError):
        found.insert(wrong)
    with pytest.raises(MeasurementError, match="which was forgotten: it left the lag of 5 stances"):
        found.insert(next(m for m in graph.measurements if isinstance(m, Odometry)))
    with pytest.raises(MeasurementError, match="was added before"):
        found.add(graph.stances[1], after=0)
    with pytest.raises(EstimationError, match="has no pose at stance 1"):
        found.pose(graph.reference, 1)
    for refused in (found.estimate, found.withdraw, lambda: found.save(tmp_path / "x"), lambda: found.graph):
        with pytest.raises(EstimationError, match="it has forgotten all before stance"):
            refused()
