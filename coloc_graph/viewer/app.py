"""The viewer: a server, a panel, and one thread that computes what is shown and alone touches the handles."""

import itertools
import socket
import threading
import time
import traceback
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from coloc_graph.errors import ColocError
from coloc_graph.frontend import PairMeasurement, measure_pair
from coloc_graph.run import Run
from coloc_graph.viewer import inspect
from coloc_graph.viewer.export import page_of
from coloc_graph.viewer.frame import NO_LINES, Frame, Lines, ViewState, frame_of, pick
from coloc_graph.viewer.handles import MOST_NAMES, GraphView, Image, camera_on, initial_camera, seen_size
from coloc_graph.viewer.live import LivePoses, LiveScene, LiveStance
from coloc_graph.viewer.panel import NOBODY, Panel, set_value
from coloc_graph.viewer.scene import Scene
from coloc_graph.viewer.server import open_listener, start_server, stop_server, url_of
from coloc_graph.viewer.worker import Failure, Worker

#: Frames are at least this far apart, so that the server comes to send them; what rests is shown whole after [s].
BETWEEN_FRAMES = 0.03
UNTIL_REST = 0.35
#: Live stances are put together at most this often [s].
BETWEEN_GROWTHS = 0.25
#: Plots are pushed whole, and this often at most while time moves [s].
BETWEEN_PLOTS = 0.15
#: So many pairs are kept that were measured; each holds its tracks.
MOST_MEASURED = 100


class Viewer:
    """Shows a scene to browsers until it is closed; a context manager.

    Callbacks and `publish` only leave a note and wake the render thread.

    Parameters
    ----------
    scene
        The first scene that is shown.
    host, port
        Address to listen on; without a port the first free one from 8080 on.
    dark
        Dark colours.
    listener
        Socket that listens at `host` already, see `open_listener`; the viewer closes it.

    Raises
    ------
    InputError
        If it cannot listen there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        dark: bool = False,
        listener: socket.socket | None = None,
    ) -> None:
        self._scene = scene
        listener = listener or open_listener(host, port)
        self.server = start_server(host, listener, scene.title or "coloc")
        self.url = url_of(host, self.server.get_port(), self.server.token)
        self._asked: deque[tuple[str, float]] = deque()
        self._news: deque[Scene | LiveStance] = deque()
        self._changed = threading.Condition()
        self._awake = True
        self._moved = self._ending = False
        self._now: LivePoses | None = None
        self._idle, self._closed = threading.Event(), threading.Event()
        self._time = scene.middle(len(scene) - 1)
        self._moved_at = 0.0
        self._picked: tuple[str, int] | None = None
        self._followed: tuple[str, Any] | None = None
        self._images: dict[str, Image | None] = {}
        self._ways: tuple[Lines, Lines] = (NO_LINES, NO_LINES)
        self._measured: dict[tuple[int, str, str], PairMeasurement] = {}
        self._live = LiveScene(scene)
        self._grown_at = self._plotted_at = self._aside = 0.0
        self._told: set[str] = set()
        self._note = "; ".join(left_out(scene))
        self.frame: Frame | None = None
        self.frame_seconds = self.frame_cpu_seconds = 0.0
        try:
            compares = any(layer.aside for layer in scene.layers)
            self.panel = Panel(self.server, scene, self._ask, fitting_sigma(scene), compares=compares)
            set_value(self.panel.dark, dark)
            self.view = GraphView(self.server, scene, dark)
            self._dark = False
            initial_camera(self.server, scene)
            self.server.scene.on_click()(self._clicked)
            self.server.on_client_connect(self._greet)
        except BaseException:
            stop_server(self.server)
            raise
        self._worker = Worker(self._wake)
        self._thread = threading.Thread(target=self._run, name="viewer-render", daemon=True)
        self._thread.start()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the threads and the server."""
        if self._ending:
            return
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(timeout=10)
        self._worker.close()
        stop_server(self.server)
        self._closed.set()

    def publish(self, news: Scene | LiveStance | LivePoses) -> None:
        """Show a stance that has just entered, where the robots are now, or another scene of the same robots.

        Costs the caller no work. Of `LivePoses` the newest is shown, to whoever looks at the last stance; a scene ends
        them.
        """
        if isinstance(news, LivePoses):
            with self._changed:
                self._now, self._moved = news, True
                self._changed.notify()
            return
        self._news.append(news)
        self._wake()

    def go(self, row: int) -> None:
        """Show a stance, by its row."""
        self._ask("stance", row)

    def pick(self, what: tuple[str, int] | None) -> None:
        """Pick an edge or a robot, as a click does: ("edge", its number), ("robot", its number)."""
        self._picked = what
        self._wake()

    @property
    def scene(self) -> Scene:
        """What is shown."""
        return self._scene

    def wait_closed(self) -> None:
        """Wait until it is closed from elsewhere, or interrupted by Ctrl-C, which ends the wait without a word."""
        try:
            while not self._closed.wait(0.5):  # a join that is interrupted takes its thread for ended
                pass
        except KeyboardInterrupt:
            return

    def wait_idle(self, timeout: float = 30.0) -> bool:
        """Wait until everything that was asked for is shown, images and all."""
        return self._idle.wait(timeout)

    def html(self) -> str:
        """What is shown, stance by stance, as one HTML page that plays without a server."""
        self.wait_idle()
        return page_of(self._scene, self._state(rests=True))

    def export(self, path: str | Path) -> None:
        """Write that page."""
        Path(path).write_text(self.html(), encoding="utf-8")

    # what callbacks may do

    def _wake(self) -> None:
        with self._changed:
            self._awake = True
            self._idle.clear()
            self._changed.notify()

    def _ask(self, what: str, value: float) -> None:
        self._asked.append((what, value))
        self._wake()

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self.frame is not None:
            self.pick(pick(self.frame, event.ray_origin, event.ray_direction, size=self.view.size))

    def _greet(self, client: viser.ClientHandle) -> None:
        @client.camera.on_update
        def _(_: viser.CameraHandle) -> None:
            if self._size() != self.view.size:
                self._wake()

    def _size(self) -> float:
        """How many times as large as they are robots are drawn, by whoever is nearest."""
        eyes = [(client.camera.position, client.camera.look_at) for client in self.server.get_clients().values()]
        if not eyes:
            first = self.server.initial_camera
            eyes = [(np.asarray(first.position), np.asarray(first.look_at))]
        return seen_size(min(float(np.linalg.norm(eye - at)) for eye, at in eyes))

    # the render thread

    def _run(self) -> None:
        played_at = due = time.perf_counter()
        pending = True
        while True:
            with self._changed:
                playing = self.panel.play.value
                resting = time.perf_counter() - self._moved_at > UNTIL_REST
                if not (playing or self._awake or pending or self._news):
                    self._idle.set()
                more = playing or pending or not resting or bool(self._news)
                wait = 0.0 if playing else max(due - time.perf_counter(), 0.0)
                self._changed.wait_for(
                    lambda: self._awake or self._moved or self._ending, timeout=wait if more else None
                )
                if self._ending:
                    return
                drives = not (playing or self._awake or (more and time.perf_counter() >= due))
                self._awake = self._moved = False
            now, used = time.perf_counter(), time.thread_time()
            try:
                if drives:
                    self._drive()
                else:
                    pending = self._step(now - played_at if playing else 0.0)
            except Exception as error:  # a thread that has died would look like a viewer that hangs
                traceback.print_exc()
                self._notify("The viewer failed", f"{type(error).__name__}: {error}")
                pending = False
            if not drives:
                played_at, due = now, time.perf_counter() + UNTIL_REST
            self.frame_seconds = time.perf_counter() - now
            self.frame_cpu_seconds = time.thread_time() - used
            time.sleep(max(BETWEEN_FRAMES - self.frame_seconds, 0.005))

    def _drive(self) -> None:
        """Move the robots to where they are now, and nothing else."""
        before = self.frame
        if before is None:
            return
        self.frame = self._brought_up_to_date(before)
        with self.server.atomic():
            self.view.place(self.frame.poses)
            self._tell(self.frame)
        self._follow(self.frame)

    def _brought_up_to_date(self, frame: Frame) -> Frame:
        """A frame with the robots where they are now, for whoever looks at the last stance."""
        now, scene = self._now, self._scene
        if now is None or frame.row != len(scene) - 1 or self.panel.play.value:
            return frame
        if unfit := now.unfit(scene.robots):
            self._complain("Not all can be shown", unfit)
        return replace(frame, poses=now.over(scene.robots, frame.poses))

    def _tell(self, frame: Frame) -> None:
        notes = (
            self._now.note if self._now is not None else "",
            frame.note,
            f"robots are drawn {self.view.size:.0f} times as large as they are, to be seen from afar"
            if self.view.size > 1
            else "",
            f"of more than {MOST_NAMES} robots no name is written: click one" if len(frame.roles) > MOST_NAMES else "",
            self._note,
        )
        self.panel.tell(self._scene, frame, self._time, notes)

    def _step(self, played: float) -> bool:
        """One frame; True where another is due, since something rests or is still being made."""
        self._grow()
        self._move(played)
        scene, panel = self._scene, self.panel
        if panel.dark.value != self._dark:
            self._dark = panel.dark.value
            panel.dress(self._dark)
            self.view.dress(scene, self._dark, self._aside)
        if panel.beside.value != bool(self._aside):
            low, high = scene.bounds
            self._aside = float(high[1] - low[1] + 1.0) if panel.beside.value else 0.0
            self.view.dress(scene, self._dark, self._aside)
            self._frame_all()
        self.view.enlarge(self._size())
        rests = time.perf_counter() - self._moved_at > UNTIL_REST
        state = self._state(rests)
        frame = self._brought_up_to_date(frame_of(scene, state))
        waiting = self._look(frame, rests)
        ways = self._ways if panel.markers.value else (NO_LINES, NO_LINES)
        with self.server.atomic():  # the server's thread is woken once, and nothing is shown half
            self.view.apply(frame, state, self._images, *ways)
            self._tell(frame)
            if rests or time.perf_counter() - self._plotted_at > BETWEEN_PLOTS:
                panel.plot(scene, frame.row)
                self._plotted_at = time.perf_counter()
            waiting |= self._inspect(frame)
        self.frame = frame
        self._follow(frame)
        return waiting or not rests

    def _state(self, rests: bool) -> ViewState:
        panel = self.panel
        return ViewState(
            time=self._time,
            shown=panel.shown,
            ellipses=panel.ellipses.value,
            wedges=panel.wedges.value,
            edges=panel.edges.value,
            stays=panel.stays.value,
            sightings=panel.sightings.value,
            odometry=panel.odometry.value,
            k_sigma=float(panel.k_sigma.value),
            picked=self._picked[1] if self._picked and self._picked[0] == "edge" else None,
            aside=self._aside,
            dark=self._dark,
            rests=rests,
        )

    def _grow(self) -> None:
        """Take in what was published."""
        if not self._news or time.perf_counter() - self._grown_at < BETWEEN_GROWTHS:
            return
        at_end = self._scene.row_at(self._time) == len(self._scene) - 1
        grown: Scene | None = None
        while self._news:
            one = self._news.popleft()
            if isinstance(one, Scene):
                grown, self._now, self._note = one, None, "; ".join(left_out(one))
            else:
                self._live.add(one)
                grown = None
                for pair in one.pairs:  # they need not be measured again to be shown
                    h = pair.homography
                    self._measured[h.stance, h.robot_i, h.robot_j] = pair
        first = not len(self._scene)
        try:
            self._scene = grown if grown is not None else self._live.scene()
        except ColocError as error:
            self._notify("A stance cannot be shown", str(error))
            return
        self.view.adopt(self._scene)
        self.view.dress(self._scene, self._dark, self._aside)
        self.panel.adopt(self._scene)
        if at_end:
            self._time = self._scene.middle(len(self._scene) - 1)
        if first and len(self._scene):
            set_value(self.panel.k_sigma, int(fitting_sigma(self._scene)))
            self._frame_all()
        else:
            initial_camera(self.server, self._scene, self._aside)  # of who comes later, and of `reset view`
        self._grown_at = time.perf_counter()

    def _frame_all(self) -> None:
        """Turn all cameras to all of the data."""
        initial_camera(self.server, self._scene, self._aside)
        position, look_at = camera_on(self._scene, self._aside)
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = position, look_at

    def _move(self, played: float) -> None:
        """Time, by what was asked for and by playing."""
        scene, before = self._scene, self._time
        if not len(scene):
            self._asked.clear()
            return
        while self._asked:
            what, value = self._asked.popleft()
            if what == "stance":
                self._time = scene.middle(min(int(value), len(scene) - 1))
            elif what == "time":
                self._time = float(scene.starts[0]) + value
            elif what == "step":
                self._time = scene.middle(int(np.clip(scene.row_at(self._time) + value, 0, len(scene) - 1)))
            elif what == "play":
                set_value(self.panel.play, not self.panel.play.value)
        if played:
            end = float(scene.ends.max())
            self._time += played * self.panel.speed.value
            if self._time > end:
                self._time = float(scene.starts[0]) if before >= end - 1e-6 else end
        if self._time != before:
            self._moved_at = time.perf_counter()

    def _look(self, frame: Frame, rests: bool) -> bool:
        """Images and marker ways of this moment, from the worker; True while some are not there yet."""
        scene, run = self._scene, self._scene.run
        if run is None or not len(scene):
            return False
        waiting = False
        moment = round(self._time, 1)
        for robot in scene.robots:
            image = self._worker.ask(f"image {robot}", moment, partial(_image_in_a_tuple, run, robot, moment))
            waiting |= image is None
            if isinstance(image, Failure):
                self._complain(f"No image of {robot}", image.why)
            elif image is not None:
                self._images[robot] = image[0]
        key = (frame.row, self._dark, id(scene))
        if rests and self.panel.markers.value:
            ways = self._worker.ask("ways", key, lambda: self._marker_ways(scene, frame.row))
            waiting |= ways is None
            self._ways = ways if isinstance(ways, tuple) else (NO_LINES, NO_LINES)
        elif not rests:
            self._ways = (NO_LINES, NO_LINES)
        return waiting

    def _marker_ways(self, scene: Scene, row: int) -> tuple[Lines, Lines]:
        assert scene.run is not None
        stance = scene.stances[row]
        measured = []
        for pair in itertools.combinations(stance.observers, 2):
            one = self._measured.get((stance.index, *pair)) or measure_pair(scene.run, stance, *pair, scene.frontend)
            if len(self._measured) > MOST_MEASURED:
                self._measured.clear()
            self._measured[stance.index, *pair] = one
            measured.append(one)
        return inspect.marker_ways(scene, row, measured, self._dark)

    def _inspect(self, frame: Frame) -> bool:
        """The panel of what was clicked; True while it is being made."""
        scene, picked = self._scene, self._picked
        if picked is None:
            self.panel.inspect("", None)
            return False
        kind, number = picked
        if kind == "robot":
            self.panel.inspect(inspect.robot_report(scene, number, frame.row), None)
            return False
        if (edge := scene.edge(number)) is None:
            self._picked = None
            return False
        found = self._worker.ask("edge", (number, id(scene)), lambda: inspect.examine(*edge))
        if isinstance(found, Failure):
            self.panel.inspect(f"{inspect.edge_report(*edge, None)}\n\n{found.why}", None)
            return False
        self.panel.inspect(inspect.edge_report(*edge, found), found.picture if found else None)
        return found is None

    def _follow(self, frame: Frame) -> None:
        """Move all cameras along with the robot that is followed."""
        robot = self.panel.follow.value
        if robot == NOBODY or robot not in self._scene.robots:
            self._followed = None
            return
        here = frame.poses[self._scene.robots.index(robot), :3]
        if not np.isfinite(here).all():
            return
        before = self._followed
        self._followed = (robot, here)
        for client in self.server.get_clients().values():
            fresh = before is None or before[0] != robot
            shift = here - (client.camera.look_at if fresh else before[1])  # type: ignore[index]
            if np.abs(shift).max() > 1e-6:
                client.camera.position = client.camera.position + shift  # what it looks at moves with it

    def _complain(self, title: str, text: str) -> None:
        """Notify once."""
        if text not in self._told:
            self._told.add(text)
            self._notify(title, text)

    def _notify(self, title: str, text: str) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=15, color="red")


def _image_in_a_tuple(run: Run, robot: str, time: float) -> tuple[Image | None]:
    return (inspect.camera_image(run, robot, time),)  # None alone is what the worker says before it knows


def fitting_sigma(scene: Scene) -> float:
    """So many sigmas that the largest ellipse can be seen and is no larger than a robot's surroundings; 3 at least."""
    if not scene.layers or not scene.layers[0].there.any():
        return 3.0
    covariance = scene.layers[0].covariance[scene.layers[0].there]
    largest = float(np.sqrt(np.nanmax(covariance.trace(axis1=1, axis2=2), initial=0.0)))
    return next((k for k in (100.0, 30.0, 10.0) if k * largest < 0.3), 3.0) if largest > 0 else 3.0


def left_out(scene: Scene) -> list[str]:
    """What a scene cannot show, in words."""
    return [one for one in (*scene.notes, missing_images(scene)) if one]


def missing_images(scene: Scene) -> str:
    """Which observers a run has neither images nor detections of, in words; "" where all is there."""
    if scene.run is None:
        return ""
    observing = {robot for stance in scene.stances for robot in stance.observers}
    blind = [
        robot
        for robot in scene.robots
        if robot in observing and not scene.run.has_images(robot) and not scene.run.has_detections(robot)
    ]
    return (
        f"the run holds neither images nor detections of {', '.join(blind)}, so that these see nothing" if blind else ""
    )
