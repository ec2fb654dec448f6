"""Rendering of the viewer to a PNG, by a browser of this machine without a window."""

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
from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.panel import WIDTH

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# without a window, a graphics card, and the network
ARGUMENTS = (
    "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)  # fmt: skip
# true once the page has drawn its floor; by viser's own names
DRAWN = "window.__viserMutable?.nodeRefFromName?.['/floor'] != null"
SETTLED = 2.0  # s without a change until a picture is taken: fonts and textures load late, without notice
BESIDE = WIDTH + 8  # px beside the scene for the panel, which is cut off
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
    """Render the viewer to a PNG of this width and height [px], from the initial camera.

    Raises
    ------
    InputError
        There is no browser, or it takes longer than `timeout` [s].
    """
    browser = require_browser()
    until = time.monotonic() + timeout
    try:
        with _page(browser, until) as page:
            width, height = size
            view = {"width": width + BESIDE, "height": height, "deviceScaleFactor": 1, "mobile": False}
            _call(page, "Emulation.setDeviceMetricsOverride", view, until)
            _call(page, "Page.navigate", {"url": f"{viewer.url}/?fixedDpr=1"}, until)
            while not _call(page, "Runtime.evaluate", {"expression": DRAWN}, until)["result"].get("value"):
                time.sleep(0.2)
            _call(page, "Runtime.evaluate", {"expression": _HIDE}, until)
            while not viewer.server.get_clients():
                _require_time(until)
                time.sleep(0.1)
            viewer.wait_idle(max(until - time.monotonic(), 0.1))
            clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
            picture = _settled(page, {"format": "png", "clip": clip}, until)
    except (TimeoutError, OSError, ValueError, KeyError) as error:
        raise InputError(f"{browser} renders no picture ({error}); write a page with --export instead") from error
    try:
        Path(path).write_bytes(picture)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}); give another path") from error


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
