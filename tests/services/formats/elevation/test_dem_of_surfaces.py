"""A surface as an elevation model: each height has the standard deviation that the surface states."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import gaussian_filter

from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.surfaces import BANDS, heights_crs
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.production.height_control import ControlHeights, known_heights
from amers.services.production.ortho_production import (
    GroundHeights,
    OrthoPointOptions,
    produce_ortho_points,
)
from amers.services.quality.block_heights import HeightModel, height_errors
from amers.services.sensors.ortho import OrthoModel
from amers.services.terrain import HEIGHT_SIGMA_POSTINGS, Terrain
from amers.services.types import Acquisition, Array, Frame, SurfaceHeights
from tests.factories import control_points
from tests.services.textures import as_pixels, texture

a_millimetre = 1e-3
SHAPE, GSD_M, CORNER_XY = (600, 600), 2.0, (7e5, 4.8e6)
GRID = MapGrid(
    "EPSG:32631",
    np.array([CORNER_XY[0] + GSD_M / 2.0, CORNER_XY[1] - GSD_M / 2.0]),
    np.array([[0.0, GSD_M], [-GSD_M, 0.0]]),
    SHAPE,
)
TRUE_M = 120.0


def sigmas_m() -> Array:
    """From 0.3 m in the west to 3 m in the east."""
    return np.tile(np.geomspace(0.3, 3.0, SHAPE[1]), (SHAPE[0], 1))


def write_surface(path: Path, first: int = 0, last: int = SHAPE[1]) -> Path:
    """Columns of a surface whose heights err as it states, alike over some cells, with a gap."""
    noise = gaussian_filter(np.random.default_rng(4).normal(size=SHAPE), 3.0)
    height_m = TRUE_M + sigmas_m() * noise / noise.std()
    height_m[200:230, 300:330] = np.nan
    sigma_m = np.where(np.isnan(height_m), np.nan, sigmas_m())
    bands = np.stack([height_m, sigma_m, np.full(SHAPE, 2.0), np.isnan(height_m) * 5.0])
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=SHAPE[0],
        width=last - first,
        count=4,
        dtype="float32",
        nodata=float("nan"),
        crs=heights_crs(GRID),
        transform=from_origin(CORNER_XY[0] + first * GSD_M, CORNER_XY[1], GSD_M, GSD_M),
    ) as file:
        file.write(bands[:, :, first:last].astype(np.float32))
        file.descriptions = BANDS
    return path


@pytest.fixture(scope="module")
def terrain(tmp_path_factory: pytest.TempPathFactory) -> Terrain:
    return read_dem(write_surface(tmp_path_factory.mktemp("surface") / "surface.tif"))


def places(count: int = 3000) -> Array:
    low, high = np.zeros(2), np.array(SHAPE) - 1.0
    return GRID.lon_lat(np.random.default_rng(9).uniform(low, high, (count, 2)))


def expected_m(lon_lat: Array) -> Array:
    return np.interp(GRID.line_sample(lon_lat)[:, 1], np.arange(SHAPE[1]), sigmas_m()[0])


def test_the_sigma_of_each_cell_is_read_and_that_of_a_gap_is_not(terrain: Terrain) -> None:
    sigma_m = terrain.sigma_m(places())
    known = np.isfinite(terrain.height_m(places()))
    np.testing.assert_array_equal(np.isfinite(sigma_m), known)
    assert 0 < (~known).sum() < 60
    np.testing.assert_allclose(sigma_m[known], expected_m(places())[known], atol=a_millimetre)
    assert any("sigma" in one.value and one.where == "band 2" for one in terrain.statements)
    assert any(one.value == "bands 3 to 4" for one in terrain.statements)


def test_it_is_the_same_in_a_part_in_another_process_and_in_tiles(
    terrain: Terrain, tmp_path: Path
) -> None:
    expected = terrain.sigma_m(places())
    for same in (terrain.around(places()), pickle.loads(pickle.dumps(terrain))):
        np.testing.assert_allclose(same.sigma_m(places()), expected, rtol=1e-6)
    write_surface(tmp_path / "west.tif", 0, 250)
    write_surface(tmp_path / "east.tif", 250)
    for tiles in (read_dem(tmp_path), read_dem(tmp_path).around(places())):
        np.testing.assert_allclose(tiles.sigma_m(places()), expected, rtol=1e-6)
    filled = read_dem(tmp_path, fill_px=30)
    assert np.isfinite(filled.sigma_m(places())).all()


@pytest.mark.parametrize("plain", ["east.tif", "west.tif"])
def test_tiles_of_which_one_states_no_sigma_have_that_of_their_distance(
    plain: str, tmp_path: Path
) -> None:
    write_surface(tmp_path / "west.tif", 0, 250)
    write_surface(tmp_path / "east.tif", 250)
    with rasterio.open(tmp_path / plain, "r+") as file:
        file.descriptions = ("", "", "", "")
    assert read_dem(tmp_path).sigmas is None
    np.testing.assert_allclose(read_dem(tmp_path).sigma_m(places()), HEIGHT_SIGMA_POSTINGS * GSD_M, 0.01)


def mean_square(error_m: Array, variance_m2: Array) -> tuple[float, float]:
    """Mean square of normalised errors: where the surface is precise, and where it is not."""
    normalised = error_m**2 / variance_m2
    east = variance_m2 > np.median(variance_m2)
    return float(normalised[~east].mean()), float(normalised[east].mean())


def test_heights_of_a_block_are_judged_by_the_sigma_of_their_place(terrain: Terrain) -> None:
    points = control_points(len(places()), np.random.default_rng(2), (0.0, 0.0, 1.0, 1.0))
    ground = np.column_stack([places(), np.full(len(places()), TRUE_M)])
    points = replace(points, lon_lat_h=ground, covariance_m2=points.covariance_m2 * 1e-6)
    errors = height_errors(points, HeightModel(terrain))
    assert all(0.7 < found < 1.5 for found in mean_square(errors.error_m, errors.variance_m2))
    blind = height_errors(points, HeightModel(replace(terrain, sigmas=None)))
    assert mean_square(blind.error_m, blind.variance_m2)[1] > 20.0


def test_points_of_an_ortho_image_have_the_sigma_of_their_place(terrain: Terrain) -> None:
    image = ArrayImage(as_pixels(texture(np.random.default_rng(4), SHAPE[0], 1.5)))
    scene = Scene(image, OrthoModel(GRID), Acquisition("land", incidence_deg=0.0, azimuth_deg=0.0), 5.0)
    options = OrthoPointOptions(points=900, fine_gsd_m=GSD_M)
    points = produce_ortho_points([scene], GroundHeights(terrain), options).points
    error_m = points.lon_lat_h[:, 2] - TRUE_M
    variance_m2 = points.covariance_m2[:, 2, 2]
    np.testing.assert_allclose(np.sqrt(variance_m2), expected_m(points.lon_lat_h), atol=a_millimetre)
    assert len(points) > 100
    assert all(0.7 < found < 1.5 for found in mean_square(error_m, variance_m2))


def test_control_heights_have_the_sigma_of_their_place(terrain: Terrain) -> None:
    points = np.column_stack([places(400), np.zeros(400)])
    above = SurfaceHeights(np.zeros(400), np.full(400, 0.1))
    heights = ControlHeights("surface.tif", terrain, Frame.from_sigmas(1.0, 0.5))
    known = known_heights(points, above, 1.0, heights)
    assert len(known.point) > 100
    error_m = known.lon_lat_h[:, 2] - TRUE_M
    west, east = mean_square(error_m, known.covariance_m2[:, 2, 2])
    assert 0.3 < west < 1.5
    assert 0.3 < east < 1.5
