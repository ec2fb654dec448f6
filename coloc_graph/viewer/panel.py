"""Controls of the viewer: sliders, switches, plots, legend, and the panel of the clicked edge or robot."""

import html
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
import viser.uplot as uplot
from numpy.typing import NDArray

from coloc_graph.viewer import palette
from coloc_graph.viewer.frame import Frame
from coloc_graph.viewer.plots import error_curves, residual_curves, with_cursor
from coloc_graph.viewer.scene import TRUE, Scene

NOT_FOLLOWED = "none"
HELP = "Click an edge or a robot. Space plays, arrow keys step."
WIDTH = 330
INSPECTOR_WIDTH = 480

HOLD_SECONDS = 0.25  # s for which a slider is left to the user who moves it, and its keys do nothing else

# called with a request: ("stance", row), ("time", seconds), ("step", rows), ("play", 0), ("changed", 0)
Ask = Callable[[str, float], None]


class Panel:
    """Owner of every GUI handle; its callbacks only pass on requests, all else is called by the render thread."""

    def __init__(self, server: viser.ViserServer, scene: Scene, ask: Ask, k_sigma: float, *, compares: bool) -> None:
        self._gui, self._ask = server.gui, ask
        self._clicked = False
        self._touched_at = -HOLD_SECONDS
        self._led: dict[str, float] = {}
        gui = server.gui
        gui.configure_theme(brand_color=palette.rgb("#0072B2"), show_share_button=False, show_logo=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        self.status = gui.add_markdown(HELP)
        with gui.add_folder("Time"):
            self.stance = gui.add_slider("Stance", 0, 1, 1, 0)
            self.time = gui.add_slider("Time [s]", 0.0, 1.0, 0.1, 0.0)
            self.play = gui.add_checkbox("Play", False, hint="space; arrow keys step")
            self.speed = gui.add_slider("Speed", 1, 100, 1, 10, hint="seconds of the run per second")
            self.follow = gui.add_dropdown("Follow", (NOT_FOLLOWED, *scene.robots))
        with gui.add_folder("Show"):
            self._layers: dict[str, viser.GuiCheckboxHandle] = {}
            self._layer_folder = gui.add_folder("Trajectories")
            self.k_sigma = gui.add_slider("Scale [sigma]", 1, 100, 1, int(k_sigma), hint="size of ellipses and wedges")
            self.ellipses = gui.add_checkbox("Ellipses", True, hint="covariances of the positions")
            self.wedges = gui.add_checkbox("Wedges", True, hint="standard deviations of the headings")
            self.edges = gui.add_checkbox("Edges", True, hint="measurements of pairs of observers")
            self.stays = gui.add_checkbox("Rings", True, hint="poses kept from one stance to the next")
            self.markers = gui.add_checkbox(
                "Markers", True, hint="trajectories of the markers, as observed and as estimated"
            )
            self.sightings = gui.add_checkbox(
                "Sightings", False, hint="robots and landmarks seen by observers, or ranged"
            )
            self.odometry = gui.add_checkbox("Odometry", False, hint="wheel odometry from pose to pose")
            self.plans = gui.add_checkbox(
                "Plans", True, hint="planned stances: promised ellipses dashed, footprints and drive of the next one",
                visible=bool(scene.plans),
            )  # fmt: skip
            self.beside = gui.add_checkbox("Side by side", False, visible=compares)
            self.dark = gui.add_checkbox("Dark", False)
        with gui.add_folder("Plots"):
            self._residual = gui.add_uplot(
                *self._plot(["largest residual [sigma]"], ["#0072B2"], compares=compares),
                title="Residual [sigma]", height=150,
                scales={"x": uplot.Scale(time=False)}, legend=uplot.Legend(show=False),
            )  # fmt: skip
            self._error = gui.add_uplot(
                *self._plot(
                    list(scene.robots), [_hex(c) for c in palette.robot_colours(len(scene.robots))], compares=compares
                ),
                title="Error [mm]" if scene.true is not None else "Sigma [mm]", height=150,
                scales={"x": uplot.Scale(time=False)}, legend=uplot.Legend(show=False),
            )  # fmt: skip
        with gui.add_folder("Legend"):
            self._legend = gui.add_html(legend(scene))
        self._inspector = gui.add_panel(visible=False)
        with self._inspector.add_tab("Clicked"):
            self._report = gui.add_markdown("")
            self._picture = gui.add_image(np.full((4, 8, 3), 40, np.uint8), format="jpeg", visible=False)
        self._inspector.float(x=12, y=12, width=INSPECTOR_WIDTH)
        self.adopt(scene)
        self._listen()

    def _listen(self) -> None:
        # an event without a client is caused by this process, not by a user
        for slider, what in (
            (self.stance, "stance"), (self.time, "time"), (self.speed, "changed"), (self.k_sigma, "changed"),
        ):  # fmt: skip
            slider.on_update(lambda event, what=what: self._on_slider(event, what))  # type: ignore[misc]
        for handle in (
            self.play, self.ellipses, self.wedges, self.edges, self.stays, self.markers, self.sightings,
            self.odometry, self.plans, self.beside, self.dark, self.follow,
        ):  # fmt: skip
            handle.on_update(lambda _: self._ask("changed", 0))
        for label, hotkey, what, value in (
            ("Play or pause", "space", "play", 0), ("Next stance", "arrowright", "step", 1),
            ("Previous stance", "arrowleft", "step", -1), ("First stance", "home", "step", -(1 << 40)),
            ("Last stance", "end", "step", 1 << 40),
        ):  # fmt: skip
            command = self._gui.add_command(label, hotkey=hotkey)  # type: ignore[arg-type]
            command.on_trigger(lambda _, what=what, value=value: self._on_hotkey(what, value))  # type: ignore[misc]

    def _on_slider(self, event: viser.GuiEvent[viser.GuiSliderHandle[Any]], what: str) -> None:
        if event.client is not None:
            self._touched_at = time.monotonic()
        if event.client is not None or what == "changed":
            self._ask(what, event.target.value)

    def _on_hotkey(self, what: str, value: float) -> None:
        """Pass on a key; an arrow that moves the slider with the focus comes as a command too, and is dropped."""
        if what != "step" or time.monotonic() - self._touched_at > HOLD_SECONDS:
            self._ask(what, value)

    def _lead(self, slider: viser.GuiSliderHandle[Any], what: str, value: float, tolerance: float) -> None:
        """Move a slider along with the frame unless a user holds it."""
        if self._led.get(what) == value or time.monotonic() - self._touched_at < HOLD_SECONDS:
            return
        self._led[what] = value
        if abs(slider.value - value) > tolerance:
            set_value(slider, value)

    def adopt(self, scene: Scene) -> None:
        """Fit sliders and switches to a scene of the same robots."""
        last = max(len(scene) - 1, 1)
        length = max(round(float(scene.ends.max() - scene.starts[0]), 1), 0.1) if len(scene) else 1.0
        if self.stance.max != last:
            self.stance.max = last
        if self.time.max != length:
            self.time.max = length
        self.stance.disabled = self.time.disabled = not len(scene)
        for number, layer in enumerate(scene.layers):
            if layer.name not in self._layers:
                with self._layer_folder:
                    box = self._gui.add_checkbox(layer.name, number == 0 or layer.aside or layer.name == TRUE)
                box.on_update(lambda _: self._ask("changed", 0))
                self._layers[layer.name] = box
        if self._legend.content != (means := legend(scene)):
            self._legend.content = means
        if self.plans.visible != bool(scene.plans):
            self.plans.visible = bool(scene.plans)
        self._curves = residual_curves(scene), error_curves(scene)

    @property
    def shown(self) -> frozenset[str]:
        """Names of the trajectories that are switched on."""
        return frozenset(name for name, box in self._layers.items() if box.value)

    def show_status(self, scene: Scene, frame: Frame, moment: float, notes: Sequence[str]) -> None:
        """Bring sliders and the sentence at the top, with its `notes`, up to date with a frame."""
        if not len(scene):
            self._say(f"**{scene.title}** no poses yet", notes)
            return
        stance = scene.stances[frame.row]
        drivers = ", ".join(stance.movers) or "none"
        anchors = ", ".join(stance.anchors) or "none"
        text = f"**Stance {stance.index}** of {len(scene)}: moving {drivers}; anchors {anchors}"
        if not stance.observers:  # of a ranging run
            text = f"**Moment {stance.index}** of {len(scene)}: moving {drivers}"
        self._say(text, notes)
        at = round(min(max(moment - float(scene.starts[0]), 0.0), self.time.max), 1)
        self._lead(self.stance, "stance", frame.row, 0)
        self._lead(self.time, "time", at, 0.05)

    def _say(self, what: str, notes: Sequence[str]) -> None:
        text = "\n\n".join([what, *(f"_{one}_" for one in notes if one)])
        if self.status.content != text:
            self.status.content = text

    def plot(self, scene: Scene, row: int) -> None:
        """Show the curves with the cursor at a row."""
        if len(scene):
            (x, residual), (x_error, errors) = self._curves
            at = float(scene.stances[row].index)
            self._residual.data = with_cursor(x, residual, at)
            self._error.data = with_cursor(x_error, errors, at)

    def inspect(self, text: str, picture: NDArray[np.uint8] | None) -> None:
        """Open the panel of the clicked edge or robot; close it with an empty text."""
        if bool(text) != self._clicked:
            self._clicked = bool(text)
            self._inspector.visible = self._clicked
        if text and self._report.content != text:
            self._report.content = text
        if picture is not None and picture is not getattr(self, "_shown", None):
            self._shown = picture
            self._picture.image = picture
        visible = picture is not None
        if self._picture.visible != visible:
            self._picture.visible = visible

    def set_theme(self, *, dark: bool) -> None:
        """Set light or dark colours of the controls."""
        self._gui.configure_theme(
            brand_color=palette.rgb("#0072B2"), show_share_button=False, show_logo=False, dark_mode=dark
        )

    @staticmethod
    def _plot(
        labels: list[str], colours: list[str], *, compares: bool
    ) -> tuple[tuple[NDArray[np.float64], ...], tuple[uplot.Series, ...]]:
        """Empty data, and a curve a label; in a comparison each once more, dashed, for the other result."""
        curves = [
            uplot.Series(label=label, stroke=c, width=2, points={"show": False})
            for label, c in zip(labels, colours, strict=True)
        ]
        if compares:
            curves += [
                uplot.Series(label=f"{label}, other", stroke=c, width=2, dash=(7, 5), points={"show": False})
                for label, c in zip(labels, colours, strict=True)
            ]
        empty = tuple(np.zeros(1) for _ in range(len(curves) + 2))
        cursor = uplot.Series(label="now", stroke="#8c959f", width=1, points={"show": False})
        return empty, (uplot.Series(label="stance"), *curves, cursor)


def set_value(handle: object, value: float | bool) -> None:
    """Set a control from this side."""
    handle.value = value  # type: ignore[attr-defined]  # viser hides the setter from type checkers


def legend(scene: Scene) -> str:
    """Legend of colours and strokes as HTML."""
    robots = "".join(
        f'<span style="color:{_hex(colour)};font-weight:600;margin-right:.7em">&#9679; {html.escape(name)}</span>'
        for name, colour in zip(scene.robots, palette.robot_colours(len(scene.robots)), strict=True)
    )
    stops = ", ".join(palette.RESIDUAL_STOPS)
    of_what = scene.edges.of_what
    if scene.beside is not None and scene.other_edges.of_what != of_what:
        of_what += f" (of the other result: {scene.other_edges.of_what})"
    lines = [
        robots,
        f'edges <span style="display:inline-block;width:90px;height:8px;border-radius:4px;'
        f'background:linear-gradient(90deg,{stops})"></span> 0 to {palette.MAX_SIGMA:.0f} sigma'
        f"<br><small>{html.escape(of_what)}; grey dashes: rejected</small>",
        "trajectories: thick: estimate, pale: other methods (chained: dashed), black or white: truth",
        "ring: pose kept from one stance to the next; bold ring: anchor of this stance",
        "ellipses, wedges: covariance of position and heading, as large as the slider says",
        f'<span style="color:{_hex(palette.SIGHTING)}">&#8212; sightings and ranges</span>, '
        f'<span style="color:{_hex(palette.ODOMETRY)}">&#8212; odometry</span> (where switched on)',
    ]
    if len(scene.landmarks):
        lines.insert(1, f'<span style="color:{_hex(palette.LANDMARK)}">&#9733;</span> '
                     f"{len(scene.landmarks)} landmarks")  # fmt: skip
    if scene.plans:
        lines.append("dashed ellipses and rings: as planned; filled ellipses: as they came")
    if scene.other is not None:
        lines.append(f"dashed, or at the side, and pale: {html.escape(scene.other.name)}; its curves are dashed")
    body = "".join(f'<div style="margin:.25em 0">{line}</div>' for line in lines)
    return f'<div style="padding:.2em .8em .5em;font-size:.8em;line-height:1.45">{body}</div>'


def _hex(colour: NDArray[np.uint8]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*(int(value) for value in colour))
