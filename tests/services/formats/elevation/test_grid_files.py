"""Terrains as operators have them: grids with headers beside them, VRTs, folders and lists of tiles."""

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from amers.services.errors import FormatError
from amers.services.formats.elevation import mosaic
from amers.services.formats.elevation.dem import read_dem
from amers.services.imagery.source import Window

a_millimetre = 1e-3
WGS84_PRJ = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]'
)
PLACE = np.array([[5.0125, 43.9875]])


def plane(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """Heights in metres by degrees."""
    return 300.0 + 2000.0 * (lon - 5.0) + 1000.0 * (lat - 44.0)


def nodes(west: float, north: float, step: float, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a grid whose first node is at (west, north)."""
    line, sample = np.indices(shape)
    return plane(west + step * sample, north - step * line)


def tile(path: Path, west: float, north: float, step: float = 0.001, size: int = 30, **options) -> Path:
    """A GeoTIFF whose corner is at (west, north)."""
    options = {"crs": "EPSG:4326", "nodata": -9999.0} | options
    heights = nodes(west + step / 2, north - step / 2, step, (size, size)).astype(np.float32)
    grid = {"height": size, "width": size, "transform": from_origin(west, north, step, step)}
    with rasterio.open(path, "w", driver="GTiff", count=1, dtype="float32", **grid, **options) as file:
        file.write(heights, 1)
    return path


def hgt(folder: Path, name: str = "N43E005.hgt") -> Path:
    heights = nodes(5.0, 44.0, 1.0 / 1200.0, (1201, 1201)).round().astype(">i2")
    heights[600, 600] = -32768
    (folder / name).write_bytes(heights.tobytes())
    return folder / name


def zipped(folder: Path) -> Path:
    path = folder / "N43E005.SRTMGL3.hgt.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(hgt(folder), "N43E005.hgt")
    return path


def bil(folder: Path, kind: str = "bil") -> Path:
    heights = nodes(5.0, 44.0, 0.001, (30, 40))
    dtype, bits, pixel = ("<f4", 32, "FLOAT") if kind == "flt" else ("<i2", 16, "SIGNEDINT")
    (folder / f"a.{kind}").write_bytes(heights.round().astype(dtype).tobytes())
    (folder / "a.hdr").write_text(
        f"BYTEORDER I\nLAYOUT BIL\nNROWS 30\nNCOLS 40\nNBANDS 1\nNBITS {bits}\nPIXELTYPE {pixel}\n"
        "ULXMAP 5.0\nULYMAP 44.0\nXDIM 0.001\nYDIM 0.001\nNODATA -9999\n"
    )
    (folder / "a.prj").write_text(WGS84_PRJ)
    return folder / f"a.{kind}"


def asc(folder: Path) -> Path:
    heights = nodes(5.0005, 43.9995, 0.001, (30, 40)).round()
    rows = "\n".join(" ".join(f"{height:.0f}" for height in row) for row in heights)
    head = "ncols 40\nnrows 30\nxllcorner 5\nyllcorner 43.97\ncellsize 0.001\nNODATA_value -9999\n"
    (folder / "a.asc").write_text(f"{head}{rows}\n")
    (folder / "a.prj").write_text(WGS84_PRJ)
    return folder / "a.asc"


def envi(folder: Path) -> Path:
    nodes(5.0005, 43.9995, 0.001, (30, 40)).astype("<f4").tofile(folder / "a.dat")
    (folder / "a.hdr").write_text(
        "ENVI\nsamples = 40\nlines = 30\nbands = 1\nheader offset = 0\ndata type = 4\ninterleave = bsq\n"
        "byte order = 0\nmap info = {Geographic Lat/Lon, 1, 1, 5.0, 44.0, 0.001, 0.001, WGS-84}\n"
    )
    return folder / "a.dat"


def vrt(folder: Path, names: tuple[str, ...] = ("a.tif", "b.tif"), extra: str = "") -> Path:
    """As gdalbuildvrt writes it, of two tiles side by side."""
    sources = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">{name}</SourceFilename>'
        "<SourceBand>1</SourceBand>"
        f'<SrcRect xOff="0" yOff="0" xSize="30" ySize="30"/>'
        f'<DstRect xOff="{30 * number}" yOff="0" xSize="30" ySize="30"/></SimpleSource>'
        for number, name in enumerate(names)
    )
    path = folder / "all.vrt"
    path.write_text(
        '<VRTDataset rasterXSize="60" rasterYSize="30"><SRS>EPSG:4326</SRS>'
        "<GeoTransform>5.0, 0.001, 0, 44.0, 0, -0.001</GeoTransform>"
        f'<VRTRasterBand dataType="Float32" band="1"><NoDataValue>-9999</NoDataValue>{sources}'
        f"</VRTRasterBand>{extra}</VRTDataset>"
    )
    return path


def two_tiles(folder: Path, **options) -> Path:
    tile(folder / "a.tif", 5.0, 44.0, **options)
    tile(folder / "b.tif", 5.03, 44.0, **options)
    return folder


def stacked(folder: Path) -> Path:
    """Three tiles, a gap in the south-east."""
    tile(two_tiles(folder) / "c.tif", 5.0, 43.97)
    return folder


def two_steps(folder: Path) -> Path:
    tile(folder / "a.tif", 5.0, 44.0)
    tile(folder / "b.tif", 5.03, 44.0, step=0.0015, size=20)
    return folder


def vrt_of_tiles(folder: Path) -> Path:
    return vrt(two_tiles(folder))


def listed(folder: Path) -> Path:
    two_tiles(folder)
    (folder / "tiles.txt").write_text("# of the area\na.tif\n\nb.tif\n")
    return folder / "tiles.txt"


@pytest.mark.parametrize("fill_px", [0, 2])
@pytest.mark.parametrize(
    "write", [hgt, zipped, bil, asc, envi, vrt_of_tiles, two_tiles, listed, stacked, two_steps]
)
def test_a_terrain_of_any_kind_has_the_heights_of_its_ground_in_every_window(
    write: Callable[[Path], Path], fill_px: int, tmp_path: Path
) -> None:
    terrain = read_dem(write(tmp_path), "ellipsoid", fill_px=fill_px)
    whole_metres = 0.6
    assert terrain.height_m(PLACE)[0] == pytest.approx(plane(*PLACE.T)[0], abs=whole_metres)
    again, (lines, samples) = pickle.loads(pickle.dumps(terrain.heights)), terrain.heights.shape
    expected = np.pad(terrain.nodes(), 3, constant_values=np.nan)
    for line in {*range(-3, 64), *range(lines - 3, lines + 3)} & set(range(-3, lines + 3)):
        found = again.read(Window(line, -3, 1, samples + 6))
        np.testing.assert_allclose(found[0], expected[line + 3], atol=a_millimetre)
    for sample in {*range(-3, 64), *range(samples - 3, samples + 3)} & set(range(-3, samples + 3)):
        found = again.read(Window(-3, sample, lines + 6, 1))
        np.testing.assert_allclose(found[:, 0], expected[:, sample + 3], atol=a_millimetre)


def test_the_voids_of_a_grid_are_void(tmp_path: Path) -> None:
    terrain = read_dem(hgt(tmp_path), "ellipsoid")
    assert np.isnan(terrain.heights.read(Window(600, 600, 1, 1))).all()


@pytest.mark.parametrize(
    ("names", "extra", "message"),
    [
        (("a.tif", "../outside.tif"), "", "in the folder of the VRT or below"),
        (("a.tif", "/etc/hostname"), "", "in the folder of the VRT or below"),
        (("/vsicurl/http://127.0.0.1/a.tif",), "", "in the folder of the VRT or below"),
        (("http://127.0.0.1/a.tif",), "", "in the folder of the VRT or below"),
        (("missing.tif",), "", "in the folder of the VRT or below"),
        (("a.tif",), "<PixelFunctionType>sqrt</PixelFunctionType>", "PixelFunctionType found"),
        (("a.tif",), "<GDALWarpOptions/>", "GDALWarpOptions found"),
        (("a.tif",), '<VRTRasterBand subClass="VRTRawRasterBand"/>', "VRTRawRasterBand found"),
        ((), "", "without any source"),
        (("all.vrt",), "", "a VRT in a VRT in a VRT"),
    ],
)
def test_a_vrt_refers_to_files_of_its_folder_and_computes_nothing(
    names: tuple[str, ...], extra: str, message: str, tmp_path: Path
) -> None:
    folder = tmp_path / "below"
    folder.mkdir()
    two_tiles(folder)
    tile(tmp_path / "outside.tif", 5.03, 44.0)
    with pytest.raises(FormatError, match=message):
        read_dem(vrt(folder, names, extra), "ellipsoid")


def test_files_of_strangers_are_images_only(tmp_path: Path) -> None:
    for write in (hgt, bil, asc, vrt_of_tiles, two_tiles):
        with pytest.raises(FormatError, match=r"expected a GeoTIFF|expected the name of an existing"):
            read_dem(write(tmp_path), "ellipsoid", images_only=True)


def test_tiles_of_one_lattice_are_copied_and_their_gaps_are_void(tmp_path: Path) -> None:
    terrain = read_dem(stacked(tmp_path), "ellipsoid")
    assert terrain.grid.shape == (60, 60)
    heights = terrain.nodes()
    with rasterio.open(tmp_path / "b.tif") as file:
        np.testing.assert_array_equal(heights[:30, 30:], file.read(1))
    with rasterio.open(tmp_path / "c.tif") as file:
        np.testing.assert_array_equal(heights[30:, :30], file.read(1))
    assert np.isnan(heights[30:, 30:]).all()


def test_tiles_of_other_steps_and_maps_are_interpolated(tmp_path: Path) -> None:
    terrain = read_dem(two_steps(tmp_path), "ellipsoid")
    lon_lat = np.column_stack([np.linspace(5.002, 5.058, 60), np.linspace(43.998, 43.974, 60)])
    height_m = terrain.height_m(lon_lat)
    a_step_of_the_plane_m = 2.0
    np.testing.assert_allclose(height_m, plane(*lon_lat.T), atol=a_step_of_the_plane_m)


def test_tiles_on_both_sides_of_the_date_line_are_one_terrain(tmp_path: Path) -> None:
    def written(name: str, west: float) -> None:
        tile(tmp_path / name, west, -16.0)
        with rasterio.open(tmp_path / name, "r+") as file:
            file.write(np.full((1, 30, 30), abs(west), dtype=np.float32))

    written("S17E179.tif", 179.97)
    written("S17W180.tif", -180.0)
    terrain = read_dem(tmp_path, "ellipsoid")
    assert terrain.grid.shape == (30, 60)
    across = np.array([[179.98, -16.01], [-179.98, -16.01], [180.02, -16.01]])
    np.testing.assert_allclose(terrain.height_m(across), [179.97, 180.0, 180.0], atol=a_millimetre)
    assert terrain.around(across).grid.shape[1] <= 50


def test_few_tiles_are_open_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mosaic, "MOST_OPEN", 2)
    for number in range(5):
        tile(tmp_path / f"{number}.tif", 5.0 + 0.03 * number, 44.0)
    terrain = read_dem(tmp_path, "ellipsoid")
    assert np.isfinite(terrain.nodes()).all()
    assert len(terrain.heights._open) == 2


def test_a_folder_or_a_list_without_heights_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match=r"a folder with files of heights, .* found 0"):
        read_dem(tmp_path / "empty", "ellipsoid")
    (tmp_path / "list.txt").write_text("nowhere.tif\n")
    with pytest.raises(FormatError, match=r"nowhere\.tif does not exist"):
        read_dem(tmp_path / "list.txt", "ellipsoid")
