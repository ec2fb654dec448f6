"""Interface of a recording for the measurement of stances."""

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from coloc_graph.run.messages import Detections, Image, OdometrySample, Planes
from coloc_graph.team import Team


class Recorded(Protocol):
    """Interface for the measurement of a stance: `run.Run`, or the memory of a mission."""

    @property
    def path(self) -> Path:
        """Origin, for messages."""

    @property
    def team(self) -> Team:
        """The team."""

    @property
    def planes(self) -> dict[int, Planes]:
        """Planes that are stated, by stance."""

    def has_detections(self, robot: str) -> bool:
        """True if there are detections of this robot's camera."""

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """The detections of a robot's camera in a time [UTC s]."""

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """The images of a robot's camera in a time [UTC s]."""

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """A robot's odometry in a time [UTC s]."""
