"""GTSAM factors of homographies with marker spans, sighted markers and ranges, on poses and calibration variables.

The models are in `camera_model`, `homography_model` and `range_model`. A mount that is stated as exact is a constant;
one with a tolerance is a variable, and one of the factor's keys after those of its two poses.
"""

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.batched_factors import BatchedFactor, FactorEvaluator, Group
from coloc_graph.backend.calibration import LENS, MOUNT, RANGING, SIZES, Variables, sigmas_of_plane
from coloc_graph.backend.camera_model import MarkersModel
from coloc_graph.backend.homography_model import HomographyModel, StatedPlaneModel, level_plane
from coloc_graph.backend.range_model import RangeModel
from coloc_graph.backend.span_factor import SpanModel
from coloc_graph.errors import EstimationError
from coloc_graph.geometry.lie import floor_pose, rotation_z, yaw
from coloc_graph.measurements import Range, RelativePose, Sighting
from coloc_graph.team import Markers

Array = NDArray[np.float64]

MOUNT_SIZE = SIZES[MOUNT]
MAX_STEPS = 8  # Gauss-Newton steps to one pose; three are usual


def homography_factors(
    links: Sequence[tuple[RelativePose, int, int]], variables: Variables, on_floor: bool
) -> list[BatchedFactor]:
    """Return the factors of homographies and their spans, all at once.

    Each is on the poses i and j, given with its link, their mounts, the movers' markers and clocks; of a homography of
    a stated plane: on the poses and that plane.
    """
    spans = _span_models([link for link, _, _ in links], variables)
    made = []
    for (link, i, j), own in zip(links, spans, strict=True):
        assert link.homography is not None and link.plane is not None
        measured = link.homography
        mount_i, mount_j = (variables.robot_models[robot].mount for robot in (link.robot_i, link.robot_j))
        if not link.plane.normal_from_mount:
            plane = StatedPlaneModel(measured, link.plane.N / link.plane.d, mount_i, mount_j)
            key = variables.plane(link.robot_i, link.stance, sigmas_of_plane(link))
            both = link.robot_i, link.robot_j
            lenses = [None if measured.by_lenses is None else variables.lens(robot) for robot in both]
            made.append(BatchedFactor(FactorEvaluator(plane, (i, j), (key, *lenses), (3, SIZES[LENS], SIZES[LENS]))))
            continue
        clocks, sign = variables.clocks(link.robot_i, link.robot_j, measured.time_offset_sigma)
        model = HomographyModel(measured, own, mount_i, mount_j, _markers_of(link, variables), on_floor, sign)
        mounts = variables.mount(link.robot_i), variables.mount(link.robot_j)
        keys = *mounts, *map(variables.markers, model.movers), clocks
        sizes = (MOUNT_SIZE, MOUNT_SIZE, *[2] * len(model.movers), 1)
        made.append(BatchedFactor(FactorEvaluator(model, (i, j), keys, sizes)))
    return made


def _markers_of(link: RelativePose, variables: Variables) -> dict[str, Markers]:
    """Markers of the movers of a homography, by robot."""
    return {robot: one for robot in link.movers if (one := variables.robot_models[robot].markers) is not None}


def _span_models(links: Sequence[RelativePose], variables: Variables) -> list[list[SpanModel]]:
    """Models of the usable spans of each homography of a plane below its camera."""
    owners, spans, planes, sigmas, lengths = [], [], [], [], []
    for n, link in enumerate(links):
        markers = _markers_of(link, variables)
        if not link.spans or link.plane is None or not link.plane.normal_from_mount:
            continue
        about, tilt_sigma = variables.anchor(link.robot_i)
        height = next(iter(markers.values())).height
        level = level_plane(variables.robot_models[link.robot_i].mount, tuple(about.tolist()), height)
        if level is not None:
            for span in link.spans:
                owners.append(n)
                spans.append(span)
                planes.append(level)
                sigmas.append(tilt_sigma)
                lengths.append(markers[span.mover].span or 0.0)
    found: list[list[SpanModel]] = [[] for _ in links]
    models = SpanModel.near(spans, np.array(planes).reshape(-1, 3), np.array(sigmas), lengths)
    for n, model in zip(owners, models, strict=True):
        if model is not None:
            found[n].append(model)
    return found


def homography_poses(
    links: Sequence[RelativePose], factors: Sequence[BatchedFactor], errors: Callable[[int], Array]
) -> list[gtsam.Pose3]:
    """Return the most likely poses of j in i on the floor, each by the factor of its homography.

    Calibration variables are at `errors` of their keys. The measured pose where the search diverges.
    """
    poses = [gtsam.Pose3(link.T_i_j) for link in links]
    kinds: dict[Hashable, list[int]] = defaultdict(list)
    for n, factor in enumerate(factors):
        kinds[factor.evaluator.kind].append(n)
    for some in kinds.values():
        group = Group([factors[n].evaluator for n in some])
        T = np.array([links[n].T_i_j for n in some])
        at, going = np.stack([T[:, 0, 3], T[:, 1, 3], yaw(T)], axis=1), np.ones(len(some), bool)
        fits = going.copy()
        for _ in range(MAX_STEPS):
            e, by = group.evaluated(np.broadcast_to(np.eye(4), T.shape), floor_pose(*at.T), errors)
            planar = by[1][:, :, 2:5]  # heading, x, y of j
            step = -(np.linalg.pinv(planar) @ e[..., None])[..., 0]
            fits &= ~going | (np.abs(step).max(axis=1) < 0.5)
            going &= fits
            turn = rotation_z(at[:, 2])[:, :2, :2]
            moved = at + np.concatenate([(turn @ step[:, 1:, None])[..., 0], step[:, :1]], axis=1)
            at = np.where(going[:, None], moved, at)
            going &= np.linalg.norm((planar @ step[..., None])[..., 0], axis=1) >= 1.0  # the rest is within the noise
            if not going.any():
                break
        for row, n in enumerate(some):
            if fits[row]:
                poses[n] = gtsam.Pose3(floor_pose(*at[row]))
    return poses


def markers_factor(link: Sighting, i: int, j: int, variables: Variables) -> BatchedFactor:
    """Return the factor of sighted markers on the poses of observer and seen, the observer's mount and the markers."""
    keys = variables.mount(link.observer), variables.markers(link.seen)
    return BatchedFactor(FactorEvaluator(_markers_model(link, variables), (i, j), keys, (MOUNT_SIZE, 2)))


def sighted_pose(link: Sighting, variables: Variables, errors: Callable[[int], Array]) -> gtsam.Pose3:
    """Return the pose of the seen robot in its observer, with mount and markers at `errors` of their keys."""
    keys = variables.mount(link.observer), variables.markers(link.seen)
    mount, markers = (np.zeros(n) if key is None else errors(key) for key, n in zip(keys, (MOUNT_SIZE, 2), strict=True))
    planar = _markers_model(link, variables).planar_pose(mount, markers)
    return gtsam.Pose3(link.T_i_j) if planar is None else gtsam.Pose3(floor_pose(*planar))


def range_factor(link: Range, i: int, j: int, variables: Variables) -> BatchedFactor:
    """Return the factor of ranges on the poses of both robots and the errors of their sensors."""
    sensor = variables.robot_models[link.robot].ranging
    if sensor is None:
        raise EstimationError(f"the {link} has no noise: give robot {link.robot} a [robots.ranging] in team.toml")
    other = variables.robot_models.get(link.target)
    model = RangeModel(link, sensor, None if other is None else other.ranging)
    keys = variables.ranging(link.robot), None if model.antenna is None else variables.ranging(link.target)
    return BatchedFactor(FactorEvaluator(model, (i, j), keys, (SIZES[RANGING], SIZES[RANGING])))


def _markers_model(link: Sighting, variables: Variables) -> MarkersModel:
    assert link.x_markers is not None and link.x_covariance is not None
    markers = variables.markers_of(link.seen)
    mount = variables.robot_models[link.observer].mount
    turn = np.eye(3) if link.R_camera_view is None else link.R_camera_view
    return MarkersModel(link.x_markers, link.x_covariance, mount, markers, turn)
