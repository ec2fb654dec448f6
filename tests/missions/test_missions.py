"""Whole missions on simulated time: shipped programs, all that is promised of them checked, faults from a seed."""

import json
import re
from functools import cache

import pytest

from coloc_graph.missions import mission
from coloc_graph.missions.faults import COORDINATOR, Fault
from coloc_graph.missions.mission import Scenario, run_mission, scenario_of
from coloc_graph.online import coordinator, journal, mission_folder
from coloc_graph.online.estimation_worker import enter_stance
from coloc_graph.online.journal import Journal
from coloc_graph.online.record import Record, continued
from coloc_graph.online.resume import restore
from coloc_graph.online.robot_registry import RobotRegistry
from coloc_graph.run import Detections

#: Outcome of the mission of a seed, run once.
outcome_of = cache(run_mission)
#: Seeds of short missions with random faults, and of those of `make test-long`; `make search` runs any number.
SEEDS = range(1, 4)
LONG_SEEDS = range(20_000, 20_200)


def test_a_seed_is_one_mission_byte_for_byte():
    first, second = outcome_of(scenario_of(1, 1, faults=3)), run_mission(scenario_of(1, 1, faults=3))
    assert first.digest == second.digest and first.seconds == second.seconds
    assert outcome_of(scenario_of(2, 1, faults=3)).digest != first.digest


def broken(outcome):
    """Promises that a mission broke, with its faults; None if it kept them and ended."""
    if outcome.violations or outcome.state not in ("done", "failed"):
        return "\n".join([f"seed {outcome.scenario.seed}:", *outcome.violations, *map(str, outcome.scenario.faults)])
    return None


@pytest.mark.parametrize("seed", SEEDS)
def test_promises_hold_whatever_happens(seed):
    assert not (found := broken(outcome_of(scenario_of(seed, 1, faults=3)))), found


@pytest.mark.long
def test_promises_hold_in_hundreds_of_missions():
    found = [broken(run_mission(scenario_of(seed, 2, faults=6))) for seed in LONG_SEEDS]
    assert not any(found), "\n".join(one for one in found if one)


#: The coordinator is killed amid its first estimate, and after it, while the mover is on its way.
KILLED_TWICE = [
    Fault(5.0, "kill", COORDINATOR, 0.5, state="estimating", late=0.1),
    Fault(21.0, "kill", COORDINATOR, 0.5, state="placing", late=1.0),
]
#: Faults of a mission in whose midst they happen, by what they are about.
DIRECTED = {
    "the coordinator is killed twice": KILLED_TWICE,
    "the mover's line is unplugged, for a moment and for long": [
        Fault(7.6, "unplug", "C", 0.06),
        Fault(14.0, "unplug", "C", 12.0),
    ],
    "the mover's program is killed": [Fault(7.6, "kill", "C", 1.5)],
    "all links are cut": [Fault(7.6, "cut", name, 3.0) for name in "ABC"],
    "processes are stopped": [Fault(7.6, "stop", "C", 1.0), Fault(12.0, "stop", COORDINATOR, 3.0)],
    "main loops hang": [Fault(7.6, "hang", COORDINATOR, 1.5), Fault(14.0, "hang", "C", 1.5)],
    "the coordinator's disk is full": [
        Fault(8.0, "full", COORDINATOR, 6.0),
        Fault(16.0, "full", COORDINATOR, 2.0, state="estimating", late=0.1),  # and of all that hold
        Fault(22.0, "cut", "A", 1.0),
        Fault(22.1, "full", COORDINATOR, 2.0, state="holding"),
    ],
    "a network loses, repeats and delays": [
        Fault(1.0, kind, name, 20.0, amount)
        for name in "ABC"
        for kind, amount in (("loss", 0.2), ("duplication", 0.3), ("delay", 0.05))
    ],
}


@pytest.mark.parametrize("what", DIRECTED)
def test_promises_hold_when(what):
    outcome = run_mission(Scenario(5, 2, tuple(DIRECTED[what])))
    assert outcome.state == "done" and not outcome.violations, (outcome.violations, outcome.log)
    # what happens is what was drawn, and poses are those of the robots
    assert any("No space left on device" in line for line in outcome.log) == ("disk" in what)
    nees, freedom = outcome.nees
    assert freedom == 6 and nees < 30  # chi2 exceeds this by chance in 4 of 100,000


def test_four_robots_go_on_where_two_observers_share_the_view(tmp_path):
    outcome = run_mission(Scenario(1, 3, formation="plan", robots=4), tmp_path)
    assert outcome.state == "done" and not outcome.violations and outcome.attempts == outcome.entered == 3
    nees, freedom = outcome.nees
    assert freedom == 9 and nees < 40  # of those that stood and saw nothing, too; exceeded in 1 of 100,000
    rows = [json.loads(line) for line in (tmp_path / "mission" / "mission.jsonl").read_text().splitlines()]
    _, *later = (row for row in rows if row["what"] == "planned")
    entered = {row["stance"]: row for row in rows if row["what"] == "entered"}
    for plan in later:
        leaper, anchors = plan["leap"][0], set(entered[plan["stance"]]["anchors"])
        assert leaper in plan["watching"] and anchors == {"A", "B", "C"} - {leaper} and anchors & set(plan["watching"])
    assert any(len(plan["watching"]) == 2 for plan in later)
    assert len({plan["leap"][0] for plan in later}) == 2


def without_follow(monkeypatch):
    def restored(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(RobotRegistry, "follow", lambda *_: None)
            return restore(*arguments)

    monkeypatch.setattr(coordinator, "restore", restored)


def without_images(monkeypatch):
    take = Record.take

    def copied(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(Record, "take", lambda self, one: one if isinstance(one, Detections) else take(self, one))
            return continued(*arguments)

    monkeypatch.setattr(mission_folder, "continued", copied)


def with_last_attempt(monkeypatch):
    began = Journal.__init__

    def begin(self, run, attempts):
        began(self, run, attempts)
        self.attempts += [one for one in attempts[-1:] if one not in self.attempts]

    monkeypatch.setattr(Journal, "__init__", begin)


def without_retakes(monkeypatch):
    monkeypatch.setattr(journal, "enter_stance", lambda *some, **more: enter_stance(*some, **{**more, "retake": False}))


TWICE = Scenario(0, 2, tuple(KILLED_TWICE))
#: An observer is pushed amid a stance, which is taken again, and the coordinator killed after that.
PUSHED = Scenario(
    1,
    2,
    (
        Fault(12.0, "push", "A", 1.0, 0.1, state="capturing", late=0.6),
        Fault(19.0, "kill", COORDINATOR, 0.5, state="placing", late=0.3),
    ),
)
#: What is broken on purpose at a resume, the promise that this breaks, a mission, and its time until then [s].
BREAKS = {
    "the registry is not restored": (
        lambda patch: patch.setattr(RobotRegistry, "restore", lambda _: None),
        "from where the coordinator has it",
        TWICE,
        27.0,
    ),
    "images of the stance under way are lost": (without_images, "lacks images of A", TWICE, 40.0),
    "poses do not follow the estimate": (without_follow, "from where the last stance has it", TWICE, 27.0),
    "an attempt that was not decided enters": (with_last_attempt, r"has the stances \[1\]", TWICE, 40.0),
    "an attempt enters that was to be taken again": (without_retakes, "another one when it is replayed", PUSHED, 50.0),
    "the last stance is forgotten": (
        lambda patch: patch.setattr(coordinator, "restore", lambda *arguments: restore(*arguments)[:-1]),
        "stance 0 is planned though stance 0 has entered",
        TWICE,
        27.0,
    ),
}


@pytest.mark.parametrize("what", BREAKS)
def test_what_is_broken_on_purpose_is_noticed(what, monkeypatch):
    break_it, promise, scenario, limit = BREAKS[what]
    break_it(monkeypatch)
    monkeypatch.setattr(mission, "LIMIT", limit)
    violations = run_mission(scenario).violations
    assert any(re.search(promise, one) for one in violations), violations
