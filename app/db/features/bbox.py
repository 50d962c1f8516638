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


WORLD = Box(-180.0, -90.0, 180.0, 90.0)
