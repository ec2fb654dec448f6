"""GTSAM factors of what cameras saw: homographies with the movers' spans, and sighted markers, on poses and mounts.

The mathematics is in `camera_model`; here it meets keys and values. An exact mount is a constant, a stated tolerance a
variable, so that a factor's keys are its two poses and what is uncertain of what it saw.
"""

from collections.abc import Callable, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.calibration import Variables, sigmas_of_plane
from coloc_graph.backend.camera_model import BEYOND, HomographyModel, MarkersModel, StatedPlaneModel
from coloc_graph.lie import floor_pose
from coloc_graph.measurements import RelativePose, Sighting

Array = NDArray[np.float64]

#: A search for one pose takes three steps; more is a search that leads nowhere.
MOST_STEPS = 8

#: From two poses (4, 4), an error of each variable, and whether derivatives are wanted: the whitened residual and its
#: Jacobians in the same order; None where it cannot be evaluated.
Evaluation = Callable[[Array, Array, Sequence[Array], bool], tuple[Array, list[Array]] | None]


def homography_factor(link: RelativePose, i: int, j: int, variables: Variables, on_floor: bool) -> gtsam.CustomFactor:
    """The factor of a homography, and of the spans seen with it, on poses i and j, their mounts, the movers' markers
    and the clocks; of a plane that was stated, on the poses and that plane."""
    assert link.homography is not None and link.plane is not None
    rig_i, rig_j = variables.rigs[link.robot_i], variables.rigs[link.robot_j]
    if not link.plane.normal_from_mount:
        plane = StatedPlaneModel(link.homography, link.plane.N / link.plane.d, rig_i.mount, rig_j.mount)
        key = variables.plane(link.robot_i, link.stance, sigmas_of_plane(link))

        def of_plane(
            T_world_i: Array, T_world_j: Array, errors: Sequence[Array], _: bool
        ) -> tuple[Array, list[Array]] | None:
            at = plane.at(T_world_i, T_world_j, errors[0])
            return None if at is None else (at[0], list(at[1:]))

        return _factor(plane.rows, (i, j), (key,), (3,), of_plane)
    measured = link.homography
    markers = {robot: rig for robot in link.movers if (rig := variables.rigs[robot].markers) is not None}
    about, tilt_sigma = variables.anchor(link.robot_i)
    model = HomographyModel(measured, link.spans, rig_i.mount, rig_j.mount, markers, on_floor, about, tilt_sigma)
    clocks, sign = variables.clocks(link.robot_i, link.robot_j, measured.time_offset_sigma)
    keys = (
        variables.mount(link.robot_i),
        variables.mount(link.robot_j),
        *map(variables.markers, model.movers),
        clocks,
    )
    sizes = (3, 3, *[2] * len(model.movers), 1)

    def of_homography(
        T_world_i: Array, T_world_j: Array, errors: Sequence[Array], derivatives: bool
    ) -> tuple[Array, list[Array]] | None:
        mount_i, mount_j, *of_markers, offset = errors
        at = model.at(
            T_world_i,
            T_world_j,
            mount_i,
            mount_j,
            tuple(of_markers),
            sign * float(offset[0]),
            derivatives=derivatives,
        )
        if at is None:
            return None
        if not derivatives:
            return at.e, []
        by_offset = sign * at.by_offset[:, None]
        return at.e, [at.by_i, at.by_j, at.by_mount_i, at.by_mount_j, *at.by_markers, by_offset]

    return _factor(model.rows, (i, j), keys, sizes, of_homography)


def related(link: RelativePose, factor: gtsam.NonlinearFactor, errors: Callable[[int], Array]) -> gtsam.Pose3:
    """The pose on the floor of j in i that a homography's factor likes best, with calibration variables at `errors` of
    their keys; as it was measured where the search for it leads nowhere."""
    i, j, *variable = map(int, factor.keys())
    values = gtsam.Values()
    values.insert(i, gtsam.Pose3())
    for key in variable:
        values.insert(key, errors(key))
    T_i_j = gtsam.Pose3(gtsam.Rot3.Yaw(link.T_i_j.rotation().yaw()), np.array([link.T_i_j.x(), link.T_i_j.y(), 0.0]))
    values.insert(j, T_i_j)
    for _ in range(MOST_STEPS):
        values.update(j, T_i_j)
        A, b = factor.linearize(values).jacobian()
        planar = A[:, 8:11]  # heading, x, y of j
        step = np.linalg.lstsq(planar, b, rcond=None)[0]
        if not np.abs(step).max() < 0.5:
            return link.T_i_j
        T_i_j = T_i_j.compose(gtsam.Pose3(gtsam.Rot3.Yaw(step[0]), np.array([step[1], step[2], 0.0])))
        if np.linalg.norm(planar @ step) < 1.0:  # what is left is far within the noise
            break
    return T_i_j


def markers_factor(link: Sighting, i: int, j: int, variables: Variables) -> gtsam.CustomFactor:
    """The factor of sighted markers on the poses of observer and seen, the observer's mount and the markers."""
    model = _markers_model(link, variables)

    def evaluation(
        T_world_i: Array, T_world_j: Array, errors: Sequence[Array], _: bool
    ) -> tuple[Array, list[Array]] | None:
        at = model.at(T_world_i, T_world_j, *errors)
        return None if at is None else (at[0], list(at[1:]))

    keys = variables.mount(link.observer), variables.markers(link.seen)
    return _factor(model.rows, (i, j), keys, (3, 2), evaluation)


def sighted(link: Sighting, variables: Variables, errors: Callable[[int], Array]) -> gtsam.Pose3:
    """The pose of the seen robot in its observer, with mount and markers off by `errors` of their keys."""
    keys = variables.mount(link.observer), variables.markers(link.seen)
    mount, markers = (np.zeros(n) if key is None else errors(key) for key, n in zip(keys, (3, 2), strict=True))
    place = _markers_model(link, variables).place(mount, markers)
    return link.T_i_j if place is None else gtsam.Pose3(floor_pose(*place))


def _markers_model(link: Sighting, variables: Variables) -> MarkersModel:
    assert link.x_markers is not None and link.x_covariance is not None
    markers = variables.markers_of(link.seen)
    return MarkersModel(link.x_markers, link.x_covariance, variables.rigs[link.observer].mount, markers)


def _factor(
    rows: int, poses: tuple[int, int], keys: Sequence[int | None], sizes: Sequence[int], evaluation: Evaluation
) -> gtsam.CustomFactor:
    """A factor on two poses and those of the variables that have a key; the others are 0."""
    exact = [np.zeros(size) for size in sizes]
    variable = [(number, key) for number, key in enumerate(keys) if key is not None]
    kept = [0, 1, *(2 + number for number, _ in variable)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        errors = list(exact)
        for number, key in variable:
            errors[number] = values.atVector(key)
        T_world_i, T_world_j = (values.atPose3(key).matrix() for key in poses)
        at = evaluation(T_world_i, T_world_j, errors, jacobians is not None)
        if at is None:
            # so far off that no search goes there, and flat, so that none is led on by it
            if jacobians is not None:
                for place, number in enumerate(kept):
                    jacobians[place] = np.zeros((rows, 6 if number < 2 else sizes[number - 2]))
            return np.full(rows, BEYOND)
        if jacobians is not None:
            for place, number in enumerate(kept):
                jacobians[place] = at[1][number]
        return at[0]

    unit = gtsam.noiseModel.Unit.Create(rows)
    return gtsam.CustomFactor(unit, [*poses, *(key for _, key in variable)], error)
