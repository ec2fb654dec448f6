"""One calibrated number: as stated, and as estimated."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One number as stated and as it turned out, each with its standard deviation, in `unit`."""

    robot: str
    what: str
    unit: str
    stated: float
    stated_sigma: float
    found: float
    found_sigma: float

    @property
    def sigmas(self) -> float:
        """How far it is from what was stated, in what that is known to; 0 where it was called exact."""
        return abs(self.found - self.stated) / self.stated_sigma if self.stated_sigma else 0.0

    def __str__(self) -> str:
        digits = 4 if self.unit == "m" else 2
        return (
            f"{self.robot}: {self.what} {self.found:.{digits}f} +- {self.found_sigma:.{digits}f} {self.unit} "
            f"(stated {self.stated:.{digits}f} +- {self.stated_sigma:.{digits}f})"
        )
