"""Files of surfaces: bands, reference system, and reading by windows."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import rasterio
from pyproj import CRS

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.datasets import GDAL_CACHE, as_format_error
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_raster
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.surface.surface import SurfaceTile
from amers.services.types import Array, FloatImage

BANDS = ("height_m", "sigma_m", "views", "reason")
"""Bands of the file of a surface."""


def heights_crs(grid: MapGrid) -> str:
    """The reference system of a grid with heights above the ellipsoid, as WKT.

    GeoTIFF cannot say this of a map; a vertical system of this name can be written, and is read again.
    """
    horizontal = CRS.from_user_input(grid.crs)
    return (
        f'COMPOUNDCRS["{horizontal.name} + ellipsoidal height",{horizontal.to_wkt("WKT2_2019")},'
        'VERTCRS["WGS 84 ellipsoidal height",VDATUM["WGS 84 ellipsoid"],CS[vertical,1],'
        'AXIS["up",up,LENGTHUNIT["metre",1]]]]'
    )


@dataclass(frozen=True)
class SurfaceImage:
    """A surface in a file. It is read by windows, and closed as a context.

    Attributes:
        image: its first band.
        grid: of its cells, in the horizontal reference system of the file.
    """

    image: RasterImage
    grid: MapGrid

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.image.close()

    def read(self, window: Window) -> SurfaceTile:
        """The surface in a window of its grid."""
        height_m, sigma_m, views, reason = (
            self.image.with_mix(one_band(number)).read(window) for number in range(1, len(BANDS) + 1)
        )
        counts = (np.nan_to_num(values).astype(np.uint8) for values in (views, reason))
        return SurfaceTile(window, height_m, sigma_m, *counts)

    def at(self, line_sample: Array, every: float = 1.0) -> FloatImage:
        """All bands in the cells at some positions: of the cell itself, or of one near it.

        Args:
            line_sample: (n, 2) positions in the grid; NaN for none.
            every: cells from one position to the next, so that as few are read.

        Returns:
            (bands, n); NaN outside.

        Raises:
            FormatError: the file cannot be read there.
        """
        out = np.full((len(BANDS), len(line_sample)), np.nan, dtype=np.float32)
        inside = np.flatnonzero(self.grid.contains(line_sample))
        if not len(inside):
            return out
        cell = np.minimum(np.floor(line_sample[inside] + 0.5), np.array(self.grid.shape) - 1.0)
        first, end = cell.min(axis=0), cell.max(axis=0) + 1.0
        shape = np.ceil((end - first) / max(every, 1.0)).astype(int)
        with as_format_error(self.image.path, "readable pixels"), rasterio.Env(**GDAL_CACHE):
            bands = self.image.dataset.read(
                window=((int(first[0]), int(end[0])), (int(first[1]), int(end[1]))),
                out_shape=(len(BANDS), int(shape[0]), int(shape[1])),
            )
        line, sample = ((cell - first) * shape / (end - first)).astype(int).T
        out[:, inside] = bands[:, line, sample]
        return out


def open_surface(path: FilePlace) -> SurfaceImage:
    """Open the file of a surface.

    Raises:
        FormatError: it is no GeoTIFF with a projected map and the bands of a surface.
    """
    with ExitStack() as stack:
        image = open_raster(path)
        stack.callback(image.close)
        grid = map_grid_of(image)
        if image.dataset.descriptions != BANDS or grid is None:
            found = ", ".join(str(name) for name in image.dataset.descriptions)
            raise FormatError(
                f"{path}: bands {found} found, {', '.join(BANDS)} on a map expected, as `amers surface "
                "make` writes them"
            )
        crs = CRS.from_user_input(grid.crs)
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
        if not horizontal.is_projected:
            raise FormatError(f"{path}: {horizontal.name} found, a projected map in metres expected")
        stack.pop_all()
    return SurfaceImage(image, replace(grid, crs=horizontal.to_wkt("WKT2_2019")))


def read_reduced(path: Path, most_cells: int) -> tuple[FloatImage, MapGrid]:
    """All bands of a GeoTIFF on a map with fewer cells, each the nearest value in the file.

    Args:
        path: as `write_cog` writes it, whose overviews make this fast.
        most_cells: of the longer side.

    Returns:
        (bands, lines, samples) values, and the grid of these cells.

    Raises:
        FormatError: the file cannot be read, or has no map.
    """
    image = open_raster(path)
    try:
        grid = map_grid_of(image)
        if grid is None:
            raise FormatError(f"{path}: no reference system found, an image on a map expected")
        reduction = max(1.0, max(grid.shape) / most_cells)
        lines, samples = (max(1, round(side / reduction)) for side in grid.shape)
        with as_format_error(path, "readable pixels"), rasterio.Env(**GDAL_CACHE):
            bands = image.dataset.read(out_shape=(image.dataset.count, lines, samples))
    finally:
        image.close()
    factors = np.array(grid.shape) / [lines, samples]
    origin_xy = grid.xy((factors[None, :] - 1.0) / 2.0)[0]
    return bands, replace(
        grid, origin_xy=origin_xy, step_xy=grid.step_xy * factors, shape=(lines, samples)
    )
