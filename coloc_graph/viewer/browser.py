"""A picture of the viewer, rendered by the browser that the machine has, without a window."""

import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from coloc_graph.errors import InputError
from coloc_graph.viewer.app import Viewer
from coloc_graph.viewer.handles import camera_on

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
#: Without a window or a graphics card, and without the network.
ARGUMENTS = (
    "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)  # fmt: skip


def find_browser() -> str | None:
    """The path of a Chromium, None where there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def write_png(viewer: Viewer, path: str | Path, size: tuple[int, int] = (1280, 720), timeout: float = 120.0) -> None:
    """Render what is shown to a PNG of this width and height, seen from where the data are framed.

    Raises `InputError` where there is no browser, or it does not come up in time [s].
    """
    browser = find_browser()
    if browser is None:
        raise InputError(
            f"a PNG is rendered by Chromium, and none of {', '.join(BROWSERS)} is on this machine: install one, or "
            "write a page with --export, which any browser opens"
        )
    width, height = size
    until = time.monotonic() + timeout
    with tempfile.TemporaryDirectory() as profile:
        page = f"{viewer.url}/?fixedDpr=1"
        command = [browser, "--headless=new", *ARGUMENTS, f"--user-data-dir={profile}",
                   f"--window-size={width + 60},{height + 200}", "--remote-debugging-port=0", page]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            before = set(viewer.server.get_clients())
            while not (new := set(viewer.server.get_clients()) - before):
                if process.poll() is not None or time.monotonic() > until:
                    raise InputError(f"{browser} does not come up without a window; write a page with --export instead")
                time.sleep(0.1)
            client = viewer.server.get_clients()[new.pop()]
            viewer.wait_idle(max(until - time.monotonic(), 1.0))
            time.sleep(3.0)  # textures and fonts are decoded by the browser, which does not say when
            position, look_at = camera_on(viewer.scene)
            client.camera.position, client.camera.look_at = position, look_at
            image = client.get_render(height, width, transport_format="png", timeout=timeout)
        except TimeoutError as error:
            raise InputError(f"{browser} gives no picture in {timeout:.0f} s; write a page with --export") from error
        finally:
            process.terminate()
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
    paper = np.array((38, 42, 48) if viewer.panel.dark.value else (255, 255, 255), float)
    alpha = image[..., 3:4] / 255.0 if image.shape[-1] == 4 else 1.0
    flat = np.rint(image[..., :3] * alpha + paper * (1 - alpha)).astype(np.uint8)
    if not cv2.imwrite(str(path), cv2.cvtColor(flat, cv2.COLOR_RGB2BGR)):
        raise InputError(f"{path} cannot be written; give another place")
