"""The viewer: a server, its controls, and the thread that renders."""

import socket
import threading
from pathlib import Path

import viser

from coloc_graph.viewer.details import Picked
from coloc_graph.viewer.export import page_of
from coloc_graph.viewer.frame import Frame, ViewState, pick
from coloc_graph.viewer.inbox import Inbox
from coloc_graph.viewer.live import LivePoses, LiveStance
from coloc_graph.viewer.panel import Panel, set_value
from coloc_graph.viewer.prepared import readable_sigma
from coloc_graph.viewer.renderer import Renderer
from coloc_graph.viewer.scene import Scene, ShownPlan
from coloc_graph.viewer.server import open_listener, start_server, stop_server, url_of

CLOSE_TIMEOUT = 10.0  # s, for the render thread to end


class Viewer:
    """Viewer of a scene in browsers until it is closed; a context manager.

    Parameters
    ----------
    scene
        The first scene.
    host, port
        Address to listen on; without a port the first free one from 8080 on.
    dark
        Dark colours.
    listener
        Socket that listens at `host` already, see `open_listener`; the viewer closes it.

    Attributes
    ----------
    url
        Address for a browser. It holds a token: whoever has it can see and control the viewer.

    Raises
    ------
    InputError
        It cannot listen there.
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
        listener = listener or open_listener(host, port)
        self.server = start_server(host, listener, scene.title or "coloc")
        self.url = url_of(host, self.server.get_port(), self.server.token)
        self._inbox, self._closed = Inbox(), threading.Event()
        try:
            compares = any(layer.aside for layer in scene.layers)
            self.panel = Panel(self.server, scene, self._inbox.request, readable_sigma(scene), compares=compares)
            set_value(self.panel.dark, dark)
            self._renderer = Renderer(self.server, scene, self.panel, self._inbox, dark=dark)
            self.view = self._renderer.view
            self.server.scene.on_click()(self._clicked)
            self._renderer.cameras.on_size_change(lambda: self.view.size, self._inbox.wake)
        except BaseException:
            stop_server(self.server)
            raise
        self._thread = threading.Thread(target=self._renderer.run, name="viewer-render", daemon=True)
        self._thread.start()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the threads and the server."""
        if self._closed.is_set():
            return
        self._inbox.close()
        self._thread.join(timeout=CLOSE_TIMEOUT)
        self._renderer.details.close()
        stop_server(self.server)
        self._closed.set()

    def publish(self, item: Scene | LiveStance | LivePoses | ShownPlan) -> None:
        """Show a new stance, a plan of the next one, the robots' current poses, or another scene of the same robots.

        Returns at once. Of `LivePoses` the newest is shown while the last stance is shown; a scene ends them.
        """
        self._inbox.publish(item)

    def go(self, row: int) -> None:
        """Show a stance, by its row."""
        self._inbox.request("stance", row)

    def pick(self, what: Picked | None) -> None:
        """Pick an edge or a robot, as a click does: ("edge", its number), ("robot", its number); None for nothing."""
        self._renderer.picked = what
        self._inbox.wake()

    @property
    def scene(self) -> Scene:
        """The scene that is shown."""
        return self._renderer.scene

    @property
    def frame(self) -> Frame | None:
        """The frame that is shown; None before the first."""
        return self._renderer.frame

    @property
    def picked(self) -> Picked | None:
        """The edge or the robot that was clicked."""
        return self._renderer.picked

    @property
    def notifications(self) -> frozenset[str]:
        """Texts of the notifications that are shown once."""
        return frozenset(self._renderer.notifications.shown)

    @property
    def frame_seconds(self) -> float:
        """Time that the last frame took [s]."""
        return self._renderer.frame_seconds

    @property
    def frame_cpu_seconds(self) -> float:
        """CPU time that the last frame took [s]."""
        return self._renderer.frame_cpu_seconds

    def go_to(self, time: float) -> None:
        """Show an instant [s] of the scene's clock, between stances too."""
        # the panel's time is since the first stance
        self._inbox.request("time", time - float(self.scene.starts[0]))

    @property
    def state(self) -> ViewState:
        """State of the controls."""
        return self._renderer.state(rests=True)

    @property
    def caption(self) -> str:
        """Title of the scene, with the stance that is shown and its time since the first."""
        frame, scene = self.frame, self.scene
        if frame is None or frame.row < 0:
            return scene.title
        since = scene.middle(frame.row) - scene.middle(0)
        return f"{scene.title}: stance {scene.stances[frame.row].index}, {since:.0f} s"

    def wait_closed(self) -> None:
        """Wait until the viewer is closed by another thread, or interrupted by Ctrl-C, which ends the wait silently."""
        try:
            while not self._closed.wait(0.5):  # an interrupted join would mark its thread as ended
                pass
        except KeyboardInterrupt:
            return

    def wait_idle(self, timeout: float = 30.0) -> bool:
        """Wait until everything that was requested is shown, images included."""
        return self._inbox.idle.wait(timeout)

    def html(self) -> str:
        """Make an HTML page of the scene that plays stance by stance without a server."""
        self.wait_idle()
        return page_of(self.scene, self._renderer.state(rests=True))

    def export(self, path: str | Path) -> None:
        """Write this page to a file."""
        Path(path).write_text(self.html(), encoding="utf-8")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if self.frame is not None:
            self.pick(pick(self.frame, event.ray_origin, event.ray_direction, size=self.view.size))
