"""Reading and writing the two tables of an Amers block, `points.parquet` and `views.parquet`."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import shapely

from amers.services.errors import FormatError
from amers.services.types import Acquisition, Array, IntArray, SurfaceHeights

POINTS_PARQUET = "points.parquet"
VIEWS_PARQUET = "views.parquet"

Dates = npt.NDArray[np.datetime64]
Texts = npt.NDArray[np.object_]

_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_CORRELATIONS = ("corr_east_north", "corr_east_up", "corr_north_up")

POINTS_SCHEMA = pa.schema(
    [
        pa.field("id", pa.int64(), nullable=False),
        pa.field("geometry", pa.binary(), nullable=False),
        *(pa.field(name, pa.float64(), nullable=False) for name in _SIGMAS + _CORRELATIONS),
        pa.field("n_views", pa.int16(), nullable=False),
        pa.field("saliency", pa.float32(), nullable=False),
        pa.field("typology", pa.string()),
        pa.field("first_view", pa.date32()),
        pa.field("last_view", pa.date32()),
        pa.field("chip_file", pa.string(), nullable=False),
        pa.field("chip_row", pa.int64(), nullable=False),
        pa.field("chip_count", pa.int16(), nullable=False),
    ]
)

SURFACE_SCHEMA = pa.schema(
    [pa.field("surface_height_m", pa.float64()), pa.field("surface_sigma_m", pa.float64())]
)
"""Columns of `points.parquet` that a block has only where its producer states the surface."""

VIEWS_SCHEMA = pa.schema(
    [
        pa.field("point_id", pa.int64(), nullable=False),
        pa.field("view", pa.int16(), nullable=False),
        pa.field("gsd_m", pa.float64(), nullable=False),
        pa.field("image_id", pa.string(), nullable=False),
        pa.field("sensor", pa.string(), nullable=False),
        pa.field("acquired_at", pa.timestamp("us", tz="UTC")),
        pa.field("incidence_deg", pa.float64()),
        pa.field("azimuth_deg", pa.float64()),
        pa.field("sun_elevation_deg", pa.float64()),
        pa.field("sun_azimuth_deg", pa.float64()),
        pa.field("chip_file", pa.string(), nullable=False),
        pa.field("chip_row", pa.int64(), nullable=False),
    ]
)


@dataclass(frozen=True)
class PointRows:
    """The rows of `points.parquet`.

    Attributes:
        id: (n,) int64.
        lon_lat_h: (n, 3) degrees, degrees, metres.
        sigma_m: (n, 3) east, north, up, one standard deviation.
        correlation: (n, 3) east-north, east-up, north-up.
        n_views: (n,) int64, images that see the point.
        saliency: (n,).
        typology: (n,) str or None.
        first_view, last_view: (n,) datetime64[D], NaT when unknown.
        chip_file: (n,) int64, rows of `chip_files`.
        chip_row, chip_count: (n,) int64, first row and number of the point's chips in its file.
        chip_files: paths in the block.
        surface: heights of the surface, NaN where unknown; None without these columns.
    """

    id: IntArray
    lon_lat_h: Array
    sigma_m: Array
    correlation: Array
    n_views: IntArray
    saliency: Array
    typology: Texts
    first_view: Dates
    last_view: Dates
    chip_file: IntArray
    chip_row: IntArray
    chip_count: IntArray
    chip_files: tuple[str, ...]
    surface: SurfaceHeights | None = None


@dataclass(frozen=True)
class ViewRows:
    """The columns of `views.parquet`, except those that `block.json` repeats for each image.

    Attributes:
        point_id, view: (m,) int64.
        gsd_m: (m,) metres.
        image: (m,) int64, rows of `image_ids`.
        incidence_deg, azimuth_deg: (m,) NaN when unknown.
        chip_file: (m,) int64, rows of `chip_files`.
        chip_row: (m,) int64.
        image_ids: names of the images.
        chip_files: paths in the block.
    """

    point_id: IntArray
    view: IntArray
    gsd_m: Array
    image: IntArray
    incidence_deg: Array
    azimuth_deg: Array
    chip_file: IntArray
    chip_row: IntArray
    image_ids: tuple[str, ...]
    chip_files: tuple[str, ...]


def covariance_from_sigmas(sigma_m: Array, correlation: Array) -> Array:
    """Covariances (n, 3, 3) of sigmas (n, 3) and correlations (n, 3) east-north, east-up, north-up."""
    covariance = sigma_m[:, :, None] * sigma_m[:, None, :]
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        covariance[:, i, j] *= correlation[:, k]
        covariance[:, j, i] *= correlation[:, k]
    return covariance


def sigmas_from_covariance(covariance_m2: Array) -> tuple[Array, Array]:
    """Sigmas (n, 3) and correlations (n, 3) east-north, east-up, north-up of covariances (n, 3, 3)."""
    sigma = np.sqrt(np.diagonal(covariance_m2, axis1=1, axis2=2))
    rows, columns = [0, 0, 1], [1, 2, 2]
    return sigma, covariance_m2[:, rows, columns] / (sigma[:, rows] * sigma[:, columns])


def write_points(path: Path, rows: PointRows) -> None:
    """Write `points.parquet`: GeoParquet 1.1, WKB PointZ in EPSG:4979."""
    columns = {
        "id": rows.id,
        "geometry": shapely.to_wkb(shapely.points(rows.lon_lat_h), flavor="iso"),
        "n_views": rows.n_views,
        "saliency": rows.saliency.astype(np.float32),
        "typology": rows.typology,
        "first_view": rows.first_view,
        "last_view": rows.last_view,
        "chip_file": pa.array(rows.chip_files, pa.string()).take(pa.array(rows.chip_file)),
        "chip_row": rows.chip_row,
        "chip_count": rows.chip_count,
    }
    columns |= {name: rows.sigma_m[:, i] for i, name in enumerate(_SIGMAS)}
    columns |= {name: rows.correlation[:, i] for i, name in enumerate(_CORRELATIONS)}
    schema = POINTS_SCHEMA
    if rows.surface is not None:
        schema = pa.unify_schemas([POINTS_SCHEMA, SURFACE_SCHEMA])
        known = (rows.surface.height_m, rows.surface.sigma_m)
        columns |= {
            name: pa.array(values, from_pandas=True)  # NaN becomes null
            for name, values in zip(SURFACE_SCHEMA.names, known, strict=True)
        }
    low, high = rows.lon_lat_h.min(axis=0), rows.lon_lat_h.max(axis=0)
    geo = {
        "version": "1.1.0",
        "primary_column": "geometry",
        "columns": {
            "geometry": {
                "encoding": "WKB",
                "geometry_types": ["Point Z"],
                "crs": pyproj.CRS.from_epsg(4979).to_json_dict(),
                "bbox": [*low.tolist(), *high.tolist()],
            }
        },
    }
    schema = schema.with_metadata({"geo": json.dumps(geo)})
    arrays = [pa.array(columns[field.name], field.type) for field in schema]
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path, compression="zstd")


def write_views(path: Path, rows: ViewRows, images: tuple[Acquisition, ...]) -> None:
    """Write `views.parquet`; `images` are in the order of `rows.image_ids`."""
    image = pa.array(rows.image)

    def per_view(values: list[object], name: str) -> pa.Array:
        return pa.array(values, VIEWS_SCHEMA.field(name).type).take(image)

    columns = {
        "point_id": rows.point_id,
        "view": rows.view,
        "gsd_m": rows.gsd_m,
        "image_id": per_view(list(rows.image_ids), "image_id"),
        "sensor": per_view([image.sensor for image in images], "sensor"),
        "acquired_at": per_view([image.acquired_at for image in images], "acquired_at"),
        "incidence_deg": rows.incidence_deg,
        "azimuth_deg": rows.azimuth_deg,
        "sun_elevation_deg": per_view([i.sun_elevation_deg for i in images], "sun_elevation_deg"),
        "sun_azimuth_deg": per_view([i.sun_azimuth_deg for i in images], "sun_azimuth_deg"),
        "chip_file": pa.array(rows.chip_files, pa.string()).take(pa.array(rows.chip_file)),
        "chip_row": rows.chip_row,
    }
    arrays = [pa.array(columns[field.name], field.type) for field in VIEWS_SCHEMA]
    pq.write_table(pa.Table.from_arrays(arrays, schema=VIEWS_SCHEMA), path, compression="zstd")


def read_points(path: Path, most_rows: int) -> PointRows:
    """The rows of a `points.parquet`; values are not checked, an empty point is NaN.

    Args:
        most_rows: a file with more is refused before it is unpacked.

    Raises:
        FormatError: the file is not Parquet, or a column is missing, has another type or is null; or it
            has more rows.
    """
    table = _read_table(path, most_rows, POINTS_SCHEMA, SURFACE_SCHEMA)
    try:
        geometry = shapely.from_wkb(table["geometry"].to_numpy())
    except shapely.errors.ShapelyError as error:
        raise FormatError(f"{path.name}: geometry: WKB expected: {error}") from error
    point = shapely.get_type_id(geometry) == shapely.GeometryType.POINT
    if not point.all():
        row = int(np.argmin(point))
        raise FormatError(
            f"{path.name}: geometry: row {row}: {geometry[row].geom_type} found, Point Z expected"
        )
    # Shapely returns no coordinates for an empty point, which WKB encodes as NaN.
    placed = ~shapely.is_empty(geometry)
    lon_lat_h = np.full((len(geometry), 3), np.nan)
    lon_lat_h[placed] = shapely.get_coordinates(geometry[placed], include_z=True)
    chip_file, chip_files = _dictionary_encoded(table["chip_file"])
    return PointRows(
        id=table["id"].to_numpy(),
        lon_lat_h=lon_lat_h,
        sigma_m=np.column_stack([table[name].to_numpy() for name in _SIGMAS]),
        correlation=np.column_stack([table[name].to_numpy() for name in _CORRELATIONS]),
        n_views=table["n_views"].to_numpy().astype(np.int64),
        saliency=table["saliency"].to_numpy().astype(np.float64),
        typology=np.array(table["typology"].to_pylist(), dtype=object),
        first_view=table["first_view"].to_numpy().astype("datetime64[D]"),
        last_view=table["last_view"].to_numpy().astype("datetime64[D]"),
        chip_file=chip_file,
        chip_row=table["chip_row"].to_numpy(),
        chip_count=table["chip_count"].to_numpy().astype(np.int64),
        chip_files=chip_files,
        surface=_surface(table),
    )


def read_views(path: Path, most_rows: int) -> ViewRows:
    """The rows of a `views.parquet`; values are not checked.

    Args:
        most_rows: a file with more is refused before it is unpacked.

    Raises:
        FormatError: the file is not Parquet, or a column is missing, has another type or is null; or it
            has more rows.
    """
    table = _read_table(path, most_rows, VIEWS_SCHEMA)
    image, image_ids = _dictionary_encoded(table["image_id"])
    chip_file, chip_files = _dictionary_encoded(table["chip_file"])
    return ViewRows(
        point_id=table["point_id"].to_numpy(),
        view=table["view"].to_numpy().astype(np.int64),
        gsd_m=table["gsd_m"].to_numpy(),
        image=image,
        incidence_deg=table["incidence_deg"].to_numpy(),
        azimuth_deg=table["azimuth_deg"].to_numpy(),
        chip_file=chip_file,
        chip_row=table["chip_row"].to_numpy(),
        image_ids=image_ids,
        chip_files=chip_files,
    )


def _surface(table: pa.Table) -> SurfaceHeights | None:
    """The heights of the surface; None where the table has none."""
    if not set(SURFACE_SCHEMA.names) <= set(table.column_names):
        return None
    return SurfaceHeights(*(table[name].to_numpy() for name in SURFACE_SCHEMA.names))


def _read_table(
    path: Path, most_rows: int, schema: pa.Schema, optional: pa.Schema | None = None
) -> pa.Table:
    """The columns of a schema, and those of an optional one if the file has them all."""
    try:
        with pq.ParquetFile(path, memory_map=False) as file:
            if optional is not None and set(optional.names) <= set(file.schema_arrow.names):
                schema = pa.unify_schemas([schema, optional])
            _check_schema(path.name, file.schema_arrow, schema)
            # A thousand equal rows take a byte in the file, and a hundred thousand in memory.
            if file.metadata.num_rows > most_rows:
                raise FormatError(
                    f"{path.name}: {file.metadata.num_rows} rows found, {most_rows} expected as "
                    "amers:counts of block.json states"
                )
            table = file.read(columns=schema.names)
        # A file may declare text that is not UTF-8, or offsets beyond its buffers.
        table.validate(full=True)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path.name}: cannot be read as Parquet: {error}") from error
    for field in schema:
        if not field.nullable and table[field.name].null_count:
            row = int(np.argmax(table[field.name].is_null().to_numpy()))
            raise FormatError(f"{path.name}: {field.name}: row {row}: null found, a value expected")
    return table


def _check_schema(name: str, actual: pa.Schema, expected: pa.Schema) -> None:
    for field in expected:
        if field.name not in actual.names:
            raise FormatError(f"{name}: {field.name}: no such column, {field.type} expected")
        if actual.field(field.name).type != field.type:
            raise FormatError(
                f"{name}: {field.name}: {actual.field(field.name).type} found, {field.type} expected"
            )


def _dictionary_encoded(column: pa.ChunkedArray) -> tuple[IntArray, tuple[str, ...]]:
    """The index (n,) of each text of a column, and the tuple of its distinct texts."""
    encoded = column.combine_chunks().dictionary_encode()
    return encoded.indices.to_numpy().astype(np.int64), tuple(encoded.dictionary.to_pylist())
