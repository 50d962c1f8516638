"""Heights of a terrain, and the intersection of lines of sight with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from amers.services import terrain as terrain_module
from amers.services.errors import CoverageError
from amers.services.imagery.source import ArrayImage, FloatImage, Window
from amers.services.lines_of_sight import intersect_terrain
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Array

a_tenth_of_a_millimetre = 1e-4
a_millimetre = 1e-3
a_thousandth_of_a_pixel = 1e-3

SHAPE = (300, 280)
GRID = MapGrid("EPSG:32631", np.array([7e5, 4.8e6]), np.array([[0.0, 10.0], [-10.0, 0.0]]), SHAPE)


def hills(amplitude_m: float = 150.0) -> FloatImage:
    line, sample = np.indices(SHAPE)
    smooth = np.sin(line / 17.0) * np.cos(sample / 13.0) + 0.3 * np.sin((line + sample) / 7.0)
    return (500.0 + amplitude_m * smooth).astype(np.float32)


class Stored:
    """Heights that are not in memory, and the windows of them that were read."""

    def __init__(self, pixels: FloatImage) -> None:
        self.image = ArrayImage(pixels)
        self.shape = self.image.shape
        self.windows: list[Window] = []

    def read(self, window: Window) -> FloatImage:
        self.windows.append(window)
        return self.image.read(window)


def terrain(amplitude_m: float = 150.0) -> Terrain:
    return Terrain(GRID, ArrayImage(hills(amplitude_m)))


def places(n: int = 500, margin: float = 3.0) -> Array:
    high = np.array(SHAPE) - 1.0 - margin
    return np.random.default_rng(3).uniform(margin, high, (n, 2))


def view(incidence_deg: float, azimuth_deg: float = 110.0) -> PushbroomModel:
    lon, lat = GRID.lon_lat(np.array([[150.0, 140.0]]))[0]
    return pushbroom_over(
        np.array([lon, lat, 500.0]), (400, 400), 2.0, (incidence_deg, azimuth_deg), (200.0, 800.0)
    )


def pixels_of(count: int = 400) -> Array:
    return np.random.default_rng(8).uniform(0.0, 399.0, (count, 2))


def test_heights_are_bilinear_between_the_nodes() -> None:
    expected = map_coordinates(hills().astype(np.float64), places().T, order=1)
    actual_m = terrain().height_m(GRID.lon_lat(places()))
    np.testing.assert_allclose(actual_m, expected, atol=a_millimetre)


def test_a_grid_read_by_windows_gives_the_same_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    lon_lat = GRID.lon_lat(places(margin=-2.0))
    whole, whole_range_m = terrain().height_m(lon_lat), terrain().range_m()
    monkeypatch.setattr(terrain_module, "_TILE", 64)
    monkeypatch.setattr(terrain_module, "_MAX_CELLS_IN_MEMORY", 1000)
    stored = replace(terrain(), heights=Stored(hills()))
    np.testing.assert_array_equal(stored.height_m(lon_lat), whole)
    assert stored.range_m() == whole_range_m
    np.testing.assert_allclose(stored.around(lon_lat[:9]).height_m(lon_lat[:9]), whole[:9])


def test_a_part_of_a_terrain_has_the_same_heights() -> None:
    lon_lat = GRID.lon_lat(places(9))
    for heights in (ArrayImage(hills()), Stored(hills())):
        part = replace(terrain(), heights=heights).around(lon_lat)
        assert part.grid.shape < GRID.shape
        np.testing.assert_allclose(part.height_m(lon_lat), terrain().height_m(lon_lat))


def test_no_window_is_larger_than_a_tile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terrain_module, "_TILE", 64)
    stored = Stored(hills())
    replace(terrain(), heights=stored).height_m(GRID.lon_lat(places()))
    assert len(stored.windows) == 25
    assert max(max(window.lines, window.samples) for window in stored.windows) <= 65


def test_heights_outside_the_grid_and_next_to_a_void_are_nan() -> None:
    heights = hills()
    heights[100, 100] = np.nan
    outside = [[-0.6, 5.0], [5.0, SHAPE[1] - 0.4], [99.5, 100.5], [100.0, 100.0]]
    inside = [[-0.4, 5.0], [99.0, 99.0], [100.0, 101.0], [101.5, 102.0]]
    holed = replace(terrain(), heights=ArrayImage(heights))
    assert np.isnan(holed.height_m(GRID.lon_lat(np.array(outside)))).all()
    # At the nodes, up to the rounding of the map projection.
    assert np.isfinite(holed.height_m(GRID.lon_lat(np.array(inside) + [1e-7, 1e-7]))[[0, 2, 3]]).all()
    assert np.isfinite(holed.height_m(GRID.lon_lat(np.array(inside[1:2]) - 1e-7))).all()


def test_heights_above_a_geoid_become_heights_above_the_ellipsoid() -> None:
    lon_lat = GRID.lon_lat(places())
    undulating = replace(terrain(), geoid=lambda place: 40.0 + 2.0 * (place[:, 1] - 43.0))
    expected = terrain().height_m(lon_lat) + 40.0 + 2.0 * (lon_lat[:, 1] - 43.0)
    np.testing.assert_allclose(undulating.height_m(lon_lat), expected, atol=a_tenth_of_a_millimetre)
    low, high = undulating.range_m()
    assert low <= expected.min() < expected.max() <= high


def test_the_slope_is_the_rise_per_metre() -> None:
    line, sample = np.indices(SHAPE)
    plane = Terrain(GRID, ArrayImage((100.0 + 3.0 * sample - 2.0 * line).astype(np.float32)))
    lon_lat = GRID.lon_lat(places())
    derivative = GRID.derivative(np.column_stack([lon_lat, np.zeros(len(lon_lat))]))
    expected = np.array([-2.0, 3.0]) @ derivative
    np.testing.assert_allclose(plane.slope(lon_lat), expected, atol=1e-3)


def test_the_slope_beside_a_ridge_is_that_of_its_side() -> None:
    """It is over one posting of 10 m: the other side begins a posting away."""
    _, sample = np.indices(SHAPE)
    ridge = Terrain(GRID, ArrayImage((500.0 - 3.0 * np.abs(sample - 140.0)).astype(np.float32)))
    places = GRID.lon_lat(np.array([[150.0, 139.0], [150.0, 141.0]]))
    slope = np.linalg.norm(ridge.slope(places), axis=1)
    np.testing.assert_allclose(slope, 0.3, rtol=0.01)


@pytest.mark.parametrize("incidence_deg", [0.0, 12.0, 35.0])
def test_lines_of_sight_end_on_the_ground(incidence_deg: float) -> None:
    model, ground = view(incidence_deg), terrain(60.0)
    met = intersect_terrain(model, pixels_of(), ground)
    np.testing.assert_allclose(met[:, 2], ground.height_m(met[:, :2]), atol=a_millimetre)
    np.testing.assert_allclose(model.project(met), pixels_of(), atol=a_thousandth_of_a_pixel)


@pytest.mark.parametrize("height_m", [0.0, 512.25, 233.1])
def test_lines_of_sight_end_on_a_plain_that_is_as_high_everywhere(height_m: float) -> None:
    """All of the search for the highest ground is done at the height of the ground itself."""
    plain = Terrain(GRID, ArrayImage(np.full(SHAPE, height_m, dtype=np.float32)))
    for incidence_deg in (0.0, 35.0):
        met = intersect_terrain(view(incidence_deg), pixels_of(), plain)
        np.testing.assert_allclose(met[:, 2], height_m, atol=a_millimetre)


def test_a_line_of_sight_ends_on_the_side_of_a_ridge_the_sensor_sees() -> None:
    """On slopes steeper than the line of sight, several points of the ground lie on one line."""
    model, ground = view(40.0), terrain(400.0)
    met = intersect_terrain(model, pixels_of(), ground)
    hidden_by_m = np.zeros(len(met))
    twice = np.zeros(len(met), dtype=bool)
    for above_m in np.arange(2.0, 900.0, 2.0):
        place = model.locate(pixels_of(), met[:, 2] + above_m)
        over_m = ground.height_m(place[:, :2]) - place[:, 2]
        hidden_by_m = np.fmax(hidden_by_m, over_m)
    for below_m in np.arange(5.0, 900.0, 5.0):
        place = model.locate(pixels_of(), met[:, 2] - below_m)
        twice |= ground.height_m(place[:, :2]) < place[:, 2]
    assert twice.sum() > 20
    assert hidden_by_m.max() < a_millimetre


def test_a_line_of_sight_passes_through_no_tower_of_a_plain() -> None:
    """Most of the ground is far below a line, and is skipped; here and there a tower stands."""
    rng = np.random.default_rng(5)
    heights = rng.uniform(0.0, 5.0, SHAPE).astype(np.float32)
    for row, column in rng.integers(4, np.array(SHAPE) - 4, (60, 2)).tolist():
        heights[row : row + 2, column : column + 2] = rng.uniform(100.0, 1500.0)
    ground = Terrain(GRID, ArrayImage(heights))
    lon, lat = GRID.lon_lat(np.array([[150.0, 140.0]]))[0]
    on_towers = 0
    for azimuth_deg in (20.0, 250.0):
        model = pushbroom_over(
            np.array([lon, lat, 0.0]), (400, 400), 2.0, (40.0, azimuth_deg), (-100.0, 1600.0)
        )
        met = intersect_terrain(model, pixels_of(), ground)
        assert np.isfinite(met).all()
        on_towers += (met[:, 2] > 20.0).sum()
        for height_m in np.arange(1.0, 1600.0, 3.0):
            place = model.locate(pixels_of(), np.full(len(met), height_m))
            above = height_m > met[:, 2] + a_millimetre
            assert not (ground.height_m(place[above, :2]) > height_m + a_millimetre).any()
    assert on_towers > 10


def test_no_height_is_asked_of_a_geoid_where_none_is_known() -> None:
    def geoid(lon_lat: Array) -> Array:
        assert len(lon_lat)
        return np.full(len(lon_lat), 50.0)

    ground = replace(terrain(), geoid=geoid)
    assert np.isnan(ground.height_m(np.array([[170.0, 10.0]]))).all()


def test_a_line_of_sight_that_leaves_the_grid_or_enters_a_void_has_no_intersection() -> None:
    heights = hills(60.0)
    heights[:, :140] = np.nan
    met = intersect_terrain(view(12.0), pixels_of(), replace(terrain(60.0), heights=ArrayImage(heights)))
    valid = np.isfinite(met[:, 2])
    assert 0.3 < valid.mean() < 0.7
    far = replace(GRID, origin_xy=GRID.origin_xy + 1e5)
    with pytest.raises(CoverageError, match="does not cover"):
        intersect_terrain(view(12.0), pixels_of(), replace(terrain(), grid=far))


@pytest.mark.parametrize("wave_m", [10.0, 0.0])
def test_the_range_of_the_ground_holds_a_geoid_whose_extremes_lie_between_its_samples(
    wave_m: float,
) -> None:
    """Its waves are eight samples long, so that the samples show 92 % of them; or there is none."""
    line, sample = np.indices(SHAPE)
    corners = np.array([[0.0, 0.0], [SHAPE[0] - 1.0, SHAPE[1] - 1.0]])
    north, south = GRID.lon_lat(corners)[:, 1]
    place = GRID.lon_lat(np.column_stack([line.ravel(), sample.ravel()]).astype(np.float64))

    def geoid(at: Array) -> Array:
        return np.asarray(
            30.0 + wave_m * np.sin(np.pi * (8.0 * (at[:, 1] - south) / (north - south) + 1 / 8))
        )

    flat = Terrain(GRID, ArrayImage(np.full(SHAPE, 500.0, dtype=np.float32)), geoid)
    low, high = flat.range_m()
    heights = flat.height_m(place)
    assert low < heights.min() <= heights.max() < high
    assert high - low < 2.0 * np.ptp(heights) + 0.5


def test_lines_of_sight_end_on_ground_above_a_geoid() -> None:
    model, flat = view(35.0), terrain(60.0)
    ground = replace(flat, geoid=lambda at: 40.0 * np.sin(2.0 * at[:, 0]) + 80.0 * (at[:, 1] - 43.3))
    met = intersect_terrain(model, pixels_of(), ground)
    assert np.isfinite(met).all()
    np.testing.assert_allclose(met[:, 2], ground.height_m(met[:, :2]), atol=a_millimetre)


def test_a_geoid_of_zero_changes_nothing_beside_voids_and_borders_either() -> None:
    """The vertical lines of the nodes of a map pass voids and end at its borders."""
    heights = hills()
    heights[::3, 1::4] = np.nan
    holed = replace(terrain(), heights=ArrayImage(heights))
    level = replace(holed, geoid=lambda at: np.zeros(len(at)))
    at_nodes = np.stack(np.indices(SHAPE), axis=-1).reshape(-1, 2)[::7] - [0.5, 0.5]
    for model, at in ((OrthoModel(GRID), at_nodes), (view(30.0), pixels_of(3000))):
        plain, met = (intersect_terrain(model, at, ground) for ground in (holed, level))
        assert 0.05 < np.isfinite(plain[:, 2]).mean() < 0.95
        np.testing.assert_allclose(met, plain, atol=a_millimetre)


def test_a_terrain_too_large_for_the_memory_is_read_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    model, ground = view(35.0), terrain(60.0)
    whole = intersect_terrain(model, pixels_of(), ground)
    monkeypatch.setattr(terrain_module, "_MAX_CELLS_IN_MEMORY", 800)
    stored = Stored(ground.heights.read(Window(0, 0, *SHAPE)))
    parts = intersect_terrain(model, pixels_of(), replace(ground, heights=stored))
    assert len(stored.windows) > 2
    np.testing.assert_allclose(parts[:, 2], whole[:, 2], atol=a_tenth_of_a_millimetre)
    corner = replace(stored.image, pixels=stored.image.pixels[:130, :120])
    grid = replace(GRID, shape=corner.shape)
    inside = intersect_terrain(model, pixels_of(), replace(ground, grid=grid, heights=corner))
    parts = intersect_terrain(
        model, pixels_of(), replace(ground, grid=grid, heights=Stored(corner.pixels))
    )
    assert 0.05 < np.isnan(inside[:, 2]).mean() < 0.95
    np.testing.assert_allclose(parts[:, 2], inside[:, 2], atol=a_tenth_of_a_millimetre)


def test_the_lines_of_sight_of_an_ortho_image_end_vertically_below() -> None:
    model, ground = OrthoModel(GRID), terrain()
    met = intersect_terrain(model, places(), ground)
    np.testing.assert_allclose(met[:, 2], ground.height_m(GRID.lon_lat(places())), atol=a_millimetre)


@pytest.mark.parametrize("west", [-180.0, 0.0, -170.0])
@pytest.mark.parametrize("columns", [3600, 3601])
@pytest.mark.parametrize("middle", [180.0, -180.0, 0.0, 5.0, -170.0])
def test_a_terrain_around_the_earth_serves_ground_on_both_sides_of_its_seam(
    west: float, columns: int, middle: float
) -> None:
    """Columns of 0.1 degrees; with one more, the last is the first again."""
    step = np.array([[0.0, 0.1], [-0.1, 0.0]])
    grid = MapGrid("EPSG:4326", np.array([west + 0.05, 10.0]), step, (20, columns))
    lon = west + 0.05 + 0.1 * np.arange(columns)
    pixels = np.tile(100.0 * np.cos(np.radians(lon)), (20, 1)).astype(np.float32)
    terrain = Terrain(grid, ArrayImage(pixels))
    lon_lat = np.column_stack([middle + np.linspace(-0.5, 0.5, 41), np.full(41, 9.3)])
    lon_lat[:, 0] = (lon_lat[:, 0] + 180.0) % 360.0 - 180.0
    around = terrain.around(lon_lat)
    assert around.grid.shape[1] <= 14
    expected = 100.0 * np.cos(np.radians(lon_lat[:, 0]))
    a_cell_of_the_cosine_m = 0.05
    np.testing.assert_allclose(around.height_m(lon_lat), expected, atol=a_cell_of_the_cosine_m)
    low, high = around.range_m()
    with pytest.raises(CoverageError):
        terrain.around(np.full((3, 2), np.nan))
    assert low <= expected.min() + a_cell_of_the_cosine_m
    assert high >= expected.max() - a_cell_of_the_cosine_m
