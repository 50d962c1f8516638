"""Density of control points in cells of a tenth of a degree."""

import numpy as np
import pyproj
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from amers.services.formats.block.document import rectangle
from amers.services.quality.density import box_area_km2, density_cells, share_reaching

a_square_metre_km2 = 1e-6
a_thousandth = 1e-3


@pytest.mark.parametrize("lat", [-89.9, -45.0, -0.05, 0.0, 43.2, 80.0])
def test_the_area_of_a_cell_agrees_with_geodesics_along_its_sides(lat):
    corner, opposite = np.array([[5.0, lat]]), np.array([[5.1, lat + 0.1]])
    step = np.linspace(0.0, 0.1, 201)
    lon = np.concatenate([5.0 + step, np.full(201, 5.1), 5.1 - step, np.full(201, 5.0)])
    lats = np.concatenate([np.full(201, lat), lat + step, np.full(201, lat + 0.1), lat + 0.1 - step])
    area, _ = pyproj.Geod(ellps="WGS84").polygon_area_perimeter(lon, lats)
    assert_allclose(box_area_km2(corner, opposite), [area * 1e-6], atol=10 * a_square_metre_km2)


def test_all_cells_together_make_the_earth():
    area = box_area_km2(np.array([[-180.0, -90.0]]), np.array([[180.0, 90.0]]))
    assert_allclose(area, 510_065_621.724, atol=1e-3)  # Moritz (2000), GRS 80 and WGS 84 agree to 1e-9


def test_every_point_is_counted_once_in_its_own_cell():
    rng = np.random.default_rng(1)
    lon_lat = rng.uniform([5.0, 43.0], [5.4, 43.3], (5000, 2))
    cells = density_cells(lon_lat, rectangle(5.0, 43.0, 5.4, 43.3))
    assert len(cells.points) == 12
    assert cells.points.sum() == 5000
    west, south = cells.lon_lat[4]
    inside = (lon_lat >= [west, south]).all(axis=1) & (lon_lat < [west + 0.1, south + 0.1]).all(axis=1)
    assert cells.points[4] == inside.sum()


def test_a_cell_half_outside_counts_with_half_its_area():
    whole = density_cells(np.empty((0, 2)), rectangle(5.0, 43.0, 5.1, 43.1)).area_km2
    half = density_cells(np.empty((0, 2)), rectangle(5.0, 43.0, 5.05, 43.1)).area_km2
    triangle = density_cells(
        np.empty((0, 2)), np.array([[5.0, 43.0], [5.1, 43.0], [5.0, 43.1]])
    ).area_km2
    assert_allclose(half, whole / 2.0, rtol=1e-9)
    assert_allclose(triangle, whole / 2.0, rtol=a_thousandth)


def test_the_share_of_cells_that_reach_a_density_is_weighted_by_their_area():
    area_km2 = float(box_area_km2(np.array([[5.0, 43.0]]), np.array([[5.1, 43.1]]))[0])
    enough = int(np.ceil(0.5 * area_km2))
    lon_lat = np.tile([5.05, 43.05], (enough, 1))
    outline = rectangle(5.0, 43.0, 5.15, 43.1)
    cells = density_cells(lon_lat, outline)
    assert_allclose(share_reaching(cells, 0.5), 2.0 / 3.0, rtol=1e-9)
    assert share_reaching(density_cells(lon_lat[1:], outline), 0.5) == 0.0
    assert_allclose(share_reaching(density_cells(lon_lat[1:], outline), 0.25), 2.0 / 3.0, rtol=1e-9)


def test_cells_the_outline_does_not_meet_are_left_out():
    outline = np.array([[5.01, 43.01], [5.99, 43.01], [5.01, 43.99]])
    cells = density_cells(np.empty((0, 2)), outline)
    assert len(cells.points) < 70
    assert (cells.area_km2 > 0.0).all()


def test_an_outline_across_the_antimeridian_counts_points_of_both_sides():
    lon_lat = np.array([[179.95, 10.05], [-179.95, 10.05], [-179.95, 10.06]])
    cells = density_cells(lon_lat, rectangle(179.9, 10.0, 180.1, 10.1))
    assert_array_equal(cells.points, [1, 2])
    west = density_cells(lon_lat, rectangle(-180.1, 10.0, -179.9, 10.1))
    assert_array_equal(west.points, [1, 2])


def test_points_on_the_edge_of_the_outline_belong_to_its_last_cell():
    cells = density_cells(np.array([[5.2, 43.1], [5.0, 43.0]]), rectangle(5.0, 43.0, 5.2, 43.1))
    assert_array_equal(cells.points, [1, 1])


def test_points_beside_the_outline_belong_to_no_cell() -> None:
    """Half a cell, a whole one and a hundredth of one beyond each of its sides."""
    beyond = np.array([0.05, 0.1, 0.001])
    inside = np.full(3, 0.05)
    west_south = np.concatenate([-beyond, inside])
    lon_lat = np.column_stack([5.0 + west_south, 43.0 + west_south[::-1]])
    east_north = np.column_stack([5.2 + np.append(beyond, -inside), 43.1 + np.append(-inside, beyond)])
    cells = density_cells(np.concatenate([lon_lat, east_north]), rectangle(5.0, 43.0, 5.2, 43.1))
    assert_array_equal(cells.points, [0, 0])
