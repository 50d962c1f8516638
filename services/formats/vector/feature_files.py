"""Tables of features, and their files for other tools: GeoParquet, GeoPackage, FlatGeobuf."""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pyproj
import shapely

from amers.services.formats.vector.qgis_styles import LAYER_STYLES, add_styles

KEYS = "keys"
"""Column of a CSV with the paging key of each row."""
ARROW_TYPES = {
    "bigint": pa.int64(),
    "real": pa.float32(),
    "double precision": pa.float64(),
    "text": pa.string(),
    "boolean": pa.bool_(),
    "date": pa.date32(),
    "timestamptz": pa.timestamp("us", "UTC"),
}


@dataclass(frozen=True)
class Column:
    """Name and SQL type of a column of properties."""

    name: str
    type: str


@dataclass(frozen=True)
class FeatureTable:
    """A table of features.

    Attributes:
        rows: properties, and WKB in the column `geometry`, longitude or east first.
        geometry_type: in the terms of GeoPackage, with Z where there are heights; MultiPolygon for all
            when one polygon has several parts, being cut at the antimeridian.
        srid: EPSG code of the coordinates.
        is_sorted: whether the order of the rows means something, and files keep it.
    """

    rows: pa.Table
    geometry_type: str
    srid: int
    is_sorted: bool = False

    def __len__(self) -> int:
        return int(self.rows.num_rows)


def read_feature_csv(
    text: BytesIO, columns: Sequence[Column], geometry_type: str, srid: int, limit: int
) -> tuple[FeatureTable, str | None]:
    """The table of a CSV of features with a header.

    Args:
        text: columns `keys`, then x, y (and h) of points or hexadecimal `wkb`, then those of `columns`.
        columns: the properties.
        geometry_type: Point, Polygon or another type of GeoPackage, without Z.
        srid: EPSG code of the coordinates.
        limit: number of rows to return.

    Returns:
        The features, and the `keys` of the last one when the CSV has more rows.
    """
    types = {KEYS: pa.string(), "x": pa.float64(), "y": pa.float64(), "h": pa.float64()}
    types |= {"wkb": pa.string(), **{column.name: ARROW_TYPES[column.type] for column in columns}}
    read = pa.csv.read_csv(
        text,
        convert_options=pa.csv.ConvertOptions(
            column_types=types,
            strings_can_be_null=True,
            quoted_strings_can_be_null=False,
            null_values=[""],
            true_values=["t"],
            false_values=["f"],
        ),
        parse_options=pa.csv.ParseOptions(newlines_in_values=True),
    )
    last = read[KEYS][limit - 1].as_py() if read.num_rows > limit else None
    read = read.slice(0, limit)
    has_height = "h" in read.column_names
    if geometry_type == "Point":
        axes = ("x", "y", "h") if has_height else ("x", "y")
        shapes = shapely.points(*(read[axis].to_numpy() for axis in axes))
    else:
        shapes = shapely.from_wkb(read["wkb"].to_numpy(zero_copy_only=False))
        if (shapely.get_type_id(shapes) == shapely.GeometryType.MULTIPOLYGON).any():
            geometry_type, shapes = "MultiPolygon", _as_multipolygons(shapes)
    geometry = pa.array(shapely.to_wkb(shapes, flavor="iso"), pa.binary())
    rows = read.select([column.name for column in columns]).append_column("geometry", geometry)
    return FeatureTable(rows, geometry_type + (" Z" if has_height else ""), srid), last


def _as_multipolygons(polygons: npt.NDArray[np.object_]) -> npt.NDArray[np.object_]:
    """Polygons and multipolygons (n,), all as multipolygons; None where the geometry is missing."""
    parts, owner = shapely.get_parts(polygons, return_index=True)
    out = np.full(len(polygons), None)
    shapely.multipolygons(parts, indices=owner, out=out)
    return out


def format_parquet(features: FeatureTable, layer: str) -> bytes:
    """The bytes of a GeoParquet 1.1 with features; the format stores no layer name."""
    shapes = shapely.from_wkb(features.rows["geometry"].to_numpy(zero_copy_only=False))
    column = {
        "encoding": "WKB",
        "geometry_types": [features.geometry_type],
        "crs": pyproj.CRS.from_epsg(features.srid).to_json_dict(),
    }
    if features.rows["geometry"].null_count < len(features):
        column["bbox"] = shapely.total_bounds(shapes).tolist()
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    out = BytesIO()
    pq.write_table(
        features.rows.replace_schema_metadata({"geo": json.dumps(geo)}), out, compression="zstd"
    )
    return out.getvalue()


def format_geopackage(features: FeatureTable, layer: str) -> bytes:
    """The bytes of a GeoPackage with one layer of features; control points have styles for QGIS."""
    return _file_bytes(features, layer, "GPKG", "features.gpkg")


def format_flatgeobuf(features: FeatureTable, layer: str) -> bytes:
    """The bytes of a FlatGeobuf with its spatial index.

    The index dictates the order of features, and holds none without a geometry. So features that are
    sorted, or some of which have no geometry, come without it.
    """
    is_indexed = not features.is_sorted and not features.rows["geometry"].null_count
    options = {"SPATIAL_INDEX": "YES" if is_indexed else "NO"}
    return _file_bytes(features, layer, "FlatGeobuf", "features.fgb", **options)


def _file_bytes(features: FeatureTable, layer: str, driver: str, name: str, **options: str) -> bytes:
    import pyogrio  # imported here because it takes 0.4 s and only these formats need it

    with tempfile.TemporaryDirectory(prefix="amers-features-") as folder:
        path = Path(folder) / name
        pyogrio.write_arrow(
            features.rows,
            path,
            layer=layer,
            driver=driver,
            geometry_name="geometry",
            geometry_type=features.geometry_type,
            crs=f"EPSG:{features.srid}",
            **options,
        )
        if driver == "GPKG" and layer in LAYER_STYLES:
            add_styles(path, [layer])
        return path.read_bytes()
