"""Parts of the online system: course, formation, driving, pose tracking, record, states."""

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coloc_graph.errors import InputError, RobotError, RunError
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.se2 import compose, inverse
from coloc_graph.missions.mission import mission_team
from coloc_graph.online.encoder_log import Counted, EncoderLog, way_since
from coloc_graph.online.estimation_worker import EstimationWorker, enter_stance
from coloc_graph.online.formation import APART, BETWEEN, STAGGER, Formation
from coloc_graph.online.mission_log import MissionLog
from coloc_graph.online.mission_states import NEXT_STATES, MissionState, StateMachine, as_dot, as_mermaid
from coloc_graph.online.motion import Follower
from coloc_graph.online.odometry_restart import DROVE, STOOD, JoinedOdometry
from coloc_graph.online.pose_tracker import PoseTracker
from coloc_graph.online.record import Record, continued
from coloc_graph.online.visibility import InView, Precision
from coloc_graph.pipeline.incremental import EnteredStance, IncrementalSolver
from coloc_graph.planning.course import Course
from coloc_graph.planning.plan import Plan, PlannedStance
from coloc_graph.run import Detections, OdometrySample, Stance, atomic_run, open_run
from coloc_graph.simulation import Imperfections, build_world
from coloc_graph.simulation import record as record_world
from coloc_graph.simulation.planned import planned
from coloc_graph.simulation.rig import reference_team
from coloc_graph.team.shared_view import View

COURSE = Course(((0.0, 0.0), (3.0, 0.0), (3.0, 2.0)))
FORMATION = Formation(Course(((0.0, 0.0), (5.0, 0.0))), ("A", "B"))


def odometry(robot, time, x, y, yaw):
    return OdometrySample(robot, time, np.array([x, y, yaw]), 1e-6 * np.eye(3))


def detections(robot, time, n=2):
    uv, covariance = np.arange(2.0 * n).reshape(n, 2) / 3, np.tile(0.01 * np.eye(2), (n, 1, 1))
    return Detections(robot, time, uv, covariance, ("",) * n, np.zeros(n, np.uint8), np.full(n, 90.0), np.full(n, 9.0))


@pytest.mark.parametrize("way", [-0.4, 0.0, 1.0, 2.9, 3.5, 5.0, 6.0])
def test_a_course_is_followed_round_its_corner(way):
    x, y, heading = COURSE.at(way)
    assert heading == pytest.approx(0.0 if way <= 3 else math.pi / 2)
    assert COURSE.way_of((x, y)) == pytest.approx(way)
    left = x - 0.2 * math.sin(heading), y + 0.2 * math.cos(heading)
    assert COURSE.way_of(left) == pytest.approx(way, abs=1e-9) or 2.7 < way < 3.3
    assert COURSE.length == 5.0


@pytest.mark.parametrize("points", [((0.0, 0.0),), ((0.0, 0.0), (0.05, 0.0)), ((0.0, 0.0), (math.nan, 1.0))])
def test_a_course_that_leads_nowhere_is_refused(points):
    with pytest.raises(InputError, match="goal"):
        Course(points)


def test_observers_stand_as_in_the_paper_and_leap_in_turn():
    places = {"A": FORMATION.place("A", 0.0), "B": FORMATION.place("B", STAGGER)}
    leapt = []
    for _ in range(4):
        a, b = places["A"], places["B"]
        assert math.dist(a[:2], b[:2]) == pytest.approx(APART)
        assert b[2] - a[2] == pytest.approx(BETWEEN)
        robot, to = FORMATION.next_leap(places)
        assert math.dist(places[robot][:2], to[:2]) == pytest.approx(2 * STAGGER)
        places[robot] = to
        leapt.append(robot)
    assert leapt == ["A", "B", "A", "B"]
    assert FORMATION.progress(places) == pytest.approx(4.5 * STAGGER)


def views(places):
    team = reference_team()
    return [View(team[r].camera, floor_pose(*places[r]) @ team[r].mount.T_body_camera) for r in ("A", "B")]


@pytest.mark.parametrize("heading", [0.0, 1.0, math.pi])
def test_the_mover_is_sent_where_all_see_it_whatever_the_heading(heading):
    ahead = 5 * math.cos(heading), 5 * math.sin(heading)
    formation = Formation(Course(((0.0, 0.0), ahead)), ("A", "B"))
    places = {"A": formation.place("A", 0.0), "B": formation.place("B", STAGGER)}
    markers = reference_team()["C"].markers.p_body
    for left in (True, False):
        patrol = formation.patrol(places, views(places), markers, left)
        for xy in patrol:
            for yaw in (0.0, 0.7, 2.0):
                points = markers @ floor_pose(*xy, yaw)[:3, :3].T + (*xy, 0.0)
                assert all(view.sees(points, 10.0).all() for view in views(places))
        sideways = patrol @ (-math.sin(heading), math.cos(heading))
        along = patrol @ (math.cos(heading), math.sin(heading))
        assert np.ptp(sideways) > 0.5 and np.ptp(along) > 0.7
        assert (sideways[0] > sideways[1]) == left


def test_observers_that_look_away_from_each_other_are_told_to_turn():
    places = {"A": (0.0, 0.4, 1.2), "B": (0.2, -0.4, -1.2)}
    with pytest.raises(InputError, match="see too little of the floor together"):
        FORMATION.patrol(places, views(places), reference_team()["C"].markers.p_body, True)


def driven(follower, pose, seconds=150.0, dt=0.05):
    way = [pose]
    for _ in range(int(seconds / dt)):
        twist = follower.step(*pose)
        if twist is None:
            return np.array(way)
        yaw = pose[2] + twist.w * dt / 2
        pose = pose[0] + twist.v * dt * math.cos(yaw), pose[1] + twist.v * dt * math.sin(yaw), pose[2] + twist.w * dt
        way.append(pose)
    raise AssertionError(f"it is still under way after {seconds} s, at {pose}")


@pytest.mark.parametrize("seed", range(20))
def test_a_robot_drives_through_its_places_and_ends_as_told(seed):
    rng = np.random.default_rng(seed)
    places = [tuple(map(float, xy)) for xy in rng.uniform(-2, 2, (rng.integers(1, 5), 2))]
    yaw = float(rng.uniform(-7, 7)) if seed % 3 else None
    way = driven(Follower(places, yaw, 0.25, backwards=bool(seed % 2)), (0.0, 0.0, float(rng.uniform(-3, 3))))
    for place in places:
        assert np.hypot(*(way[:, :2] - place).T).min() < 0.03
    assert np.hypot(*(way[-1, :2] - places[-1])) < 0.03
    if yaw is not None:
        assert abs(math.remainder(way[-1, 2] - yaw, 2 * math.pi)) < 0.03
    assert np.hypot(*np.diff(way[:, :2], axis=0).T).max() < 0.25 * 0.05 + 1e-9


def test_a_robot_goes_backwards_only_where_it_may():
    assert np.ptp(driven(Follower([(-1.0, 0.0)], None, 0.2), (0.0, 0.0, 0.0))[:, 2]) < 0.1
    assert np.ptp(driven(Follower([(-1.0, 0.0)], None, 0.2, backwards=False), (0.0, 0.0, 0.0))[:, 2]) > 3.0


def test_a_robot_is_where_it_was_last_seen_and_its_wheels_went_since():
    place = PoseTracker((1.0, 2.0, math.pi / 2))
    assert place.pose() == (1.0, 2.0, math.pi / 2) and not place.known
    for n in range(11):
        place.add(odometry("A", 10.0 + n, 5.0 + 0.1 * n, 0.0, 0.0))
    assert place.pose(10.0) == pytest.approx((1.0, 2.0, math.pi / 2))
    assert place.pose() == pytest.approx((1.0, 3.0, math.pi / 2))
    place.fix(15.0, (0.0, 0.0, 0.0))
    assert place.pose(15.0) == pytest.approx((0.0, 0.0, 0.0))
    assert place.pose() == pytest.approx((0.5, 0.0, 0.0))
    assert place.in_odometry((0.0, 0.0, 0.0)) == pytest.approx((5.5, 0.0, 0.0))
    assert place.moved_since(12.0) and not place.moved_since(20.0)
    assert compose(inverse((1.0, 2.0, 3.0)), (1.0, 2.0, 3.0)) == pytest.approx((0.0, 0.0, 0.0))


def test_odometry_goes_on_over_a_restart_and_admits_what_it_missed():
    joined = JoinedOdometry()
    joined.restart(moving=True)  # before anything there is nothing to join
    assert np.allclose(joined.take(odometry("A", 0.0, 0.0, 0.0, 0.0)).covariance, 1e-6 * np.eye(3))
    joined.take(odometry("A", 1.0, 1.0, 0.0, math.pi / 2))
    joined.restart(moving=False)
    again = joined.take(odometry("A", 2.0, 0.0, 0.0, 0.0))
    assert np.allclose(again.pose, (1.0, 0.0, math.pi / 2))
    assert np.allclose(np.sqrt(np.diag(again.covariance)), STOOD)
    assert np.allclose(joined.take(odometry("A", 3.0, 0.5, 0.0, 0.0)).pose, (1.0, 0.5, math.pi / 2))
    joined.restart(moving=True)
    assert np.allclose(np.sqrt(np.diag(joined.take(odometry("A", 4.0, 9.0, 9.0, 1.0)).covariance)), DROVE)


def test_a_killed_program_s_wheels_are_counted_on_by_the_next(tmp_path):
    ledger = EncoderLog(tmp_path / "A.wheels.json")
    assert ledger.read() is None
    counted = Counted("one", (65_500, 10), (1.0, 2.0, math.pi / 2))
    ledger.write(counted)
    assert ledger.read() == counted
    way, sigmas = way_since(counted, (964, 1010))  # 1000 counts each, the left one over the top
    metres = 1000 * math.pi * 0.072 / 508.8
    assert way == pytest.approx((metres, 0.0, 0.0)) and sigmas[0] > 0.05 * metres
    assert way_since(counted, (30_000, 30_000)) is None
    assert way_since(counted, counted.ticks)[0] == (0.0, 0.0, 0.0)
    (tmp_path / "A.wheels.json").write_text('{"frame": "one", "ticks": [1')
    assert ledger.read() is None
    joined = JoinedOdometry()
    joined.go_on((1.0, 2.0, 0.0), sigmas)
    first = joined.take(odometry("A", 5.0, 0.3, 0.0, 0.0))
    assert np.allclose(first.pose, (1.0, 2.0, 0.0)) and np.allclose(np.sqrt(np.diag(first.covariance)), sigmas)


def test_the_mover_is_found_in_an_image_where_its_wheels_lost_it():
    team = reference_team()
    places = {"A": FORMATION.place("A", 0.0), "B": FORMATION.place("B", STAGGER)}
    view = InView(team, "C", places)
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(40):
        true = float(rng.uniform(0.9, 1.6)), float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-3, 3))
        points = team["C"].markers.p_body @ floor_pose(*true)[:3, :3].T + (*true[:2], 0.0)
        uv, inside = view.views["A"].project(points)
        if not inside.all():
            continue
        lights = np.vstack([uv, rng.uniform((0, 0), (319, 100), (3, 2))])
        seen = replace(detections("A", 1.0, len(lights)), uv=lights[rng.permutation(len(lights))])
        thought = true[0] + 0.2, true[1] - 0.15, true[2] + 0.5
        where = view.find(seen, thought)
        if where is not None:
            found += 1
            assert where == pytest.approx(true, abs=1e-6)
            assert view.take(seen, true)
    assert found > 25
    nothing = replace(seen, uv=seen.uv[:1])
    assert view.find(nothing, true) is None and view.missing() == ["B"]


def test_an_observer_that_was_pushed_is_told_by_where_it_has_the_mover():
    team, mover = reference_team(), (1.25, 0.05, 0.4)
    said = {"A": FORMATION.place("A", 0.0), "B": FORMATION.place("B", STAGGER)}
    push = compose(said["B"], (0.06, -0.05, 0.2))
    points = team["C"].markers.p_body @ floor_pose(*mover)[:3, :3].T + (*mover[:2], 0.0)
    view, truly = InView(team, "C", said), InView(team, "C", said | {"B": push})
    for robot in "AB":
        uv, inside = truly.views[robot].project(points)
        assert inside.all()
        for one in (view, truly):
            one.take(replace(detections(robot, 1.0), uv=uv), mover)
    thought = mover[0] + 0.03, mover[1] - 0.02, mover[2] + 0.05
    moved = view.displaced(thought)
    assert moved.keys() == {"B"} and moved["B"] == pytest.approx(push, abs=1e-6)
    assert truly.displaced(thought) == {}


def test_odometry_is_kept_for_ten_minutes_and_no_longer():
    tracker = PoseTracker((0.0, 0.0, 0.0))
    for n in range(2000):
        tracker.add(odometry("A", float(n), 0.01 * n, 0.0, 0.0))
    assert 600 <= len(tracker._times) <= 1.2 * 600 + 2
    assert tracker.pose(1999.0 - 600.0)[0] == pytest.approx(0.01 * (1999 - 600))


def test_a_robot_that_was_carried_is_no_anchor_in_the_record_either():
    joined, seen, resumed = JoinedOdometry(), PoseTracker((0.0, 0.0, 0.0)), PoseTracker((0.0, 0.0, 0.0))
    for n in range(3):
        sample = joined.take(odometry("A", float(n), 0.0, 0.0, 0.0))
        seen.add(sample)
        resumed.add(sample)
    assert not seen.moved_since(1.0)
    joined.carried()
    seen.displace(2.5, (0.1, 0.0, 0.2))
    assert seen.moved_since(1.0) and not seen.moved_since(2.6) and seen.pose() == pytest.approx((0.1, 0.0, 0.2))
    resumed.add(joined.take(odometry("A", 3.0, 0.0, 0.0, 0.0)))
    resumed.add(joined.take(odometry("A", 4.0, 0.0, 0.0, 0.0)))
    assert resumed.moved_since(1.0) and not resumed.moved_since(3.0)


#: A push that contradicts no single measurement, but all of its stance together.
SMALL = (0.0, 0.0, -0.05)

#: Pushes that explain as much as wrong images of the stance.
LARGE = (0.1, 0.06, 0.25), (0.1, 0.1, 0.035)


@pytest.mark.parametrize("push", [(0.03, -0.02, 0.05), *LARGE, SMALL])
def test_an_anchor_that_was_pushed_is_named_and_its_stance_comes_again(tmp_path, hallway, copied, push):
    run = open_run(hallway)
    before, stance = run.stances[4:6]
    (anchor,) = stance.anchors
    robot, height = run.team[anchor], run.team["C"].markers.height
    T_body_camera, T_push = robot.mount.T_body_camera, floor_pose(*push)

    def pushed(record):
        """What the camera sees from where it was pushed to."""
        if isinstance(record, Detections) and record.robot == anchor and record.time >= stance.start:
            rays = (
                np.column_stack([robot.camera.normalise(record.uv), np.ones(len(record.uv))]) @ T_body_camera[:3, :3].T
            )
            points = T_body_camera[:3, 3] + rays * ((height - T_body_camera[2, 3]) / rays[:, 2])[:, None]
            T = T_push @ T_body_camera
            return replace(record, uv=robot.camera.project((points - T[:3, 3]) @ T[:3, :3])[0])
        return record

    seen = open_run(copied(hallway, tmp_path / "run.mcap", change=pushed, stances=run.stances[:6]))
    solver = IncrementalSolver(seen.team)
    measuring = EstimationWorker(seen, solver)

    def entered(one, retake=False):
        measuring.enter(one, retake=retake)
        while (found := measuring.entered()) is None:
            time.sleep(0.01)
        return found

    for one in seen.stances[:5]:
        assert isinstance(entered(one), EnteredStance)
    stands = solver.estimator.pose(anchor, 4).matrix()
    if push in LARGE:  # or what is seen in this stance alone is wrong: another look tells
        with pytest.raises(RobotError, match=f"robot {anchor} was bumped .* or else .* the stance is taken again"):
            entered(seen.stances[5], retake=True)
        assert solver.estimator.stances[-1] == seen.stances[4]
    (bump,) = entered(seen.stances[5])
    assert bump.stay_put.robot == anchor and bump.stay_put.after == stance.index
    T = bump.T_before_after
    assert (T.x(), T.y(), T.rotation().yaw()) == pytest.approx(push, abs=0.04)
    assert solver.estimator.stances[-1] == seen.stances[4] and not solver.estimator.rejected

    class Told:
        """The run, in which the wheels' last word before the stance is what the coordinator makes of it."""

        def __getattr__(self, name):
            return getattr(seen, name)

        def odometry(self, robot, start=None, end=None):
            samples = list(seen.odometry(robot, start, end))
            if robot == anchor:
                joined = JoinedOdometry()
                last = joined.take([one for one in seen.odometry(robot) if one.time < stance.start][-1])
                joined.carried()
                samples += [joined.take(replace(last, time=(before.end + stance.start) / 2))]
            return iter(sorted(samples, key=lambda one: one.time))

    measuring.end()
    measuring = EstimationWorker(Told(), solver)
    assert isinstance(entered(replace(seen.stances[5], anchors=())), EnteredStance)
    assert not solver.estimator.rejected
    T = np.linalg.inv(stands) @ solver.estimator.pose(anchor, 5).matrix()
    assert (T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])) == pytest.approx(push, abs=0.04)
    measuring.end()


def test_a_record_gives_back_what_its_run_holds(tmp_path):
    team = reference_team()
    with Record(tmp_path / "run.mcap", team) as record:
        assert record.newest() == 0.0
        for n in range(50):
            record.take(detections("A", 1e9 + n / 30))
            record.take(odometry("C", 1e9 + n / 20, 0.1 * n, 0.0, 0.0))
        late = record.take(detections("A", 1e9))  # time does not run backwards
        record.moves("C", 1e9, True)
        record.moves("C", 1e9 + 1, True)
        record.moves("C", 1e9 + 2, False)
        record.complete(Stance(0, 1e9, 1e9 + 2, ("A", "B"), ("C",)))
        memory = list(record.detections("A", 1e9 + 0.5, 1e9 + 1.5)), list(record.odometry("C"))
    run = open_run(tmp_path / "run.mcap")
    assert len(memory[0]) == 31 and 0 < late.time - (1e9 + 49 / 30) < 1e-5
    assert len(list(run.detections("A"))) == 51
    for ours, read in zip(memory[0], run.detections("A", 1e9 + 0.5, 1e9 + 1.5), strict=True):
        assert ours.time == read.time and np.array_equal(ours.uv, read.uv)
        assert np.array_equal(ours.covariance, read.covariance)
    for ours, read in zip(memory[1], run.odometry("C"), strict=True):
        assert ours.time == read.time and np.array_equal(ours.pose, read.pose)
        assert np.array_equal(ours.covariance, read.covariance)
    assert [one.moving for one in run.motions("C")] == [True, False]


def test_a_record_that_was_cut_off_goes_on_and_the_old_one_is_kept(tmp_path):
    team, path = reference_team(), tmp_path / "run.mcap"
    with Record(path, team) as record:
        for n in range(900):
            record.take(detections("A", 1e9 + n / 30, 8))
        record.complete(Stance(0, 1e9, 1e9 + 2, ("A", "B"), ("C",)))
    path.write_bytes(path.read_bytes()[:-3000])
    record, _ = continued(path, team)
    with record:
        assert record.take(detections("A", 1e9 + 100)).time == 1e9 + 100
    kept, run = open_run(tmp_path / "run.1.mcap"), open_run(path)
    assert kept.warnings and not run.warnings
    before = [one.time for one in kept.detections("A")]
    assert [one.time for one in run.detections("A")] == [*before, 1e9 + 100] and len(before) > 400
    assert run.stances == kept.stances
    with pytest.raises(RunError, match="another team"):
        continued(path, reference_team((0.1, 0.0, 0.0, 0.0)))


def test_a_record_that_cannot_be_continued_stays_as_it_was(tmp_path, monkeypatch):
    team, path = reference_team(), tmp_path / "run.mcap"
    with Record(path, team) as record:
        record.take(detections("A", 1e9))
        record.complete(Stance(0, 1e9, 1e9 + 2, ("A", "B"), ("C",)))
    before = path.read_bytes()

    def fail(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr(Record, "complete", fail)
    with pytest.raises(OSError, match="full"):
        continued(path, team)
    assert path.read_bytes() == before and [one.name for one in tmp_path.iterdir()] == ["run.mcap"]


class Broken(Record):
    """A record whose disk, or whoever reads it, fails."""

    def detections(self, robot, start, end):
        raise ZeroDivisionError("a fault of the program's own")


def answer(ask):
    until = time.monotonic() + 30
    while time.monotonic() < until:
        if (found := ask()) is not None:
            return found
        time.sleep(0.01)
    raise AssertionError("nothing came of it")


@pytest.mark.parametrize(("record", "why"), [(Record, "stance 0 measures nothing"), (Broken, "a fault of the program")])
def test_a_stance_that_measures_nothing_and_a_fault_are_errors_of_the_stance(tmp_path, record, why):
    team = reference_team()
    stance = Stance(0, 1e9, 1e9 + 2, ("A", "B"), ("C",))
    solver = IncrementalSolver(team)
    with record(tmp_path / "run.mcap", team) as kept:
        measuring = EstimationWorker(kept, solver)
        assert measuring.judged() is None and measuring.entered() is None and not measuring.judging
        measuring.enter(stance)
        with pytest.raises(RobotError, match=why):
            answer(measuring.entered)
        assert measuring.entered() is None and not solver.estimator.stances
        measuring.judge(stance)
        assert measuring.judging
        if record is Record:
            assert answer(measuring.judged).why
        measuring.end()


def test_states_follow_each_other_as_drawn():
    heard = []
    states = StateMachine(heard.append)
    with pytest.raises(ValueError, match="capturing cannot follow gathering"):
        states.enter(MissionState.CAPTURING, 0)
    for state in (MissionState.SYNCHRONISING, MissionState.HOLDING, MissionState.SYNCHRONISING, MissionState.FAILED):
        states.enter(state, 3, "because")
    assert [(change.state, change.stance, change.reason) for change in heard][-1] == (MissionState.FAILED, 3, "because")
    with pytest.raises(ValueError, match="failed cannot follow failed"):
        states.enter(MissionState.FAILED, 3)
    drawn = as_dot()
    assert all(f'"{state}"' in drawn for state in MissionState)
    assert drawn.count("->") == sum(map(len, NEXT_STATES.values())) + len(MissionState) - 2
    page = Path(__file__).parents[2] / "docs" / "missions.md"
    assert as_mermaid() in page.read_text(encoding="utf-8")  # the page draws the present table
    reached = {MissionState.GATHERING}
    for _ in MissionState:
        reached |= {after for state in reached for after in NEXT_STATES[state]}
    assert reached == set(MissionState) - {MissionState.FAILED}


def test_a_log_on_a_full_disk_is_an_error_in_a_sentence():
    with MissionLog(Path("/dev/full"), lambda: 0.0) as log, pytest.raises(RunError, match="full: cannot be written"):
        log.note("state")


def test_a_warning_is_in_the_log_once(tmp_path):
    with MissionLog(tmp_path / "mission.jsonl", lambda: 1.5) as log:
        log.warn(["the clock of B is wrong", "the wheels of C are wrong"])
        log.warn(["the clock of B is wrong"])
    lines = [json.loads(line) for line in (tmp_path / "mission.jsonl").read_text().splitlines()]
    assert [(one["what"], one["text"]) for one in lines] == [
        ("warning", "the clock of B is wrong"),
        ("warning", "the wheels of C are wrong"),
    ]


def test_a_precision_is_told_where_a_pair_is_measured():
    assert str(Precision(40, 0.0123, 0.01)) == "40 points, 12.3 mm, 0.57 deg"
    assert str(Precision(4, math.inf, math.inf, "too few points")) == "4 points"


def recorded(plan, team, folder):
    world = build_world(planned(plan), team=team, fps=10.0, imperfections=Imperfections(noise_px=0.3))
    with atomic_run(folder / "planned.mcap", team) as writer:
        record_world(world, writer, "tracks")
    return open_run(folder / "planned.mcap")


def test_a_stance_is_void_where_the_observer_that_leapt_is_not_measured(tmp_path):
    team, drive = mission_team(4), ((1.2, 0.3), (1.7, -0.3), (1.2, -0.2), (1.7, 0.3))
    stayed = {"A": (0.0, 0.45, -0.2), "B": (0.0, -0.45, 0.2)}
    plan = Plan((
        PlannedStance({**stayed, "C": (-0.5, 0.0, 0.0)}, (), "D", drive, 6.0),
        PlannedStance({**stayed, "C": (-0.5, 0.1, 2.0)}, ("A", "B"), "D", drive, 6.0),
    ))  # fmt: skip
    run, solver = recorded(plan, team, tmp_path), IncrementalSolver(team)
    first, second = run.stances
    everybody = ("A", "B", "C")
    with pytest.raises(RobotError, match="stance 0 measures nothing of C: the observers never see"):
        enter_stance(solver, run, replace(second, index=0, observers=everybody, anchors=()))
    assert isinstance(enter_stance(solver, run, first), EnteredStance)
    with pytest.raises(RobotError, match="stance 1 measures nothing of C: the observers never see"):
        enter_stance(solver, run, replace(second, observers=everybody))
    assert isinstance(enter_stance(solver, run, replace(second, observers=("A", "B"))), EnteredStance)


def test_an_anchor_that_was_pushed_while_it_saw_nothing_is_found_once_it_sees_the_mover_again(tmp_path):
    team = mission_team(4)
    A, B, C, pushed = (0.0, 0.45, -0.2), (0.0, -0.45, 0.2), (-0.5, 0.0, 0.0), (-0.46, 0.03, 0.06)
    ahead = {"A": (0.3, 0.45, -0.2), "B": (0.3, -0.45, 0.2)}
    drive = ((1.2, 0.3), (1.7, -0.3), (1.2, -0.2), (1.7, 0.3))
    plan = Plan((
        PlannedStance({"A": A, "B": B, "C": C}, (), "D", drive, 6.0),
        PlannedStance({"B": B, "C": C, "A": ahead["A"]}, ("B", "C"), "D", drive, 6.0),
        PlannedStance({"A": ahead["A"], "C": C, "B": ahead["B"]}, ("A", "C"), "D", drive, 6.0),
        PlannedStance({**ahead, "C": pushed}, ("A", "B"), "D", drive, 6.0),
    ))  # fmt: skip
    run, solver = recorded(plan, team, tmp_path), IncrementalSolver(team)
    first, *unseen, last = run.stances
    for stance in (first, *(replace(one, observers=("A", "B")) for one in unseen)):
        entered = enter_stance(solver, run, stance)
        assert isinstance(entered, EnteredStance) and "C" in entered.estimate.poses
    (bump,) = enter_stance(solver, run, replace(last, anchors=("A", "B", "C")))
    assert (bump.stay_put.robot, bump.stay_put.after) == ("C", last.index)
    assert bump.T_before_after.rotation().yaw() == pytest.approx(0.06, abs=0.02)
    # as an observer that moved it is where it stands
    assert isinstance(enter_stance(solver, run, replace(last, anchors=("A", "B"))), EnteredStance)
