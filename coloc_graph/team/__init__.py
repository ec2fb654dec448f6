"""Description of a team: `Team` of `Robot`s and `Landmark`s on a `Floor`, and the file team.toml.

Fields carry the unit a person writes (`tilt_deg`); metres where a name says nothing. Tolerances (`*_sigma*`)
are one standard deviation: what a simulated truth is drawn from and what the estimators take as a prior.
"""

from coloc_graph.geometry.mounting import R_BODY_OPTICAL
from coloc_graph.team.blink import IMAGES_A_BIT, Blink
from coloc_graph.team.body import LEAST_SLIP, Devices, Markers, Mount, Slip
from coloc_graph.team.camera import Camera
from coloc_graph.team.centre_noise import CentreNoise
from coloc_graph.team.file import parse_team, read_team, team_of_fields, without_none, write_team
from coloc_graph.team.landmark import Landmark, Tag
from coloc_graph.team.sensors import Ranging, Wheels
from coloc_graph.team.team import Floor, Robot, Team

__all__ = [
    "IMAGES_A_BIT",
    "LEAST_SLIP",
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
    "Wheels",
    "parse_team",
    "read_team",
    "team_of_fields",
    "without_none",
    "write_team",
]
