"""Selections of simulated catalogues, checked against their footprints and masks point by point."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from amers.services.errors import CoverageError
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.production.image_selection import (
    SelectionOptions,
    default_cell_m,
    duplicates,
    image_steps,
    select_images,
    view_classes,
    with_cloud_from_masks,
)
from benchmarks._catalogue import simulate_catalogue

AREA = shapely.box(13.5, -1.5, 16.5, 1.5)
DAY = np.timedelta64(1, "D")


@pytest.fixture(scope="module")
def catalogue():
    return simulate_catalogue(2500, 500.0, np.random.default_rng(5))


@pytest.fixture(scope="module")
def selection(catalogue):
    return select_images(catalogue, SelectionOptions(cell_m=8000.0), AREA)


def stack(count, **changes):
    """Images of the same square, ten days apart, clear and without masks."""
    masks = np.empty(count, dtype=object)
    values = {
        "id": np.array([f"i{k}" for k in range(count)], dtype=object),
        "footprint": np.array([shapely.box(0, 0, 1, 1)] * count, dtype=object),
        "mask": masks,
        "acquired": np.datetime64("2024-01-01", "ms") + 10 * DAY * np.arange(count),
        "cloud_percent": np.zeros(count),
        "snow_percent": np.full(count, np.nan),
        "incidence_deg": np.full(count, np.nan),
        "azimuth_deg": np.full(count, np.nan),
        "sun_elevation_deg": np.full(count, np.nan),
        "sun_azimuth_deg": np.full(count, np.nan),
        "platform": np.array(["p"] * count, dtype=object),
        "orbit": np.arange(count),
    }
    return ImageCatalogue(**{**values, **changes})


def ids(catalogue, selection):
    return [str(name) for name in catalogue.id[selection.image]]


def clear_views(catalogue, rows, places):
    """Clear views (n,) of places by some images, with shapely alone."""
    views = np.zeros(len(places), dtype=int)
    for row in rows:
        sees = shapely.contains_xy(catalogue.footprint[row], *places.T)
        for cloud in shapely.get_parts(catalogue.mask[row]) if catalogue.mask[row] else ():
            sees &= ~shapely.contains_xy(cloud, *places.T)
        views += sees
    return views


@pytest.mark.long
def test_every_place_has_the_views_that_the_catalogue_allows(catalogue, selection):
    """Every cell, counted again from footprints and masks, with the cloud limit of the cell."""
    cells, options = selection.cells, selection.options
    places = cells.grid.centres(cells.cell)
    step = image_steps(with_cloud_from_masks(catalogue), options)
    for limit in range(len(options.cloud_limits_percent)):
        here = cells.step == limit
        allowed = np.flatnonzero((step >= 0) & (step <= limit))
        available = clear_views(catalogue, allowed, places[here])
        chosen = clear_views(catalogue, np.intersect1d(allowed, selection.image), places[here])
        assert (available == cells.available[here]).all()
        assert (chosen == cells.views[here]).all()
        assert (chosen >= np.minimum(available, 6)).all()
        if limit > 0:
            below = np.flatnonzero((step >= 0) & (step < limit))
            assert (clear_views(catalogue, below, places[here]) < 6).all()
    assert len(np.unique(cells.step)) > 2


@pytest.mark.long
def test_cells_stay_short_exactly_where_all_usable_images_are_too_few(catalogue, selection):
    places = selection.cells.grid.centres(selection.cells.cell)
    usable = np.flatnonzero(image_steps(with_cloud_from_masks(catalogue), selection.options) >= 0)
    shortage = np.maximum(0, 6 - clear_views(catalogue, usable, places))
    assert (selection.missing == shortage).all()
    assert 0 < (shortage > 0).sum() < len(shortage)


def test_the_selection_is_near_the_bound_and_no_image_can_be_left_out(catalogue, selection):
    assert 0.0 <= selection.above_bound < 0.15
    cells = selection.cells
    places = cells.grid.centres(cells.cell)
    need = np.minimum(cells.available, 6)
    step = dict(zip(selection.image.tolist(), selection.step.tolist(), strict=True))
    for row in selection.image:
        sees = clear_views(catalogue, [row], places).astype(bool) & (cells.step >= step[row])
        assert (cells.views[sees] <= need[sees]).any()
    # So that all lie in the area, and cloudy ones only where the limit was relaxed.
    assert (selection.step > 0).any()


def test_the_same_catalogue_gives_the_same_selection(catalogue, selection):
    again = select_images(catalogue, selection.options, AREA)
    assert (again.image == selection.image).all()
    assert again.bound.images == selection.bound.images


def test_variety_gives_more_seasons_and_directions_for_few_more_images(catalogue, selection):
    blind = select_images(catalogue, replace(selection.options, variety=0.0), AREA)
    whole = selection.missing == 0
    assert selection.cells.seasons[whole].mean() > blind.cells.seasons[whole].mean()
    assert selection.cells.directions[whole].mean() > blind.cells.directions[whole].mean()
    assert len(selection.image) <= 1.05 * len(blind.image)


def test_of_images_that_show_the_same_the_recent_ones_are_chosen():
    images = stack(10, acquired=np.datetime64("2024-01-15", "ms") - 365 * DAY * np.arange(10))
    assert ids(images, select_images(images)) == ["i0", "i1", "i2", "i3", "i4", "i5"]


def test_seasons_come_before_a_few_months_of_age():
    months = np.array(["2024-07", "2024-08", "2024-07", "2023-10", "2024-01", "2024-04"])
    days = np.arange(6) * DAY
    images = stack(6, acquired=months.astype("datetime64[ms]") + days)
    chosen = select_images(images, SelectionOptions(min_views=4))
    assert chosen.cells.seasons.tolist() == [4] * len(chosen.cells.cell)


def test_directions_are_from_where_the_sensor_looks():
    images = stack(
        6,
        incidence_deg=np.array([5.0, 25.0, 25.0, 25.0, 25.0, np.nan]),
        azimuth_deg=np.array([np.nan, 350.0, 90.0, 180.0, 269.0, 12.0]),
    )
    assert view_classes(images)[:, 1].tolist() == [1, 2, 4, 8, 16, 0]


def test_seasons_are_quarters_from_december_on():
    months = np.array([f"2023-{month:02d}-15" for month in range(1, 13)], dtype="datetime64[ms]")
    season = view_classes(stack(12, acquired=months))[:, 0]
    assert season.tolist() == [1, 1, 2, 2, 2, 4, 4, 4, 8, 8, 8, 1]


def test_snow_is_refused_and_unknown_snow_taken_and_counted():
    images = stack(9, snow_percent=np.array([40.0, 2.0, 0.5, 0.0, *[np.nan] * 5]))
    selection = select_images(images)
    assert not {"i0", "i1"} & set(ids(images, selection))
    assert (selection.use.snow, selection.use.snow_unknown, selection.use.usable) == (2, 5, 7)


def test_unknown_cloud_cover_is_not_zero():
    images = stack(8, cloud_percent=np.array([np.nan, np.nan, *[5.0] * 6]))
    selection = select_images(images)
    assert ids(images, selection) == [f"i{k}" for k in range(2, 8)]
    assert selection.use.cloud_unknown == 2


def test_unknown_cloud_cover_is_measured_on_the_mask():
    masks = np.empty(2, dtype=object)
    masks[:] = [
        shapely.MultiPolygon([shapely.box(0, 0, 0.5, 0.5), shapely.box(0, 0, 0.5, 0.5)]),
        shapely.MultiPolygon([shapely.box(-1, -1, 0.1, 2)]),
    ]
    images = stack(2, mask=masks, cloud_percent=np.full(2, np.nan))
    assert with_cloud_from_masks(images).cloud_percent == pytest.approx([25.0, 10.0])


def test_a_cloudy_image_needs_a_mask_and_counts_only_outside_of_it():
    masks = np.empty(9, dtype=object)
    masks[7] = masks[8] = shapely.MultiPolygon([shapely.box(0, 0, 0.5, 1)])
    cloud = np.array([5.0] * 5 + [50.0, 50.0, 50.0, 55.0])
    images = stack(9, mask=masks, cloud_percent=cloud)
    selection = select_images(images)
    assert ids(images, selection) == ["i0", "i1", "i2", "i3", "i4", "i7"]
    assert selection.step.tolist() == [0, 0, 0, 0, 0, 3]
    assert selection.use.without_mask == 2
    lon = selection.cells.grid.centres(selection.cells.cell)[:, 0]
    assert (selection.cells.views == np.where(lon < 0.5, 5, 6)).all()
    assert (selection.missing == np.where(lon < 0.5, 1, 0)).all()


def test_the_mask_of_a_nominal_image_counts_too():
    masks = np.empty(7, dtype=object)
    masks[0] = shapely.MultiPolygon([shapely.box(0, 0, 0.3, 0.3)])
    images = stack(7, mask=masks, cloud_percent=np.array([9.0] + [10.0] * 6))
    assert len(select_images(images).image) == 6
    assert "i0" not in ids(images, select_images(images))


def test_a_second_product_of_an_acquisition_is_no_second_view():
    acquired = np.datetime64("2024-03-01T10:00:00", "ms") + np.array([0, 400, 30_000], "timedelta64[ms]")
    assert duplicates(stack(3, acquired=acquired)).tolist() == [False, True, False]
    other = np.array(["p", "q", "p"], dtype=object)
    assert not duplicates(stack(3, acquired=acquired, platform=other)).any()
    beside = np.array([shapely.box(k, 0, k + 1, 1) for k in (0, 0.5, 0)], dtype=object)
    assert not duplicates(stack(3, acquired=acquired, footprint=beside)).any()
    unknown = np.array([""] * 3, dtype=object)
    assert not duplicates(stack(3, acquired=acquired, platform=unknown)).any()


def test_ground_without_any_image_is_short_of_all_views():
    selection = select_images(stack(6), SelectionOptions(), shapely.box(0, 0, 2, 1))
    lon = selection.cells.grid.centres(selection.cells.cell)[:, 0]
    assert (selection.missing == np.where(lon < 1.0, 0, 6)).all()


def test_an_area_beside_all_footprints_is_refused():
    with pytest.raises(CoverageError, match=r"none of the .* cells of the area lies in one of the 6"):
        select_images(stack(6), SelectionOptions(), shapely.box(30, 30, 31, 31))


def test_an_image_is_used_below_a_cloud_limit_and_not_at_it() -> None:
    mask = np.full(4, shapely.MultiPolygon(), dtype=object)
    images = stack(4, cloud_percent=np.array([14.9, 15.0, 79.9, 80.0]), mask=mask)
    np.testing.assert_array_equal(image_steps(images, SelectionOptions()), [0, 1, 4, -1])


def test_cells_are_as_large_for_footprints_of_one_size_at_every_latitude() -> None:
    at_equator, far_north = (
        stack(3, footprint=np.full(3, box, dtype=object))
        for box in (shapely.box(0.0, -0.5, 1.0, 0.5), shapely.box(0.0, 59.5, 2.0, 60.5))
    )
    assert default_cell_m(far_north) == pytest.approx(default_cell_m(at_equator), rel=0.01)
    assert default_cell_m(at_equator) == pytest.approx(111_200.0 / 12.0, rel=0.01)
