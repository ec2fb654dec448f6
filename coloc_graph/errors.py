"""Errors that a user can cause.

They form one small tree::

    ColocError
    ├── InputError            a file or an argument is wrong
    │   ├── TeamError         a team description
    │   ├── RunError          a run (MCAP)
    │   ├── TracksError       tracks or planes in a CSV
    │   └── BagError          a ROS bag, or the map that says what is in it
    ├── DegenerateGeometry    the geometry cannot give what is asked, with the remedy
    ├── EstimationError       the graph cannot be solved, or the solver's answer did not pass its check
    │   └── MeasurementError  a measurement, or a stance, cannot enter the graph
    └── RobotError            a device of a robot does not answer, is lost, or refuses to go on
        └── CameraError       a camera

Messages are one sentence: what is wrong, where (file, line, stance, robot), and what to do. They are raised
deep and caught once, in `cli`, which prints the sentence and ends with exit code 2.
"""

import re

_LINE_ENDS = re.compile(r"\s*[\n\r\v\f\x1c-\x1e\x85\u2028\u2029]+\s*")
_NOT_PRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


class ColocError(Exception):
    """Base of all errors that a user can cause.

    The message is one line of printable text, whatever it quotes of a file: line ends become spaces, other control
    characters, with which a file could write to the terminal, question marks.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(_NOT_PRINTABLE.sub("?", _LINE_ENDS.sub(" ", str(message))))


class InputError(ColocError):
    """A file or an argument is wrong."""


class TeamError(InputError):
    """A team description is wrong; the message names the path in the file."""


class RunError(InputError):
    """A run cannot be read, or what it holds contradicts itself."""


class TracksError(InputError):
    """Imported tracks or planes are wrong; the message names file and line."""


class BagError(InputError):
    """A ROS bag, or the map that says what is in it, is wrong; the message names file, topic and time."""


class DegenerateGeometry(ColocError):
    """The geometry cannot give what is asked (collinear tracks, no common view); the message says the remedy."""


class EstimationError(ColocError):
    """The graph cannot be solved, or the solver's answer did not pass its check."""


class MeasurementError(EstimationError):
    """A measurement, or a stance, cannot enter the graph; the message says which one and why."""


class RobotError(ColocError):
    """A device of a robot does not answer, is lost, or refuses to go on; the message names its port and the remedy."""


class CameraError(RobotError):
    """A camera cannot be opened, delivers no images or others than the team says; the message says which and why."""


class ColocWarning(UserWarning):
    """Something was left out or assumed; the work goes on."""
