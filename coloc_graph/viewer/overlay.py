"""Legend, scale and caption over a rendered picture or film, as HTML of the page that is rendered."""

import html
import json

import numpy as np

from coloc_graph.viewer import palette
from coloc_graph.viewer.cameras import FOV, camera_on
from coloc_graph.viewer.frame import ViewState
from coloc_graph.viewer.panel import legend
from coloc_graph.viewer.scene import Scene

BAR = 160.0  # px, length of the scale's bar, at most
NICE = (1.0, 2.0, 5.0)  # first digits of its length
MARGIN = 12  # px from the picture's border
CAPTION = "coloc-caption"  # id of the caption's element


def scale_bar(scene: Scene, height: int, aside: float = 0.0) -> tuple[float, float]:
    """Return length [m] and width [px] of a bar at the point that the initial camera looks at.

    Parameters
    ----------
    scene : Scene
        The scene.
    height : int
        Height of the picture [px].
    aside : float
        Offset of another result to the side [m].
    """
    eye, at = camera_on(scene, aside)
    per_metre = height / 2 / (np.tan(FOV / 2) * float(np.linalg.norm(eye - at)))
    longest = BAR / per_metre
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(digit * power for digit in NICE if digit * power <= longest * (1 + 1e-9))
    return float(length), float(length * per_metre)


def overlay_script(scene: Scene, state: ViewState, size: tuple[int, int]) -> str:
    """JavaScript that adds the legend, the scale and an empty caption to a page with a picture of this size [px]."""
    width, height = size
    ink, paper = (f"rgb({r},{g},{b})" for r, g, b in (palette.ink(state.dark), palette.paper(state.dark)))
    length, pixels = scale_bar(scene, height, state.aside)
    text = f"{length:g} m" if length >= 0.1 else f"{100 * length:g} cm"
    look = f"color:{ink};background:{paper};opacity:.9;border-radius:6px;font:14px/1.4 sans-serif"
    box = f"position:fixed;z-index:5;{look}"
    # cut to the picture, which ends beside the panel
    left = width - MARGIN - round(pixels) - 24
    parts = (
        f'<div style="{box};left:{MARGIN}px;top:{height - MARGIN}px;transform:translateY(-100%);max-width:300px;'
        f'padding:.3em">{legend(scene)}<div style="font-size:.8em;padding:0 .8em">ellipses and wedges: '
        f"{state.k_sigma:g} sigma</div></div>"
        f'<div style="{box};left:{left}px;top:{height - MARGIN - 44}px;padding:4px 12px;text-align:center">{text}'
        f'<div style="width:{pixels:.1f}px;height:7px;border:2px solid {ink};border-top:none"></div></div>'
        f'<div id="{CAPTION}" style="{box};left:{MARGIN}px;top:{MARGIN}px;padding:.2em .7em"></div>'
    )
    markup = "".join(parts)
    return f"document.body.insertAdjacentHTML('beforeend', {json.dumps(markup)})"


def caption_script(text: str) -> str:
    """JavaScript that sets the caption."""
    return f"document.getElementById({json.dumps(CAPTION)}).innerHTML = {json.dumps(html.escape(text))}"
