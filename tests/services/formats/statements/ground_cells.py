"""Vectors, masks and land cover: reference systems, heights, layers, classes."""

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import rasterio
import shapely
from rasterio.transform import from_origin

from amers.services.formats import ground_masks
from amers.services.formats.ground_masks import (
    CoveredGround,
    ExcludedGround,
    read_ground_mask,
    read_land_cover,
)
from amers.services.formats.reader_rows import Outcome
from amers.services.formats.vector import map_layers
from amers.services.formats.vector.layers import VectorLayer, write_layer
from amers.services.formats.vector.map_layers import read_map_layer, read_pixel_layer
from amers.services.statements import Subject
from tests.services.formats.statements.cell import cell
from tests.services.formats.statements.point_files import MOON

VECTORS, MASKS = map_layers.READER.name, ground_masks.READER.name
UTM_FEET = "EPSG:2263+6360"
a_millimetre = 1e-3


def add_vectors(
    subject: Subject,
    outcome: Outcome,
    shows: str,
    crs: str | None,
    wkt: str = "POINT Z (12 41 100)",
    *,
    read: Callable[[Path], VectorLayer] = read_map_layer,
    height_m: float | None = None,
    suffix: str = "gpkg",
    then: Callable[[Path], None] = lambda path: None,
) -> None:
    """A cell: a layer of one geometry is written and read; its first vertex has a height."""

    def written_and_read(folder: Path) -> VectorLayer:
        path = folder / f"layer.{suffix}"
        geometries = np.array([shapely.from_wkt(wkt)], dtype=object)
        write_layer(path, VectorLayer("layer", geometries, pa.table({"name": ["a"]}), crs))
        then(path)
        layer = read(path)
        if height_m is not None:
            z = shapely.get_coordinates(layer.geometries, include_z=True)[0, 2]
            assert abs(z - height_m) < a_millimetre
        return layer

    cell(VECTORS, subject, outcome, shows)(written_and_read)


AT_SEA = "LINESTRING Z (275443.7 4646566.3 100, 275453.7 4646566.3 101)"
for suffix in ("gpkg", "fgb", "shp"):
    add_vectors(
        Subject.HORIZONTAL_DATUM, "used", "33N", "EPSG:32633", AT_SEA, height_m=100.0, suffix=suffix
    )
add_vectors(Subject.HORIZONTAL_DATUM, "used", "WGS 84", "EPSG:4326", "POINT (12 41)", suffix="geojson")
add_vectors(
    Subject.HORIZONTAL_DATUM, "named", "EPSG:4326", "EPSG:4326", "POINT (5 -6)", read=read_pixel_layer
)
add_vectors(Subject.HORIZONTAL_DATUM, "refused", "of the Earth", MOON)
add_vectors(Subject.VERTICAL_DATUM, "assumed", "that of the terrain", "EPSG:32633", AT_SEA)
add_vectors(Subject.UNIT, "assumed", "metres", "EPSG:2263", "POINT Z (980000 200000 100)")
add_vectors(Subject.VERTICAL_DATUM, "used", "ellipsoid", "EPSG:4979", height_m=100.0)
add_vectors(Subject.UNIT, "used", "metre", "EPSG:4979", height_m=100.0)
add_vectors(
    Subject.VERTICAL_DATUM,
    "refused",
    "in a system without heights",
    UTM_FEET,
    "POINT Z (980000 200000 100)",
)
ELLIPSOIDAL_FEET = (
    'COMPD_CS["UTM + feet",PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1]],VERT_CS["WGS 84 ellipsoid",'
    'VERT_DATUM["Ellipsoid",2002],UNIT["{0}",{1}],AXIS["Up",UP]]]'
)
for unit, unit_m in (("foot", 0.3048), ("US survey foot", 1200 / 3937), ("centimetre", 0.01)):
    add_vectors(
        Subject.UNIT,
        "used",
        unit.split()[0],
        ELLIPSOIDAL_FEET.format(unit, unit_m),
        AT_SEA,
        height_m=100.0 * unit_m,
    )
add_vectors(
    Subject.ORDER, "refused", "exchanged", "EPSG:32633", "POINT (4646566.3 275443.7)", suffix="shp"
)


def _another_layer(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE remarks (text TEXT)")
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) "
            "VALUES ('remarks', 'attributes', 'remarks')"
        )
        file.commit()


def _epoch(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        columns = [row[1] for row in file.execute("PRAGMA table_info(gpkg_spatial_ref_sys)")]
        if "epoch" not in columns:
            file.execute("ALTER TABLE gpkg_spatial_ref_sys ADD COLUMN epoch DOUBLE")
        file.execute("UPDATE gpkg_spatial_ref_sys SET epoch = 2010.5")
        file.commit()


add_vectors(Subject.IDENTITY, "named", "remarks", "EPSG:4326", then=_another_layer)
add_vectors(Subject.EPOCH, "named", "2010.5", "EPSG:4326", then=_epoch)

# Masks and land cover

ON_IT = np.array([[5.005, 43.095], [5.055, 43.045]])


def image(folder: Path, *, crs: str | None = "EPSG:4326", count: int = 1, colours: bool = False) -> Path:
    """Ten by ten pixels of 80, of which the first has no data."""
    path = folder / "ground.tif"
    pixels = np.full((count, 10, 10), 80, dtype=np.uint8)
    pixels[:, 0, 0] = 255
    where = {} if crs is None else {"crs": crs, "transform": from_origin(5.0, 43.1, 0.01, 0.01)}
    with rasterio.open(
        path, "w", driver="GTiff", count=count, dtype="uint8", height=10, width=10, nodata=255, **where
    ) as file:
        file.write(pixels)
        if colours:
            file.write_colormap(1, {80: (0, 100, 200, 255), 0: (0, 0, 0, 255)})
    return path


@cell(MASKS, Subject.HORIZONTAL_DATUM, "used", "WGS 84")
def mask_on_a_map(folder: Path) -> ExcludedGround:
    mask = read_ground_mask(image(folder))
    assert mask(ON_IT).tolist() == [False, True]
    return mask


@cell(MASKS, Subject.VALIDITY, "used", "255")
def nodata(folder: Path) -> ExcludedGround:
    return mask_on_a_map(folder)


@cell(MASKS, Subject.IDENTITY, "assumed", "WorldCover")
def classes_with_a_colour_table(folder: Path) -> CoveredGround:
    cover = read_land_cover(image(folder, colours=True))
    assert cover(ON_IT) == ["unknown", "water"]
    return cover


@cell(MASKS, Subject.HORIZONTAL_DATUM, "refused", "no coordinate reference system")
def mask_on_no_map(folder: Path) -> ExcludedGround:
    return read_ground_mask(image(folder, crs=None))


@cell(MASKS, Subject.BANDS, "refused", "found 3")
def land_cover_of_three_bands(folder: Path) -> CoveredGround:
    return read_land_cover(image(folder, count=3))


def polygon(folder: Path, *, turn: bool = False, **members: object) -> ExcludedGround:
    """A square of polygons in GeoJSON."""
    ring = [[105.0, 43.0], [105.1, 43.0], [105.1, 43.1], [105.0, 43.0]]
    geometry = {"type": "Polygon", "coordinates": [[xy[::-1] if turn else xy for xy in ring]]}
    feature = {"type": "Feature", "geometry": geometry, "properties": {"kind": "lake"}}
    path = folder / "area.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature], **members}))
    return read_ground_mask(path)


@cell(MASKS, Subject.HORIZONTAL_DATUM, "assumed", "RFC 7946")
def polygons(folder: Path) -> ExcludedGround:
    return polygon(folder)


@cell(MASKS, Subject.IDENTITY, "named", "kind")
def properties_of_polygons(folder: Path) -> ExcludedGround:
    return polygon(folder)


@cell(MASKS, Subject.HORIZONTAL_DATUM, "refused", "longitude and latitude")
def polygons_on_a_map(folder: Path) -> ExcludedGround:
    return polygon(folder, crs={"type": "name", "properties": {"name": "EPSG:32633"}})


@cell(MASKS, Subject.ORDER, "refused", "longitude and latitude in degrees")
def polygons_with_exchanged_axes(folder: Path) -> ExcludedGround:
    return polygon(folder, turn=True)
