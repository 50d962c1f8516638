"""A GeoPackage layer of ground cells with their figures."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.types import Array


def write_cell_layer(
    path: Path, layer: str, corners: tuple[Array, Array], fields: Mapping[str, npt.NDArray[np.generic]]
) -> None:
    """Write boxes of longitude and latitude with their attributes.

    Args:
        path: of the GeoPackage.
        layer: its only layer.
        corners: south-west and north-east corners (n, 2) of the boxes, degrees.
        fields: attributes (n,), by name.
    """
    import pyogrio  # imported here because it takes 0.4 s and only these layers need it

    (west, south), (east, north) = (corner.T for corner in corners)
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapely.box(west, south, east, north)),
        list(fields.values()),
        list(fields),
        layer=layer,
        driver="GPKG",
        geometry_type="Polygon",
        crs="EPSG:4326",
    )
