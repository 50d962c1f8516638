"""Terrains: units, datums of heights, voids, nodes, tiles and the grids of geoids."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.elevation.rows import (
    GEOID_READER,
    GRID_READER,
    TERRAIN_READER,
    TILES_READER,
)
from amers.services.formats.reader_rows import Outcome
from amers.services.statements import Subject
from amers.services.terrain import Terrain
from tests.services.formats.elevation.test_dem import write_geoid
from tests.services.formats.elevation.test_grid_files import asc, bil, envi, hgt, tile, two_tiles, vrt
from tests.services.formats.statements.cell import Read, add, cell

US_FT = 1200.0 / 3937.0
HEIGHT = 1200.0
SYSTEMS = {
    "EPSG:4326": (5.0, 44.0, 1e-4),
    "EPSG:32631": (675e3, 4.898e6, 10.0),
    "EPSG:25832": (5e5, 5e6, 10.0),
    "EPSG:31468": (4541500.0, 5848500.0, 10.0),
    "EPSG:21781": (599500.0, 200500.0, 10.0),
    "EPSG:27700": (437e3, 287e3, 10.0),
    "EPSG:28992": (154500.0, 463500.0, 10.0),
    "EPSG:4230": (5.395, 43.305, 1e-4),
    "EPSG:26713": (482e3, 4.34e6, 10.0),
    "EPSG:2263": (980e3, 200e3, 30.0),
    "EPSG:3857": (5e5, 5e6, 10.0),
}


def dem(
    folder: Path,
    crs: str = "EPSG:32631",
    *,
    height: float = HEIGHT,
    unit: str = "",
    values: Any = None,
    tags: dict[str, str] | None = None,
    scale_offset: tuple[float, float] = (1.0, 0.0),
    aux: str = "",
    **options: Any,
) -> Path:
    """A GeoTIFF of 9 x 9 equal heights, unless `values` are others."""
    path = folder / "dem.tif"
    x, y, step = SYSTEMS.get(crs.partition("+")[0], SYSTEMS["EPSG:32631"])
    bands = np.full((1, 9, 9), height, dtype=np.float32) if values is None else values
    options = {"crs": crs, "transform": Affine(step, 0, x, 0, -step, y)} | options
    with rasterio.open(
        path, "w", driver="GTiff", height=9, width=9, count=len(bands), dtype=bands.dtype, **options
    ) as file:
        file.write(bands)
        file.units = (unit,) * len(bands)
        file.scales, file.offsets = [(value,) * len(bands) for value in scale_offset]
        file.update_tags(**(tags or {}))
    if aux:
        path.with_name("dem.tif.aux.xml").write_text(f"<PAMDataset>{aux}</PAMDataset>")
    return path


def checked(terrain: Terrain, height_m: float | None) -> Terrain:
    """The terrain, whose node (4, 4) has a height above the ellipsoid; NaN for a void."""
    if height_m is not None:
        found = terrain.height_m(terrain.grid.lon_lat(np.array([[4.0, 4.0]])))[0]
        assert found == pytest.approx(height_m, abs=2e-3, nan_ok=True)
    return terrain


def terrain_of(height_m: float | None = None, vertical: str | None = "ellipsoid", **form: Any) -> Read:
    """Writes a `dem` and reads it."""
    return lambda folder: checked(read_dem(dem(folder, **form), vertical), height_m)


def on_geoid(height_m: float | None = None, vertical: str | None = None, **form: Any) -> Read:
    """The same above a geoid of 40 m."""

    def read(folder: Path) -> Terrain:
        grid = folder / "geoid.gtx"
        header = np.array([-90.0, -180.0, 9.0, 9.0], ">f8").tobytes()
        header += np.array([21, 41], ">i4").tobytes()
        grid.write_bytes(header + np.full(21 * 41, 40.0, ">f4").tobytes())
        return checked(read_dem(dem(folder, **form), vertical, grid), height_m)

    return read


# Units of bands, of vertical systems and of both

UNITS = {
    "m": 1.0, "metre": 1.0, "Meters": 1.0, "meter": 1.0, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
    "international foot": 0.3048, "Foot_Intl": 0.3048, "US survey foot": US_FT, "us-ft": US_FT,
    "foot_us": US_FT, "Foot_US": US_FT, "ftUS": US_FT, "US ft": US_FT, "US Survey Feet": US_FT,
    "survey foot": US_FT, "cm": 0.01, "centimetre": 0.01, "Centimeters": 0.01, "dm": 0.1,
    "decimeter": 0.1, "mm": 0.001, "km": 1000.0, "kilometre": 1000.0, "yd": 0.9144, "[m]": 1.0,
}  # fmt: skip
for unit, metres in UNITS.items():
    height = HEIGHT if metres < 10.0 else 1.2
    read = terrain_of(height * metres, unit=unit, height=height)
    add(TERRAIN_READER, Subject.UNIT, "used", f"unit: {unit}", f"band_in_{unit}", read)
for unit in ("furlong", "degrees", "K", "counts"):
    shows = f"unit: '{unit}' found"
    add(TERRAIN_READER, Subject.UNIT, "refused", shows, f"band_in_{unit}", terrain_of(unit=unit))
for crs, unit, metres in (
    ("EPSG:4326+6360", "US survey foot", US_FT),
    ("EPSG:4326+8228", "foot", 0.3048),
    ("EPSG:32631+5703", "metre", 1.0),
    ("EPSG:2263+6360", "US survey foot", US_FT),
):
    read = on_geoid(HEIGHT * metres + 40.0, crs=crs)
    add(TERRAIN_READER, Subject.UNIT, "used", f"unit: {unit}", f"heights_of_{crs}", read)
for crs, unit, metres in (
    ("EPSG:32631+5773", "ft", 0.3048),
    ("EPSG:32631+5773", "US survey foot", US_FT),
    ("EPSG:4326+5773", "cm", 0.01),
    ("EPSG:4326+6360", "m", 1.0),
    ("EPSG:4326+6360", "ft", 0.3048),
):
    read = on_geoid(HEIGHT * metres + 40.0, crs=crs, unit=unit)
    shows = f"the unit of the band, {unit}, is used"
    add(TERRAIN_READER, Subject.UNIT, "named", shows, f"{unit}_in_{crs}", read)
for crs, shows in (("EPSG:32631", "metre"), ("EPSG:2263", "though positions are in US survey foot")):
    read = terrain_of(HEIGHT, crs=crs)
    add(TERRAIN_READER, Subject.UNIT, "assumed", shows, f"no_unit_in_{crs}", read)
for scale_offset, unit, height_m in (
    ((0.1, 5.0), "", 125.0),
    ((0.5, 400.0), "ft", 1000.0 * 0.3048),
    ((0.01, 0.0), "cm", 0.12),
    ((1.0, -50.0), "m", 1150.0),
):
    read = terrain_of(height_m, unit=unit, scale_offset=scale_offset)
    shows = f"scale {scale_offset[0]:g}, offset {scale_offset[1]:g}"
    add(TERRAIN_READER, Subject.UNIT, "used", shows, f"{shows}_in_{unit}", read)
AUX_BAND = '<PAMRasterBand band="1">{}</PAMRasterBand>'
for text, shows, height_m in (
    ("<UnitType>ft</UnitType>", "unit: ft", HEIGHT * 0.3048),
    ("<Scale>0.5</Scale><Offset>2</Offset>", "scale 0.5, offset 2", 602.0),
):
    read = terrain_of(height_m, aux=AUX_BAND.format(text))
    add(TERRAIN_READER, Subject.UNIT, "used", shows, f"aux_{shows}", read)

# Heights above the ellipsoid are not moved by a datum shift

for crs in ("EPSG:31468", "EPSG:21781", "EPSG:27700", "EPSG:28992", "EPSG:4230", "EPSG:26713"):
    shows = "as GNSS gives"
    read = terrain_of(HEIGHT, crs=crs)
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "assumed", shows, f"ellipsoid_in_{crs}", read)
for crs in ("EPSG:4326", "EPSG:32631", "EPSG:25832", "EPSG:3857"):
    read = terrain_of(HEIGHT, crs=crs)
    shows = "the ellipsoid: used"
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "used", shows, f"ellipsoid_in_{crs}", read)
for crs in ("EPSG:4979", "EPSG:4937", "EPSG:7912"):
    form = {"crs": crs, "transform": Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0)}
    read = terrain_of(HEIGHT, None, **form)
    shows = "the ellipsoid: used"
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "used", shows, f"three_axes_{crs}", read)
for crs, name in (
    ("EPSG:32631+5773", "EGM96 height"),
    ("EPSG:4326+3855", "EGM2008 height"),
    ("EPSG:4326+5703", "NAVD88 height"),
    ("EPSG:25832+5783", "DHHN92 height"),
):
    read = on_geoid(HEIGHT + 40.0, crs=crs)
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "used", name, f"file_states_{name}", read)
for vertical in ("EGM96", "EGM2008", "EPSG:5720"):
    read = on_geoid(HEIGHT + 40.0, vertical)
    shows = "as the caller states"
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "used", shows, f"caller_states_{vertical}", read)
for crs, vertical, shows in (
    ("EPSG:4326", None, "does not state its vertical datum"),
    ("EPSG:4326+5773", "ellipsoid", "above EGM96 height, the caller the ellipsoid"),
    ("EPSG:4326+5773", "EGM2008", "above EGM96 height, the caller EGM2008 height"),
    ("EPSG:4979", "EGM96", "above the ellipsoid, the caller EGM96 height"),
    ("EPSG:4326+5703", "EGM96", "above NAVD88 height, the caller EGM96 height"),
    ("EPSG:4326", "EPSG:6357", "counts depths"),
):
    form = {"crs": crs, "transform": Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0)}
    read = (
        on_geoid(vertical=vertical, **form)
        if vertical == "EPSG:6357"
        else terrain_of(None, vertical, **form)
    )
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "refused", shows, f"{crs}_{vertical}", read)

# Horizontal datums

for crs, shows in (
    ("EPSG:26713", "NAD27 to WGS 84 (6), accuracy 7 m"),
    ("EPSG:31468", "DHDN to WGS 84 (3), accuracy 2 m"),
    ("EPSG:4230", "ED50 to WGS 84 (17), accuracy 2 m"),
    ("EPSG:25832", "leaves positions as they are"),
    ("EPSG:32631", "WGS 84 / UTM zone 31N: used"),
):
    add(TERRAIN_READER, Subject.HORIZONTAL_DATUM, "used", shows, f"map_{crs}", terrain_of(crs=crs))
for ellipsoid in ("GRS80", "WGS84"):
    read = terrain_of(crs=f"+proj=utm +zone=31 +ellps={ellipsoid} +units=m")
    shows = "taken as WGS 84"
    add(TERRAIN_READER, Subject.HORIZONTAL_DATUM, "assumed", shows, f"ellipsoid_{ellipsoid}", read)
for ellipsoid in ("bessel", "intl", "clrk66", "krass"):
    read = terrain_of(crs=f"+proj=utm +zone=31 +ellps={ellipsoid} +units=m")
    shows = "expected one with a transformation to WGS 84"
    add(TERRAIN_READER, Subject.HORIZONTAL_DATUM, "refused", shows, f"ellipsoid_{ellipsoid}", read)

# Nodes, voids, bands, epochs

for point in ("Area", "Point"):
    add(
        TERRAIN_READER,
        Subject.PIXEL_ORIGIN,
        "used",
        f"pixel origin: {point}",
        f"nodes_as_{point}",
        terrain_of(HEIGHT, tags={"AREA_OR_POINT": point}),
    )
for nodata, values, height_m in (
    (-9999.0, np.float32(-9999.0), np.nan),
    (0.0, np.float32(0.0), np.nan),
    (-32768, np.int16(-32768), np.nan),
    (np.nan, np.float32(np.nan), np.nan),
    (-3.4028234663852886e38, np.float32(-3.4028234663852886e38), np.nan),
    (-32767, np.int16(0), 0.0),
):
    filled = np.full((1, 9, 9), values)
    read = terrain_of(height_m, values=filled, nodata=nodata)
    shows = f"no data where the value is {nodata:g}"
    add(TERRAIN_READER, Subject.VALIDITY, "used", shows, f"{shows}_{values}", read)
for value in (np.float32(-9999.0), np.int16(-32768), np.int16(32767), np.float32(np.nan)):
    read = terrain_of(np.nan, values=np.full((1, 9, 9), value))
    add(TERRAIN_READER, Subject.VALIDITY, "assumed", "voids are -9999", f"void_{value}", read)
read = terrain_of(0.0, values=np.zeros((1, 9, 9), np.int16))
add(TERRAIN_READER, Subject.VALIDITY, "assumed", "voids are -9999", "zero_is_a_height", read)
read = terrain_of(HEIGHT, values=np.stack([np.full((9, 9), HEIGHT), np.ones((9, 9))]).astype(np.float32))
add(TERRAIN_READER, Subject.BANDS, "named", "bands 2 to 2", "two_bands", read)


@cell(TERRAIN_READER.name, Subject.BANDS, "refused", "palette of colours")
def a_palette(folder: Path) -> Terrain:
    path = dem(folder, values=np.ones((1, 9, 9), np.uint8), photometric="palette")
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {0: (0, 0, 0, 255), 1: (10, 200, 10, 255)})
    return read_dem(path, "ellipsoid")


@cell(TERRAIN_READER.name, Subject.EPOCH, "named", "epoch: 2015.50: not used")
def an_epoch_of_coordinates(folder: Path) -> Terrain:
    path = dem(folder, "EPSG:9000", transform=Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0))
    with_epoch(path, 2015.5)
    return checked(read_dem(path, "ellipsoid"), HEIGHT)


def with_epoch(path: Path, epoch: float) -> None:
    """State the epoch of the coordinates in the keys of a little-endian GeoTIFF."""
    data = bytearray(path.read_bytes())
    first = int.from_bytes(data[4:8], "little")
    count = int.from_bytes(data[first : first + 2], "little")
    entries = [bytes(data[first + 2 + 12 * k : first + 14 + 12 * k]) for k in range(count)]
    tags = {int.from_bytes(entry[:2], "little"): entry for entry in entries}

    def array(tag: int, dtype: str) -> np.ndarray:
        number, at = (int.from_bytes(tags[tag][k : k + 4], "little") for k in (4, 8))
        return np.frombuffer(bytes(data), dtype, number, at)

    keys = array(34735, "<u2").reshape(-1, 4).copy()
    doubles = array(34736, "<f8") if 34736 in tags else np.empty(0)
    keys[0, 3] += 1
    keys = np.vstack([keys, [5120, 34736, 1, len(doubles)]]).astype("<u2")
    for tag, kind, values in ((34735, 3, keys), (34736, 12, np.append(doubles, epoch).astype("<f8"))):
        data += b"\0" * (-len(data) % 8)
        header = np.array([tag, kind], "<u2").tobytes()
        tags[tag] = header + np.array([values.size, len(data)], "<u4").tobytes()
        data += values.tobytes()
    data += b"\0" * (-len(data) % 8)
    data[4:8] = len(data).to_bytes(4, "little")
    data += len(tags).to_bytes(2, "little") + b"".join(tags[tag] for tag in sorted(tags)) + b"\0" * 4
    path.write_bytes(bytes(data))


@cell(TERRAIN_READER.name, Subject.PLACE, "used", "dem.tfw")
def a_world_file(folder: Path) -> Terrain:
    path = folder / "dem.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=9, width=9, count=1, dtype="float32", crs="EPSG:32631"
    ) as file:
        file.write(np.full((1, 9, 9), HEIGHT, np.float32))
    (folder / "dem.tfw").write_text("10\n0\n0\n-10\n675005\n4897995\n")
    terrain = read_dem(path, "ellipsoid")
    np.testing.assert_allclose(terrain.grid.origin_xy, [675005.0, 4897995.0])
    return terrain


# Grids with headers

for name in ("N43E005.hgt", "N43E005.SRTMGL3.hgt", "n43e005.HGT"):
    add(
        GRID_READER,
        Subject.VERTICAL_DATUM,
        "assumed",
        "EGM96 height: assumed",
        name,
        lambda folder, name=name: read_dem(hgt(folder, name), geoid=write_geoid(folder / "geoid.gtx")),
    )
GRIDS = {"hgt": hgt, "bil": bil, "flt": lambda folder: bil(folder, "flt"), "asc": asc, "envi": envi}
for name, write in GRIDS.items():
    read = lambda folder, write=write: read_dem(write(folder), "ellipsoid")  # noqa: E731
    add(GRID_READER, Subject.HORIZONTAL_DATUM, "used", "WGS 84: used", name, read)
    add(GRID_READER, Subject.VERTICAL_DATUM, "used", "the ellipsoid: used", name, read)
    is_hgt = name == "hgt"
    add(GRID_READER, Subject.UNIT, "used" if is_hgt else "assumed", "m", name, read)
    outcome: Outcome = "used" if is_hgt else "assumed"
    add(GRID_READER, Subject.PIXEL_ORIGIN, outcome, "Point" if is_hgt else "Area", name, read)
    has_voids = name != "envi"
    shows = "no data where" if has_voids else "voids are -9999"
    add(GRID_READER, Subject.VALIDITY, "used" if has_voids else "assumed", shows, name, read)
    if not is_hgt:
        read = lambda folder, write=write: read_dem(write(folder))  # noqa: E731
        shows = "does not state its vertical datum"
        add(GRID_READER, Subject.VERTICAL_DATUM, "refused", shows, name, read)


@cell(GRID_READER.name, Subject.UNIT, "used", "unit: ft")
def a_bil_in_feet(folder: Path) -> Terrain:
    path = bil(folder, "flt")
    path.with_name("a.flt.aux.xml").write_text(
        f"<PAMDataset>{AUX_BAND.format('<UnitType>ft</UnitType>')}</PAMDataset>"
    )
    terrain = read_dem(path, "ellipsoid")
    assert terrain.nodes()[0, 0] == pytest.approx(300.0 * 0.3048)
    return terrain


@cell(GRID_READER.name, Subject.HORIZONTAL_DATUM, "refused", "write a.prj beside it")
def a_grid_without_a_system(folder: Path) -> Terrain:
    path = asc(folder)
    (folder / "a.prj").unlink()
    return read_dem(path, "ellipsoid")


@cell(GRID_READER.name, Subject.PLACE, "used", "N43E005")
def a_place_in_a_name(folder: Path) -> Terrain:
    terrain = read_dem(hgt(folder), "ellipsoid")
    np.testing.assert_allclose(terrain.grid.origin_xy, [5.0, 44.0], atol=1e-12)
    return terrain


@cell(GRID_READER.name, Subject.PLACE, "refused", "N44E005.hgt; name it so")
def a_name_without_a_place(folder: Path) -> Terrain:
    return read_dem(hgt(folder, "srtm.hgt"), "ellipsoid")


# Tiles

for form in ("folder", "list", "vrt"):

    def tiles(folder: Path, form: str = form, **options: Any) -> Path:
        """Two tiles in feet above EGM96."""
        below = folder / "tiles"
        below.mkdir()
        two_tiles(below, **({"crs": "EPSG:4326+5773"} | options))
        for name in ("a.tif", "b.tif"):
            with rasterio.open(below / name, "r+") as file:
                file.units = ("ft",)
        (below / "list.txt").write_text("a.tif\nb.tif\n")
        return {"folder": below, "list": below / "list.txt", "vrt": vrt(below)}[form]

    def read_tiles(folder: Path, tiles: Callable[[Path], Path] = tiles) -> Terrain:
        terrain = read_dem(tiles(folder), geoid=write_geoid(folder / "geoid.gtx"))
        assert terrain.grid.shape == (30, 60)
        assert 60.0 < float(np.nanmin(terrain.nodes())) < 150.0
        return terrain

    add(TILES_READER, Subject.HORIZONTAL_DATUM, "used", "WGS 84", form, read_tiles)
    add(TILES_READER, Subject.VERTICAL_DATUM, "used", "EGM96 height", form, read_tiles)
    add(TILES_READER, Subject.UNIT, "used", "ft", form, read_tiles)
    add(TILES_READER, Subject.VALIDITY, "used", "no data where", form, read_tiles)
    if form != "vrt":
        shows = "tif and 1 more"
        add(TILES_READER, Subject.PIXEL_ORIGIN, "used", shows, form, read_tiles)


@cell(TILES_READER.name, Subject.VERTICAL_DATUM, "refused", "one vertical datum expected")
def tiles_of_two_datums(folder: Path) -> Terrain:
    tile(folder / "a.tif", 5.0, 44.0, crs="EPSG:4326+5773")
    tile(folder / "b.tif", 5.03, 44.0, crs="EPSG:4979")
    (folder / "list.txt").write_text("a.tif\nb.tif\n")
    return read_dem(folder / "list.txt")


@cell(TILES_READER.name, Subject.UNIT, "refused", "the same in all sources expected")
def a_vrt_of_two_units(folder: Path) -> Terrain:
    two_tiles(folder)
    with rasterio.open(folder / "b.tif", "r+") as file:
        file.units = ("ft",)
    return read_dem(vrt(folder), "ellipsoid")


@cell(TILES_READER.name, Subject.PLACE, "refused", "in the folder of the VRT or below")
def a_vrt_that_leaves_its_folder(folder: Path) -> Terrain:
    two_tiles(folder)
    return read_dem(vrt(folder, ("a.tif", "../b.tif")), "ellipsoid")


@cell(TILES_READER.name, Subject.PLACE, "refused", "c.tif does not exist")
def a_list_with_a_missing_tile(folder: Path) -> Terrain:
    (folder / "list.txt").write_text("c.tif\n")
    return read_dem(folder / "list.txt", "ellipsoid")


@cell(TILES_READER.name, Subject.IDENTITY, "refused", "cover the same ground")
def heights_beside_their_quality(folder: Path) -> Terrain:
    tile(folder / "ASTGTMV003_N44E005_dem.tif", 5.0, 44.0)
    tile(folder / "ASTGTMV003_N44E005_num.tif", 5.0, 44.0)
    return read_dem(folder, "ellipsoid")


# Grids of geoids


def named_grid(folder: Path, name: str) -> Path:
    return write_geoid(folder / name)


def with_grid(name: str, vertical: str | None, crs: str = "EPSG:4326") -> Read:
    return lambda folder: read_dem(dem(folder, crs), vertical, named_grid(folder, name))


for name, vertical, crs in (
    ("egm96_15.gtx", "EGM2008", "EPSG:4326"),
    ("us_nga_egm96_15.tif", None, "EPSG:4326+3855"),
    ("us_nga_egm08_25.tif", "EGM96", "EPSG:4326"),
    ("EGM2008.gtx", None, "EPSG:4326+5773"),
    ("egm84_30.gtx", "EGM96", "EPSG:4326"),
):
    shows, label = "the same geoid expected", f"{name}_{vertical}_{crs}"
    add(GEOID_READER, Subject.VERTICAL_DATUM, "refused", shows, label, with_grid(name, vertical, crs))
for name, vertical, crs in (
    ("egm96_15.gtx", None, "EPSG:4326+5773"),
    ("geoid.gtx", "EGM2008", "EPSG:4326"),
    ("egm08_25.gtx", "EGM2008", "EPSG:4326"),
    ("es_ign_egm08-rednap.gtx", "EPSG:5782", "EPSG:4326"),
    ("anything.gtx", None, "EPSG:4326"),
):
    read, label = with_grid(name, vertical, crs), f"{name}_{vertical}_{crs}"
    add(GEOID_READER, Subject.VERTICAL_DATUM, "used", f"from {name}", label, read)
for crs in ("EPSG:4326+5703", "EPSG:4326+5720", "EPSG:4326+6360"):
    shows = "the grid egm96_15.gtx is EGM96, and is used"
    read = with_grid("egm96_15.gtx", None, crs)
    add(GEOID_READER, Subject.VERTICAL_DATUM, "named", shows, crs, read)


@cell(GEOID_READER.name, Subject.VERTICAL_DATUM, "refused", "pyproj sync --file us_nga_egm08_25.tif")
def a_name_that_no_folder_has(folder: Path) -> Terrain:
    return read_dem(dem(folder), "EGM2008", Path("egm08_25.gtx"))


@cell(GEOID_READER.name, Subject.VERTICAL_DATUM, "refused", "does not cover the terrain")
def a_grid_of_another_region(folder: Path) -> Terrain:
    return read_dem(dem(folder), "EGM96", write_geoid(folder / "geoid.gtx", west=100.0))
