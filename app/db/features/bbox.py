"""A box on the map."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Box:
    """A box of longitude and latitude; `east` below `west` crosses the antimeridian.

    Attributes:
        low_m, high_m: heights; unbounded unless given.
    """

    west: float
    south: float
    east: float
    north: float
    low_m: float = -math.inf
    high_m: float = math.inf

    @property
    def longitude_ranges(self) -> tuple[tuple[float, float], ...]:
        """West and east of the parts of the box between -180 and 180 degrees: one, or two."""
        if self.east < self.west:
            return (self.west, 180.0), (-180.0, self.east)
        return ((self.west, self.east),)

    @property
    def bounds_height(self) -> bool:
        """Whether the box has limits of height."""
        return self.low_m > -math.inf


WORLD = Box(-180.0, -90.0, 180.0, 90.0)
