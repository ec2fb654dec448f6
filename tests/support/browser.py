"""A real Chromium without a window, for the tests of the viewer; they skip where there is none."""

import contextlib
import time

import numpy as np
import pytest

from coloc_graph.viewer.browser import ARGUMENTS, find_browser

CHROMIUM = find_browser()
SIZE = (900, 500)
NODE = "name => window.__viserMutable?.nodeRefFromName?.[name] != null"


@pytest.fixture(scope="session")
def browser():
    """One browser for all tests."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine (Debian: apt-get install chromium fonts-dejavu-core)")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install playwright)")
    with sync_api.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield chromium
        chromium.close()


@pytest.fixture
def page_of(browser):
    """Opens a page of an address and waits until a node is in its scene; no request may fail, no script break."""
    problems, contexts = [], []

    def open_page(url, node="/floor"):
        context = browser.new_context(viewport={"width": SIZE[0], "height": SIZE[1]})
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("requestfailed", lambda request: problems.append(f"{request.url[:200]} failed"))
        page.goto(url if url.startswith("file:") else f"{url}/?fixedDpr=1")
        page.wait_for_function(NODE, arg=node, timeout=60_000)
        page.add_style_tag(content=".mantine-Notifications-root{display:none!important}")
        return page

    yield open_page
    for context in contexts:
        with contextlib.suppress(Exception):
            context.close()
    assert not problems, problems


def until(what, timeout=60.0):
    """Whether something comes true in time."""
    ends = time.monotonic() + timeout
    while time.monotonic() < ends:
        if what():
            return True
        time.sleep(0.05)
    return False


def client_of(viewer):
    """The browser's end, once its camera is where the viewer has it begin: a page connects with another one."""
    assert until(viewer.server.get_clients)
    client = next(iter(viewer.server.get_clients().values()))
    first = viewer.server.initial_camera
    assert until(lambda: np.allclose(client.camera.position, first.position, atol=0.05))
    assert until(lambda: np.allclose(client.camera.look_at, first.look_at, atol=0.05))
    return client


def pixel_of(client, point):
    """Where a camera sees a point of the world, in pixels of its canvas."""
    camera = client.camera
    w, x, y, z = camera.wxyz
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    at = (np.asarray(point) - camera.position) @ R
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return at[:2] / at[2] * focal + (camera.image_width / 2, camera.image_height / 2)


def place_of(page, node):
    """Where a node is in the scene graph of the page, in three.js's axes."""
    return page.evaluate("name => window.__viserMutable.nodeRefFromName[name].position.toArray()", node)
