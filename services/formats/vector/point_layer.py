"""Points with attributes, for tables and maps: CSV, GeoJSON, GeoPackage."""

import csv
import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.errors import InputError
from amers.services.types import Array

POINT_SUFFIXES = (".csv", ".geojson", ".json", ".gpkg")
"""Formats of files of points, by the suffix of their names."""
CRS_3D = "EPSG:4979"
Fields = Mapping[str, npt.NDArray[Any]]


def write_point_layer(path: Path, layer: str, lon_lat_h: Array, fields: Fields) -> None:
    """Write points in the format that the suffix of the name of the file states.

    A CSV has the columns lon, lat and height_m after the first attribute, and a first line that states
    the datum of the heights, so that it can be read again as a file of ground points.

    Args:
        path: of the file, one of `POINT_SUFFIXES`; an existing one is replaced.
        layer: name of the layer of a GeoPackage.
        lon_lat_h: (n, 3) of the points.
        fields: attributes (n,), by name; the first one is the name of the points. NaN is unknown.

    Raises:
        InputError: the file has another suffix.
    """
    check_point_suffix(path)
    if path.suffix.lower() == ".csv":
        path.write_text(_csv(lon_lat_h, fields), encoding="utf-8")
    elif path.suffix.lower() == ".gpkg":
        _write_geopackage(path, layer, lon_lat_h, fields)
    else:
        path.write_text(_geojson(lon_lat_h, fields), encoding="utf-8")


def check_point_suffix(path: Path) -> None:
    """Refuse a file of points of another suffix.

    Raises:
        InputError: the suffix is not one of `POINT_SUFFIXES`.
    """
    if path.suffix.lower() not in POINT_SUFFIXES:
        raise InputError(
            f"{path}: {path.suffix or 'no suffix'} found, one of {', '.join(POINT_SUFFIXES)} expected"
        )


def _csv(lon_lat_h: Array, fields: Fields) -> str:
    out = io.StringIO()
    out.write("# heights=ellipsoid\n")
    rows = csv.writer(out, lineterminator="\n")
    first, *others = fields
    rows.writerow([first, "lon", "lat", "height_m", *others])
    for i, (lon, lat, height_m) in enumerate(lon_lat_h.tolist()):
        values = [_plain(fields[name][i]) for name in others]
        shown = ["" if value is None else value for value in values]
        name = _plain(fields[first][i])
        rows.writerow([name, f"{lon:.9f}", f"{lat:.9f}", f"{height_m:.4f}", *shown])
    return out.getvalue()


def _geojson(lon_lat_h: Array, fields: Fields) -> str:
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": position},
            "properties": {name: _plain(values[i]) for name, values in fields.items()},
        }
        for i, position in enumerate(lon_lat_h.tolist())
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def _write_geopackage(path: Path, layer: str, lon_lat_h: Array, fields: Fields) -> None:
    import pyogrio  # imported here because it takes 0.4 s and only these layers need it

    path.unlink(missing_ok=True)
    columns = [
        values.astype(object) if values.dtype.kind == "U" else values for values in fields.values()
    ]
    pyogrio.raw.write(
        path,
        shapely.to_wkb(shapely.points(lon_lat_h), output_dimension=3),
        columns,
        list(fields),
        layer=layer,
        driver="GPKG",
        geometry_type="Point Z",
        crs=CRS_3D,
    )


def _plain(value: np.generic) -> object:
    """A value of an array as JSON has it; None for NaN."""
    plain: object = value.item()
    return None if isinstance(plain, float) and math.isnan(plain) else plain
