"""Show a mission in the viewer while it runs, and its result at the end."""

import logging
import sys
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from coloc_graph.online.leap_planner import StancePlan
    from coloc_graph.online.mission import MissionStatus
    from coloc_graph.pipeline.incremental import EnteredStance
    from coloc_graph.team import Team


log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class MissionListener:
    """Callbacks of a mission for `Coordinator`, None without a viewer."""

    on_stance: "Callable[[EnteredStance], None] | None" = None
    on_status: "Callable[[MissionStatus], None] | None" = None
    on_plan: "Callable[[StancePlan], None] | None" = None


@contextmanager
def watched(team: "Team", port: int | None, *, browser: bool, view: bool = True) -> Iterator[MissionListener]:
    """Show a mission in a viewer while it runs; yield its callbacks, which are None without `view`."""
    if not view:
        yield MissionListener()
        return
    from coloc_graph.cli.view import take_port
    from coloc_graph.viewer import LivePoses, LiveStance, Scene, Viewer
    from coloc_graph.viewer.plans import plan_of_row

    scene = Scene(team.names, (), team=team, title="a mission")
    with take_port(port, say=log.info) as listener, Viewer(scene, listener=listener) as viewer:
        log.info("the viewer is at %s", viewer.url)
        if browser and sys.stdout.isatty():
            webbrowser.open(viewer.url)
        yield MissionListener(
            lambda one: viewer.publish(LiveStance(one.stance, one.estimate, one.measurements)),
            lambda one: viewer.publish(LivePoses(one.time, one.T_world_body, one.text)),
            lambda one: viewer.publish(plan_of_row(one.as_row())) if one.promise is not None else None,
        )


@contextmanager
def published(team: "Team", address: str | None) -> Iterator[MissionListener]:
    """Publish a mission to ROS 2 on an interface; yield its callbacks, which are None without an address."""
    if address is None:
        yield MissionListener()
        return
    from coloc_graph.exchange.ros_live import RosPublisher

    with RosPublisher(team, address) as publisher:

        def on_stance(one: "EnteredStance") -> None:
            publisher.publish_stance(one.stance.index, _poses(one))

        yield MissionListener(on_stance, lambda one: publisher.publish_poses(one.time, one.T_world_body))


def _poses(one: "EnteredStance") -> "dict[str, tuple[float, NDArray[np.float64], NDArray[np.float64]]]":
    """Time [UTC s], pose and covariance of each observer of a stance, and of each mover that was sighted at rest."""
    from coloc_graph.measurements import Sighting

    times = dict.fromkeys(one.stance.observers, one.stance.start)
    times |= {seen.seen: seen.time for seen in one.measurements if isinstance(seen, Sighting)}
    estimate = one.estimate
    return {
        robot: (times[robot], pose.matrix(), estimate.covariances[robot])
        for robot, pose in estimate.poses.items()
        if robot in times
    }


def both(first: MissionListener, second: MissionListener) -> MissionListener:
    """Callbacks that call those of two listeners."""
    return MissionListener(
        _in_turn(first.on_stance, second.on_stance),
        _in_turn(first.on_status, second.on_status),
        _in_turn(first.on_plan, second.on_plan),
    )


def _in_turn(*callbacks: "Callable[[T], None] | None") -> "Callable[[T], None] | None":
    given = [one for one in callbacks if one is not None]
    if len(given) < 2:
        return given[0] if given else None

    def call(value: T) -> None:
        for one in given:
            one(value)

    return call


def report(folder: Path, truth_path: Path | None = None, *, stopped: bool = False) -> bool:
    """Solve the record of a mission again as online, write the result beside it, and print it.

    If a signal `stopped` the mission and nobody reads stdout, nothing is printed, so that the program ends. Return
    whether the result was printed.
    """
    from coloc_graph.cli.accuracy import print_accuracy, print_calibration, print_last_poses, print_promised
    from coloc_graph.cli.printing import warn
    from coloc_graph.cli.running import output_is_read
    from coloc_graph.pipeline.batch import SolveOptions, solve
    from coloc_graph.results.writer import assess, write_result
    from coloc_graph.run import open_run

    solution = solve(open_run(folder / "run.mcap"), SolveOptions(incremental=True))
    write_result(solution, folder / "result")
    if stopped and not output_is_read():
        return False
    warn(solution.warnings)
    assessed = None if truth_path is None else assess(solution, truth_path)
    if assessed is None:
        print_last_poses(solution.estimate.trajectories)
    else:
        warn(assessed[0].warnings)
        print_accuracy(assessed[0])
        print_promised(solution.estimate.trajectories)
    print_calibration(solution.estimate.calibration)
    estimate = solution.estimate
    agreement = f", chi2/dof {estimate.chi2 / estimate.dof:.2f}" if estimate.dof > 0 else ""
    stances = len(solution.run.stances)
    print(f"{stances} stances{agreement}; record: {folder / 'run.mcap'}; result: {folder / 'result'}")
    return True
