"""Footprints as plain polygons: across the antimeridian, around the poles, with holes."""

import numpy as np
import pytest
import shapely

from amers.services.imagery.footprints import footprint_on_ground


def has(shape, lon, lat):
    """Whether a footprint includes a place, whatever turn its longitudes are in."""
    return any(shapely.contains_xy(shape, lon + turn, lat) for turn in (-360.0, 0.0, 360.0))


def ring(lat, *, start=0.0, corners=4):
    lon = (start + np.arange(corners) * 360.0 / corners + 180.0) % 360.0 - 180.0
    return shapely.polygons(np.column_stack([lon, np.full(corners, lat)]))


def test_a_footprint_away_from_seam_and_poles_stays_as_it_is():
    square = shapely.box(10.0, 20.0, 10.5, 20.4)
    assert footprint_on_ground(square).equals(square)


def test_a_ring_that_jumps_crosses_the_antimeridian():
    shape = footprint_on_ground(shapely.polygons([(179.6, -1), (-179.6, -1), (-179.6, 1), (179.6, 1)]))
    assert shape.area == pytest.approx(0.8 * 2.0)
    assert has(shape, 179.9, 0.0)
    assert has(shape, -179.9, 0.0)
    assert not has(shape, 0.0, 0.0)


def test_a_footprint_cut_at_the_antimeridian_has_both_parts():
    cut = shapely.MultiPolygon([shapely.box(179.5, 10, 180, 11), shapely.box(-180, 10, -179.5, 11)])
    shape = footprint_on_ground(cut)
    assert has(shape, 179.75, 10.5)
    assert has(shape, -179.75, 10.5)
    assert shape.area == pytest.approx(1.0)


def test_a_hole_stays_in_a_footprint_across_the_antimeridian():
    outer = [(178, -2), (-178, -2), (-178, 2), (178, 2)]
    hole = [(-179.5, -0.5), (-179.0, -0.5), (-179.0, 0.5), (-179.5, 0.5)]
    shape = footprint_on_ground(shapely.polygons(outer, [hole]))
    assert shape.is_valid
    assert not has(shape, -179.25, 0.0)
    assert has(shape, 179.0, 0.0)


@pytest.mark.parametrize("pole", [90.0, -90.0])
@pytest.mark.parametrize("start", [0.0, 45.0, 90.0, 179.0])
def test_a_ring_around_a_pole_includes_it(pole, start):
    shape = footprint_on_ground(ring(0.99 * pole, start=start))
    for lon in range(-175, 180, 10):
        assert has(shape, float(lon), pole * 0.9999)
    assert shape.is_valid


def test_the_edges_of_a_footprint_near_a_pole_are_straight_across_it():
    """Between corners 120 degrees apart, the edge passes the pole at half their distance."""
    shape = footprint_on_ground(shapely.polygons([(-60, 89), (60, 89), (60, 88.0), (-60, 88.0)]))
    assert has(shape, 0.0, 89.4)
    assert not has(shape, 0.0, 89.6)


def test_a_footprint_that_names_the_pole_as_a_corner_is_taken_as_written():
    shape = footprint_on_ground(shapely.polygons([(-180, 85), (180, 85), (180, 90), (-180, 90)]))
    assert has(shape, 123.0, 86.0)
    assert shape.area == pytest.approx(360.0 * 5.0)


@pytest.mark.parametrize("pole", [-1.0, 1.0])
def test_a_ring_around_a_pole_is_on_its_own_side_of_the_earth(pole: float) -> None:
    """Sixteen corners at 80 degrees: a cap of ten degrees, and nothing beyond it."""
    shape = footprint_on_ground(ring(pole * 80.0, corners=16))
    for lon in (-170.0, -40.0, 3.0, 95.0):
        assert has(shape, lon, pole * 83.0)
        assert not has(shape, lon, pole * 79.0)
        assert not has(shape, lon, 0.0)
        assert not has(shape, lon, -pole * 83.0)
    beside = footprint_on_ground(shapely.box(10.0, pole * 78.0, 20.0, pole * 79.0))
    south, north = beside.bounds[1], beside.bounds[3]
    assert 77.8 < min(abs(south), abs(north)) < max(abs(south), abs(north)) < 79.3
    assert np.sign(south) == np.sign(north) == pole
