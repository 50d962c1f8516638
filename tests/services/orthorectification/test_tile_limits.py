"""The tiles of a scene in the tile matrix set of web maps, and heights between control points."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import CoverageError, InputError
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.orthorectification.point_terrain import terrain_of_points
from amers.services.orthorectification.tile_limits import (
    TILE_PX,
    TilePlace,
    choose_tiles,
    tiles_over,
)
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Acquisition, Array

SHAPE = (3000, 2000)
a_millionth_deg = 1e-6
a_centimetre = 0.01


def scene_at(lon: float, lat: float, shape: tuple[int, int] = SHAPE) -> Scene:
    """A vertical, north-up view of 0.5 m."""
    one = np.eye(20)[0]
    half = np.array(shape, dtype=np.float64) / 2.0
    half_deg = half * 0.5 / 111_320.0
    model = RpcModel(
        line_num=-np.eye(20)[2],
        line_den=one,
        sample_num=np.eye(20)[1],
        sample_den=one,
        image_offset=half - 0.5,
        image_scale=half,
        ground_offset=np.array([lon, lat, 100.0]),
        ground_scale=np.array([half_deg[1] / np.cos(np.radians(lat)), half_deg[0], 500.0]),
    )
    return Scene(ArrayImage(np.zeros(shape, dtype=np.float32)), model, Acquisition("a scene"), 1.0)


def inside(lon_lat: Array, corners: Array) -> bool:
    """Whether positions lie between the north-western and the south-eastern corner of a map."""
    (west, north), (east, south) = corners
    lon = west + (lon_lat[:, 0] - west) % 360.0
    east = west + (east - west) % 360.0
    return bool(
        (lon <= east).all() and (lon_lat[:, 1] <= north).all() and (lon_lat[:, 1] >= south).all()
    )


@pytest.mark.parametrize(("lon", "lat"), [(5.25, 43.25), (-71.0, -33.0), (179.999, -16.0), (10.0, 79.0)])
def test_the_tiles_of_every_zoom_hold_the_scene(lon: float, lat: float) -> None:
    scene = scene_at(lon, lat)
    levels = choose_tiles([scene], (90.0, 110.0))
    ends = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]) * (np.array(SHAPE) - 1.0)
    corners = scene.model.locate(ends, np.full(4, 100.0))[:, :2]
    for level in levels:
        grid = level.grid()
        assert grid.shape == (TILE_PX * level.rows, TILE_PX * level.columns)
        both = np.array([[-0.5, -0.5], np.array(grid.shape) - 0.5])
        assert inside(corners, grid.lon_lat(both)), level
    assert 0.7 < levels[0].grid().derivative(np.array([[lon, lat, 0.0]]))[0, 1, 0] * 0.5 < 1.42
    assert max(levels[-1].rows, levels[-1].columns) <= 2


def test_the_tiles_hold_a_scene_through_each_of_its_models() -> None:
    """The registered model puts it two of its widths to the east of where the delivered one does."""
    both = [scene_at(5.25, 43.25), scene_at(5.275, 43.25)]
    for level in choose_tiles(both, (100.0, 100.0)):
        ends = np.array([[0.0, 0.0], np.array(SHAPE) - 1.0])
        grid = level.grid()
        corners = grid.lon_lat(np.array([[-0.5, -0.5], np.array(grid.shape) - 0.5]))
        for scene in both:
            assert inside(scene.model.locate(ends, np.full(2, 100.0))[:, :2], corners), level


def test_a_corner_of_the_tiles_is_where_the_tile_matrix_set_has_it() -> None:
    level = choose_tiles([scene_at(5.25, 43.25)], (100.0, 100.0))[0]
    corner = level.grid().lon_lat(np.array([[-0.5, -0.5]]))[0]
    turn = 2**level.zoom
    lat = np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * level.first_row / turn))))
    expected = [level.first_column / turn * 360.0 - 180.0, lat]
    np.testing.assert_allclose(corner, expected, atol=a_millionth_deg)


def test_columns_go_on_beyond_the_antimeridian() -> None:
    level = choose_tiles([scene_at(180.0, -16.0)], (100.0, 100.0))[0]
    last = 2**level.zoom - 1
    assert level.first_column < last < level.last_column
    row = level.first_row
    assert level.index(TilePlace(level.zoom, row, last + 1 - level.first_column)) is None
    at_the_end = level.index(TilePlace(level.zoom, row, last))
    assert at_the_end == last - level.first_column
    assert level.index(TilePlace(level.zoom, row, 0)) == at_the_end + 1
    assert level.index(TilePlace(level.zoom, row, -1)) is None


def test_a_narrow_scene_that_lies_askew_has_no_more_tiles_than_its_pixels_warrant() -> None:
    scene = scene_at(5.25, 43.25, (40, 20_000))
    model = scene.model
    assert isinstance(model, RpcModel)
    turned = replace(
        scene,
        model=replace(
            model,
            line_num=-(np.eye(20)[2] * 500.0 + np.eye(20)[1] * 500.0),
            sample_num=np.eye(20)[1] - np.eye(20)[2] / 500.0,
        ),
    )
    finest = choose_tiles([turned], (100.0, 100.0))[0]
    assert finest.rows * finest.columns * TILE_PX**2 <= 8 * 40 * 20_000


def test_a_scene_at_a_pole_has_no_tiles() -> None:
    with pytest.raises(InputError, match="latitude 88"):
        choose_tiles([scene_at(5.0, 88.0)], (100.0, 100.0))


def test_heights_are_linear_between_points_and_those_of_the_nearest_outside() -> None:
    lon_lat_h = np.array(
        [[5.0, 43.0, 0.0], [5.01, 43.0, 100.0], [5.0, 43.01, 200.0], [5.01, 43.01, 300.0]]
    )
    terrain = terrain_of_points(lon_lat_h, np.array([[4.99, 42.99], [5.02, 43.02]]))
    heights = terrain.height_m(
        np.array([[5.005, 43.005], [5.0025, 43.0075], [5.019, 43.019], [4.991, 42.991]])
    )
    np.testing.assert_allclose(heights, [150.0, 175.0, 300.0, 0.0], atol=1.0)
    assert terrain.vertical == "interpolated between 4 control points"


def test_the_nearest_point_is_nearest_in_metres() -> None:
    """At 60 degrees of latitude, a degree of longitude is half as long as one of latitude."""
    points = np.array([[10.015, 60.0, 100.0], [10.0, 60.01, 200.0]])
    terrain = terrain_of_points(points, np.array([[9.98, 59.98], [10.02, 60.02]]))
    np.testing.assert_allclose(terrain.height_m(np.array([[10.0, 60.0]])), [100.0], atol=a_centimetre)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_points_on_a_line_give_the_heights_of_the_nearest(count: int) -> None:
    lon = 179.99 + 0.01 * np.arange(count)
    places = np.column_stack([(lon + 180.0) % 360.0 - 180.0, np.zeros(count), 10.0 * np.arange(count)])
    terrain = terrain_of_points(places, np.array([[179.98, -0.01], [180.02, 0.01]]))
    np.testing.assert_allclose(terrain.height_m(places[:, :2]), places[:, 2], atol=a_centimetre)


def test_without_points_there_are_no_heights() -> None:
    with pytest.raises(CoverageError, match="at least one"):
        terrain_of_points(np.zeros((0, 3)), np.array([[5.0, 43.0], [5.1, 43.1]]))


@pytest.mark.parametrize("turn_deg", [-720.0, -360.0, 360.0])
@pytest.mark.parametrize("west_deg", [-179.9, -20.0, 179.9])
def test_whole_turns_of_longitude_change_no_tile(west_deg: float, turn_deg: float) -> None:
    outline = np.array([[0.0, 40.0], [0.3, 40.1], [0.2, 40.3], [-0.05, 40.2]]) + [west_deg, 0.0]
    expected = tiles_over(outline, 5.0, 5000 * 5000)
    assert expected[0].columns > 5
    assert tiles_over(outline + [turn_deg, 0.0], 5.0, 5000 * 5000) == expected
