"""Digital elevation models: GeoTIFF in, terrain above the ellipsoid out. No height without its datum."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pyproj import CRS

from services.errors import CoverageError, FormatError, VerticalDatumError
from services.formats.elevation.geoid import geoid_of_crs, geoid_of_grid, vertical_crs
from services.formats.images.raster import RasterImage, map_grid_of, open_raster
from services.imagery.source import ImageSource, Window
from services.terrain import Geoid, Terrain
from services.types import FloatImage

HEIGHTS_M = (-11_100.0, 9_000.0)
"""From the deepest sea to above the highest mountain: what lies beyond is a void nobody declared."""
UNDECLARED_VOID = -9999.0
"""So many producers write for a void that no height is believed to be exactly this."""


def read_dem(
    path: Path, vertical: str | None = None, geoid: Path | None = None, fill_px: int = 0
) -> Terrain:
    """The terrain in a file; it stays open and is read by windows.

    Args:
        path: GeoTIFF (or COG), JPEG 2000 or NITF with a reference system, any.
        vertical: what the heights are counted from, when the file does not say: "ellipsoid", "EGM96",
            "EGM2008" or the code of a vertical reference system.
        geoid: grid file of that geoid; by default the one PROJ has installed.
        fill_px: voids are filled from heights at most so many nodes away; 0 leaves them.

    Raises:
        FormatError: when the file cannot be used.
        VerticalDatumError: when nobody says what the heights are counted from, the file and the caller
            disagree, or the geoid is not at hand.
        CoverageError: when the grid of the geoid does not reach the terrain.
    """
    image = open_raster(path)
    try:
        grid = map_grid_of(image)
        if grid is None:
            raise FormatError(f"{path}: expected heights on a map, found no reference system")
        unit_m, zero, note = _vertical(image, vertical, geoid)
    except (FormatError, VerticalDatumError):
        image.close()
        raise
    heights: ImageSource = _Heights(image, unit_m)
    if fill_px > 0:
        heights = FilledVoids(heights, fill_px)
        note += f"; voids filled from heights within {fill_px} nodes"
    terrain = Terrain(grid, heights, zero, note)
    if zero is not None:
        _check_reach(terrain, path)
    return terrain


@dataclass(frozen=True)
class FilledVoids:
    """Heights whose voids near known ones are filled.

    Each void node gets the mean of the known nodes around it, weighted by the inverse square of their
    distance; nodes further than the reach from any known one stay void.

    Attributes:
        heights: with voids as NaN.
        reach: nodes.
    """

    heights: ImageSource
    reach: int

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.heights.shape

    def read(self, window: Window) -> FloatImage:
        """Heights of a window; NaN beyond the grid and in voids that are out of reach."""
        r = self.reach
        wider = Window(window.line - r, window.sample - r, window.lines + 2 * r, window.samples + 2 * r)
        pixels = self.heights.read(wider)
        void = np.isnan(pixels)
        inside = np.s_[r : r + window.lines, r : r + window.samples]
        if void[inside].any():
            square = (np.arange(-r, r + 1)[:, None] ** 2 + np.arange(-r, r + 1) ** 2).astype(np.float32)
            kernel = np.where((square > 0) & (square <= r * r), 1.0 / np.maximum(square, 1.0), 0.0)
            known = np.where(void, np.float32(0.0), np.float32(1.0))
            border = cv2.BORDER_CONSTANT
            level = np.float32(np.nanmean(pixels)) if not void.all() else np.float32(0.0)
            total = cv2.filter2D(
                np.where(void, 0.0, pixels - level), cv2.CV_64F, kernel, borderType=border
            )
            weight = cv2.filter2D(known, cv2.CV_64F, kernel, borderType=border)
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
    """The numbers of a file as metres, voids as NaN."""

    image: RasterImage
    unit_m: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        band = self.image.band - 1
        dataset = self.image.dataset
        stored = self.image.read(window)
        scale = np.float32(dataset.scales[band] * self.unit_m)
        heights = stored * scale + np.float32(dataset.offsets[band] * self.unit_m)
        with np.errstate(invalid="ignore"):
            void = (heights < HEIGHTS_M[0]) | (heights > HEIGHTS_M[1]) | (stored == UNDECLARED_VOID)
        heights[void] = np.nan
        return np.asarray(heights)


def _vertical(
    image: RasterImage, said: str | None, grid: Path | None
) -> tuple[float, Geoid | None, str]:
    """Metres a unit, the geoid (None: the ellipsoid), and one sentence on how they are known."""
    path = image.path
    stated, by_file = _stated(CRS.from_wkt(image.dataset.crs.to_wkt(version="WKT2_2019")))
    by_caller = None if said is None else vertical_crs(said)
    if by_file and said is not None and _name(stated) != _name(by_caller):
        raise VerticalDatumError(
            f"{path}: the file counts its heights from {_name(stated)}, and {_name(by_caller)} was given"
        )
    if not by_file and said is None and grid is None:
        raise VerticalDatumError(
            f"{path}: the file does not say what its heights are counted from: give ellipsoid, EGM96, "
            "EGM2008 or the code of a vertical reference system"
        )
    who = "the file" if by_file else "the caller"
    zero = stated if by_file else by_caller
    if grid is not None:
        if zero is None and (by_file or said is not None):
            raise VerticalDatumError(
                f"{path}: heights above the ellipsoid, by {who}, need no geoid: {grid.name} was given"
            )
        name = "the geoid" if zero is None else zero.name
        return _unit_m(zero, path), geoid_of_grid(grid), f"{name} by {who}, from {grid.name}"
    if zero is None:
        return 1.0, None, f"metres above the ellipsoid, by {who}"
    return _unit_m(zero, path), geoid_of_crs(zero), f"{zero.name} by {who}, from the grids of PROJ"


def _stated(crs: CRS) -> tuple[CRS | None, bool]:
    """The vertical reference system of a file, None for the ellipsoid; and whether it states one."""
    if crs.is_compound:
        return crs.sub_crs_list[1], True
    return None, len(crs.axis_info) == 3


def _name(vertical: CRS | None) -> str:
    return "the ellipsoid" if vertical is None else vertical.name


def _unit_m(vertical: CRS | None, path: Path) -> float:
    if vertical is None:
        return 1.0
    axis = vertical.axis_info[0]
    if axis.direction.lower() != "up":
        raise VerticalDatumError(f"{path}: expected heights, found depths: {vertical.name}")
    return float(axis.unit_conversion_factor)


def _check_reach(terrain: Terrain, path: Path) -> None:
    """A geoid of another part of the world would make every height unknown."""
    last = np.array(terrain.grid.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]]) * last
    assert terrain.geoid is not None
    if np.isnan(terrain.geoid(terrain.grid.lon_lat(corners))).all():
        raise CoverageError(f"{path}: the grid of the geoid does not reach the terrain")
