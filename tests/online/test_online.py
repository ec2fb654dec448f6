"""A team leads itself down a hallway, with real processes, links, serial lines and images; and things happen to it."""

import signal
import time
from pathlib import Path

import gtsam
import numpy as np
import pytest
from online_mission import TEAM, Mission

from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.results.writer import assess
from coloc_graph.run import open_run

pytestmark = pytest.mark.realtime
#: How many stances, or with --whole, and before which an anchor is pushed then.
STANCES = 2
WHOLE = 12
PUSHED = 5
#: What a wheel may turn on for after what let it go was cut off [s].
STOP = 0.5


@pytest.fixture(scope="module")
def mission(tmp_path_factory, request):
    """A mission to which bad things happen, one after the other; it ends by itself."""
    whole = request.config.getoption("--whole")
    with Mission(tmp_path_factory.mktemp("online"), WHOLE if whole else STANCES) as m:
        m.field.start()
        m.start_coordinator()

        def in_mid_stance(stance):
            m.wait_for(stance, "capturing")
            m.wait_moving()

        in_mid_stance(0)
        m.field.kill("C")
        m.time_to_stand("a robot's program is gone")
        m.field.start("C")
        in_mid_stance(1)
        m.relay.cut()
        m.time_to_stand("the link is cut")
        time.sleep(3.0)
        m.relay.mend()
        in_mid_stance(1)  # once more
        time.sleep(1.5)
        m.wait_moving()
        m.killed_at = time.time()
        m.coordinator.kill()
        m.coordinator.wait()
        m.time_to_stand("the coordinator is gone")
        m.start_coordinator("--resume")
        if whole:
            more_happens(m, in_mid_stance)
        m.code = m.wait_end(400.0)
        m.field.close()
        yield m


def more_happens(m, in_mid_stance):
    m.wait_for(PUSHED, "placing")
    m.pushed = m.anchor()
    m.field.tell(f"push {m.pushed} 0.07 -0.05 0.12")
    in_mid_stance(7)
    m.field.tell("freeze A")
    m.wait_for(7, "holding")
    m.field.tell("thaw A")
    in_mid_stance(9)
    m.field.tell("hangup C")
    m.wait_for(9, "holding")
    m.field.tell("plug C")
    in_mid_stance(10)
    m.field.kill("B")
    m.field.start("B", program=[str(Path(__file__).parents[1] / "support" / "jumping_clock.py")])
    in_mid_stance(11)
    m.field.programs["B"].send_signal(signal.SIGUSR1)


def reasons(mission, stance):
    return " | ".join(why for k, state, why in mission.states() if k == stance and state == "holding")


def test_the_mission_ends_by_itself_with_every_stance_once(mission):
    assert mission.code == 0, mission.log()
    run = open_run(mission.folder / "mission" / "run.mcap")
    assert [stance.index for stance in run.stances] == list(range(mission.stances))
    entered = [row["stance"] for row in mission.rows if row["what"] == "entered"]
    assert entered == list(range(mission.stances))
    assert not run.warnings
    for before, stance in zip(run.stances, run.stances[1:], strict=False):
        assert set(stance.anchors) < set(stance.observers) and stance.start > before.end
        assert bool(stance.anchors) == (stance.index != PUSHED)


def test_what_happened_is_named(mission):
    assert "C is not there" in reasons(mission, 0)
    assert "not there" in reasons(mission, 1) or "has sent nothing" in reasons(mission, 1)
    assert any(row["what"] == "resumed" and row["stances"] == 1 for row in mission.rows)
    if mission.stances < WHOLE:
        return
    assert f"robot {mission.pushed} was bumped between stances {PUSHED - 1} and {PUSHED}" in reasons(mission, PUSHED)
    assert "A" in reasons(mission, 7) and "image" in reasons(mission, 7)
    assert "C" in reasons(mission, 9)
    assert "the clock of B jumped" in reasons(mission, 11)


def test_wheels_stand_soon_after_they_are_let_go(mission):
    print(f"    the wheels stood after {mission.stops} s")
    assert len(mission.stops) == 3
    assert 0.05 < max(mission.stops.values()) < STOP, mission.stops


def test_a_killed_coordinator_s_record_misses_half_a_second_at_most(mission):
    cut_off = open_run(mission.folder / "mission" / "run.1.mcap")
    assert len(cut_off.stances) == 1
    last = max(one.time for robot in "AB" for one in cut_off.detections(robot))
    # and the image before that, which a loaded machine takes longer to send
    assert mission.killed_at - last < 0.5 + 0.5
    goes_on = open_run(mission.folder / "mission" / "run.mcap")
    for robot in "ABC":
        before = [one.time for one in cut_off.odometry(robot)]
        assert [one.time for one in goes_on.odometry(robot)][: len(before)] == before


def test_the_record_solved_offline_is_what_was_known_online(mission):
    online = {row["stance"]: row["poses"] for row in mission.rows if row["what"] == "entered"}
    heard = []
    solve(open_run(mission.folder / "mission" / "run.mcap"), SolveOptions(incremental=True), on_update=heard.append)
    assert len(heard) == mission.stances
    for one in heard:
        poses = online[one.stance.index]
        assert poses.keys() == one.estimate.poses.keys()
        for robot, pose in one.estimate.poses.items():
            # a sample of wheels may come after its stance has entered, and once a stance was taken out, ISAM2 has
            # linearised it elsewhere: below what is not known; `coloc replay` compares bits
            off = gtsam.Pose3(np.array(poses[robot])).localCoordinates(pose)[[2, 3, 4]]
            sigmas = np.sqrt(np.diag(one.estimate.covariances[robot])[[2, 3, 4]])
            assert (np.abs(off) < 0.5 * sigmas + 1e-5).all()


def test_it_is_as_accurate_as_the_same_record_in_batch(mission):
    run = open_run(mission.folder / "mission" / "run.mcap")
    online, batch = (
        assess(solve(run, SolveOptions(incremental=incremental)), mission.field.truth_path)[0]
        for incremental in (True, False)
    )
    assert online.ate < 2 * batch.ate + 5e-3  # which of two estimates of so few stances is nearer is a matter of luck
    leapt = [row for row in batch.robots if row.robot != "C" and row.true_length > 0.3]
    assert len(leapt) == min(mission.stances - 1, 2) and all(abs(row.length_error) < 0.02 for row in leapt)
    assert batch.ate < 0.05


def test_robots_keep_records_of_their_own(mission):
    team = TEAM
    for name in team.names:
        runs = [open_run(path) for path in sorted((mission.folder / "field" / "robots").glob(f"{name}-*.mcap"))]
        begun_anew = "BC" if mission.stances >= WHOLE else "C"
        assert len(runs) == (2 if name in begun_anew else 1)
        assert all(run.team == team for run in runs)
        assert sum(1 for run in runs for _ in run.odometry(name)) > 40
    seen = sum(
        1 for path in (mission.folder / "field" / "robots").glob("A-*.mcap") for _ in open_run(path).detections("A")
    )
    recorded = sum(1 for _ in open_run(mission.folder / "mission" / "run.mcap").detections("A"))
    assert 0 < recorded <= seen


def test_figures_are_kept_of_each_stance(mission):
    rows = [row for row in mission.rows if row["what"] == "entered"]
    latencies = [row["latency"] for row in rows]
    assert all(0 < latency < 10 for latency in latencies) and all(row["points"] >= 50 for row in rows)
