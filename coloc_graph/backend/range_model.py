"""Residuals of ranges and bearings by two poses and the errors of both sensors, vectorised. Plain numpy."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.sensor_model import RANGING, Sensors
from coloc_graph.geometry.lie import floor_pose, hat, se3_inverse
from coloc_graph.geometry.se2 import wrap
from coloc_graph.measurements import Range
from coloc_graph.team import Ranging

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RangeModel:
    """Residual of the ranges and the bearing of one measurement, whitened; heights are not used.

    Variables: the errors (7,) of the sensor, and those of the target's, which count where ranges are `two_way`.
    """

    measured: Range
    sensor: Ranging
    target: Ranging | None

    @property
    def rows(self) -> int:
        """Number of its residuals."""
        return len(self.measured.range) + (self.measured.bearing is not None)

    @property
    def kind(self) -> Hashable:
        """Number of residuals, and whether the last is that of a bearing."""
        return "ranges", self.rows, self.measured.bearing is not None

    @property
    def antenna(self) -> Ranging | None:
        """The target's sensor, where a range is that to its antenna."""
        return self.target if self.sensor.two_way else None

    @staticmethod
    def batch(models: Sequence["RangeModel"]) -> "_Ranges":
        """Return the batch of models of one kind."""
        return _Ranges(models)


class _Ranges:
    """Batch of measurements of n ranges, or of n - 1 ranges and a bearing while both stand, each."""

    def __init__(self, models: Sequence[RangeModel]) -> None:
        self._n = models[0].rows
        self._sensors = Sensors([one.sensor for one in models])
        self._index = np.repeat(np.arange(len(models)), self._n)
        antennas = [one.antenna for one in models]
        at = [(0.0, 0.0, 0.0) if one is None else (one.offset, one.x, one.y) for one in antennas]
        self._antennas = np.repeat(np.array(at), self._n, axis=0)
        self._two_way = np.repeat(np.array([one is not None for one in antennas], float), self._n)
        measured = [one.measured for one in models]
        bearing = measured[0].bearing is not None
        stands = np.zeros((int(bearing), 3))
        self._kind = np.tile(np.arange(self._n) == (self._n - 1 if bearing else -1), len(models)).astype(int)
        self._moved = se3_inverse(floor_pose(*np.concatenate([x for one in measured for x in (one.moved, stands)]).T))
        self._target_moved = floor_pose(*np.concatenate([x for one in measured for x in (one.target_moved, stands)]).T)
        self._of_robot = np.repeat(np.array([one.measured.target_stance >= 0 for one in models]), self._n)
        self._values = np.concatenate(
            [np.append(one.range, [] if one.bearing is None else [one.bearing]) for one in measured]
        )
        C = np.zeros((len(models), self._n, self._n))
        for row, one in enumerate(measured):
            C[row, -1, -1] = (one.bearing_sigma or 0.0) ** 2
            C[row, : len(one.range), : len(one.range)] = one.covariance
        self._roots = np.linalg.inv(np.linalg.cholesky(C))

    def at(
        self, T_world_i: Array, T_world_j: Array, errors: Sequence[Array]
    ) -> tuple[Array, list[Array], NDArray[np.bool_]]:
        own, other = (one[self._index] for one in errors)
        other = other * self._two_way[:, None]
        T_i_j = (se3_inverse(T_world_i) @ T_world_j)[self._index]
        rows = np.arange(len(self._kind))
        p_body = np.zeros((len(rows), 4))
        p_body[:, :2], p_body[:, 3] = self._antennas[:, 1:] + other[:, 3:5], 1.0
        p_j = (self._target_moved @ p_body[..., None])[:, :3, 0]
        R_i_j = T_i_j[:, :3, :3]
        p_i = (R_i_j @ p_j[..., None])[..., 0] + T_i_j[:, :3, 3]
        turn = self._moved[:, :2, :3]  # into the body at each instant
        xy = (turn @ p_i[..., None])[..., 0] + self._moved[:, :2, 3]
        found = self._sensors.expected(self._index, xy, own, self._of_robot)
        delayed = self._two_way * (self._kind == 0)  # a bearing has no offset of the other sensor
        e = found.values[rows, self._kind] + delayed * (self._antennas[:, 0] + other[:, 0]) - self._values
        e = np.where(self._kind == 1, wrap(e), e)
        by_p_i = found.by_xy[rows, self._kind][:, None] @ turn
        by_i = np.concatenate([by_p_i @ hat(p_i), -by_p_i], axis=-1)
        by_p_j = by_p_i @ R_i_j
        by_j = np.concatenate([-by_p_j @ hat(p_j), by_p_j], axis=-1)
        by_other = np.zeros((len(xy), 1, RANGING))
        by_other[:, 0, 0] = delayed
        by_antenna = by_p_j @ self._target_moved[:, :3, :2]
        by_other[:, :, 3:5] = self._two_way[:, None, None] * by_antenna
        parts = (by_i, by_j, found.by_errors[rows, self._kind][:, None], by_other)
        whitened = [self._roots @ one.reshape(-1, self._n, one.shape[-1]) for one in parts]
        e = (self._roots @ e.reshape(-1, self._n, 1))[..., 0]
        return e, whitened, np.ones(len(e), bool)
