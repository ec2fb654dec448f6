"""Export of a scene to one HTML page that plays without a server: viser's recording, with a legend."""

import html
import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coloc_graph.errors import ColocError
from coloc_graph.viewer import inspect, palette
from coloc_graph.viewer.cameras import camera_on, initial_camera, seen_size
from coloc_graph.viewer.frame import Frame, ViewState, frame_of, thinned_rows
from coloc_graph.viewer.handles import GraphView, Image
from coloc_graph.viewer.panel import legend
from coloc_graph.viewer.scene import Scene
from coloc_graph.viewer.server import open_listener, start_server, stop_server

STANCE_SECONDS = 1.0  # s per stance, less in a long run
MAX_SECONDS = 60.0  # s for all stances
HELD_SECONDS = 3.0  # s for the last stance
STEP_SECONDS = 0.1  # s between steps of the animation
MAX_STANCES = 240  # stances that are played; of more a selection
MAX_STANCES_IN_FULL = 80  # stances up to which each has its images, and trails in each step
CAPTION_HEIGHT = 0.9  # m over the team, of the stance's number
CAPTION_SHARE = 0.1  # share of the camera's distance that it is at least over the team


def page_of(scene: Scene, state: ViewState) -> str:
    """Make the page of a scene, from the first stance to the last, with the contents that `state` switches on.

    Clicks, switches, plots and marker trajectories need a server, and are not in it.
    """
    rows = thinned_rows(len(scene) - 1, MAX_STANCES)
    full = len(rows) <= MAX_STANCES_IN_FULL
    state = replace(state, picked=None, rests=full)
    bare = replace(state, shown=frozenset(), ellipses=False, wedges=False, edges=False, stays=False)
    each = min(STANCE_SECONDS, MAX_SECONDS / max(len(rows), 1))
    steps = max(round(each / STEP_SECONDS), 2)
    server = start_server("127.0.0.1", open_listener(port=0), scene.title)
    try:
        view = GraphView(server, scene, state.dark)
        view.fit_floor(scene, state.dark, state.aside)
        initial_camera(server, scene, state.aside)
        eye, at = camera_on(scene, state.aside)
        distance = float(np.linalg.norm(eye - at))
        view.enlarge(seen_size(distance))
        height = max(CAPTION_HEIGHT, CAPTION_SHARE * distance)
        caption = server.scene.add_label("/stance", "", anchor="bottom-center")

        def show(time: float, images: dict[str, Image | None] | None = None) -> Frame:
            frame = frame_of(scene, replace(state, time=time))
            view.apply(frame, state, images)
            caption.text, caption.position = _caption(scene, frame, height)
            return frame

        frame = show(scene.middle(0), _images(scene, 0))
        recording = server.get_scene_serializer()  # it begins with what there is by now
        for now, then in itertools.pairwise(rows.tolist()):
            for time in np.linspace(scene.middle(now), scene.middle(then), steps + 1)[1:-1].tolist():
                recording.insert_sleep(each / steps)
                if full:
                    show(time)
                else:
                    view.move_robots(frame_of(scene, replace(bare, time=time)).poses)
            recording.insert_sleep(each / steps)
            frame = show(scene.middle(then), _images(scene, then) if full else None)
        if len(rows) > 1:
            recording.insert_sleep(HELD_SECONDS)
        page = recording.as_html(dark_mode=state.dark)
    finally:
        stop_server(server)
    played = f"{len(rows)} of {len(scene):,} stances are played" if len(rows) < len(scene) else ""
    enlarged = f"robots are drawn {view.size:.0f} times as large as they are" if view.size > 1 else ""
    return _with_legend(page, scene, state, [played, frame.note.partition(";")[0], enlarged])


def _images(scene: Scene, row: int) -> dict[str, Image | None]:
    if scene.run is None:
        return {}
    found: dict[str, Image | None] = {}
    for robot in scene.robots:
        try:
            found[robot] = inspect.camera_image(scene.run, robot, scene.middle(row))
        except ColocError:  # the viewer reports it
            found[robot] = None
    return found


def _caption(scene: Scene, frame: Frame, height: float) -> tuple[str, tuple[float, float, float]]:
    """Caption with the number of the stance, and its position over the middle of the team."""
    there = frame.poses[np.isfinite(frame.poses).all(axis=1), :2]
    if frame.row < 0 or not len(there):
        return "", (0.0, 0.0, height)
    x, y = there.mean(axis=0)
    return f"stance {scene.stances[frame.row].index}", (float(x), float(y), height)


def _with_legend(page: str, scene: Scene, state: ViewState, notes: Sequence[str]) -> str:
    """Add title and a folding legend to a page."""
    title = html.escape(scene.title or "coloc-graph")
    ink, paper = (f"rgb({r},{g},{b})" for r, g, b in (palette.ink(state.dark), palette.paper(state.dark)))
    lines = (f"ellipses and wedges: {state.k_sigma:g} sigma", *notes)
    box = (
        '<details open style="position:fixed;z-index:5;bottom:56px;left:10px;max-width:300px;padding:.4em .7em;'
        f'border-radius:6px;font:14px/1.4 sans-serif;color:{ink};background:{paper};opacity:.9">'
        f'<summary style="cursor:pointer"><b>{title}</b></summary>{legend(scene)}'
        f'<div style="font-size:.8em;padding:0 .8em">{"<br>".join(line for line in lines if line)}</div></details>'
    )
    head, tail = page.rsplit("</body>", 1)
    return f"{head}{box}</body>{tail}".replace("<title>Viser</title>", f"<title>{title}</title>", 1)
