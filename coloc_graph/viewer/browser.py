"""Rendering of the viewer to pictures, by a browser of this machine without a window."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.sync.connection import Connection

from coloc_graph.errors import InputError
from coloc_graph.run.atomic_file import write_atomically
from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.overlay import caption_script, overlay_script
from coloc_graph.viewer.panel import WIDTH

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# without a window, a graphics card, and the network
ARGUMENTS = (
    "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)  # fmt: skip
# true once the page has drawn its floor; by viser's own names
DRAWN = "window.__viserMutable?.nodeRefFromName?.['/floor'] != null"
QUALITY = 95  # of JPEGs, percent
SETTLED = 2.0  # s without a change until a picture is taken: fonts and textures load late, without notice
BESIDE = WIDTH + 8  # px beside the scene for the panel, which is cut off
# resolves when the page has drawn twice after what it was sent; its messages come a few at a time
AFTER_DRAWING = "new Promise(r => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(r)), 60))"
_HIDE = (
    "document.head.appendChild(Object.assign(document.createElement('style'), "
    "{textContent: '.mantine-Notifications-root{display:none!important}'}))"
)


def find_browser() -> str | None:
    """Return the path of a Chromium, None where there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def require_browser() -> str:
    """Return the path of a Chromium; `InputError` where there is none."""
    browser = find_browser()
    if browser is None:
        raise InputError(
            f"a PNG is rendered by Chromium, and none of {', '.join(BROWSERS)} is on this machine: install one, or "
            "write a page with --export, which any browser opens"
        )
    return browser


def write_png(viewer: Viewer, path: str | Path, size: tuple[int, int] = (1280, 720), timeout: float = 120.0) -> None:
    """Render the viewer to a PNG of this width and height [px], with legend and scale, from the initial camera.

    Raises
    ------
    InputError
        There is no browser, or it takes longer than `timeout` [s].
    """
    with rendered(viewer, size, timeout) as page:
        picture = page.settled()
    try:
        write_atomically(Path(path), picture)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); give another path") from error


class RenderedPage:
    """The viewer in a browser without a window."""

    def __init__(self, page: Connection, size: tuple[int, int], until: float) -> None:
        self._page, self._until = page, until
        width, height = size
        self._picture = {"format": "png", "clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}}

    def evaluate(self, script: str) -> Any:
        """Run JavaScript, wait for its promise if it returns one, and return its value."""
        parameters = {"expression": script, "awaitPromise": True}
        return _call(self._page, "Runtime.evaluate", parameters, self._until)["result"].get("value")

    def settled(self) -> bytes:
        """Return a picture that equals the two before it, as PNG."""
        return _settled(self._page, self._picture, self._until)

    def drawn(self) -> bytes:
        """Return a picture of what the page has been sent, as JPEG."""
        self.evaluate(AFTER_DRAWING)
        parameters = self._picture | {"format": "jpeg", "quality": QUALITY, "optimizeForSpeed": True}
        return base64.b64decode(_call(self._page, "Page.captureScreenshot", parameters, self._until)["data"])


@contextmanager
def rendered(viewer: Viewer, size: tuple[int, int], timeout: float) -> Iterator[RenderedPage]:
    """Yield the viewer in a browser, with legend and scale; `InputError` where it fails or takes too long."""
    browser = require_browser()
    until = time.monotonic() + timeout
    try:
        with _page(browser, until) as connection:
            width, height = size
            page = RenderedPage(connection, size, until)
            view = {"width": width + BESIDE, "height": height, "deviceScaleFactor": 1, "mobile": False}
            _call(connection, "Emulation.setDeviceMetricsOverride", view, until)
            _call(connection, "Page.navigate", {"url": f"{viewer.url}/?fixedDpr=1"}, until)
            while not page.evaluate(DRAWN):
                time.sleep(0.2)
            page.evaluate(_HIDE)
            while not viewer.server.get_clients():
                _require_time(until)
                time.sleep(0.1)
            viewer.wait_idle(max(until - time.monotonic(), 0.1))
            page.evaluate(overlay_script(viewer.scene, viewer.state, size))
            page.evaluate(caption_script(viewer.caption))
            yield page
    except (TimeoutError, OSError, ValueError, KeyError) as error:
        why = f"within {timeout:.0f} s" if isinstance(error, TimeoutError) else f"({error})"
        raise InputError(f"{browser} renders no picture {why}; write a page with --export instead") from error


@contextmanager
def _page(browser: str, until: float) -> Iterator[Connection]:
    """Yield an empty page of a browser without a window, controlled by Chrome's DevTools protocol."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [browser, "--headless=new", *ARGUMENTS, f"--user-data-dir={profile}", "--no-first-run",
                   "--remote-debugging-port=0", "about:blank"]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            said = Path(profile) / "DevToolsActivePort"
            while not (said.exists() and said.read_text().strip()):
                _require_time(until)
                if process.poll() is not None:
                    raise OSError("it ended at once")
                time.sleep(0.1)
            port = int(said.read_text().split()[0])
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
                pages = [one for one in json.load(answer) if one["type"] == "page"]
            if not pages:
                raise OSError("it opens no page")
            with connect(pages[0]["webSocketDebuggerUrl"], max_size=None, open_timeout=10) as page:
                yield page
        finally:
            process.terminate()
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()


def _settled(page: Connection, parameters: dict[str, Any], until: float) -> bytes:
    """Return a screenshot that equals the two before it."""
    pictures: list[bytes] = []
    while len(pictures) < 3 or len(set(pictures[-3:])) > 1:
        time.sleep(SETTLED / 2)
        pictures.append(base64.b64decode(_call(page, "Page.captureScreenshot", parameters, until)["data"]))
    return pictures[-1]


def _call(page: Connection, method: str, parameters: dict[str, Any], until: float) -> dict[str, Any]:
    """Return the browser's answer to one call."""
    page.send(json.dumps({"id": 1, "method": method, "params": parameters}))
    while True:
        answer = json.loads(page.recv(timeout=_require_time(until)))
        if answer.get("id") == 1:
            if "error" in answer:
                raise ValueError(answer["error"].get("message", method))
            return dict(answer["result"])


def _require_time(until: float) -> float:
    """Return the time left [s]; raises `TimeoutError` if there is none."""
    left = until - time.monotonic()
    if left <= 0:
        raise TimeoutError("it takes too long")
    return left
