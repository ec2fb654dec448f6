"""Interface of a recording for the measurement of stances."""

from collections.abc import Iterator
from dataclasses import dataclass
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
        """Planes that are stated, by stance."""
        return self.recorded.planes

    def has_detections(self, robot: str) -> bool:
        """True if there are detections of this robot's camera."""
        return self.recorded.has_detections(robot)

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """The detections of a robot's camera in a time [UTC s]."""
        return self.recorded.detections(robot, start, end)

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        """The images of a robot's camera in a time [UTC s]."""
        return self.recorded.images(robot, start, end)

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """A robot's odometry in a time [UTC s]."""
        return self.recorded.odometry(robot, start, end)
