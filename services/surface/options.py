"""Options of a surface."""

from dataclasses import dataclass, field

from amers.services.surface.match import SemiGlobal

MOST_FILL_CELLS = 20
"""Gaps are filled from so far away at most: the results were measured with this reach."""


@dataclass(frozen=True)
class SurfaceOptions:
    """How a surface is made.

    Attributes:
        gsd_m: side of a cell, metres; None takes the ground sampling of the finest image in two
            digits.
        heights_m: lowest and highest surface above the ellipsoid, metres; None takes the heights that
            the models are meant for.
        pairs: number of pairs at most.
        bases: least and largest base over height of a pair.
        fill_cells: fill gaps from heights at most this many cells away; 0 leaves gaps open.
        matcher: finds the disparities.
    """

    gsd_m: float | None = None
    heights_m: tuple[float, float] | None = None
    pairs: int = 10
    bases: tuple[float, float] = (0.1, 0.9)
    fill_cells: int = MOST_FILL_CELLS
    matcher: SemiGlobal = field(default_factory=SemiGlobal)
