"""Content of the reports on a surface and on a difference of two: inputs, options, figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from amers.services.map_grid import MapGrid
from amers.services.statements import Statements
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.types import FloatImage

SHOWN_CELLS = 800
"""Cells along the longer side of a map on a page: more than its columns have pixels."""


@dataclass(frozen=True)
class ReducedMap:
    """A map with as few cells as a page shows.

    Attributes:
        name: of the file.
        shape: lines and samples of the file.
        gsd_m: side of a cell of the file, metres.
        bands: (k, lines, samples) of the file, reduced.
        grid: of the reduced cells, projected and north-up.
    """

    name: str
    shape: tuple[int, int]
    gsd_m: float
    bands: FloatImage
    grid: MapGrid


@dataclass(frozen=True)
class UsedPair:
    """A pair of images that a surface was made of.

    Attributes:
        images: names of both.
        base_to_height: base over height.
        shift_m: x, y and height by which it was moved onto the others.
        sigma_m: noise of its heights, one standard deviation.
    """

    images: Sequence[str]
    base_to_height: float
    shift_m: Sequence[float]
    sigma_m: float


@dataclass(frozen=True)
class SurfaceReport:
    """The report on a surface.

    Attributes:
        map: with height, sigma, number of images, and reason.
        crs: name of the reference system.
        pairs: that it was made of.
        cells: number of cells by why they have no height, or that they have one.
        sigma_m: median of the standard deviations of the heights.
        statements: of the files of the images.
        finished_at: UTC.
        software_version: of Amers.
    """

    map: ReducedMap
    crs: str
    pairs: tuple[UsedPair, ...]
    cells: dict[str, int]
    sigma_m: float
    statements: Statements
    finished_at: datetime
    software_version: str

    @property
    def known(self) -> float:
        """Share of the cells that have a height."""
        return self.cells.get(REASON_LABELS[Reason.FOUND], 0) / max(sum(self.cells.values()), 1)


@dataclass(frozen=True)
class DifferenceReport:
    """The report on the difference of two surfaces.

    Attributes:
        map: with difference, sigma, and their ratio.
        crs: name of the reference system.
        earlier, later: names of the surfaces.
        shift_m, shift_sigma_m: x, y and height that were added to the later surface, and their standard
            deviations.
        aligned_cells: cells that agreed on the shift; 0 where none was asked for.
        moved_horizontally: False where none was asked for, or the ground is too flat to tell.
        known: share of the cells in which both surfaces have a height.
        median_m, nmad_m: of the differences.
        spread: of the differences in units of their sigma.
        changed: share of the known cells whose difference is larger than 3 sigmas.
        finished_at: UTC.
        software_version: of Amers.
    """

    map: ReducedMap
    crs: str
    earlier: str
    later: str
    shift_m: tuple[float, ...]
    shift_sigma_m: tuple[float, ...]
    aligned_cells: int
    moved_horizontally: bool
    known: float
    median_m: float
    nmad_m: float
    spread: float
    changed: float
    finished_at: datetime
    software_version: str
