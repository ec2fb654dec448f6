"""The render thread: computes each frame from scene, controls and inbox; only it uses the handles."""

import time
import traceback
from dataclasses import replace

import viser

from coloc_graph.errors import ColocError
from coloc_graph.viewer.cameras import Cameras, initial_camera
from coloc_graph.viewer.details import Details, Picked
from coloc_graph.viewer.frame import NO_LINES, Frame, ViewState, frame_of
from coloc_graph.viewer.handles import MAX_NAMES, GraphView
from coloc_graph.viewer.inbox import Inbox, Work
from coloc_graph.viewer.live import LiveScene
from coloc_graph.viewer.notes import Notifications, missing_parts
from coloc_graph.viewer.panel import Panel, set_value
from coloc_graph.viewer.plans import planned_note
from coloc_graph.viewer.playback import REST_DELAY, Playback
from coloc_graph.viewer.prepared import readable_sigma
from coloc_graph.viewer.scene import Scene, ShownPlan

FRAME_INTERVAL = 0.03  # s between frames, so that the server has time to send them
GROWTH_INTERVAL = 0.12  # s between scenes made of live stances, or published
PLOT_INTERVAL = 0.15  # s between plots while time moves; each is sent as a whole


class Renderer:
    """Loop that keeps the frame up to date.

    Attributes
    ----------
    scene, frame
        The last ones shown; the frame is None before the first.
    frame_seconds, frame_cpu_seconds
        Time that the last frame took, on the clock and on the processor [s].
    picked
        The edge or the robot that was clicked.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, panel: Panel, inbox: Inbox, *, dark: bool) -> None:
        self.scene = scene
        self.view = GraphView(server, scene, dark)
        self.cameras = Cameras(server)
        self.notifications = Notifications(server)
        self.frame: Frame | None = None
        self.frame_seconds = self.frame_cpu_seconds = 0.0
        self.picked: Picked | None = None
        self._server, self._panel, self._inbox = server, panel, inbox
        self._playback = Playback(scene)
        self._live = LiveScene(scene)
        self._note = "; ".join(missing_parts(scene))
        self._dark = False
        self._aside = self._grown_at = self._plotted_at = 0.0
        initial_camera(server, scene)
        self.details = Details(inbox.wake)

    def run(self) -> None:
        """Make frames until the inbox is closed."""
        played_at = due = time.perf_counter()
        is_pending = True
        while True:
            is_playing = self._panel.play.value
            work = self._inbox.wait(
                is_playing=is_playing, is_pending=is_pending, is_at_rest=self._playback.is_at_rest, due=due
            )
            if work is Work.CLOSE:
                return
            now, used = time.perf_counter(), time.thread_time()
            try:
                if work is Work.POSES:
                    self._move_robots()
                else:
                    is_pending = self._step(now - played_at if is_playing else 0.0)
            except Exception as error:  # a dead thread would look like a viewer that hangs
                traceback.print_exc()
                self.notifications.show("The viewer failed", f"{type(error).__name__}: {error}")
                is_pending = False
            if work is Work.FRAME:
                played_at, due = now, time.perf_counter() + REST_DELAY
            self.frame_seconds = time.perf_counter() - now
            self.frame_cpu_seconds = time.thread_time() - used
            time.sleep(max(FRAME_INTERVAL - self.frame_seconds, 0.005))

    def state(self, *, rests: bool) -> ViewState:
        """State of the controls."""
        panel = self._panel
        return ViewState(
            time=self._playback.time,
            shown=panel.shown,
            ellipses=panel.ellipses.value,
            wedges=panel.wedges.value,
            edges=panel.edges.value,
            stays=panel.stays.value,
            sightings=panel.sightings.value,
            odometry=panel.odometry.value,
            plans=panel.plans.value,
            k_sigma=float(panel.k_sigma.value),
            picked=self.picked[1] if self.picked and self.picked[0] == "edge" else None,
            aside=self._aside,
            dark=self._dark,
            rests=rests,
        )

    def _step(self, played: float) -> bool:
        """Make one frame; True if another is due, since time is not at rest or something is still being made."""
        self._grow()
        scene, panel, details = self.scene, self._panel, self.details
        self._playback.advance(scene, panel, self._inbox.take_requests(), played)
        self._dress()
        self.view.enlarge(self.cameras.size())
        rests = self._playback.is_at_rest
        state = self.state(rests=rests)
        frame = self._with_live_poses(frame_of(scene, state))
        is_waiting = details.look_up_images(scene, state.time, self.notifications.show_once)
        wants_markers = panel.markers.value
        is_waiting |= details.look_up_markers(scene, frame.row, dark=self._dark, rests=rests, wanted=wants_markers)
        marker_lines = details.marker_lines if wants_markers else (NO_LINES, NO_LINES)
        with self._server.atomic():  # the server's thread is woken once, and nothing is shown half
            self.view.apply(frame, state, details.images, *marker_lines)
            self._tell(frame)
            if rests or time.perf_counter() - self._plotted_at > PLOT_INTERVAL:
                panel.plot(scene, frame.row)
                self._plotted_at = time.perf_counter()
            is_waiting |= self._report(frame)
        self.frame = frame
        self.cameras.follow(panel.follow.value, scene, frame)
        return is_waiting or not rests

    def _move_robots(self) -> None:
        """Move the robots to their live poses, and nothing else."""
        if self.frame is None:
            return
        self.frame = self._with_live_poses(self.frame)
        with self._server.atomic():
            self.view.move_robots(self.frame.poses)
            self._tell(self.frame)
        self.cameras.follow(self._panel.follow.value, self.scene, self.frame)

    def _with_live_poses(self, frame: Frame) -> Frame:
        """A frame with the robots at their live poses, if it is of the last stance."""
        live, scene = self._inbox.live_poses, self.scene
        if live is None or frame.row != len(scene) - 1 or self._panel.play.value:
            return frame
        if problems := live.problems(scene.robots):
            self.notifications.show_once("Not all can be shown", problems)
        return replace(frame, poses=live.over(scene.robots, frame.poses))

    def _tell(self, frame: Frame) -> None:
        """Bring sliders and notes up to date."""
        size, live = self.view.size, self._inbox.live_poses
        notes = (
            live.note if live is not None else "",
            frame.note,
            planned_note(self.scene, frame.row) if self._panel.plans.value else "",
            f"robots are drawn {size:.0f} times as large as they are, to be visible from afar" if size > 1 else "",
            f"names of more than {MAX_NAMES} robots are not shown: click one" if len(frame.roles) > MAX_NAMES else "",
            self._note,
        )
        self._panel.show_status(self.scene, frame, self._playback.time, notes)

    def _report(self, frame: Frame) -> bool:
        """Bring the panel of the clicked item up to date; True while it is being made."""
        picked = self.picked
        report = self.details.report(self.scene, picked, frame.row) if picked else ("", None, False)
        if report is None:
            self.picked = None
            return False
        text, picture, is_waiting = report
        self._panel.inspect(text, picture)
        return is_waiting

    def _dress(self) -> None:
        """Follow the switches for dark colours and for results side by side."""
        scene, panel = self.scene, self._panel
        if panel.dark.value != self._dark:
            self._dark = panel.dark.value
            panel.set_theme(dark=self._dark)
            self.view.fit_floor(scene, self._dark, self._aside)
        if panel.beside.value != bool(self._aside):
            low, high = scene.bounds
            self._aside = float(high[1] - low[1] + 1.0) if panel.beside.value else 0.0
            self.view.fit_floor(scene, self._dark, self._aside)
            self.cameras.frame_all(scene, self._aside)

    def _grow(self) -> None:
        """Add published stances and scenes; where the last stance was shown, show the new one."""
        if not self._inbox.has_published or time.perf_counter() - self._grown_at < GROWTH_INTERVAL:
            return
        was_at_end = self.scene.row_at(self._playback.time) == len(self.scene) - 1
        whole: Scene | None = None
        for item in self._inbox.take_published():
            if isinstance(item, Scene):
                whole, self._inbox.live_poses, self._note = item, None, "; ".join(missing_parts(item))
            elif isinstance(item, ShownPlan):
                self._live.add_plan(item)
                whole = None
            else:
                self._live.add(item)
                self.details.keep(item.pairs)
                whole = None
        is_first = not len(self.scene)
        try:
            scene = self.scene = whole if whole is not None else self._live.scene()
        except ColocError as error:
            self.notifications.show("A stance cannot be shown", str(error))
            return
        self.view.adopt(scene)
        self.view.fit_floor(scene, self._dark, self._aside)
        self._panel.adopt(scene)
        if was_at_end:
            self._playback.time = scene.middle(len(scene) - 1)
        if is_first and len(scene):
            set_value(self._panel.k_sigma, int(readable_sigma(scene)))
            self.cameras.frame_all(scene, self._aside)
        else:
            initial_camera(self._server, scene, self._aside)  # for later browsers, and for `reset view`
        self._grown_at = time.perf_counter()
