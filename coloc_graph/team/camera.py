"""Camera model: a pinhole with a lens, or a fisheye, `Camera`."""

import math
from typing import Literal

import msgspec
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from coloc_graph.input_file import quoted
from coloc_graph.team import fisheye
from coloc_graph.team.centre_noise import CentreNoise
from coloc_graph.team.checks import require_finite, require_not_negative

Array = NDArray[np.float64]


MAX_SIDE = 65_535  # px, side of an image, as of a JPEG
MAX_RAY = 15.0  # x / z of the outermost ray by which a lens model is checked, 86 deg off the axis
RAYS = 6001  # number of these rays
LENS_ORDER = 3  # of the polynomials that a lens model may leave
LENS_TERMS = (LENS_ORDER + 1) * (LENS_ORDER + 2)  # two for each of these polynomials
MIN_DEPTH = math.cos(math.radians(89.5))  # z of a unit ray below which a fisheye's (x, y, 1) is not defined


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Camera with a lens model of OpenCV; pixel (0, 0) is the centre of the top-left pixel.

    Parameters
    ----------
    width, height : int
        Size of the image [px].
    fx, fy, cx, cy : float
        Focal lengths and principal point [px].
    model : "pinhole" or "fisheye"
        Lens model; "fisheye" is OpenCV's model of that name, ROS's `equidistant` (Kannala-Brandt).
    distortion : tuple of float
        OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6]]) of a pinhole, (k1, k2, k3, k4) of a fisheye; () for none.
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
    lens_px : float
        Standard deviation per axis of each smooth term that the lens model leaves, the same in all images [px].
    centre_noise : CentreNoise or None
        Noise beyond that stated by detections, with tolerances; None for the defaults.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: Literal["pinhole", "fisheye"] = "pinhole"
    distortion: tuple[float, ...] = ()
    fps: float = 100.0
    noise_px: float = 0.3
    shot_gain: float = 0.1
    bias_px: float = 0.0
    bias_factor: float = 3.0
    lens_px: float = 0.03
    centre_noise: CentreNoise | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("width", "height", "fx", "fy", "fps", "noise_px"):
            if getattr(self, name) <= 0:
                raise ValueError(f"`{name}` is {getattr(self, name)}; give a number above 0")
        for name in ("width", "height"):
            if getattr(self, name) > MAX_SIDE:
                raise ValueError(f"`{name}` is {quoted(getattr(self, name))}; give pixels, {MAX_SIDE} at most")
        require_not_negative(self, ("shot_gain", "bias_px", "lens_px"))
        if not 1 < self.bias_factor <= 100:
            raise ValueError(f"`bias_factor` is {self.bias_factor}; give a number above 1, 100 at most")
        if self.model == "fisheye" and len(self.distortion) not in (0, 4):
            raise ValueError(f"`distortion` has {len(self.distortion)} numbers; give none, or a fisheye's 4, k1 to k4")
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

    def lens_terms(self, uv: Array) -> Array:
        """Evaluate the terms of what a lens model may leave, at pixels (n, 2): shifts (n, 2, LENS_TERMS) [px].

        Legendre polynomials in the image, up to the third order, each with a standard deviation of `lens_px`.
        """
        x, y = (legendre.legvander(one, LENS_ORDER) for one in (2 * uv / (self.width, self.height) - 1).T)
        root = np.sqrt(2 * np.arange(LENS_ORDER + 1) + 1)  # so that the mean square over the image is 1
        orders = [(m, n) for m in range(LENS_ORDER + 1) for n in range(LENS_ORDER + 1 - m)]
        terms = np.stack([(root[m] * x[:, m]) * (root[n] * y[:, n]) for m, n in orders], axis=1)
        shifts = np.einsum("nq,ab->naqb", terms, np.eye(2)).reshape(len(uv), 2, LENS_TERMS)
        return np.asarray(self.lens_px * shifts)

    @property
    def typical_noise_px(self) -> float:
        """Standard deviation of a typical marker centre per axis [px]: as learnt, or `noise_px`."""
        learnt = self.centre_noise and self.centre_noise.typical_px
        return learnt or self.noise_px

    @property
    def K(self) -> Array:
        """Intrinsic matrix, (3, 3), pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_camera: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points in the camera frame (..., 3) [m].

        Returns
        -------
        uv : (..., 2) float
            Pixels; NaN of points behind a pinhole camera.
        inside : (...) bool
            True of points in the image.

        Notes
        -----
        Source: OpenCV, "Camera Calibration and 3D Reconstruction".
        """
        points = np.asarray(points_camera, float)
        if self.model == "fisheye":
            m, seen = fisheye.image_of(self.distortion, points)
            uv = m * (self.fx, self.fy) + (self.cx, self.cy)
            return uv, self._inside(uv) & seen
        ahead = points[..., 2] > 1e-9
        x, y = np.moveaxis(points[..., :2] / np.where(ahead, points[..., 2], np.nan)[..., None], -1, 0)
        ahead &= self._unfolded(x, y)
        x, y = self._distort(x, y)
        uv = np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        return uv, self._inside(uv) & ahead

    def _inside(self, uv: Array) -> NDArray[np.bool_]:
        """Return whether pixels (..., 2) are in the image."""
        with np.errstate(invalid="ignore"):
            return np.asarray((uv >= -0.5).all(-1) & (uv[..., 0] < self.width - 0.5) & (uv[..., 1] < self.height - 0.5))

    def rays(self, uv: ArrayLike) -> Array:
        """Return the rays (n, 3) of pixels (n, 2) in the camera frame.

        Those of a pinhole are (x, y, 1), those of a fisheye are of unit length. NaN where the lens model cannot be
        inverted.
        """
        if self.model == "fisheye":
            m = (np.asarray(uv, float).reshape(-1, 2) - (self.cx, self.cy)) / (self.fx, self.fy)
            return fisheye.rays_of(self.distortion, m)
        x = self.normalise(uv)
        return np.concatenate([x, np.ones((len(x), 1))], axis=1)

    def turned(self, R_camera_view: Array) -> "TurnedCamera":
        """Return the camera with coordinates of a frame that is turned against its own; see `TurnedCamera`."""
        fields = {name: getattr(self, name) for name in Camera.__struct_fields__}
        return TurnedCamera(**fields, turn=tuple(np.asarray(R_camera_view, float).ravel().tolist()))

    @property
    def R_camera_view(self) -> Array:
        """Rotation (3, 3) of the frame in which `normalise`, `per_pixel` and `project` work: the camera's own."""
        return np.eye(3)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angles of view across and down through the principal point [rad]; of a pinhole without its distortion."""
        if self.model == "fisheye":
            edges = np.array(
                [[-0.5, self.cy], [self.width - 0.5, self.cy], [self.cx, -0.5], [self.cx, self.height - 0.5]]
            )
            angles = np.arccos(np.clip(self.rays(edges)[:, 2], -1, 1))
            left, right, up, down = np.where(np.isnan(angles), fisheye.largest_angle(self.distortion), angles).tolist()
            return left + right, up + down
        return 2 * math.atan(self.width / 2 / self.fx), 2 * math.atan(self.height / 2 / self.fy)

    def fold_radius(self) -> float | None:
        """Return the distance from the principal point at which the lens model folds back within the image [px].

        None if every pixel has one ray. Beyond the fold the model maps outer rays onto the same pixels, which no lens
        does, and which a calibration without corners there does not notice.
        """
        if self.model == "fisheye":
            return self._fisheye_fold()
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

    def _fisheye_fold(self) -> float | None:
        """Return `fold_radius` of a fisheye, whose image may end within the sensor, at 90 deg and beyond."""
        if fisheye.largest_angle(self.distortion) > math.pi / 2:
            return None
        across = max(abs(edge - self.cx) for edge in (-0.5, self.width - 0.5)) / self.fx
        down = max(abs(edge - self.cy) for edge in (-0.5, self.height - 0.5)) / self.fy
        reached = fisheye.largest_radius(self.distortion)
        return None if reached >= math.hypot(across, down) else reached * math.sqrt(self.fx * self.fy)

    def _unfolded(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """Return where the distorted radius still grows: beyond, a lens model folds far points back into the image."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *([0.0] * (8 - len(self.distortion))))
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            above_grows = 2 * r2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
            if not (k4 or k5 or k6):
                return np.asarray(above + above_grows > 0)
            below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            below_grows = 2 * r2 * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
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

        NaN where the lens model cannot be inverted (pixels far outside the image), and of a fisheye's rays 89.5 deg and
        more off the axis.
        """
        if self.model == "fisheye":
            rays = self.rays(uv)
            return rays[:, :2] / np.where(rays[:, 2] > MIN_DEPTH, rays[:, 2], np.nan)[:, None]
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
        if self.model == "fisheye":
            return self._per_pixel_along(np.column_stack([at, np.ones(len(at))]), np.eye(3))
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

    def _per_pixel_along(self, rays: Array, R_camera_view: Array) -> Array:
        """Return the derivative (n, 2, 2) by pixels of x and y, at rays (x, y, 1) (n, 3) in a fisheye's turned view."""
        by_ray = fisheye.derivative(self.distortion, rays @ R_camera_view.T)
        (a, b), (c, d) = np.moveaxis(by_ray @ R_camera_view[:, :2], 0, -1)
        with np.errstate(all="ignore"):
            inverse = np.array([[d / self.fx, -b / self.fy], [-c / self.fx, a / self.fy]]) / (a * d - b * c)
        return np.moveaxis(inverse, -1, 0)


class TurnedCamera(Camera, frozen=True, kw_only=True):
    """Fisheye whose `normalise`, `per_pixel` and `project` are in a frame that is turned about its optical centre.

    Rays (x, y, 1) cover the half of space before an image plane. Turned towards the markers' plane, this half holds all
    rays that meet the plane, also those beside and behind the camera.

    Parameters
    ----------
    turn : tuple of float
        R_camera_view, row by row.
    """

    turn: tuple[float, ...]

    @property
    def R_camera_view(self) -> Array:
        """Rotation (3, 3) of the frame in which `normalise`, `per_pixel` and `project` work."""
        return np.array(self.turn).reshape(3, 3)

    def project(self, points_camera: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points (..., 3) of the turned frame; NaN and not inside where they are behind it."""
        points = np.asarray(points_camera, float)
        uv, inside = super().project(points @ self.R_camera_view.T)
        ahead = points[..., 2] > 1e-9
        return np.where(ahead[..., None], uv, np.nan), inside & ahead

    def normalise(self, uv: ArrayLike) -> Array:
        """Return x and y (n, 2) of the rays (x, y, 1) of pixels (n, 2) in the turned frame; NaN behind it."""
        rays = self.rays(uv) @ self.R_camera_view
        return rays[:, :2] / np.where(rays[:, 2] > 1e-3, rays[:, 2], np.nan)[:, None]

    def per_pixel(self, x: ArrayLike) -> Array:
        """Return the derivative (n, 2, 2) of x and y in the turned frame by pixels, at x (n, 2)."""
        at = np.asarray(x, float)
        return self._per_pixel_along(np.column_stack([at, np.ones(len(at))]), self.R_camera_view)
