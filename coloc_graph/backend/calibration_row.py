"""One calibrated number: as stated, and as estimated."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One calibrated number.

    Parameters
    ----------
    robot, what : str
        Robot (or landmark), and the name of the number.
    unit : str
        Its unit; "" without one.
    stated, stated_sigma : float
        As stated, with its standard deviation.
    found, found_sigma : float
        As estimated, with its standard deviation.
    """

    robot: str
    what: str
    unit: str
    stated: float
    stated_sigma: float
    found: float
    found_sigma: float

    @property
    def sigmas(self) -> float:
        """Distance from the stated value in its standard deviations; 0 where it was stated as exact."""
        return abs(self.found - self.stated) / self.stated_sigma if self.stated_sigma else 0.0

    def __str__(self) -> str:
        digits = 4 if self.unit == "m" else 2
        return (
            f"{self.robot}: {self.what} {self.found:.{digits}f} +- {self.found_sigma:.{digits}f} {self.unit} "
            f"(stated {self.stated:.{digits}f} +- {self.stated_sigma:.{digits}f})"
        )
