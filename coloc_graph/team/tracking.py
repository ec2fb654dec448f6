"""Options of the tracking of markers, for unusual motion or detection: `Tracking`."""

import msgspec

from coloc_graph.team.checks import require_finite


class Tracking(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of the tracking of markers; None: the default. Pixels are those of images 320 px wide.

    Parameters
    ----------
    speed : float or None
        Standard deviation of a new track's velocity [px/s].
    acceleration : float or None
        Spectral density of the acceleration at the beginning [px^2/s^3]; the tracker adapts it.
    jerk : float or None
        Standard deviation of sudden changes of velocity [px/s].
    detected : float or None
        Probability that a marker is detected in an image.
    clutter : float or None
        Density of false detections in an image [1/px^2].
    patience_s : float or None
        Time after which a track that is not seen ends [s].
    patch : int or None
        Side of the search patch, at least [px].
    """

    speed: float | None = None
    acceleration: float | None = None
    jerk: float | None = None
    detected: float | None = None
    clutter: float | None = None
    patience_s: float | None = None
    patch: int | None = None

    def __post_init__(self) -> None:
        require_finite(self)
        for name, value in msgspec.structs.asdict(self).items():
            if value is not None and value <= 0:
                raise ValueError(f"`{name}` is {value}; give a positive number")
        if self.detected is not None and self.detected >= 1:
            raise ValueError(f"`detected` is {self.detected}; give a probability below 1, as 0.95")
