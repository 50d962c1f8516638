"""Map grids agree with GDAL and PROJ through rasterio."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import Geod
from rasterio.transform import Affine
from rasterio.warp import transform

from amers.services.errors import InputError
from amers.services.geodesy import east_north_up
from amers.services.map_grid import MapGrid, check_map_code, map_units_per_metre, utm_of, xy_of_lon_lat

a_micropixel = 1e-6
a_millionth = 1e-6

NORTH_UP = MapGrid(
    "EPSG:32633", np.array([330005.0, 5861995.0]), np.diag([-10.0, 10.0])[::-1], (3200, 2400)
)
ROTATED = MapGrid("EPSG:2154", np.array([7e5, 6.6e6]), np.array([[0.4, 1.9], [-2.1, 0.3]]), (900, 700))
DEGREES = MapGrid(
    "EPSG:4326", np.array([179.2, -16.0]), np.array([[0.0, 1e-3], [-1e-3, 0.0]]), (800, 1600)
)
UTM_1 = MapGrid(
    "EPSG:32701", np.array([172000.0, 8.2e6]), np.array([[0.0, 30.0], [-30.0, 0.0]]), (900, 900)
)


def positions(grid: MapGrid, n: int = 200) -> np.ndarray:
    return np.random.default_rng(4).uniform(-0.5, np.array(grid.shape) - 0.5, (n, 2))


@pytest.mark.parametrize("grid", [NORTH_UP, ROTATED, DEGREES, UTM_1])
def test_positions_of_pixels_agree_with_gdal(grid: MapGrid) -> None:
    """GDAL counts from the corner of the first pixel, which is a difference of half a pixel."""
    lines, samples = positions(grid).T
    (a, b), (c, d) = grid.step_xy
    corner = grid.origin_xy - grid.step_xy @ [0.5, 0.5]
    x, y = Affine(b, a, corner[0], d, c, corner[1]) @ (samples + 0.5, lines + 0.5)
    lon, lat = transform(grid.crs, "EPSG:4326", x, y)
    ours = grid.lon_lat(positions(grid))
    np.testing.assert_allclose((ours[:, 0] - lon + 180.0) % 360.0 - 180.0, 0.0, atol=1e-10)
    np.testing.assert_allclose(ours[:, 1], lat, atol=1e-10)


@pytest.mark.parametrize("grid", [NORTH_UP, ROTATED, DEGREES, UTM_1])
def test_a_pixel_survives_a_round_trip_through_the_ground(grid: MapGrid) -> None:
    lon_lat = grid.lon_lat(positions(grid))
    assert (np.abs(lon_lat[:, 0]) <= 180.0).all()
    np.testing.assert_allclose(grid.line_sample(lon_lat), positions(grid), atol=a_micropixel)


@pytest.mark.parametrize("grid", [DEGREES, UTM_1])
def test_a_grid_across_the_antimeridian_has_no_seam(grid: MapGrid) -> None:
    lon_lat = grid.lon_lat(positions(grid))
    assert lon_lat[:, 0].max() > 179.0
    assert lon_lat[:, 0].min() < -179.0
    again = grid.line_sample(lon_lat + [360.0, 0.0])
    np.testing.assert_allclose(again, positions(grid), atol=a_micropixel)


@pytest.mark.parametrize("grid", [NORTH_UP, ROTATED, DEGREES, UTM_1])
def test_the_derivative_agrees_with_differences_in_metres(grid: MapGrid) -> None:
    place = np.append(grid.lon_lat(np.array([[100.0, 200.0]]))[0], 0.0)
    near = np.column_stack([grid.lon_lat(np.array([[100.5, 200.0], [100.0, 200.5]])), np.zeros(2)])
    moved_m = east_north_up(near, place)[:, :2]
    derivative = grid.derivative(place[None, :])[0]
    np.testing.assert_allclose(moved_m @ derivative.T, 0.5 * np.eye(2), atol=1e-4)


def test_positions_outside_the_map_are_nan() -> None:
    actual = NORTH_UP.line_sample(np.array([[15.0, 52.0], [np.nan, 52.0], [15.0, 91.0]]))
    assert np.isfinite(actual[0]).all()
    assert np.isnan(actual[1:]).all()


@pytest.mark.parametrize(
    ("lon", "lat", "zone"),
    [
        (5.4, 43.6, "EPSG:32631"),
        (-180.0, -1.0, "EPSG:32701"),
        (179.9, 1.0, "EPSG:32660"),
        (180.0, 0.5, "EPSG:32601"),
        (5.999, -0.5, "EPSG:32731"),
        (6.0, 0.0, "EPSG:32632"),
    ],
)
def test_every_position_has_its_utm_zone(lon: float, lat: float, zone: str) -> None:
    assert utm_of(lon, lat) == zone


def test_a_grid_around_the_whole_earth_has_every_place_once() -> None:
    earth = MapGrid(
        "EPSG:4326", np.array([-179.5, 89.5]), np.array([[0.0, 1.0], [-1.0, 0.0]]), (180, 360)
    )
    edges = np.array([[90.0, -0.4], [90.0, 0.4], [90.0, 359.4], [90.0, 180.0]])
    np.testing.assert_allclose(earth.line_sample(earth.lon_lat(edges)), edges, atol=a_micropixel)


@pytest.mark.parametrize("grid", [NORTH_UP, ROTATED, DEGREES, UTM_1])
def test_the_ground_sampling_is_the_side_of_a_square_as_large_as_the_central_pixel(
    grid: MapGrid,
) -> None:
    centre = (np.array(grid.shape) - 1.0) / 2.0
    corners = centre + np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, 0.5], [0.5, -0.5]])
    lon_lat_h = np.column_stack([grid.lon_lat(corners), np.zeros(4)])
    x, y = east_north_up(lon_lat_h, lon_lat_h[0])[:, :2].T
    area_m2 = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert grid.gsd_m == pytest.approx(np.sqrt(area_m2), rel=1e-4)


def test_pixels_reach_half_a_step_around_their_middles() -> None:
    last = np.array(NORTH_UP.shape) - 1.0
    inside = np.array([[-0.5, -0.5], last + 0.5, [0.0, last[1] + 0.4]])
    outside = np.array([[-0.6, 0.0], [0.0, -0.6], [last[0] + 0.6, 0.0], [0.0, last[1] + 0.6]])
    assert NORTH_UP.contains(inside).all()
    assert not NORTH_UP.contains(outside).any()


def test_a_map_with_heights_is_that_without_them() -> None:
    with_heights = replace(NORTH_UP, crs="EPSG:32633+5773")
    lon_lat = NORTH_UP.lon_lat(positions(NORTH_UP))
    np.testing.assert_allclose(with_heights.lon_lat(positions(NORTH_UP)), lon_lat, atol=1e-12)
    np.testing.assert_allclose(with_heights.line_sample(lon_lat), NORTH_UP.line_sample(lon_lat))
    assert not with_heights.is_geographic


@pytest.mark.parametrize(
    ("crs", "north_first"),
    [("EPSG:4326", True), ("OGC:CRS84", False), ("EPSG:32633", False), ("EPSG:2180", True)],
)
def test_the_first_axis_is_that_of_the_reference_system(crs: str, north_first: bool) -> None:
    assert replace(NORTH_UP, crs=crs).first_axis_is_north == north_first


@pytest.mark.parametrize("code", ["EPSG:32633", "ESRI:54009", "EPSG:4326", "OGC:CRS84"])
def test_codes_of_maps_on_the_earth_are_accepted(code: str) -> None:
    check_map_code(code)


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("EPSG:999999", "no known reference system"),
        ("+proj=utm +zone=33", "no known reference system"),
        ("EPSG:32633+5773", "no known reference system"),
        ("/etc/passwd", "no known reference system"),
        ("http://example.org/crs", "no known reference system"),
        ("PROJ:32633", "no known reference system"),
        ("EPSG:5773", "has no map coordinates"),
        ("EPSG:4978", "has no map coordinates"),
        ("ESRI:104903", "cannot be reached from WGS 84"),
    ],
)
def test_codes_of_something_else_are_refused(code: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        check_map_code(code)


@pytest.mark.parametrize(
    ("crs", "lon", "lat"),
    [
        ("EPSG:32618", -73.95, 40.69),
        ("EPSG:2263", -73.95, 40.69),  # US survey feet
        ("EPSG:6539", -73.95, 40.69),  # US survey feet, NAD83(2011)
        ("EPSG:2223", -110.5, 33.0),  # international feet
        ("EPSG:2314", -61.3, 10.4),  # Clarke's feet
        ("EPSG:24600", 47.9, 29.3),  # metres
        ("EPSG:3857", -73.95, 40.69),
        ("EPSG:3857", 20.0, -65.0),
        ("EPSG:3857", 20.0, 1.0),
        ("EPSG:3857", 180.0, -16.0),
        ("EPSG:3857", 180.0002, -16.0),
        ("EPSG:3395", 20.0, 60.0),
        ("EPSG:3031", 60.0, -80.0),
        ("EPSG:3035", -9.0, 38.7),
        ("EPSG:4326", 5.2, 44.2),
        ("EPSG:4326", 5.2, -70.0),
        ("EPSG:4267", -90.0, 40.0),
        ("EPSG:4807", 5.2, 44.2),  # grads from Paris
        ("EPSG:27572", 5.2, 44.2),  # metres, grads from Paris below
    ],
)
def test_a_metre_of_the_ground_is_a_metre_in_every_unit_and_scale(
    crs: str, lon: float, lat: float
) -> None:
    """Ten metres by the geodesic, against the same in units of the map."""
    per_metre = map_units_per_metre(crs, np.array([lon, lat]))
    lon = min(lon, 179.9)
    place = np.array([lon, lat])
    east, north, _ = zip(
        *(Geod(ellps="WGS84").fwd(lon, lat, way, 10.0) for way in (90.0, 0.0)), strict=True
    )
    x, y = xy_of_lon_lat(crs, np.array([place, *zip(east, north, strict=True)])).T
    moved = np.array([[x[1] - x[0], x[2] - x[0]], [y[1] - y[0], y[2] - y[0]]]) / 10.0
    if crs in ("EPSG:4326", "EPSG:4267", "EPSG:4807"):
        np.testing.assert_allclose(per_metre, np.diag(moved), rtol=1e-3)
    else:
        assert per_metre[0] == per_metre[1]
        assert per_metre[0] == pytest.approx(np.sqrt(abs(np.linalg.det(moved))), rel=0.01)


def test_steps_of_maps_that_are_nearly_true_are_round_numbers_of_their_unit() -> None:
    us_survey_foot_m = 1200.0 / 3937.0
    place = np.array([-73.95, 40.69])
    assert map_units_per_metre("EPSG:32618", place).tolist() == [1.0, 1.0]
    np.testing.assert_allclose(
        map_units_per_metre("EPSG:2263", place), 1.0 / us_survey_foot_m, rtol=1e-9
    )
