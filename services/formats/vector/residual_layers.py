"""The points of a registration and their residuals, as layers of a GeoPackage."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.formats.gcp.json_formats import measured_numbers
from amers.services.formats.vector.qgis_styles import add_styles
from amers.services.geodesy import metres_per_degree_at, wrapped_degrees
from amers.services.types import Array, Measures

CRS_3D = "EPSG:4979"
"""Longitude, latitude, height above the WGS 84 ellipsoid."""
CRS = "EPSG:4326"

VISIBLE_SHARE = 0.04

Fields = dict[str, npt.NDArray[np.generic]]


def write_residual_layers(
    path: Path,
    measures: Measures,
    image: str,
    exaggeration: float,
    held: Sequence[Sequence[Array]] = (),
) -> None:
    """Write the layers `held_area`, `residuals` (3D lines) and `control_points` (3D points).

    Each has a style for QGIS.

    A line starts at the control point and follows, at its height, the residual on the ground, observed
    minus computed, times the exaggeration, which is an attribute of each line. Only matched points have
    a line.

    Args:
        path: of the file; an existing one is replaced.
        measures: of all n points within the scene.
        image: name of the scene.
        exaggeration: ratio of the length of a line to that of its residual.
        held: polygons of rings (n, 2), lon, lat: the area for which accuracy is stated.
    """
    path.unlink(missing_ok=True)
    fields = _fields(measures, image)
    has_residual = measures.matched & np.isfinite(measures.residual_m).all(axis=1)
    start = measures.lon_lat_h[has_residual]
    end = start.copy()
    end[:, :2] += exaggeration * measures.residual_m[has_residual] / metres_per_degree_at(start)
    lines = shapely.linestrings(np.stack([start, end], axis=1))
    stretch = {"exaggeration": np.full(len(lines), exaggeration)}
    line_fields = {name: values[has_residual] for name, values in fields.items()}
    area = shapely.MultiPolygon([(rings[0], rings[1:]) for rings in held])
    of_image: Fields = {"image": np.array([image], dtype=object)}
    _write(path, "held_area", "MultiPolygon", np.array([area]), of_image)
    _write(path, "residuals", "LineString Z", lines, {**line_fields, **stretch})
    _write(path, "control_points", "Point Z", shapely.points(measures.lon_lat_h), fields)
    add_styles(path, ["held_area", "residuals", "control_points"])


def exaggeration_for(measures: Measures) -> float:
    """The exaggeration with which residuals are visible on a map of the scene.

    The residual that 90 % are smaller than gets at most `VISIBLE_SHARE` of the diagonal of the points.

    Returns:
        1, 2 or 5 times a power of ten; at least 1.
    """
    length_m = np.hypot(*measures.residual_m[measures.active].T)
    length_m = length_m[np.isfinite(length_m)]
    if not len(length_m):
        return 1.0
    offset = measures.lon_lat_h[:, :2] - measures.lon_lat_h[0, :2]
    offset[:, 0] = wrapped_degrees(offset[:, 0])
    extent_m = np.ptp(offset, axis=0) * metres_per_degree_at(measures.lon_lat_h[:1])[0]
    wanted = VISIBLE_SHARE * float(np.hypot(*extent_m)) / max(float(np.quantile(length_m, 0.9)), 1e-9)
    if not wanted > 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted))


def _fields(measures: Measures, image: str) -> Fields:
    """The attributes (n,) of all points, by name."""
    n = len(measures.point_id)
    return {
        "point_id": measures.point_id,
        "image": np.full(n, image, dtype=object),
        "status": np.array([measures.status(i) for i in range(n)], dtype=object),
        "reason": measures.reason.astype(object),
        "views": measures.views,
        **measured_numbers(measures),
        "residual_m": np.hypot(*measures.residual_m.T),
        "height_m": measures.lon_lat_h[:, 2],
    }


def _write(path: Path, layer: str, kind: str, geometry: npt.NDArray[np.object_], fields: Fields) -> None:
    import pyogrio  # imported here because it takes 0.4 s and only these layers need it

    pyogrio.raw.write(
        path,
        shapely.to_wkb(geometry, output_dimension=3 if kind.endswith("Z") else 2),
        list(fields.values()),
        list(fields),
        layer=layer,
        driver="GPKG",
        geometry_type=kind,
        crs=CRS_3D if kind.endswith("Z") else CRS,
        append=path.exists(),
    )
