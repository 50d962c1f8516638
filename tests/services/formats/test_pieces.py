"""Images and terrains in pieces: the same pixels and heights as the whole, whatever names the pieces."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images import mosaic
from amers.services.formats.images.mosaic import ImageMosaic, open_mosaic
from amers.services.formats.images.raster import map_grid_of, open_raster
from amers.services.formats.pieces import IMAGES, pieces_of, source_of
from amers.services.imagery.source import Window
from amers.services.map_grid import xy_of_lon_lat
from tests.services.file_server import served_folder
from tests.services.pieces_world import as_safe, catalogue, cut, in_zone, item, packed

SIDE = 2100
WINDOWS = [Window(0, 0, 700, 900), Window(890, 950, 300, 400), Window(-50, 1800, 400, 500)]
A_HUNDREDTH_OF_THE_CONTRAST = 0.01


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of 16 bits without gaps, as those of Sentinel-2, far from the middle of its zone."""
    pixels = gaussian_filter(np.random.default_rng(2).standard_normal((SIDE, SIDE)), 2.5)
    pixels /= pixels.std()
    path = tmp_path_factory.mktemp("whole") / "whole.tif"
    place = from_origin(620_000.0, 5_300_000.0, 10.0, 10.0)
    with rasterio.open(
        path, "w", "GTiff", SIDE, SIDE, 1, "EPSG:32632", place, "uint16", nodata=0, tiled=True
    ) as file:
        file.write(np.rint(6000.0 + 1000.0 * pixels).astype(np.uint16), 1)
    return path


@pytest.fixture(scope="module")
def tiles(whole: Path) -> list[Path]:
    return cut(whole, whole.parent / "tiles")


def mosaic_at(*places: str | Path) -> ImageMosaic:
    return open_mosaic(pieces_of(source_of(places), IMAGES))


def assert_same(found: ImageMosaic, whole: Path) -> None:
    expected = open_raster(whole)
    assert found.shape == expected.shape
    # Lines and columns of one pixel are those of the last and the first pixels of tiles, too.
    lines = [Window(at, 700, 1, 600) for at in range(997, 1003)] + [Window(SIDE - 1, 0, 1, SIDE)]
    columns = [Window(w.sample, w.line, w.samples, w.lines) for w in lines]
    for window in (*WINDOWS, *lines, *columns):
        np.testing.assert_array_equal(found.read(window), expected.read(window))
    expected.close()
    found.close()


def test_tiles_have_the_pixels_of_the_whole_and_few_are_open(
    whole: Path, tiles: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mosaic, "MOST_OPEN", 2)
    found = mosaic_at(*tiles)
    assert_same(found, whole)
    found.read(Window(0, 0, SIDE, SIDE))
    assert len(found._open) == 2
    found.close()


def vrt_of(tiles: list[Path]) -> Path:
    sources = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">{tile.name}</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource>"
        for tile in tiles
    )
    path = tiles[0].parent / "tiles.vrt"
    band = f'<VRTRasterBand dataType="UInt16" band="1">{sources}</VRTRasterBand>'
    path.write_text(f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}">{band}</VRTDataset>')
    return path


def listed(tiles: list[Path]) -> Path:
    path = tiles[0].parent / "tiles.txt"
    path.write_text("# tiles\n" + "\n".join(tile.name for tile in tiles) + "\n")
    return path


def item_of_archive(tiles: list[Path]) -> Path:
    """The layout of the Global Reference Image: an item whose only file is a gzipped tar."""
    folder = tiles[0].parents[1] / "gri" / "T32" / "T32T"
    folder.mkdir(parents=True)
    archive = packed(as_safe(tiles, tiles[0].parents[1] / "gri-made"), folder / "GRI_L1C_T32TPT.tar.gz")
    return item(tiles[0], folder, archive.name)


@pytest.mark.parametrize(
    "form",
    [
        lambda tiles: tiles[0].parent,
        vrt_of,
        listed,
        catalogue,
        lambda tiles: as_safe(tiles, tiles[0].parents[1] / "safe"),
        lambda tiles: packed(
            as_safe(tiles, tiles[0].parents[1] / "made"), tiles[0].parents[1] / "product.zip"
        ),
        item_of_archive,
    ],
    ids=["folder", "vrt", "list", "stac", "safe", "zip", "gri"],
)
def test_every_form_of_pieces_has_the_pixels_of_the_whole(
    whole: Path, tmp_path: Path, form: Callable[[list[Path]], Path]
) -> None:
    assert_same(mosaic_at(form(cut(whole, tmp_path / "tiles"))), whole)


def test_a_catalogue_on_a_server_is_read_by_parts(whole: Path, tmp_path: Path) -> None:
    catalogue(cut(whole, tmp_path / "tiles"))
    with served_folder(tmp_path) as address:
        found = pieces_of(source_of([f"{address}/tiles/collection.json"]), IMAGES)
        assert all(isinstance(place, Address) for place in found)
        assert_same(open_mosaic(found), whole)


def test_items_apart_from_the_scene_are_not_opened(whole: Path, tmp_path: Path) -> None:
    collection = catalogue(cut(whole, tmp_path / "tiles"))
    image = open_raster(whole)
    corner = mosaic_at(whole, whole).grid.lon_lat(np.array([[50.0, 50.0], [90.0, 90.0]]))
    image.close()
    near = pieces_of(collection, IMAGES, corner)
    assert [place.name for place in near] == ["tile_0_0.tif"]
    others = pieces_of(tmp_path / "tiles", IMAGES)
    assert open_mosaic(others, corner).shape == (1100, 1100)


@pytest.mark.parametrize("turn_deg", [0.0, -360.0])
@pytest.mark.parametrize(
    ("west", "east", "names"),
    [(179.2, 179.6, ["here"]), (179.6, 180.2, ["here", "across"]), (180.3, 181.0, ["across", "east"])],
)
def test_items_are_taken_whose_boxes_meet_an_outline_on_either_side_of_the_antimeridian(
    tmp_path: Path, west: float, east: float, names: list[str], turn_deg: float
) -> None:
    """Boxes touch where they share an edge; one has heights, and one crosses the meridian."""
    boxes = {
        "here": [179.0, -1.0, 5.0, 179.7, 1.0, 90.0],
        "across": [179.6001, -1.0, -179.7, 1.0],
        "east": [-179.6, -1.0, -179.0, 1.0],
        "north": [179.0, 1.5, -179.0, 2.0],
    }
    rows = []
    for name, box in boxes.items():
        (tmp_path / f"{name}.tif").write_bytes(b"")
        asset = {"href": f"./{name}.tif", "type": "image/tiff; application=geotiff"}
        feature = {"type": "Feature", "stac_version": "1.0.0", "id": name, "bbox": box}
        rows.append(json.dumps(feature | {"assets": {"visual": asset}}))
    (tmp_path / "items.ndjson").write_text("\n".join(rows))
    outline = np.array([[west, -0.5], [east, -0.5], [east, 1.0], [west, 1.0]]) + [turn_deg, 0.0]
    found = pieces_of(tmp_path / "items.ndjson", IMAGES, outline)
    assert [place.stem for place in found] == names  # type: ignore[union-attr]


def test_tiles_of_two_zones_side_by_side_are_one_image(whole: Path, tmp_path: Path) -> None:
    tiles = cut(whole, tmp_path / "tiles")
    others = [tile for tile in tiles if "_1000" in tile.name]
    beyond = [in_zone(tile, tmp_path / f"33_{tile.name}", "EPSG:32633") for tile in others]
    found = mosaic_at(*(tile for tile in tiles if tile not in others), *beyond)
    expected = open_raster(whole)
    grid = map_grid_of(expected)
    assert grid is not None
    line, sample = grid.line_sample_of_xy(found.grid.origin_xy[None, :])[0].round().astype(int)
    inside = Window(1200, 200, 700, 700)  # of a tile of the other zone alone
    pixels = found.read(Window(1200 - line, 200 - sample, 700, 700))
    true = expected.read(inside)
    assert np.isfinite(pixels).all()
    assert np.std(pixels - true) < A_HUNDREDTH_OF_THE_CONTRAST * np.std(true)
    expected.close()
    found.close()


def test_gaps_are_lost_and_the_next_image_shows_what_the_first_has_not(
    whole: Path, tmp_path: Path
) -> None:
    tiles = cut(whole, tmp_path / "tiles")
    with rasterio.open(tiles[0], "r+") as first:
        pixels = first.read(1)
        pixels[1010:1050, 1020:1060] = 0
        first.write(pixels, 1)
    found, expected = (
        mosaic_at(*(tile for tile in tiles if tile.name != "tile_1000_0.tif")),
        open_raster(whole),
    )
    overlap = Window(1000, 1000, 100, 100)
    np.testing.assert_array_equal(found.read(overlap), expected.read(overlap))
    assert np.isnan(found.read(Window(1200, 100, 200, 200))).all()
    expected.close()
    found.close()


def test_heights_come_in_the_same_forms(tmp_path: Path) -> None:
    (tmp_path / "dem").mkdir()
    paths = []
    for number, east in enumerate((10.0, 10.5)):
        paths.append(tmp_path / "dem" / f"tile_{number}.tif")
        place = from_origin(east, 45.0, 0.005, 0.005)
        with rasterio.open(paths[-1], "w", "GTiff", 101, 100, 1, "EPSG:4979", place, "float32") as file:
            rows, columns = np.mgrid[:100, :101]
            file.write((500.0 + rows + (east - 10.0) * 200.0 + columns).astype(np.float32), 1)
    at = np.array([[10.2, 44.8], [10.7, 44.7]])
    heights_m = read_dem(tmp_path / "dem", "ellipsoid").height_m(at)
    assert np.isfinite(heights_m).all()
    collection = catalogue(paths)
    with served_folder(tmp_path) as address:
        for source in (
            source_of(paths),
            collection,
            packed(tmp_path / "dem", tmp_path / "dem.zip"),
            source_of([f"{address}/dem/collection.json"]),
            source_of([f"{address}/dem/tile_0.tif", paths[1]]),
        ):
            terrain = read_dem(source, "ellipsoid")
            np.testing.assert_array_equal(terrain.height_m(at), heights_m)


@pytest.mark.parametrize(
    ("path", "is_piece"),
    [
        ("S2A_MSIL1C.SAFE/GRANULE/L1C_T33UUU/IMG_DATA/T33UUU_20160608T101032_B04.jp2", True),
        ("S2A_MSIL1C.SAFE/GRANULE/L1C_T33UUU/IMG_DATA/T33UUU_20160608T101032_B8A.jp2", False),
        ("S2A_MSIL1C.SAFE/GRANULE/L1C_T33UUU/IMG_DATA/T33UUU_20160608T101032_TCI.jp2", False),
        ("S2A_MSIL1C.SAFE/GRANULE/L1C_T33UUU/QI_DATA/MSK_QUALIT_B04.jp2", False),
        ("S2A_MSIL2A.SAFE/GRANULE/L2A_T33UUU/IMG_DATA/R10m/T33UUU_20160608T101032_B04_10m.jp2", True),
        ("S2A_MSIL2A.SAFE/GRANULE/L2A_T33UUU/IMG_DATA/R20m/T33UUU_20160608T101032_B04_20m.jp2", False),
        ("S2A_MSIL2A.SAFE/GRANULE/L2A_T33UUU/IMG_DATA/R20m/T33UUU_20160608T101032_SCL_20m.jp2", False),
        ("S2A_OPER_PRD.SAFE/GRANULE/T33UUU/IMG_DATA/S2A_OPER_MSI_L1C_TL_A005_T33UUU_B04.jp2", True),
        ("orthos/sheet_12.tif", True),
        ("orthos/sheet_12.tif.aux.xml", False),
        ("orthos/sheets.vrt", False),
    ],
)
def test_the_red_band_of_products_of_sentinel_2_is_taken_by_its_delivered_name(
    path: str, is_piece: bool
) -> None:
    assert IMAGES.fits(Path(path)) is is_piece


def with_a_wrong_item(folder: Path) -> Path:
    path = folder / "items.ndjson"
    path.write_text(json.dumps({"type": "Feature", "stac_version": "1.0.0", "id": "x", "assets": {}}))
    return path


def empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def processed_vrt(folder: Path) -> Path:
    path = folder / "processed.vrt"
    path.write_text('<VRTDataset><VRTRasterBand subClass="VRTDerivedRasterBand"/></VRTDataset>')
    return path


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda folder: folder / "none.tif", "expected the name of an existing file or folder"),
        (empty, "expected a folder with images on a map, at most 20,000, found 0"),
        (processed_vrt, r"a VRT as gdalbuildvrt writes it expected: .*gdal_translate"),
        (with_a_wrong_item, "item 'x': assets: none found as images"),
        (lambda folder: "https://localhost/GRI_L1C_T32TPT.tar.gz", "download it, and give the file"),
    ],
    ids=["missing", "empty", "vrt", "item", "archive"],
)
def test_what_has_no_pieces_is_refused(
    tmp_path: Path, make: Callable[[Path], str | Path], reason: str
) -> None:
    with pytest.raises(FormatError, match=reason):
        pieces_of(source_of([make(tmp_path)]), IMAGES)


@pytest.mark.parametrize("names", ["ab", "ba"])
def test_an_image_of_several_datums_is_as_accurate_as_the_least_accurate_of_them(
    names: str, tmp_path: Path
) -> None:
    """One on WGS 84, and one beside it on DHDN, whose operation has an accuracy of 2 m."""
    for name, crs in zip(names, ("EPSG:31468", "EPSG:32633"), strict=True):
        x, y = xy_of_lon_lat(crs, np.array([[12.6 if crs == "EPSG:31468" else 12.6005, 52.75]]))[0]
        place = from_origin(x, y, 1.0, 1.0)
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", "GTiff", 20, 20, 1, crs, place, "uint8"
        ) as file:
            file.write(np.full((1, 20, 20), 7, np.uint8))
    assert mosaic_at(tmp_path).shift_sigma_m == 2.0
