"""The seams of a mosaic as a layer of a GeoPackage: one feature for each scene."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.features
import shapely
from rasterio.transform import Affine

from amers.services.formats.images.datasets import GDAL_OPTIONS, as_format_error

LAYER = "seams"
_SPECK_CELLS = 4
"""Smaller groups of cells, where a scene fills single pixels of another, are part of what is around."""


def write_seam_layer(
    path: Path,
    sources: Path,
    cell_px: int,
    fields: Mapping[str, npt.NDArray[np.generic]],
) -> None:
    """Write the ground that each scene shows in a mosaic, as multipolygons in the system of the map.

    Args:
        path: of the GeoPackage; an existing file is replaced.
        sources: image with the number of the scene of each pixel, from 1.
        cell_px: the outlines follow cells of this many pixels.
        fields: attributes (scenes,) by name; the scene of row k has the number k + 1.
    """
    import pyogrio  # imported here because it takes 0.4 s and only these layers need it

    with (
        as_format_error(sources, "an image of the sources of a mosaic"),
        rasterio.Env(**GDAL_OPTIONS),
        rasterio.open(sources) as file,
    ):
        shape = tuple(max(1, -(-size // cell_px)) for size in file.shape)
        numbers = file.read(1, out_shape=shape)
        scale = Affine.scale(file.width / shape[1], file.height / shape[0])
        transform, crs = file.transform @ scale, file.crs.to_wkt()
    numbers = rasterio.features.sieve(numbers, _SPECK_CELLS)
    parts: dict[int, list[shapely.Geometry]] = {}
    for geometry, number in rasterio.features.shapes(numbers, numbers > 0, transform=transform):
        parts.setdefault(int(number), []).append(shapely.geometry.shape(geometry))
    count = len(next(iter(fields.values())))
    ground = [shapely.MultiPolygon(parts.get(number, [])) for number in range(1, count + 1)]
    path.unlink(missing_ok=True)
    pyogrio.raw.write(
        path,
        shapely.to_wkb(np.array(ground, dtype=object)),
        [np.arange(1, count + 1), *fields.values()],
        ["number", *fields],
        layer=LAYER,
        driver="GPKG",
        geometry_type="MultiPolygon",
        crs=crs,
    )
