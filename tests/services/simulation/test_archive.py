"""The images of an archive: passes with errors of their own, seasons, and what is stated of both."""

from collections import defaultdict
from datetime import date

import numpy as np
import pytest

from amers.services.geodesy import east_north_up
from amers.services.simulation.archive import (
    CENTRE_LON_LAT,
    CONTINENT,
    GSD_M,
    IMAGE_SIGMA_M,
    PASS_SIGMA_M,
    SMALL,
    ArchiveView,
    archive_views,
    later_views,
    older_views,
    season_of,
)
from amers.services.types import Array


def passes(seed: int) -> dict[int, list[ArchiveView]]:
    """The images of each pass, in their order."""
    found = defaultdict(list)
    for view in archive_views(CONTINENT, seed):
        found[view.orbit].append(view)
    return found


def places_m(views: list[ArchiveView]) -> Array:
    """Centres (n, 2) of images, east and north of the middle of the archive."""
    places = np.array([[*view.plan.lon_lat, 0.0] for view in views])
    return east_north_up(places, np.array([*CENTRE_LON_LAT, 0.0]))[:, :2]


def test_a_pass_has_two_strips_from_north_to_south_and_what_lies_between() -> None:
    for views in passes(1).values():
        strip = len(views) // 2
        east, north = places_m(views).T
        assert east[:strip].max() < 0.0 < east[strip : 2 * strip].min()
        assert (np.diff(north[:strip]) < 0.0).all()
        assert (np.diff(north[strip : 2 * strip]) < 0.0).all()
        assert np.diff([view.plan.acquired_at for view in views]).min().total_seconds() > 0.0
        assert len({view.day for view in views}) == len({view.platform for view in views}) == 1
        reach_m = CONTINENT.area_m / 2.0 - CONTINENT.lines * GSD_M / 2.0
        assert np.abs(places_m(views)).max() < 1.3 * reach_m


def test_errors_of_passes_and_of_their_images_are_as_large_as_stated() -> None:
    shared, own = [], []
    for seed in range(30):
        for views in passes(seed).values():
            (pass_error_m,) = {view.pass_error_m for view in views}
            shared.append(pass_error_m)
            own += [np.subtract(view.error_m, pass_error_m) for view in views]
            assert {view.stated_m for view in views} == {(PASS_SIGMA_M, IMAGE_SIGMA_M)}
    np.testing.assert_allclose(np.std(shared, axis=0), PASS_SIGMA_M, rtol=0.15)
    np.testing.assert_allclose(np.std(own, axis=0), IMAGE_SIGMA_M, rtol=0.1)


@pytest.mark.parametrize("views_of", [archive_views, later_views, older_views])
def test_each_image_follows_from_the_seed_and_its_number(views_of) -> None:
    first, again, other = (views_of(SMALL, seed) for seed in (1, 1, 2))
    assert [view.name for view in first] == [view.name for view in again]
    assert [view.seed for view in first] == [view.seed for view in again]
    assert {view.seed for view in first}.isdisjoint(view.seed for view in other)
    assert len({view.name for view in first}) == len(first)
    for view in first:
        assert view.conditions.season == season_of(view.day)
        assert 0.0 <= view.conditions.cloud_cover <= 0.6


def test_a_winter_is_farthest_from_a_summer_and_both_change_slowly() -> None:
    assert season_of(date(2021, 7, 15)) == pytest.approx(0.0, abs=1e-3)
    assert season_of(date(2021, 1, 14)) == pytest.approx(0.5, abs=1e-3)
    spring, autumn = season_of(date(2021, 4, 15)), season_of(date(2021, 10, 14))
    np.testing.assert_allclose([spring, autumn], 0.25, atol=0.01)
