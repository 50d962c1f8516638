"""Reading digital elevation models as terrain with heights above the WGS 84 ellipsoid."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS

from amers.services.errors import CoverageError, FormatError, VerticalDatumError
from amers.services.formats.elevation.heights import HeightsByCaller, height_datum
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_values, shift_of_grid
from amers.services.imagery.source import ImageSource, Window
from amers.services.terrain import Geoid, Terrain
from amers.services.types import FloatImage

HEIGHTS_M = (-11_100.0, 9_000.0)
"""Range of heights, from the deepest sea to above the highest mountain; others are undeclared voids."""
UNDECLARED_VOID = -9999.0
"""A value so common for voids that it is never taken as a height."""


def read_dem(
    path: Path, vertical: str | None = None, geoid: Path | None = None, fill_px: int = 0
) -> Terrain:
    """The terrain in a file, which stays open and is read by windows.

    Args:
        path: GeoTIFF (or COG), JPEG 2000 or NITF with any reference system.
        vertical: vertical datum of the heights, when the file does not state it: "ellipsoid", "EGM96",
            "EGM2008" or the code of a vertical reference system.
        geoid: grid file of the geoid; by default the grid that PROJ has installed.
        fill_px: largest distance in nodes from which voids are filled; 0 leaves voids.

    Raises:
        FormatError: the file cannot be used.
        VerticalDatumError: the vertical datum is not stated, the file and the caller contradict each
            other, or the grid of the geoid is missing.
        CoverageError: the grid of the geoid does not cover the terrain.
    """
    image = open_values(path)
    try:
        grid = map_grid_of(image)
        if grid is None:
            raise FormatError(f"{path}: expected heights with a map grid, found no reference system")
        shift = shift_of_grid(image, grid)
        middle = grid.lon_lat((np.array([grid.shape]) - 1.0) / 2.0)[0]
        caller = HeightsByCaller(vertical, geoid)
        unit = image.dataset.units[image.band - 1] or ""
        datum = height_datum(CRS.from_wkt(grid.crs), shift, middle, caller, str(path), band_unit=unit)
    except (FormatError, VerticalDatumError):
        image.close()
        raise
    heights: ImageSource = _Heights(image, datum.unit_m)
    note = datum.origin
    if fill_px > 0:
        heights = FilledVoids(heights, fill_px)
        note += f"; voids filled from heights within {fill_px} nodes"
    of_datum = (replace(statement, file=path.name) for statement in datum.statements)
    statements = (*image.statements, shift.statement(path.name), *of_datum)
    terrain = Terrain(grid, heights, datum.zero_m, note, statements)
    if datum.zero_m is not None:
        _check_geoid_coverage(terrain, datum.zero_m, path)
    return terrain


@dataclass(frozen=True)
class FilledVoids:
    """Heights with filled voids; an `ImageSource`.

    Each void node gets the mean of the valid nodes within reach, weighted by the inverse square of
    their distance; a node without any stays void.

    Attributes:
        heights: with voids as NaN.
        reach: largest distance, nodes.
    """

    heights: ImageSource
    reach: int

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.heights.shape

    def read(self, window: Window) -> FloatImage:
        """Heights of a window; NaN outside the grid and in voids out of reach."""
        r = self.reach
        wider = Window(window.line - r, window.sample - r, window.lines + 2 * r, window.samples + 2 * r)
        pixels = self.heights.read(wider)
        void = np.isnan(pixels)
        inside = np.s_[r : r + window.lines, r : r + window.samples]
        if void[inside].any():
            square = (np.arange(-r, r + 1)[:, None] ** 2 + np.arange(-r, r + 1) ** 2).astype(np.float32)
            kernel = np.where((square > 0) & (square <= r * r), 1.0 / np.maximum(square, 1.0), 0.0)
            # OpenCV filters to doubles what is in doubles; from singles only where the kernel is large.
            valid = np.where(void, 0.0, 1.0)
            border = cv2.BORDER_CONSTANT
            level = np.float32(np.nanmean(pixels)) if not void.all() else np.float32(0.0)
            above = np.where(void, 0.0, pixels - level).astype(np.float64)
            total = cv2.filter2D(above, cv2.CV_64F, kernel, borderType=border)
            weight = cv2.filter2D(valid, cv2.CV_64F, kernel, borderType=border)
            with np.errstate(invalid="ignore", divide="ignore"):
                filled = np.where(weight > 1e-9, total / weight + level, np.nan)
            pixels = np.where(void, filled, pixels).astype(np.float32)
        out = np.array(pixels[inside])
        lines = np.arange(window.line, window.line + window.lines)
        samples = np.arange(window.sample, window.sample + window.samples)
        out[(lines < 0) | (lines >= self.shape[0])] = np.nan
        out[:, (samples < 0) | (samples >= self.shape[1])] = np.nan
        return out


@dataclass(frozen=True)
class _Heights:
    """The values of a file in metres, with voids as NaN."""

    image: RasterImage
    unit_m: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        band = self.image.band - 1
        dataset = self.image.dataset
        heights = self.image.read(window)
        void = heights == UNDECLARED_VOID
        heights *= np.float32(dataset.scales[band] * self.unit_m)
        heights += np.float32(dataset.offsets[band] * self.unit_m)
        with np.errstate(invalid="ignore"):
            void |= (heights < HEIGHTS_M[0]) | (heights > HEIGHTS_M[1])
        heights[void] = np.nan
        return heights


def _check_geoid_coverage(terrain: Terrain, geoid: Geoid, path: Path) -> None:
    """Refuse a geoid of another region, with which every height would be unknown."""
    last = np.array(terrain.grid.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]]) * last
    if np.isnan(geoid(terrain.grid.lon_lat(corners))).all():
        raise CoverageError(
            f"{path}: the grid of the geoid does not cover the terrain; give the geoid of this region"
        )
