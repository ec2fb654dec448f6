"""Every error a user can cause, as one small tree.

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


class ColocError(Exception):
    """Base of all errors that a user can cause."""


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
