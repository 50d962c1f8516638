"""Reading digital elevation models as terrain with heights above the WGS 84 ellipsoid."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS

from amers.services.errors import CoverageError, FormatError, VerticalDatumError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.elevation.geoid import geoid_of_crs, geoid_of_grid, vertical_crs
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_raster
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
    image = open_raster(path)
    try:
        grid = map_grid_of(image)
        if grid is None:
            raise FormatError(f"{path}: expected heights with a map grid, found no reference system")
        unit_m, geoid_heights, note = _vertical_datum(image, vertical, geoid)
    except (FormatError, VerticalDatumError):
        image.close()
        raise
    heights: ImageSource = _Heights(image, unit_m)
    if fill_px > 0:
        heights = FilledVoids(heights, fill_px)
        note += f"; voids filled from heights within {fill_px} nodes"
    terrain = Terrain(grid, heights, geoid_heights, note)
    if geoid_heights is not None:
        _check_geoid_coverage(terrain, geoid_heights, path)
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


def _vertical_datum(
    image: RasterImage, requested: str | None, grid: Path | None
) -> tuple[float, Geoid | None, str]:
    """Metres per unit, the geoid (None for the ellipsoid), and one sentence on their origin."""
    path = image.path
    of_file, file_states = _vertical_of_file(CRS.from_wkt(image.dataset.crs.to_wkt(version="WKT2_2019")))
    of_caller = None if requested is None else vertical_crs(requested)
    if file_states and requested is not None and _name(of_file) != _name(of_caller):
        raise VerticalDatumError(
            f"{path}: the file states heights above {_name(of_file)}, the caller {_name(of_caller)}; "
            "omit the vertical datum or correct it"
        )
    if not file_states and requested is None and grid is None:
        raise VerticalDatumError(
            f"{path}: the file does not state its vertical datum: give ellipsoid, EGM96, EGM2008 or the "
            "code of a vertical reference system"
        )
    who = "the file" if file_states else "the caller"
    vertical = of_file if file_states else of_caller
    if grid is not None:
        if vertical is None and (file_states or requested is not None):
            raise VerticalDatumError(
                f"{path}: heights are above the ellipsoid, by {who}, and need no geoid; omit {grid.name}"
            )
        name = "the geoid" if vertical is None else vertical.name
        return _unit_m(vertical, path), geoid_of_grid(grid), f"{name} by {who}, from {grid.name}"
    if vertical is None:
        return 1.0, None, f"metres above the ellipsoid, by {who}"
    note = f"{vertical.name} by {who}, from the grids of PROJ"
    return _unit_m(vertical, path), geoid_of_crs(vertical), note


def _vertical_of_file(crs: CRS) -> tuple[CRS | None, bool]:
    """The vertical reference system of a file, None for the ellipsoid; whether the file states it."""
    if crs.is_compound:
        return crs.sub_crs_list[1], True
    return None, len(crs.axis_info) == 3


def _name(vertical: CRS | None) -> str:
    return "the ellipsoid" if vertical is None else vertical.name


def _unit_m(vertical: CRS | None, path: FilePlace) -> float:
    """Metres per unit of a vertical reference system."""
    if vertical is None:
        return 1.0
    axis = vertical.axis_info[0]
    if axis.direction.lower() != "up":
        raise VerticalDatumError(f"{path}: {vertical.name} found, which counts depths; heights expected")
    return float(axis.unit_conversion_factor)


def _check_geoid_coverage(terrain: Terrain, geoid: Geoid, path: Path) -> None:
    """Refuse a geoid of another region, with which every height would be unknown."""
    last = np.array(terrain.grid.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]]) * last
    if np.isnan(geoid(terrain.grid.lon_lat(corners))).all():
        raise CoverageError(
            f"{path}: the grid of the geoid does not cover the terrain; give the geoid of this region"
        )
