"""Table of the lights in some images or detections of a run: LEDs, and reflections or lamps."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.images.detection import Blobs, detector_for
from coloc_graph.frontend.images.light_kinds import LED_PROBABILITY
from coloc_graph.frontend.stance_tracks import stance_markers
from coloc_graph.run import Run, Stance

IMAGES_EACH = 5  # images of a robot that are looked at, evenly spread over its stances

LIGHTS_HEADER = ("lights of", "images", "LEDs each", "others each", "LEDs' peak", "probability of LEDs", "of others")


@dataclass(frozen=True)
class LightRow:
    """Lights of one camera: medians of their counts in an image, and ranges over all of these images."""

    robot: str
    images: int
    leds: float
    others: float
    led_peak: tuple[float, float] | None
    led_probability: tuple[float, float] | None
    other_probability: tuple[float, float] | None

    def cells(self) -> list[str]:
        """Return the row in words; "" where there are no such lights."""
        peak = "" if self.led_peak is None else "{:.0f} to {:.0f}".format(*self.led_peak)
        likely = ["" if one is None else "{:.2f} to {:.2f}".format(*one)
                  for one in (self.led_probability, self.other_probability)]  # fmt: skip
        return [self.robot, str(self.images), f"{self.leds:g}", f"{self.others:g}", peak, *likely]


def light_table(run: Run) -> list[LightRow]:
    """Look at some images of each robot that observes, or its detections where these are recorded without names."""
    rows = []
    for robot in run.team.names:
        stances = [stance for stance in run.stances if robot in stance.observers]
        seen = list(_seen(run, robot, stances))
        if not seen:
            continue
        led = [one.led > LED_PROBABILITY for one in seen]
        peaks = np.concatenate([one.peak[is_led] for one, is_led in zip(seen, led, strict=True)])
        likely = [np.concatenate([one.led[kind] for one, kind in zip(seen, kinds, strict=True)])
                  for kinds in (led, [~one for one in led])]  # fmt: skip
        counts = np.array([[is_led.sum(), (~is_led).sum()] for is_led in led])
        rows.append(LightRow(robot, len(seen), *np.median(counts, axis=0).tolist(), *map(_range, (peaks, *likely))))
    return rows


def _seen(run: Run, robot: str, stances: list[Stance]) -> Iterator[Blobs]:
    """Blobs in some images or records of detections of a robot."""
    picked = np.unique(np.linspace(0, len(stances) - 1, min(IMAGES_EACH, len(stances))).round().astype(int)).tolist()
    each = -(-IMAGES_EACH // max(len(picked), 1))
    for stance in (stances[k] for k in picked):
        if run.has_detections(robot):
            records = [one for one in run.detections(robot, stance.start, stance.end) if len(one.uv)]
            for one in records[:: max(len(records) // each, 1)][:each]:
                if not any(one.markers):
                    yield Blobs(one.uv, one.covariance, one.flags, one.peak, one.area)
            continue
        try:
            markers = stance_markers(run, stance)
        except DegenerateGeometry:
            markers = None
        for n, image in enumerate(run.images(robot, stance.start, stance.end)):
            if n == each:
                break
            yield detector_for(markers, run.team[robot].camera)(image.pixels)


def _range(values: np.ndarray) -> tuple[float, float] | None:
    return (float(values.min()), float(values.max())) if len(values) else None
