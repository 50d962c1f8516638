"""Masks and land cover of the ground, from polygons and from images on a map."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from amers.services.errors import FormatError
from amers.services.formats.ground_masks import any_of, read_ground_mask, read_land_cover

PLACES = np.array([[5.005, 43.095], [5.055, 43.045], [5.095, 43.005], [6.0, 43.05]])
"""Of the first, the middle and the last of ten by ten pixels of 0.01 degree, and beside them."""


def write(path: Path, pixels: np.ndarray, *, on_a_map: bool = True) -> Path:
    where = {"crs": "EPSG:4326", "transform": from_origin(5.0, 43.1, 0.01, 0.01)} if on_a_map else {}
    height, width = pixels.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=1,
        dtype="uint8",
        height=height,
        width=width,
        nodata=255,
        **where,
    ) as file:
        file.write(pixels.astype(np.uint8), 1)
    return path


def test_pixels_other_than_zero_are_excluded_and_nothing_else(tmp_path: Path) -> None:
    pixels = np.zeros((10, 10))
    pixels[0, 0], pixels[9, 9] = 7, 255
    mask = read_ground_mask(write(tmp_path / "mask.tif", pixels))
    assert mask(PLACES).tolist() == [True, False, False, False]


def test_polygons_are_excluded(tmp_path: Path) -> None:
    path = tmp_path / "lake.geojson"
    ring = "[[5.04,43.0],[5.2,43.0],[5.2,43.08],[5.04,43.08],[5.04,43.0]]"
    path.write_text(f'{{"type":"Polygon","coordinates":[{ring}]}}')
    lake = read_ground_mask(path)
    assert lake(PLACES).tolist() == [False, True, True, False]
    pixels = np.zeros((10, 10))
    pixels[0, 0] = 1
    both = any_of([lake, read_ground_mask(write(tmp_path / "mask.tif", pixels))])
    assert both is not None
    assert both(PLACES).tolist() == [True, True, True, False]
    assert any_of([]) is None


def test_classes_have_the_names_of_world_cover_where_there_are_no_others(tmp_path: Path) -> None:
    pixels = np.full((10, 10), 10)
    pixels[5, 5], pixels[9, 9] = 80, 0
    cover = read_land_cover(write(tmp_path / "cover.tif", pixels))
    assert cover(PLACES) == ["trees", "water", "unknown", "unknown"]
    pixels[5, 5] = 3
    other = read_land_cover(write(tmp_path / "other.tif", pixels))
    assert other(PLACES) == ["class 10", "class 3", "unknown", "unknown"]


def test_many_positions_in_any_order_agree_with_single_ones(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 2, (2500, 1300))
    mask = read_ground_mask(write(tmp_path / "large.tif", pixels))
    row, column = rng.integers(0, 2500, 500), rng.integers(0, 1300, 500)
    places = np.column_stack([5.0 + (column + 0.5) * 0.01, 43.1 - (row + 0.5) * 0.01])
    np.testing.assert_array_equal(mask(places), pixels[row, column] != 0)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_an_image_on_no_map_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "image.tif", np.ones((4, 4)), on_a_map=False)
    with pytest.raises(FormatError, match=r"image\.tif.*GeoJSON or an image on a map"):
        read_ground_mask(path)
