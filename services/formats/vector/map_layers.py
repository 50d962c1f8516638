"""Vector layers on a map with heights above the ellipsoid, and layers in pixels of an image."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from amers.services.errors import MissingGeoid
from amers.services.formats.gcp.comments import check_axes, earth_crs
from amers.services.formats.gcp.marked_points import to_wgs84
from amers.services.formats.gcp.record import Record
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.vector.layers import Geometries, VectorLayer, read_layer
from amers.services.statements import Subject
from amers.services.types import Array

READER = Reader(
    "Vectors: GeoPackage, GeoJSON, shapefile, FlatGeobuf",
    ("read_layer", "read_map_layer", "read_pixel_layer"),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "Vectors on a map have a reference system."),
        Treatment(
            Subject.HORIZONTAL_DATUM, "named", "Vectors in pixel coordinates have a reference system."
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "The reference system is not of the Earth."),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The reference system has heights, as a compound system or with three axes.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "The system has no heights: the heights of vertices have the vertical datum of the terrain.",
        ),
        Treatment(Subject.VERTICAL_DATUM, "refused", "The grid of the vertical datum is not installed."),
        Treatment(
            Subject.UNIT,
            "used",
            "A reference system with heights states the unit of heights, such as feet.",
        ),
        Treatment(
            Subject.UNIT, "assumed", "The system has no heights: the heights of vertices are in metres."
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "The vertices are in the area of their reference system only if x and y are exchanged.",
        ),
        Treatment(Subject.EPOCH, "named", "A GeoPackage states a coordinate epoch."),
        Treatment(Subject.IDENTITY, "named", "The file has other layers than the one that is read."),
    ),
    (
        Subject.MODEL,
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.VALIDITY,
        Subject.BANDS,
        Subject.ACCURACY,
    ),
)


def read_pixel_layer(path: Path, name: str | None = None) -> VectorLayer:
    """A layer in pixel coordinates of an image; a reference system is named as not used.

    Args:
        path, name: as for `read_layer`.

    Raises:
        InputError, FormatError: as for `read_layer`.
    """
    layer = read_layer(path, name)
    record = Record(path.name, list(layer.statements))
    if layer.crs is not None:
        record.not_used(
            Subject.HORIZONTAL_DATUM, layer.crs[:80], "", "its coordinates are pixels of the image"
        )
    return replace(layer, statements=tuple(record.statements))


def read_map_layer(path: Path, name: str | None = None) -> VectorLayer:
    """A layer on a map; in a reference system with heights they are metres above the WGS 84 ellipsoid.

    In a system without heights they stay as they are.

    Args:
        path, name: as for `read_layer`.

    Raises:
        InputError, FormatError: as for `read_layer`; the reference system is of another body, x and y
            are exchanged, or the heights cannot be converted.
    """
    layer = read_layer(path, name)
    if layer.crs is None:
        return layer
    record = Record(path.name, list(layer.statements))
    crs = earth_crs(layer.crs, path.name)
    xyz = shapely.get_coordinates(layer.geometries, include_z=True)
    check_axes(xyz, crs, path.name)
    geometries = layer.geometries
    if not np.isfinite(xyz[:, 2]).any():
        record.used(Subject.HORIZONTAL_DATUM, crs.name, "reference system")
    elif len(crs.axis_info) < 3:
        record.used(Subject.HORIZONTAL_DATUM, crs.name, "reference system")
        record.assumed(Subject.UNIT, "metres", "heights")
        record.assumed(Subject.VERTICAL_DATUM, "that of the terrain", "heights")
    else:
        try:
            ground = to_wgs84(xyz, crs, None, path.name)
        except MissingGeoid as error:
            raise MissingGeoid(
                f"{error}; or give the vectors in a system without heights, with heights in metres in "
                "the vertical datum of the terrain"
            ) from None
        record.statements += ground.statements
        geometries = _with_heights(geometries, ground.lon_lat_h[:, 2])
    return replace(layer, geometries=geometries, statements=tuple(record.statements))


def _with_heights(geometries: Geometries, height_m: Array) -> Geometries:
    """Geometries with other heights (v,) of all their vertices, where they have any."""
    out = geometries.copy()
    rows = np.flatnonzero(shapely.has_z(geometries))
    _, owner = shapely.get_coordinates(geometries, return_index=True)
    new = height_m[np.isin(owner, rows)]
    out[rows] = shapely.transform(
        geometries[rows],
        lambda xyz: np.column_stack([xyz[:, :2], np.where(np.isnan(xyz[:, 2]), math.nan, new)]),
        include_z=True,
    )
    return out
