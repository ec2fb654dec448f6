"""Description of a team: `Team` of `Robot`s and `Landmark`s on a `Floor`, and the file team.toml.

Units are in the names of fields (`tilt_deg`), otherwise metres. Tolerances (`*_sigma*`) are one standard deviation:
the distribution of a simulated truth, and the prior of an estimate.
"""

from coloc_graph.geometry.mounting import R_BODY_OPTICAL
from coloc_graph.team.blink import MIN_IMAGES_PER_BIT, Blink
from coloc_graph.team.body import MIN_SLIP, Devices, Markers, Mount, Slip
from coloc_graph.team.camera import Camera
from coloc_graph.team.centre_noise import CentreNoise
from coloc_graph.team.file import parse_team, read_team, team_of_fields, without_none, write_team
from coloc_graph.team.landmark import Landmark, Tag
from coloc_graph.team.sensors import Ranging, Wheels
from coloc_graph.team.team import Floor, Robot, Team
from coloc_graph.team.tracking import Tracking

__all__ = [
    "MIN_IMAGES_PER_BIT",
    "MIN_SLIP",
    "R_BODY_OPTICAL",
    "Blink",
    "Camera",
    "CentreNoise",
    "Devices",
    "Floor",
    "Landmark",
    "Markers",
    "Mount",
    "Ranging",
    "Robot",
    "Slip",
    "Tag",
    "Team",
    "Tracking",
    "Wheels",
    "parse_team",
    "read_team",
    "team_of_fields",
    "without_none",
    "write_team",
]
