"""The grid of nearly equal cells, and the cells in footprints."""

import numpy as np
import pytest
import shapely

from amers.services.imagery.footprints import footprint_on_ground
from amers.services.production.ground_cells import ground_grid, seen_cells

EARTH_KM2 = 510_065_621.7
"""Area of the WGS 84 ellipsoid."""


def shapes(*values):
    out = np.empty(len(values), dtype=object)
    out[:] = values
    return out


def cells_of(shape, grid, mask=None):
    seen = seen_cells(shapes(shape), shapes(mask), grid)
    return set(seen.cell.tolist()), set(seen.cell[seen.clear].tolist())


def test_the_cells_cover_the_earth_and_are_nearly_equal():
    grid = ground_grid(100_000.0)
    area = grid.area_km2(np.arange(grid.first[-1]))
    assert area.sum() == pytest.approx(EARTH_KM2, rel=1e-6)
    low, high = grid.boxes(np.arange(grid.first[-1]))
    away_from_poles = np.abs(low + high)[:, 1] / 2.0 < 85.0
    assert area[away_from_poles] == pytest.approx(10_000.0, rel=0.1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.long
def test_the_cells_of_a_footprint_are_those_whose_centre_it_contains(seed):
    rng = np.random.default_rng(seed)
    grid = ground_grid(20_000.0)
    middle = np.array([rng.uniform(-175, 175), rng.uniform(-70, 70)])
    corners = middle + rng.normal(0.0, 2.0, (12, 2))
    hull = shapely.convex_hull(shapely.multipoints(corners))
    hole = shapely.affinity.scale(hull, 0.3, 0.3)
    shape = shapely.difference(hull, hole)
    every = np.arange(grid.first[-1])
    expected = every[shapely.contains_xy(shape, *grid.centres(every).T)]
    assert cells_of(shape, grid)[0] == set(expected.tolist())


def test_the_centre_of_a_cell_lies_in_it_on_every_turn():
    grid = ground_grid(50_000.0)
    every = np.arange(grid.first[-1])
    for turn in (-360.0, 0.0, 360.0):
        assert (grid.cell_of(grid.centres(every) + [turn, 0.0]) == every).all()


def test_footprints_side_by_side_share_no_cell_and_leave_none_out():
    grid = ground_grid(10_000.0)
    both, _ = cells_of(shapely.box(0, 0, 4, 3), grid)
    middle = 180.0 * 360.0 / (np.diff(grid.first).max() * 180.0)
    west, _ = cells_of(shapely.box(0, 0, middle * 1.5, 3), grid)
    east, _ = cells_of(shapely.box(middle * 1.5, 0, 4, 3), grid)
    assert west | east == both
    assert not west & east


def test_the_antimeridian_is_no_seam():
    grid = ground_grid(10_000.0)
    crossing = footprint_on_ground(shapely.polygons([(179, 5), (-179, 5), (-179, 7), (179, 7)]))
    cut = shapely.MultiPolygon([shapely.box(179, 5, 180, 7), shapely.box(-180, 5, -179, 7)])
    there, _ = cells_of(crossing, grid)
    assert there == cells_of(footprint_on_ground(cut), grid)[0]
    area = grid.area_km2(np.array(sorted(there))).sum()
    assert area == pytest.approx(2 * 111.3 * np.cos(np.radians(6)) * 2 * 110.6, rel=0.02)


def test_a_footprint_over_the_pole_has_all_cells_there():
    grid = ground_grid(10_000.0)
    lon = np.array([10.0, 100.0, -170.0, -80.0])
    shape = footprint_on_ground(shapely.polygons(np.column_stack([lon, np.full(4, 89.0)])))
    there, _ = cells_of(shape, grid)
    area = grid.area_km2(np.array(sorted(there))).sum()
    assert area == pytest.approx(2.0 * 111.7**2, rel=0.02)
    assert set(range(grid.first[-2], grid.first[-1])) <= there


def test_masks_that_overlap_hide_the_ground_once():
    grid = ground_grid(5_000.0)
    footprint = shapely.box(0, 0, 1, 1)
    mask = shapely.MultiPolygon([shapely.box(0.1, 0.1, 0.6, 0.6), shapely.box(0.4, 0.4, 1.5, 1.5)])
    seen, clear = cells_of(footprint, grid, mask)
    hidden = np.array(sorted(seen - clear))
    inside = shapely.contains_xy(shapely.union_all(shapely.get_parts(mask)), *grid.centres(hidden).T)
    assert inside.all()
    left = np.array(sorted(clear))
    assert not shapely.contains_xy(mask.geoms[0], *grid.centres(left).T).any()
    assert not shapely.contains_xy(mask.geoms[1], *grid.centres(left).T).any()


def test_an_empty_mask_hides_nothing():
    seen, clear = cells_of(shapely.box(0, 0, 1, 1), ground_grid(5_000.0), shapely.MultiPolygon())
    assert seen == clear
    assert len(seen) == pytest.approx(494, abs=25)


def test_each_of_many_footprints_has_its_own_cells_and_its_own_mask() -> None:
    """Together they have more cells than there is room for at first."""
    grid, rng = ground_grid(4_000.0), np.random.default_rng(1)
    corner, size = rng.uniform(-60.0, 60.0, (40, 2)), rng.uniform(0.5, 9.0, (40, 2))
    footprints = [
        shapely.MultiPolygon(
            [shapely.box(*low, *(low + side)), shapely.box(*(low + 9.5), *(low + 10.0))]
        )
        for low, side in zip(corner, size, strict=True)
    ]
    masks = [
        None if number % 3 == 0 else shapely.box(*low, *(low + side * [0.5, number / 40.0]))
        for number, (low, side) in enumerate(zip(corner, size, strict=True))
    ]
    seen = seen_cells(shapes(*footprints), shapes(*masks), grid)
    assert len(seen.cell) > 1.5 * 65_536
    assert seen.start[0] == 0
    assert seen.start[-1] == len(seen.cell) == len(seen.clear)
    for number, (footprint, mask) in enumerate(zip(footprints, masks, strict=True)):
        own = slice(seen.start[number], seen.start[number + 1])
        every, clear = cells_of(footprint, grid, mask)
        np.testing.assert_array_equal(seen.cell[own], sorted(every))
        assert set(seen.cell[own][seen.clear[own]].tolist()) == clear
        assert (len(clear) < len(every)) == (mask is not None and number > 0)
