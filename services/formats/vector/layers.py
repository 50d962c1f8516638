"""Reading and writing of whole vector layers, with all attributes.

| format | suffix | attributes |
|---|---|---|
| GeoPackage | `.gpkg` | all types, feature numbers |
| GeoJSON | `.geojson`, `.json` | JSON types |
| shapefile | `.shp` | names of 10 letters, one type of geometry |
| FlatGeobuf | `.fgb` | all types |
"""

import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from amers.services.errors import FormatError, InputError
from amers.services.formats.vector.plain_geojson import plain_geojson
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import IntArray

DRIVERS = {
    ".gpkg": "GPKG",
    ".geojson": "GeoJSON",
    ".json": "GeoJSON",
    ".shp": "ESRI Shapefile",
    ".fgb": "FlatGeobuf",
}
"""Drivers of GDAL, by the suffix of the file; no other is used."""
_SIGNATURES = {
    "GPKG": b"SQLite format 3\0",
    "GeoJSON": b"{",
    "ESRI Shapefile": b"\0\0\x27\x0a",
    "FlatGeobuf": b"fgb\3fgb",
}
_OPTIONS = {"FlatGeobuf": {"SPATIAL_INDEX": "NO"}}
"""Options of drivers; with an index, a FlatGeobuf would have its features in another order."""

INFINITE = "a coordinate is not a number or infinite"
NO_SHAPE = "a damaged geometry or a curve; points, lines and polygons with straight edges expected"
_TAKEN = {"fid", "ogc_fid", "geom", "geometry"}
"""Names of columns that a GeoPackage has itself, or that GDAL takes for those."""

Geometries = npt.NDArray[np.object_]


@dataclass(frozen=True)
class VectorLayer:
    """Features of one layer.

    Attributes:
        name: of the layer.
        geometries: (n,) of shapely; None where a feature has none.
        attributes: n rows.
        crs: code or WKT of the reference system; None when there is none, or an unknown one.
        fid: (n,) numbers of the features where the format keeps them; None otherwise.
        unusable: rows whose geometry cannot be used and is missing, each with the reason.
        statements: of the file.
    """

    name: str
    geometries: Geometries
    attributes: pa.Table
    crs: str | None
    fid: IntArray | None = None
    unusable: dict[int, str] = field(default_factory=dict)
    statements: Statements = ()

    def changed(
        self, geometries: Geometries, columns: dict[str, npt.NDArray[Any]], crs: str | None
    ) -> "VectorLayer":
        """The layer with other geometries (n,), and more attributes (n,), of which NaN is null.

        They replace attributes of the same names, in small or capital letters.
        """
        new = {name.lower() for name in columns}
        former = [name for name in self.attributes.column_names if name.lower() in new]
        table = self.attributes.drop_columns(former)
        for name, values in columns.items():
            table = table.append_column(name, pa.array(values, from_pandas=True))
        return replace(self, geometries=geometries, attributes=table, crs=crs)

    def take(self, rows: IntArray) -> "VectorLayer":
        """The features of the given rows, in that order."""
        fid = None if self.fid is None else self.fid[rows]
        taken = {row: number for number, row in enumerate(rows.tolist())}
        return replace(
            self,
            geometries=self.geometries[rows],
            attributes=self.attributes.take(rows),
            fid=fid,
            unusable={taken[row]: why for row, why in self.unusable.items() if row in taken},
        )


def driver_of(path: Path) -> str:
    """The driver for a file, by its suffix.

    Raises:
        InputError: no format has that suffix.
    """
    driver = DRIVERS.get(path.suffix.lower())
    if driver is None:
        raise InputError(
            f"{path}: {path.suffix or 'no suffix'} found, one of {', '.join(DRIVERS)} expected"
        )
    return driver


def read_layer(path: Path, name: str | None = None) -> VectorLayer:
    """A layer of a file; geometries that cannot be used are missing, and named in `unusable`.

    Args:
        path: of the file; the suffix states the format.
        name: of the layer; None for the only one with geometries.

    Raises:
        InputError: the suffix is that of no format, or the layer must be named.
        FormatError: the file is damaged, has another format than its suffix says, or has no feature that
            can be used.
    """
    import pyogrio  # imported here because it takes 0.4 s and only vectors need it

    driver = driver_of(path)
    _check_signature(path, driver)
    with _named(path, "read"), TemporaryDirectory(prefix="amers-") as folder:
        source, is_known, unusable = str(path), True, dict[int, str]()
        if driver == "GeoJSON":
            source, is_known, unusable = plain_geojson(path, Path(folder))
        layers = {str(layer): kind for layer, kind in pyogrio.list_layers(source)}
        with_geometries = [layer for layer, kind in layers.items() if kind is not None]
        names = ", ".join(with_geometries)[:300] or "none"
        if name is None and len(with_geometries) != 1:
            raise InputError(f"{path}: one layer with geometries expected, {names} found; add --layer")
        if name is not None and name not in with_geometries:
            raise InputError(f"{path}: no layer {name[:80]!r} with geometries; it has {names}")
        meta, table = pyogrio.read_arrow(source, layer=name or with_geometries[0], return_fids=True)
    at = _geometry_column(table, meta["geometry_name"] or "wkb_geometry")
    geometries, unread = _geometries(table.column(at))
    unusable |= unread
    if unusable and len(unusable) == len(geometries):
        row, why = min(unusable.items())
        raise FormatError(f"{path}: no feature can be used; feature {row + 1}: {why}")
    attributes = [number for number in range(1, table.num_columns) if number != at]
    taken = name or with_geometries[0]
    return VectorLayer(
        taken,
        geometries,
        table.select(attributes),
        meta["crs"] if is_known else None,
        table.column(0).to_numpy() if driver == "GPKG" else None,
        unusable,
        _statements(path, driver, taken, list(layers)),
    )


def _statements(path: Path, driver: str, taken: str, layers: list[str]) -> Statements:
    """What a file states beside the layer that is read."""
    others = [layer for layer in layers if layer not in (taken, "layer_styles")]
    found = []
    if others:
        shown = ", ".join(others)[:200]
        found.append(Statement(path.name, Subject.IDENTITY, Use.NOT_USED, shown, "other layers"))
    epoch = _epoch(path, taken) if driver == "GPKG" else None
    if epoch is not None:
        note = "its reference system is taken at its own epoch"
        found.append(Statement(path.name, Subject.EPOCH, Use.NOT_USED, f"{epoch:g}", "", note))
    return tuple(found)


def _epoch(path: Path, layer: str) -> float | None:
    """The coordinate epoch of a layer of a GeoPackage, in a column that GDAL adds to its systems."""
    query = (
        "SELECT s.epoch FROM gpkg_spatial_ref_sys s "
        "JOIN gpkg_geometry_columns g ON g.srs_id = s.srs_id WHERE g.table_name = ?"
    )
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as file:
            row = file.execute(query, (layer,)).fetchone()
    except sqlite3.Error:
        return None
    return float(row[0]) if row and isinstance(row[0], (int, float)) else None


def _geometry_column(table: pa.Table, name: str) -> int:
    """The number of the column of geometries; an attribute may have its name."""
    columns = [number for number, one in enumerate(table.column_names) if one == name]
    binary = [number for number in columns if pa.types.is_binary(table.schema.field(number).type)]
    return (binary or columns)[-1]


def _geometries(column: pa.ChunkedArray) -> tuple[Geometries, dict[int, str]]:
    """The geometries (n,) of a column, and the rows of those that cannot be used, which are missing."""
    geometries = shapely.from_wkb(column.to_numpy(zero_copy_only=False), on_invalid="ignore")
    # A FlatGeobuf has no bytes where a feature has no geometry.
    size = pc.fill_null(pc.binary_length(column), 0).to_numpy()
    unread = np.flatnonzero(shapely.is_missing(geometries) & (size > 0))
    xyz, owner = shapely.get_coordinates(geometries, include_z=True, return_index=True)
    has_z = shapely.has_z(geometries)[owner]
    is_wrong = ~np.isfinite(xyz[:, :2]).all(axis=1) | (has_z & ~np.isfinite(xyz[:, 2]))
    infinite = np.unique(owner[is_wrong])
    geometries[infinite] = None
    return geometries, {int(row): NO_SHAPE for row in unread} | {int(row): INFINITE for row in infinite}


def write_layer(path: Path, layer: VectorLayer) -> dict[str, str]:
    """Write a file with one layer; an existing one is replaced, and stays whole when writing fails.

    Returns:
        The attributes that have other names in the file, with these.

    Raises:
        InputError: the suffix is that of no format, or the format cannot have these features.
    """
    import pyogrio  # imported here because it takes 0.4 s and only vectors need it

    driver = driver_of(path)
    geometries, kind = _of_one_type(layer.geometries, path)
    names = _free_names(layer.attributes, _TAKEN if driver == "GPKG" else set())
    table = layer.attributes.rename_columns(names)
    if layer.fid is not None and driver == "GPKG" and "fid" not in names:
        table = table.append_column("fid", pa.array(layer.fid))
    wkb = next(
        name for name in map("geometry{}".format, ("", *range(len(names) + 1))) if name not in names
    )
    table = table.append_column(wkb, pa.array(shapely.to_wkb(geometries), pa.binary()))
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".amers-", dir=path.parent) as folder:
        with _named(path, "written"), warnings.catch_warnings():
            # Pixel coordinates have no reference system.
            warnings.filterwarnings("ignore", message="'crs' was not provided")
            pyogrio.write_arrow(
                table,
                Path(folder) / path.name,
                layer=layer.name,
                driver=driver,
                geometry_name=wkb,
                geometry_type=kind,
                crs=layer.crs,
                **_OPTIONS.get(driver, {}),
            )
        for file in sorted(Path(folder).iterdir()):
            file.replace(path.parent / file.name)
    pairs = zip(layer.attributes.column_names, names, strict=True)
    return {former: name for former, name in pairs if former != name}


def _free_names(attributes: pa.Table, taken: set[str]) -> list[str]:
    """Names of attributes in a file, where capital letters do not count and some names are taken.

    An attribute `fid` of different whole numbers has the numbers of the features and keeps its name.
    """
    names, used = list[str](), {name.lower() for name in attributes.column_names} | taken
    for number, name in enumerate(attributes.column_names):
        is_taken = name.lower() in {one.lower() for one in names} | taken
        if is_taken and not (name == "fid" and _numbers_features(attributes.column(number))):
            name = next(
                f"{name}_{n}" for n in range(1, len(used) + 2) if f"{name}_{n}".lower() not in used
            )
            used.add(name.lower())
        names.append(name)
    return names


def _numbers_features(column: pa.ChunkedArray) -> bool:
    is_whole = pa.types.is_integer(column.type) and column.null_count == 0
    return is_whole and pc.count_distinct(column).as_py() == len(column)


def _of_one_type(geometries: Geometries, path: Path) -> tuple[Geometries, str]:
    """Geometries with single ones as multiple ones where both occur, and the type of their layer."""
    present = ~shapely.is_missing(geometries)
    kinds = {shape.geom_type for shape in geometries[present]}
    height = " Z" if shapely.has_z(geometries[present]).any() else ""
    if len(kinds) == 2 and {kind.removeprefix("Multi") for kind in kinds} != kinds:
        single = present & (shapely.get_type_id(geometries) < shapely.GeometryType.MULTIPOINT)
        build = {"Point": shapely.multipoints, "LineString": shapely.multilinestrings}
        kind = min(kinds, key=len)
        out = geometries.copy()
        rows = np.flatnonzero(single)
        out[rows] = build.get(kind, shapely.multipolygons)(
            geometries[rows], indices=np.arange(len(rows))
        )
        return out, f"Multi{kind}{height}"
    one_type = {".shp": "a shapefile", ".fgb": "a FlatGeobuf with heights"}.get(path.suffix.lower())
    if len(kinds) > 1 and one_type and (height or path.suffix.lower() == ".shp"):
        raise InputError(
            f"{path}: {one_type} has one type of geometry, {', '.join(sorted(kinds))} found; write "
            "a .gpkg"
        )
    return geometries, kinds.pop() + height if len(kinds) == 1 else "Unknown"


def _check_signature(path: Path, driver: str) -> None:
    """Refuse a file that is something else than its suffix says, before a driver opens it."""
    try:
        with path.open("rb") as file:
            start = file.read(200)
    except OSError as error:
        raise FormatError(f"{path}: cannot be opened: {error.strerror}") from error
    if driver == "GeoJSON":
        start = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not start.startswith(_SIGNATURES[driver]):
        raise FormatError(f"{path}: expected a {driver} file, found another kind of file")


@contextmanager
def _named(path: Path, what: str) -> Iterator[None]:
    """Turn errors of the drivers into errors that name the file."""
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, FieldError

    try:
        yield
    except (DataLayerError, DataSourceError, FeatureError, FieldError, RuntimeError, OSError) as error:
        raise FormatError(f"{path}: cannot be {what}: {error}") from error
    except (pa.ArrowException, ValueError) as error:
        raise FormatError(f"{path}: damaged, cannot be {what}: {error}") from error
