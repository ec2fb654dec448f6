"""The floor's slope under the mover, in the information of a stance."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from coloc_graph.frontend.homography.floor_tilt import GRAIN, alike
from coloc_graph.planning.belief import Belief
from coloc_graph.planning.drive import drive_through, there_and_back
from coloc_graph.planning.stance_information import StanceModel
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.rig import stated_team

STANDING = np.array([[0.0, 0.3, -0.2], [-0.5, -0.3, 0.2]])
SHORT, ROUND = ((1.2, 0.2), (1.6, 0.0)), ((1.0, 0.3), (1.8, 0.4), (1.8, -0.4), (1.0, -0.3))
SPEED, FPS = 0.2, 10.0


TEAM = stated_team(reference_team(), Imperfections(mount_sigma_deg=1.0, height_sigma=0.005, floor_sigma_deg=0.01))


def model(floor_sigma_deg=0.1):
    team = replace(TEAM, floor=replace(TEAM.floor, tilt_sigma_deg=floor_sigma_deg))
    return StanceModel(team, ("A", "B"), "C", 0.04, images_per_metre=FPS / SPEED)


def total(waypoints, seconds, n=48, floor_sigma_deg=0.1):
    drive = drive_through(there_and_back(waypoints, seconds, SPEED), SPEED)
    times = (np.arange(n) + 0.5) * seconds / n
    velocity = (drive.at(times + 0.01) - drive.at(times)) / 0.01
    stretch = seconds / n
    return model(floor_sigma_deg).total(STANDING, drive.at(times), FPS * stretch, velocity, stretch)[0]


def variance(information):
    """Variance of B's heading after a stance that brings this, where bodies tilt little."""
    start = Belief.start(TEAM, {"A": tuple(STANDING[0]), "B": tuple(STANDING[1]), "C": (1.5, 0.0, 0.0)})
    return start.after_stance(("A", "B"), "C", information).heading_sigma(["B"]) ** 2


def test_driving_there_and_back_longer_makes_the_floor_no_better_known():
    even = [variance(total(SHORT, seconds, floor_sigma_deg=0.0)) for seconds in (4.0, 16.0)]
    sloping = [variance(total(SHORT, seconds)) for seconds in (4.0, 16.0)]
    assert even[0] / even[1] > 2.0
    assert sloping[0] / sloping[1] < 1.1
    assert sloping[1] > 3 * even[1]


@pytest.mark.parametrize("waypoints", [SHORT, ROUND])
def test_few_instants_stand_for_all_images(waypoints):
    few, many = (variance(total(waypoints, 16.0, n)) for n in (24, 320))
    assert few == pytest.approx(many, rel=0.1)


def test_slopes_of_stretches_are_alike_as_their_places_are():
    places, stretches = np.array([[0.0, 0.0], [0.12, 0.02]]), np.array([[0.1, 0.03], [-0.02, 0.12]])
    along = (np.arange(200) + 0.5) / 200 - 0.5
    points = [place + along[:, None] * stretch for place, stretch in zip(places, stretches, strict=True)]
    for i, j in ((0, 0), (0, 1), (1, 1)):
        apart = points[i][:, None] - points[j]
        mean = np.exp(-(apart**2).sum(axis=-1) / (2 * GRAIN**2)).mean()
        assert alike(places, stretches)[i, j] == pytest.approx(mean, rel=0.1)
    np.testing.assert_allclose(alike(places, 0 * stretches), alike(places))


def test_single_images_of_a_drive_add_up_to_the_drive():
    drive = drive_through(np.array(ROUND), SPEED)
    seconds = float(drive.times[-1])
    poses = drive.at((np.arange(60) + 0.5) * seconds / 60)
    one = model()
    evenly = one.of_stance(one.see(STANDING, poses).total(np.full(60, FPS * seconds / 60)))
    assert variance(evenly) == pytest.approx(
        variance(total(ROUND, seconds)), rel=0.25
    )  # it comes by the same places again
    assert variance(total(ROUND, seconds, floor_sigma_deg=0.0)) < 0.3 * variance(evenly)


def test_the_sensitivity_to_images_is_their_derivative():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(1.0, 1.8, 12), rng.uniform(-0.4, 0.4, 12), rng.uniform(-3, 3, 12)])
    seen, images, rows = model().see(STANDING, poses), np.full(12, 20.0), rng.standard_normal((3, 14)) * 1e-3
    found = seen.sensitivities(images, rows)
    for n in (0, 5):
        step = 1e-3 * np.eye(12)[n]
        more, less = (np.trace(rows @ seen.total(images + sign * step) @ rows.T) for sign in (1, -1))
        assert found[n] == pytest.approx((more - less) / 2e-3, rel=1e-4)
    assert math.isclose(float(found @ images), float(np.trace(rows @ seen.total(images) @ rows.T)), rel_tol=1e-6)
