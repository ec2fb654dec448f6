"""Camera model: a pinhole with a lens, `Camera`."""

import math

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from coloc_graph.input_file import quoted
from coloc_graph.team.centre_noise import CentreNoise
from coloc_graph.team.checks import require_finite, require_not_negative

Array = NDArray[np.float64]


MAX_SIDE = 65_535  # px, side of an image, as of a JPEG
MAX_RAY = 15.0  # x / z of the outermost ray by which a lens model is checked, 86 deg off the axis
RAYS = 6001  # number of these rays


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pinhole camera with OpenCV's distortion; pixel (0, 0) is the centre of the top-left pixel.

    Parameters
    ----------
    width, height : int
        Size of the image [px].
    fx, fy, cx, cy : float
        Focal lengths and principal point [px].
    distortion : tuple of float
        OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6]]); () for none.
    fps : float
        Images per second.
    noise_px : float
        Standard deviation of a marker centre per axis, where a detection has no covariance of its own [px].
    shot_gain : float
        Variance that one grey level of light adds to a pixel [grey levels]; determines the covariance of a centre.
    bias_px : float
        Standard deviation per axis of an error that all centres of one marker share during a stance [px]: residual
        lens distortion, a bright background. A median; 0 states nothing.
    bias_factor : float
        Factor within which `bias_px` is known (one standard deviation of its logarithm).
    centre_noise : CentreNoise or None
        Noise beyond that stated by detections, with tolerances; None for the defaults.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fps: float = 100.0
    noise_px: float = 0.3
    shot_gain: float = 0.1
    bias_px: float = 0.0
    bias_factor: float = 3.0
    centre_noise: CentreNoise | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("width", "height", "fx", "fy", "fps", "noise_px"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        for name in ("width", "height"):
            if getattr(self, name) > MAX_SIDE:
                raise ValueError(f"`{name}` is {quoted(getattr(self, name))}; give pixels, {MAX_SIDE} at most")
        require_not_negative(self, ("shot_gain", "bias_px"))
        if not 1 < self.bias_factor <= 100:
            raise ValueError(f"`bias_factor` is {self.bias_factor}; give a number above 1, 100 at most")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise ValueError(
                f"`distortion` has {len(self.distortion)} numbers; give none, or OpenCV's 4, 5 or 8 coefficients"
            )
        if not all(map(math.isfinite, self.distortion)):
            raise ValueError("`distortion` holds a number that is not finite")

    def centre_covariance(self, stated: Array, loads: Array) -> Array:
        """Covariance (n, 2, 2) [px^2] of marker centres with the `centre_noise`.

        Parameters
        ----------
        stated
            Covariances that detections state, (n, 2, 2) [px^2].
        loads
            Parts (n, 2) of the white floors, of other and of saturated spots, in each centre.
        """
        if self.centre_noise is None:
            return stated
        scale, *added = self.centre_noise.variances
        return np.asarray(scale * stated + (loads @ added)[:, None, None] * np.eye(2))

    @property
    def K(self) -> Array:
        """Intrinsic matrix, (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_camera: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points in the camera frame (..., 3) [m].

        Returns
        -------
        uv : (..., 2) float
            Pixels; NaN of points behind the camera.
        inside : (...) bool
            True of points in the image.

        Notes
        -----
        Source: OpenCV, "Camera Calibration and 3D Reconstruction".
        """
        points = np.asarray(points_camera, float)
        ahead = points[..., 2] > 1e-9
        x, y = np.moveaxis(points[..., :2] / np.where(ahead, points[..., 2], np.nan)[..., None], -1, 0)
        ahead &= self._unfolded(x, y)
        x, y = self._distort(x, y)
        uv = np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        with np.errstate(invalid="ignore"):
            inside = (uv >= -0.5).all(-1) & (uv[..., 0] < self.width - 0.5) & (uv[..., 1] < self.height - 0.5)
        return uv, inside & ahead

    def fold_radius(self) -> float | None:
        """Return the distance from the principal point at which the lens model folds back within the image [px].

        None if every pixel has one ray. Beyond the fold the model maps outer rays onto the same pixels, which no lens
        does, and which a calibration without corners there does not notice.
        """
        if not self.distortion:
            return None
        across = max(abs(edge - self.cx) for edge in (-0.5, self.width - 0.5)) / self.fx
        down = max(abs(edge - self.cy) for edge in (-0.5, self.height - 0.5)) / self.fy
        r = np.linspace(0.0, MAX_RAY, RAYS)
        zero = np.zeros_like(r)
        with np.errstate(all="ignore"):
            seen = r * self._lens(r, zero)[0]
            grows = self._unfolded(r, zero) & np.isfinite(seen) & (seen >= 0)
        # up to the first ray whose radius no longer grows
        reached = float(seen[: max(1, len(r) if grows.all() else int(np.argmin(grows)))].max())
        return None if reached >= math.hypot(across, down) else reached * math.sqrt(self.fx * self.fy)

    def _unfolded(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Return where the distorted radius still grows: beyond, a lens model folds far points back into the image."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *([0.0] * (8 - len(self.distortion))))
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            above, below = (1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
            above_grows, below_grows = (
                2 * r2 * (a + r2 * (2 * b + r2 * 3 * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6))
            )
            # the sign of d(r above / below)/dr
            return np.asarray((above + above_grows) * below - above * below_grows > 0)

    def _lens(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return radial factor and tangential shift of the lens at undistorted normalised coordinates."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *([0.0] * (8 - len(self.distortion))))
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (
            radial,
            2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        if not self.distortion:
            return x, y
        radial, dx, dy = self._lens(x, y)
        return x * radial + dx, y * radial + dy

    def normalise(self, uv: ArrayLike) -> Array:
        """Return the undistorted normalised coordinates (n, 2) of pixels (n, 2): the ray is (x, y, 1).

        NaN where the lens model cannot be inverted (pixels far outside the image).
        """
        seen = (np.asarray(uv, float).reshape(-1, 2) - (self.cx, self.cy)) / (self.fx, self.fy)
        if not self.distortion:
            return np.asarray(seen)
        x, y = seen.T
        # OpenCV's fixed-point iteration, to rounding: its five steps leave 1e-3 px at the corners of a wide lens
        with np.errstate(all="ignore"):
            for _ in range(100):
                radial, dx, dy = self._lens(x, y)
                x_before, y_before = x, y
                x, y = (seen[:, 0] - dx) / radial, (seen[:, 1] - dy) / radial
                moved = np.maximum(np.abs(x - x_before), np.abs(y - y_before))
                if not (moved > 1e-13).any():
                    break
        return np.where((moved < 1e-9)[:, None], np.stack([x, y], axis=1), np.nan)

    def per_pixel(self, x: ArrayLike) -> Array:
        """Return the derivative (n, 2, 2) of normalised coordinates by pixels, at normalised coordinates x (n, 2)."""
        at = np.asarray(x, float)
        if not self.distortion:
            return np.broadcast_to(np.diag([1 / self.fx, 1 / self.fy]), (len(at), 2, 2))
        step = 1e-6
        sides = [
            np.stack(self._distort(*(at + off).T), -1) - np.stack(self._distort(*(at - off).T), -1)
            for off in ((step, 0.0), (0.0, step))
        ]
        seen_by_x = np.stack(sides, axis=-1) / (2 * step)
        (a, b), (c, d) = np.moveaxis(seen_by_x, 0, -1)
        with np.errstate(all="ignore"):
            inverse = np.array([[d / self.fx, -b / self.fy], [-c / self.fx, a / self.fy]]) / (a * d - b * c)
        return np.moveaxis(inverse, -1, 0)
