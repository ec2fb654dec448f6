"""Interface of a recording for the measurement of stances."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from coloc_graph.run.messages import Detections, Image, OdometrySample, Planes
from coloc_graph.team import Team


class Recorded(Protocol):
    """Source of a stance's recordings: `run.Run`, or the memory of a mission."""

    @property
    def path(self) -> Path:
        """Origin, for messages."""

    @property
    def team(self) -> Team:
        """The team."""

    @property
    def planes(self) -> dict[int, Planes]:
        """Stated planes by stance."""

    def has_detections(self, robot: str) -> bool:
        """Return whether there are detections of this robot's camera."""

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """Yield the detections of a robot's camera in an interval [UTC s]."""

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """Yield the images of a robot's camera in an interval [UTC s]."""

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Yield a robot's odometry in an interval [UTC s]."""


@dataclass(frozen=True, eq=False)
class Restated:
    """A recording with another description of its team."""

    recorded: Recorded
    team: Team

    @property
    def path(self) -> Path:
        """Origin, for messages."""
        return self.recorded.path

    @property
    def planes(self) -> dict[int, Planes]:
        """Stated planes by stance."""
        return self.recorded.planes

    def has_detections(self, robot: str) -> bool:
        """Return whether there are detections of this robot's camera."""
        return self.recorded.has_detections(robot)

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """Yield the detections of a robot's camera in an interval [UTC s]."""
        return self.recorded.detections(robot, start, end)

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """Yield the images of a robot's camera in an interval [UTC s]."""
        return self.recorded.images(robot, start, end)

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """Yield a robot's odometry in an interval [UTC s]."""
        return self.recorded.odometry(robot, start, end)
