"""Figures of a block cell by cell: what was put in is found, and a cell that misses is named."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from amers.services.formats.block.document import rectangle
from amers.services.quality.block_cells import block_cells, images_per_point, view_ages_years
from amers.services.quality.density import cell_of_points, covered_area_km2, density_cells
from amers.services.types import Acquisition, Array, ControlPoints
from tests.factories import control_points

NOW = datetime(2026, 1, 1, tzinfo=UTC)
half_a_percent = 5e-3
a_day_years = 1.0 / 365.25


def points_at(lon_lat: Array) -> ControlPoints:
    """Points with six chips of three images, as `control_points` makes them, at some places."""
    points = control_points(len(lon_lat), np.random.default_rng(1))
    return replace(points, lon_lat_h=np.column_stack([lon_lat, np.zeros(len(lon_lat))]))


def test_the_one_cell_that_misses_its_density_is_named_with_what_it_lacks():
    rng = np.random.default_rng(2)
    outline = rectangle(5.0, 43.0, 5.3, 43.2)
    corners = [(5.0, 43.0), (5.0, 43.1), (5.1, 43.0), (5.1, 43.1), (5.2, 43.0), (5.2, 43.1)]
    counts = [60, 60, 60, 25, 60, 60]
    lon_lat = np.concatenate(
        [corner + rng.uniform(0.0, 0.1, (n, 2)) for corner, n in zip(corners, counts, strict=True)]
    )
    cells = block_cells(points_at(lon_lat), outline, 3, NOW)
    missing = cells.missing_points(0.5)
    poor = np.flatnonzero(missing)
    assert_allclose(cells.density.lon_lat[poor], [[5.1, 43.1]])
    assert missing[poor[0]] == int(0.5 * cells.density.area_km2[poor[0]]) - 25
    assert (cells.missing_points(0.2) == 0).all()
    assert cells.short_of_views.sum() == 0
    assert (
        block_cells(points_at(lon_lat), outline, 4, NOW).short_of_views == cells.density.points
    ).all()
    assert (cells.images == 3.0).all()


def test_a_sliver_along_the_outline_that_holds_less_than_a_point_misses_nothing():
    cells = block_cells(points_at(np.empty((0, 2))), rectangle(5.0, 43.0, 5.001, 43.1), 1, NOW)
    assert cells.density.area_km2[0] < 1.0
    assert_array_equal(cells.missing_points(0.5), [0])


def test_excluded_ground_counts_neither_as_area_nor_with_its_points():
    outline = rectangle(5.0, 43.0, 5.1, 43.1)
    lon_lat = np.array([[5.01, 43.05], [5.02, 43.05], [5.09, 43.05]])

    def west_of_the_coast(lon_lat: Array) -> np.ndarray:
        return lon_lat[:, 0] < 5.03

    whole = block_cells(points_at(lon_lat), outline, 1, NOW)
    cells = block_cells(points_at(lon_lat), outline, 1, NOW, west_of_the_coast)
    assert_array_equal(cells.density.points, [1])
    assert_allclose(cells.density.area_km2, 0.7 * whole.density.area_km2, rtol=2 * half_a_percent)
    assert_allclose(cells.density.area_km2 + cells.excluded_km2, whole.density.area_km2)

    nothing = block_cells(points_at(lon_lat), outline, 1, NOW, lambda place: place[:, 0] < 9.0)
    assert len(nothing.density.points) == 0


def test_the_covered_part_of_a_triangle_is_measured_inside_it():
    outline = np.array([[5.0, 43.0], [5.1, 43.0], [5.0, 43.1]])
    cells = density_cells(np.empty((0, 2)), outline)
    covered = covered_area_km2(cells, outline, lambda place: place[:, 0] < 5.05)
    assert_allclose(covered / cells.area_km2, [0.75], atol=half_a_percent)


@pytest.mark.parametrize("west", [179.95, -180.05])
def test_masks_are_asked_at_longitudes_from_minus_180_to_180_also_across_the_antimeridian(west):
    outline = rectangle(west, 10.0, west + 0.1, 10.1)
    cells = density_cells(np.empty((0, 2)), outline)
    covered = covered_area_km2(cells, outline, lambda place: place[:, 0] > 0.0)
    assert_allclose(covered.sum() / cells.area_km2.sum(), 0.5, atol=half_a_percent)


def test_points_outside_all_cells_have_none():
    cells = density_cells(np.empty((0, 2)), rectangle(5.0, 43.0, 5.2, 43.1))
    places = np.array([[5.15, 43.05], [4.99, 43.05], [5.05, 43.11], [5.2, 43.1], [-174.9, 43.05]])
    assert_array_equal(cell_of_points(cells, places), [1, -1, -1, 1, -1])


def test_the_age_of_a_point_is_that_of_its_newest_dated_view():
    points = control_points(4, np.random.default_rng(3))
    newest = max(image.acquired_at for image in points.views.images if image.acquired_at is not None)
    expected = (NOW - newest).days / 365.25
    assert_allclose(view_ages_years(points, NOW), np.full(4, expected), atol=a_day_years)
    undated = tuple(replace(image, acquired_at=None) for image in points.views.images)
    without = replace(points, views=replace(points.views, images=undated))
    assert np.isnan(view_ages_years(without, NOW)).all()
    assert_array_equal(images_per_point(points), [3, 3, 3, 3])


def test_the_age_of_a_cell_is_the_mean_of_both_middle_ages_of_an_even_number() -> None:
    """Four points in one cell, each in an image of its own, and three in the next."""
    lon_lat = np.array([[5.02, 43.05]] * 4 + [[5.15, 43.05]] * 3)
    points = points_at(lon_lat)
    years = np.array([1.0, 8.0, 4.0, 5.0, 2.0, 9.0, 3.0])
    taken = tuple(
        Acquisition(f"IMG_{k}", acquired_at=NOW - timedelta(days=365.25 * age))
        for k, age in enumerate(years.tolist())
    )
    count = np.diff(points.views.start)
    views = replace(points.views, image=np.repeat(np.arange(7), count), images=taken)
    cells = block_cells(replace(points, views=views), rectangle(5.0, 43.0, 5.2, 43.1), 2, NOW)
    assert_allclose(cells.age_years, [4.5, 3.0])
    assert_array_equal(cells.images, [1.0, 1.0])
    assert_array_equal(cells.short_of_views, [4, 3])
