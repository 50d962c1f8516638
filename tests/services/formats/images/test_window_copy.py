"""Copies of windows: pixel for pixel, in their place, without what a mask hides."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
import shapely
from rasterio.transform import Affine

from amers.services.errors import CoverageError, FormatError
from amers.services.formats.images.window_copy import (
    WindowSource,
    clear_share,
    copy_heights,
    copy_window,
)
from amers.services.imagery.archives import LANDSAT, SENTINEL_2
from amers.services.map_grid import lon_lat_of_xy
from tests.open_archive import write_cog

CRS = "EPSG:32632"
NORTH_WEST = 600_000.0, 4_900_000.0
a_pixel = 1


def ground(left: float, top: float, right: float, bottom: float) -> shapely.Geometry:
    """A rectangle of pixels of 10 m, longitude and latitude."""
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    return shapely.Polygon(lon_lat_of_xy(CRS, corners * [10.0, -10.0] + NORTH_WEST))


@pytest.fixture
def source(tmp_path: Path) -> WindowSource:
    """An image of 3000 x 2000 pixels with an offset, and classes of 20 m: clouds on the right half."""
    rng = np.random.default_rng(1)
    pixels = rng.integers(900, 9000, (3000, 2000), dtype=np.uint16)
    pixels[:100] = 0
    write_cog(
        tmp_path / "red.tif", pixels, CRS, Affine(10.0, 0.0, NORTH_WEST[0], 0.0, -10.0, NORTH_WEST[1])
    )
    classes = np.full((1500, 1000), 4, dtype=np.uint8)
    classes[:, 500:] = 9
    transform = Affine(20.0, 0.0, NORTH_WEST[0], 0.0, -20.0, NORTH_WEST[1])
    write_cog(tmp_path / "scl.tif", classes, CRS, transform)
    return WindowSource(tmp_path / "red.tif", tmp_path / "scl.tif", SENTINEL_2, -1000.0)


def test_a_window_is_copied_with_offset_mask_and_place(source: WindowSource, tmp_path: Path) -> None:
    copied = copy_window(source, ground(705.5, 905.5, 1304.5, 2504.5), tmp_path / "copy.tif")
    with rasterio.open(tmp_path / "copy.tif") as copy, rasterio.open(source.image) as image:
        at = copy.transform.c, copy.transform.f
        assert at == (NORTH_WEST[0] + 7050.0, NORTH_WEST[1] - 9050.0)
        found, full = copy.read(1), image.read(1)
        part = full[905:2505, 705:1305].astype(np.int64) - 1000
        np.testing.assert_array_equal(found[:, : 1000 - 705], np.clip(part[:, : 1000 - 705], 1, None))
        assert not found[:, 1000 - 705 :].any()
        assert copy.nodata == 0
    assert copied.shape == found.shape == (1600, 600)
    assert copied.full == (3000, 2000)
    assert (copied.valid, copied.clear) == (1.0, pytest.approx(295 / 600))
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_window_beyond_the_image_is_cut_and_one_elsewhere_refused(
    source: WindowSource, tmp_path: Path
) -> None:
    copied = copy_window(source, ground(-500.0, -200.0, 300.0, 200.0), tmp_path / "copy.tif")
    np.testing.assert_allclose(copied.shape, (200, 300), atol=a_pixel)  # edges are not quite straight
    assert copied.valid == pytest.approx(0.5, abs=0.01)
    with pytest.raises(CoverageError, match="does not show the area"):
        copy_window(source, ground(5000.0, 0.0, 6000.0, 100.0), tmp_path / "none.tif")
    assert not (tmp_path / "none.tif").exists()


def test_only_the_tiles_that_the_area_touches_are_read(source: WindowSource, tmp_path: Path) -> None:
    far = shapely.union(ground(0.0, 200.0, 300.0, 500.0), ground(600.0, 2600.0, 900.0, 2900.0))
    copied = copy_window(source, far, tmp_path / "copy.tif")
    assert copied.shape == (2700, 900)
    assert copied.pixels == (1024 - 200) * 900 + (2900 - 2048) * 900
    with rasterio.open(tmp_path / "copy.tif") as copy:
        assert not copy.read(1)[1024 - 200 : 2048 - 200].any()


def test_the_clear_share_comes_from_the_mask_alone(source: WindowSource) -> None:
    places = shapely.get_coordinates(ground(600.5, 500.5, 1400.5, 1500.5))[:4]
    assert clear_share(source, places) == 0.5
    without = WindowSource(source.image, None, SENTINEL_2)
    assert clear_share(without, places) == 1.0


def test_bits_and_classes_hide() -> None:
    values = np.array([0b1, 0b1000, 0b1000000, 0b10000000])
    landsat = WindowSource(Path("image"), None, LANDSAT)
    np.testing.assert_array_equal(landsat.hidden(values), [True, True, False, True])
    classes = np.array([3, 4, 5, 6, 8, 11])
    hidden = WindowSource(Path("image"), None, SENTINEL_2).hidden(classes)
    np.testing.assert_array_equal(hidden, [True, False, False, True, True, True])


def test_an_image_without_a_map_and_a_mask_on_another_are_refused(
    source: WindowSource, tmp_path: Path
) -> None:
    write_cog(tmp_path / "raw.tif", np.ones((300, 300), np.uint16), "", Affine.identity())
    with pytest.raises(FormatError, match="no map found"):
        copy_window(
            WindowSource(tmp_path / "raw.tif", None, SENTINEL_2),
            ground(0, 0, 9, 9),
            tmp_path / "copy.tif",
        )
    other = Affine(20.0, 0.0, NORTH_WEST[0], 0.0, -20.0, NORTH_WEST[1])
    write_cog(tmp_path / "other.tif", np.ones((1500, 1000), np.uint8), "EPSG:32631", other)
    wrong = WindowSource(source.image, tmp_path / "other.tif", SENTINEL_2)
    with pytest.raises(FormatError, match="the map of its image"):
        copy_window(wrong, ground(700.0, 900.0, 800.0, 1000.0), tmp_path / "copy.tif")


def test_heights_are_copied_as_they_are(tmp_path: Path) -> None:
    heights = np.random.default_rng(2).normal(100.0, 30.0, (400, 500)).astype(np.float32)
    transform = Affine(30.0, 0.0, NORTH_WEST[0], 0.0, -30.0, NORTH_WEST[1])
    write_cog(tmp_path / "dem.tif", heights, CRS, transform, nodata=-32767.0)
    count = copy_heights(tmp_path / "dem.tif", ground(300.0, 300.0, 600.0, 450.0), tmp_path / "copy.tif")
    with rasterio.open(tmp_path / "copy.tif") as copy:
        found = copy.read(1)
        assert count == found.size
        np.testing.assert_array_equal(found, heights[100:150, 100:200])
        assert copy.nodata == -32767.0
