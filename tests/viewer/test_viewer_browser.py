"""The viewer in a real browser: what a user sees and does."""

# ruff: noqa: F811  the fixtures' names are imported, and are arguments

import http.server
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import viser
from browser import CHROMIUM, browser, client_of, page_of, pixel_of, place_of, until  # noqa: F401  fixtures
from whole_graph import replay

from coloc_graph.cli import main
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.viewer import LivePoses, LiveStance, Viewer, empty_scene, scene_of_result, scene_of_solution, video
from coloc_graph.viewer.panel import NOT_FOLLOWED, set_value

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(result):
    return scene_of_result(result)


def click(page, uv):
    page.mouse.move(*uv)
    page.mouse.down()
    page.mouse.up()


def clicked(page, uv, met):
    """Click until it shows: a page that is still drawing loses a click."""
    for _ in range(6):
        click(page, uv)
        if until(met, 10.0):
            return True
    return False


def on_canvas(client, uv):
    return 20 < uv[0] < client.camera.image_width - 20 and 20 < uv[1] < client.camera.image_height - 20


def middle_of(viewer, edge):
    return viewer.frame.edge_points[viewer.frame.edge_ids == edge][0].mean(axis=0)


def clear_edge(viewer, client):
    """An edge of which the middle is seen with no robot before it, and the pixel there."""
    for edge in viewer.frame.edge_ids.tolist():
        uv = pixel_of(client, middle_of(viewer, edge))
        near = min(np.linalg.norm(uv - pixel_of(client, pose[:3])) for pose in viewer.frame.poses)
        if on_canvas(client, uv) and near > 40:
            return edge, uv
    raise AssertionError("no edge is clear of the robots")


def segments_of(page, node):
    """How many segments of lines the page draws of a node; 0 where it is hidden."""
    return page.evaluate(
        """name => {
            const node = window.__viserMutable.nodeRefFromName[name];
            let count = 0;
            if (node && node.visible) node.traverse(one => {
                count += one.geometry?.attributes?.instanceStart?.count ?? 0;
            });
            return count;
        }""",
        node,
    )


def test_slider_click_and_keys(scene, page_of):
    """One page for all of it, since a page takes seconds to come up."""
    with Viewer(scene, port=0) as viewer:
        page = page_of(viewer.url, "/robots/A")
        client = client_of(viewer)
        assert viewer.wait_idle()
        last, before = viewer.frame.row, place_of(page, "/robots/A")
        assert last == len(scene) - 1

        # the slider moves a robot
        slider = page.get_by_role("slider").first
        slider.focus()
        slider.press("Home")
        assert until(lambda: viewer.frame.row == 0)
        assert until(lambda: np.linalg.norm(np.subtract(place_of(page, "/robots/A"), before)) > 0.5)

        # the space bar plays, and time goes on
        page.locator("canvas").first.focus()
        page.mouse.move(5, 250)
        slider.blur()
        page.keyboard.press("Space")
        assert until(lambda: viewer.panel.play.value)
        played = viewer.panel.time.value
        assert until(lambda: viewer.panel.time.value > played + 5)
        page.keyboard.press("Space")
        assert until(lambda: not viewer.panel.play.value)
        page.keyboard.press("Home")
        assert until(lambda: viewer.frame.row == 0)
        page.keyboard.press("ArrowRight")
        assert until(lambda: viewer.frame.row == 1)

        # the camera follows a robot
        set_value(viewer.panel.follow, "A")
        for row in (2, last):
            viewer.go(row)
            assert until(lambda row=row: viewer.frame.row == row) and viewer.wait_idle()
            assert until(lambda: np.allclose(client.camera.look_at, viewer.frame.poses[0, :3], atol=0.02))
        set_value(viewer.panel.follow, NOT_FOLLOWED)

        # a click on a robot opens its panel
        assert viewer.wait_idle()
        seen = [(n, pixel_of(client, np.add(pose[:3], (0, 0, 0.1)))) for n, pose in enumerate(viewer.frame.poses)]
        number, uv = next((n, uv) for n, uv in seen if on_canvas(client, uv))
        assert clicked(page, uv, lambda: viewer.picked == ("robot", number))
        assert until(lambda: page.get_by_text(f"Robot {scene.robots[number]}, stance {last}").first.is_visible())
        assert until(lambda: page.get_by_text("height [m]").first.is_visible())

        # a click on an edge that was refused, which is dashed, opens the panel that says why
        why = "contradicted by all others"
        edge = clear_edge(viewer, client)[0]
        doubtful = replace(scene.edges, reason=tuple(why if n == edge else "" for n in range(len(scene.edges))))
        assert segments_of(page, "/rejected") == 0
        viewer.pick(None)
        viewer.publish(replace(scene, edges=doubtful))
        assert until(lambda: segments_of(page, "/rejected") == len(viewer.frame.rejected.points) > 1)
        assert until(lambda: not page.get_by_text("height [m]").first.is_visible())
        assert clicked(page, pixel_of(client, middle_of(viewer, edge)), lambda: viewer.picked == ("edge", edge))
        assert until(lambda: page.get_by_text(why).first.is_visible())
        viewer.pick(None)
        viewer.publish(scene)
        assert until(lambda: segments_of(page, "/rejected") == 0)

        # and one on any other opens what was measured
        edge, uv = clear_edge(viewer, client)
        click(page, uv)
        assert until(lambda: viewer.picked == ("edge", edge))
        edges = scene.edges
        title = f"{scene.robots[edges.i[edge]]} - {scene.robots[edges.j[edge]]}, stance {edges.rows[edge]}"
        assert until(lambda: page.get_by_text(title).first.is_visible())
        assert until(lambda: page.get_by_text("decomposition").first.is_visible())
        assert until(lambda: page.get_by_text("inliers").first.is_visible())


OPEN_WEBSOCKET = """([url, protocol]) => new Promise(done => {
    const socket = new WebSocket(url, [protocol]);
    let bytes = 0;
    socket.onmessage = event => { bytes += event.data.size ?? event.data.length; };
    socket.onclose = () => done(["closed", bytes]);
    socket.onopen = () => setTimeout(() => done(["open", bytes]), 2000);
})"""
FETCH = "url => fetch(url).then(answer => answer.status, error => String(error))"


@pytest.fixture
def foreign_page(browser):
    """A page of another origin on this machine, as any web server or program may send one."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<html><body>another page</body></html>")

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        context = browser.new_context()
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        yield page
        context.close()
        server.shutdown()


def test_a_page_of_another_origin_is_refused_and_an_honest_one_goes_on(scene, page_of, foreign_page):
    with Viewer(scene, port=0) as viewer:
        honest = page_of(viewer.url, "/robots/A")
        client_of(viewer)
        protocol = f"viser-v{viser.__version__}"
        root = viewer.url.removesuffix(f"/{viewer.server.token}")
        for address in (root, viewer.url):  # even one that has learnt the token
            socket = address.replace("http:", "ws:")
            assert foreign_page.evaluate(OPEN_WEBSOCKET, [socket, protocol]) == ["closed", 0]
            assert "Failed to fetch" in foreign_page.evaluate(FETCH, address)
        assert len(viewer.server.get_clients()) == 1

        # the same script in the viewer's own page gets the stream
        state, size = honest.evaluate(OPEN_WEBSOCKET, [viewer.url.replace("http:", "ws:"), protocol])
        assert state == "open" and size > 10_000
        slider = honest.get_by_role("slider").first
        slider.focus()
        slider.press("Home")
        assert until(lambda: viewer.frame.row == 0)
        honest.reload()
        assert until(lambda: honest.evaluate("() => window.__viserMutable?.nodeRefFromName?.['/robots/A'] != null"))


def test_a_live_stance_appears_while_one_looks_at_an_old_one(short_solution, page_of):
    run = short_solution.run
    with Viewer(empty_scene(run, "joint"), port=0) as viewer:
        page = page_of(viewer.url)
        entered = []
        replay(short_solution.estimate.graph, "joint", lambda *one: entered.append(LiveStance(*one)))
        for one in entered[:2]:
            viewer.publish(one)
        assert until(lambda: len(viewer.scene) == 2) and viewer.wait_idle()
        assert until(lambda: page.evaluate("() => window.__viserMutable.nodeRefFromName['/robots/A'].visible"))

        # and robots drive on while the next stance is not there yet
        viewer.publish(LivePoses(0.0, {"B": floor_pose(1.25, -0.75, 0.3)}, "stance 2: capturing, 112 points"))
        # three.js has its y axis up: what is x, y, z here is x, z, -y there
        assert until(lambda: np.allclose(np.abs(place_of(page, "/robots/B")), np.abs((1.25, 0.0, 0.75)), atol=1e-3)
                     or np.allclose(place_of(page, "/robots/B"), (1.25, -0.75, 0.0), atol=1e-3))  # fmt: skip
        assert until(lambda: page.get_by_text("stance 2: capturing, 112 points").first.is_visible())

        viewer.go(0)
        assert until(lambda: viewer.frame.row == 0)
        viewer.publish(entered[2])
        assert until(lambda: page.get_by_role("slider").first.get_attribute("aria-valuemax") == "2")
        assert viewer.frame.row == 0
        viewer.publish(scene_of_solution(short_solution))
        assert until(lambda: page.get_by_text("chained").first.is_visible())
        assert viewer.frame.row == 0


def test_a_page_opens_from_its_file_and_plays(scene, page_of, tmp_path):
    path = tmp_path / "view.html"
    with Viewer(scene, port=0) as viewer:
        viewer.export(path)
    assert path.stat().st_size < 3e6
    page = page_of(path.as_uri(), "/robots/A")
    base, number = scene.layers[0], scene.robots.index("A")

    def stands_at(row):
        played.fill(str(row))  # again where its playing on went over it
        time.sleep(0.2)
        return np.allclose(place_of(page, "/robots/A"), base.xyz[number, row], atol=1e-3)

    assert until(lambda: page.get_by_text("anchor of this stance").is_visible())
    played = page.get_by_role("textbox").first
    assert until(lambda: float(played.input_value()) > 0.2)  # by itself
    assert until(lambda: stands_at(len(scene) - 1))
    assert until(lambda: stands_at(0))  # back to the first, where all is hidden and made anew
    visible = "name => window.__viserMutable.nodeRefFromName[name].visible"
    assert until(lambda: page.evaluate(visible, "/robots/A") and page.evaluate(visible, "/floor"))


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine, which renders films")
def test_a_film_moves_from_stance_to_stance(result, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(video, "STANCE_FRAMES", 1)
    monkeypatch.setattr(video, "MAX_STANCES", 2)
    path = tmp_path / "film.mp4"
    assert main(["view", str(result), "--video", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    film = cv2.VideoCapture(str(path))
    frames = []
    while (read := film.read())[0]:
        frames.append(read[1])
    assert len(frames) == 2 + video.HELD_FRAMES and frames[0].shape == (720, 1280, 3)
    assert film.get(cv2.CAP_PROP_FPS) == video.FPS
    differing = (np.abs(frames[0].astype(int) - frames[1]).max(axis=2) > 30).mean()
    assert 0.005 < differing < 0.5  # robots and their edges, not the floor
    assert np.ptp(frames[1][-160:, :300]) > 100  # the legend


def test_a_film_that_cannot_be_is_refused_before_the_work(result, tmp_path, capsys):
    assert main(["view", str(result), "--video", str(tmp_path / "film.avi")]) == 2
    assert "is not the name of a film: give one that ends in .mp4" in capsys.readouterr().err
    (tmp_path / "film.mp4").touch()
    assert main(["view", str(result), "--video", str(tmp_path / "film.mp4")]) == 2
    assert "exists; replace it with --force" in capsys.readouterr().err
