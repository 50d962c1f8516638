"""The ground changes on its day, by the share asked for, and water does not."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from amers.services.simulation.changes import Change, apply_changes, draw_changes, scatter_things
from amers.services.simulation.land import NO_ROOF, WATER
from amers.services.simulation.world import World, flood, make_world

FIRST, LAST = date(2020, 1, 1), date(2024, 1, 1)
a_percent_a_year = 0.01
years = 4.0


@pytest.fixture
def world() -> World:
    made = make_world(np.random.default_rng(2), 1500.0, 2.0, 40.0, region_m=700.0)
    flood(made, 0.1)
    return made


def copy_of(world: World) -> World:
    layers = ("terrain_m", "roof_m", "albedo", "parcel")
    return replace(world, **{name: getattr(world, name).copy() for name in layers})


def test_water_is_level_dark_and_bare_and_covers_its_share(world: World) -> None:
    wet = world.parcel == WATER
    assert 0.08 < wet.mean() < 0.12
    assert np.ptp(world.terrain_m[wet]) == 0.0
    assert world.terrain_m[wet].max() <= world.terrain_m[~wet].min()
    assert (world.roof_m[wet] == NO_ROOF).all()
    assert np.ptp(world.albedo[wet]) == 0.0


def test_the_share_of_the_ground_that_changes_is_the_one_asked_for(world: World) -> None:
    changes = draw_changes(world, np.random.default_rng(3), FIRST, LAST, a_percent_a_year)
    cells = sum(change.shape[0] * change.shape[1] for change in changes)
    wanted = a_percent_a_year * years * world.albedo.size
    assert wanted <= cells < wanted + max(c.shape[0] * c.shape[1] for c in changes)
    assert [change.day for change in changes] == sorted(change.day for change in changes)
    assert changes[0].day >= FIRST
    assert changes[-1].day <= LAST


def test_ground_changes_on_its_day_and_nowhere_else(world: World) -> None:
    before = copy_of(world)
    day = date(2021, 5, 1)
    change = Change(day, (100, 200), (40, 60), None)
    early = apply_changes(copy_of(world), [change], date(2021, 4, 30))
    np.testing.assert_array_equal(early.albedo, before.albedo)
    late = apply_changes(copy_of(world), [change], day)
    inside = np.zeros(world.albedo.shape, dtype=bool)
    inside[100:140, 200:260] = True
    dry = inside & (before.parcel != WATER)
    assert dry.sum() > 500
    np.testing.assert_array_equal(late.albedo[~dry], before.albedo[~dry])
    assert (late.albedo[dry] != before.albedo[dry]).mean() > 0.99
    assert (late.roof_m[dry] == NO_ROOF).all()


def test_buildings_that_are_copied_stand_on_the_ground(world: World) -> None:
    changes = draw_changes(world, np.random.default_rng(4), FIRST, LAST, 0.1)
    later = apply_changes(copy_of(world), changes, LAST)
    built = later.roof_m > NO_ROOF
    new = built & (world.roof_m == NO_ROOF)
    assert new.sum() > 1000
    assert (later.roof_m[new] >= later.terrain_m[new] + 3.0).all()
    assert later.roof_clearance_m < 60.0


def test_what_is_copied_rises_as_high_above_the_ground_as_where_it_stood(world: World) -> None:
    """Above the first cell of each rectangle, whose ground lies at another height."""
    row, column = (int(v) - 10 for v in np.argwhere(world.roof_m > NO_ROOF).mean(axis=0))
    source, place = np.s_[row : row + 200, column : column + 200], np.s_[20:220, 30:230]
    before = copy_of(world)
    change = Change(FIRST, (20, 30), (200, 200), (row, column))
    later = apply_changes(copy_of(world), [change], FIRST)
    dry = (before.parcel[place] != WATER) & (before.parcel[source] != WATER)
    both = dry & (later.roof_m[place] > NO_ROOF)
    assert both.sum() > 100
    above = (later.roof_m[place] - before.terrain_m[place][0, 0])[both]
    stood = (before.roof_m[source] - before.terrain_m[source][0, 0])[both]
    np.testing.assert_allclose(above, stood, atol=1e-3)
    assert abs(before.terrain_m[place][0, 0] - before.terrain_m[source][0, 0]) > 1.0


def test_things_come_in_their_number_on_open_ground_only(world: World) -> None:
    before = copy_of(world)
    places = scatter_things(world, np.random.default_rng(5), 400.0)
    area_km2 = world.albedo.size * world.posting_m**2 * 1e-6
    assert len(places) == pytest.approx(400.0 * area_km2, rel=0.15)
    changed = world.albedo != before.albedo
    assert (before.roof_m[changed] == NO_ROOF).all()
    assert len(places) < changed.sum() < 30 * len(places)
