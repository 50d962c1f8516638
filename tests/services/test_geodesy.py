"""Coordinates agree with PROJ over the whole globe and survive round trips; the sun is in its place."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from amers.services.geodesy import (
    box_around,
    continuous,
    east_north_up,
    ecef_from_east_north_up,
    ecef_from_lon_lat_h,
    lon_lat_h_from_east_north_up,
    lon_lat_h_from_ecef,
    longitudes_near,
    metres_per_degree,
    move_metres,
    sun_direction,
    wrapped_degrees,
)
from amers.services.types import Array

a_micrometre = 1e-6
a_micrometre_deg = a_micrometre / 111_000.0
a_tenth_of_a_millimetre = 1e-4
a_millimetre = 1e-3

GEODETIC, GEOCENTRIC = "EPSG:4979", "EPSG:4978"
LONGITUDES = [-180.0, -179.999_999, -123.4, -1e-9, 0.0, 90.0, 179.999_999, 180.0]
LATITUDES = [-90.0, -89.999_999, -45.0, -1e-9, 0.0, 60.0, 89.999_999, 90.0]
HEIGHTS = [-11_000.0, 0.0, 8_848.0, 700e3]

longitudes = st.floats(-180.0, 180.0)
latitudes = st.floats(-89.9, 89.9)
heights = st.floats(-500.0, 9000.0)
metres = st.floats(-50e3, 50e3)


@pytest.fixture(scope="module")
def globe() -> Array:
    """Positions at all latitudes and longitudes, including the poles and the antimeridian."""
    rng = np.random.default_rng(0)
    corners = np.stack(np.meshgrid(LONGITUDES, LATITUDES, HEIGHTS), axis=-1).reshape(-1, 3)
    anywhere = np.column_stack(
        [rng.uniform(-180, 180, 2000), rng.uniform(-90, 90, 2000), rng.uniform(-500, 9000, 2000)]
    )
    return np.concatenate([corners, anywhere])


def test_ecef_agrees_with_proj_over_the_globe(globe: Array) -> None:
    proj = np.column_stack(
        Transformer.from_crs(GEODETIC, GEOCENTRIC, always_xy=True).transform(*globe.T)
    )
    np.testing.assert_allclose(ecef_from_lon_lat_h(globe), proj, rtol=0.0, atol=a_micrometre)


def test_geodetic_positions_agree_with_proj_over_the_globe(globe: Array) -> None:
    ecef = np.column_stack(
        Transformer.from_crs(GEODETIC, GEOCENTRIC, always_xy=True).transform(*globe.T)
    )
    actual = lon_lat_h_from_ecef(ecef)
    np.testing.assert_allclose(actual[:, 1], globe[:, 1], rtol=0.0, atol=a_micrometre_deg)
    np.testing.assert_allclose(actual[:, 2], globe[:, 2], rtol=0.0, atol=a_micrometre)
    turn = (actual[:, 0] - globe[:, 0] + 180.0) % 360.0 - 180.0
    assert np.abs(turn * np.cos(np.radians(globe[:, 1]))).max() < a_micrometre_deg
    assert np.abs(actual[:, 0]).max() <= 180.0


def test_the_poles_have_a_latitude_and_a_height() -> None:
    polar_radius = 6_356_752.314_245
    actual = lon_lat_h_from_ecef(np.array([[0.0, 0.0, polar_radius + 5.0], [0.0, 0.0, -polar_radius]]))
    np.testing.assert_allclose(actual[:, 1:], [[90.0, 5.0], [-90.0, 0.0]], atol=a_micrometre)


@given(longitudes, st.floats(-90.0, 90.0), st.floats(-11e3, 800e3))
def test_geodetic_and_ecef_conversions_are_inverse(lon: float, lat: float, h: float) -> None:
    ecef = ecef_from_lon_lat_h(np.array([[lon, lat, h]]))
    again = ecef_from_lon_lat_h(lon_lat_h_from_ecef(ecef))
    np.testing.assert_allclose(again, ecef, rtol=0.0, atol=a_micrometre)


@given(longitudes, latitudes, heights, metres, metres, st.floats(-5e3, 5e3))
def test_east_north_up_survives_a_round_trip(
    lon: float, lat: float, h: float, east: float, north: float, up: float
) -> None:
    origin, enu = np.array([lon, lat, h]), np.array([[east, north, up]])
    again = east_north_up(lon_lat_h_from_east_north_up(enu, origin), origin)
    np.testing.assert_allclose(again, enu, rtol=0.0, atol=a_micrometre)


@given(longitudes, latitudes)
def test_axes_are_orthonormal_and_right_handed(lon: float, lat: float) -> None:
    axes = ecef_from_east_north_up(np.array([lon, lat, 0.0]))
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(axes[:, 0], axes[:, 1]), axes[:, 2], atol=1e-15)


def test_axes_point_east_north_and_up() -> None:
    origin = np.array([179.999_99, 43.0, 100.0])
    one_m = a_micrometre_deg * 1e6
    moved = np.array(
        [[-179.999_99, 43.0, 100.0], [179.999_99, 43.0 + one_m, 100.0], [179.999_99, 43.0, 101.0]]
    )
    east, north, up = east_north_up(moved, origin)
    east_m = Geod(ellps="WGS84").inv(origin[0], 43.0, moved[0, 0], 43.0)[2]
    assert east[0] == pytest.approx(east_m, abs=a_millimetre)  # across the antimeridian
    assert np.abs(east[1:]).max() < a_millimetre
    assert north[1] == pytest.approx(np.linalg.norm(north), abs=a_millimetre)
    assert up[2] == pytest.approx(1.0, abs=a_micrometre)


@pytest.mark.parametrize("lat", [-70.0, 0.0, 43.6, 85.0])
def test_the_length_of_a_degree_agrees_with_the_geodesic(lat: float) -> None:
    geod, step = Geod(ellps="WGS84"), 1e-4
    east_m, north_m = metres_per_degree(lat, 0.0)
    assert geod.inv(5.0, lat, 5.0 + step, lat)[2] == pytest.approx(east_m * step, abs=a_micrometre)
    along = geod.inv(5.0, lat - step / 2.0, 5.0, lat + step / 2.0)[2]
    assert along == pytest.approx(north_m * step, abs=a_micrometre)


def test_the_length_of_a_degree_grows_with_the_height() -> None:
    above = ecef_from_lon_lat_h(np.array([[5.0, 43.0, 3000.0], [5.000_1, 43.0, 3000.0]]))
    east_m, _ = metres_per_degree(43.0, 3000.0)
    assert np.linalg.norm(above[1] - above[0]) == pytest.approx(east_m * 1e-4, abs=a_micrometre)


@pytest.mark.parametrize("height_m", [-100.0, 0.0, 8000.0])
def test_a_move_in_metres_is_that_of_the_frame_east_north_and_up(height_m: float) -> None:
    at = np.array([[179.999, -43.0, height_m], [5.4, 60.0, height_m], [-70.0, 0.0, height_m]])
    step_m = np.array([[3.0, -4.0, 2.0], [-5.0, 1.0, -3.0], [2.0, 6.0, 0.0]])
    expected = [lon_lat_h_from_east_north_up(step_m[k : k + 1], at[k])[0] for k in range(3)]
    apart = [
        east_north_up(move_metres(at, step_m)[k : k + 1], np.array(expected[k]))[0] for k in range(3)
    ]
    assert np.abs(apart).max() < a_tenth_of_a_millimetre


@pytest.mark.parametrize("west", [12.0, 179.9, -180.05])
def test_the_box_around_points_holds_them_and_runs_counter_clockwise(west: float) -> None:
    rng = np.random.default_rng(3)
    lon_lat = np.column_stack([west + rng.uniform(0.0, 0.3, 50), rng.uniform(-0.1, 0.1, 50)])
    turned = np.column_stack([wrapped_degrees(lon_lat[:, 0]), lon_lat[:, 1]])
    box = box_around(turned)
    x, y = box.T
    area = 0.5 * (np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    outermost = np.ptp(lon_lat, axis=0)
    assert area == pytest.approx(outermost.prod(), rel=1e-3)
    inside = longitudes_near(turned[:, 0], float(x.mean()))
    beyond_m = 111_000.0 * np.array(
        [inside.min() - x.min(), x.max() - inside.max(), turned[:, 1].min() - y.min()]
    )
    assert (beyond_m > 0.05).all()
    assert (beyond_m < 0.2).all()


def test_positions_are_continued_from_the_first_of_them() -> None:
    lon_lat = np.array([[179.0, 1.0], [-179.0, 2.0], [10.0, 3.0], [-1.5, 4.0]])
    np.testing.assert_allclose(continuous(lon_lat)[:, 0], [179.0, 181.0, 10.0, 358.5])
    np.testing.assert_allclose(continuous(lon_lat[::-1])[:, 0], [-1.5, 10.0, -179.0, -181.0])
    np.testing.assert_allclose(continuous(lon_lat)[:, 1], lon_lat[:, 1])


def test_differences_of_longitudes_go_the_short_way_round() -> None:
    difference = wrapped_degrees(np.array([0.0, 359.0, -359.0, 181.0, -181.0, 540.5]))
    np.testing.assert_allclose(difference, [0.0, -1.0, 1.0, -179.0, 179.0, -179.5])


@pytest.mark.parametrize(
    ("month", "day", "hour", "minute", "declination_deg"),
    [(3, 20, 3, 6, 0.0), (6, 20, 20, 51, 23.44), (9, 22, 12, 44, 0.0), (12, 21, 9, 21, -23.44)],
)
def test_the_sun_is_as_high_at_a_pole_as_at_an_equinox_or_a_solstice(
    month: int, day: int, hour: int, minute: int, declination_deg: float
) -> None:
    when = datetime(2024, month, day, hour, minute, tzinfo=UTC)
    for lon in (-100.0, 0.0, 77.0):
        heights_deg = [sun_direction(np.array([lon, lat]), when)[0] for lat in (90.0, -90.0)]
        assert heights_deg == pytest.approx([declination_deg, -declination_deg], abs=0.02)


@pytest.mark.parametrize(
    ("month", "day", "late_min"), [(2, 11, 14.2), (5, 14, -3.7), (7, 26, 6.5), (11, 3, -16.4)]
)
def test_the_sun_is_in_the_south_at_noon_by_the_equation_of_time_and_east_before(
    month: int, day: int, late_min: float
) -> None:
    """A degree of longitude is four minutes; in the south of the Earth, noon is in the north."""
    when = datetime(2024, month, day, 13, tzinfo=UTC)
    lon = (late_min - 60.0) / 4.0
    for lat, azimuth_deg in ((50.0, 180.0), (-50.0, 0.0)):
        noon, before, after = (
            sun_direction(np.array([lon + step, lat]), when) for step in (0.0, -20.0, 20.0)
        )
        a_few_seconds_deg = 0.15
        assert wrapped_degrees(noon[1] - np.array(azimuth_deg)) == pytest.approx(
            0.0, abs=a_few_seconds_deg
        )
        assert noon[0] > max(before[0], after[0])
        assert before[1] < 180.0 < after[1]
