"""Each known site alone as control of a block, the others as check."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.geodesy import move_metres
from amers.services.quality.site_reach import SiteReach, site_reach
from amers.services.types import Frame
from benchmarks._cape_verde import SITES, STEREO, Draw, draw

pytestmark = pytest.mark.long

OFF_M = 1.0


def reach(one: Draw, sites: int = 2) -> SiteReach:
    return site_reach(one.images, one.observations, one.sites[:sites], one.heights)


@pytest.fixture(scope="module")
def one() -> Draw:
    return draw(np.random.default_rng(47), 120).without(STEREO)


@pytest.fixture(scope="module")
def plain(one: Draw) -> SiteReach:
    return reach(one)


def test_every_site_is_checked_by_every_other_one(plain: SiteReach) -> None:
    names = list(SITES)[:2]
    assert [(check.active, check.check) for check in plain.checks] == [
        (names[0], names[1]),
        (names[1], names[0]),
    ]
    for check in plain.checks:
        assert 66.0 < check.distance_km < 70.0
        assert check.points >= 6
        declared_m = np.sqrt(np.trace(check.covariance_m2[:2, :2]))
        assert 0.9 < declared_m < 3.0
        assert check.residual_m < 3.0 * declared_m


def test_the_known_ground_of_a_check_site_takes_no_part(one: Draw, plain: SiteReach) -> None:
    site = one.sites[1]
    moved = move_metres(site.ground.lon_lat_h, np.tile([OFF_M, 0.0, 0.0], (len(site.ground), 1)))
    elsewhere = replace(site, ground=replace(site.ground, lon_lat_h=moved))
    after = reach(replace(one, sites=(one.sites[0], elsewhere)))
    np.testing.assert_allclose(
        after.checks[0].error_m - plain.checks[0].error_m, [-OFF_M, 0.0, 0.0], atol=1e-6
    )


def test_what_is_declared_for_a_check_holds_both_frames_of_sites(one: Draw, plain: SiteReach) -> None:
    """That of a vague site counts in full as a check, and beside the images as control."""
    site = one.sites[0]
    frame_m2 = site.ground.frames[0].covariance_m2
    badly = replace(site, ground=replace(site.ground, frames=(Frame(9.0 * frame_m2),)))
    after = reach(replace(one, sites=(badly, one.sites[1])))
    of_control, of_check = (
        later.covariance_m2 - before.covariance_m2
        for later, before in zip(after.checks, plain.checks, strict=True)
    )
    np.testing.assert_allclose(of_check, 8.0 * frame_m2, atol=1e-9)
    assert (0.2 * 8.0 * np.diag(frame_m2) < np.diag(of_control))[:2].all()
    assert (np.diag(of_control) < 8.0 * np.diag(frame_m2)).all()


def test_own_errors_of_the_points_of_a_check_site_average_out(one: Draw, plain: SiteReach) -> None:
    site, check = one.sites[0], plain.checks[1]
    own_m2 = site.ground.covariance_m2
    badly = replace(site, ground=replace(site.ground, covariance_m2=own_m2 + np.eye(3)))
    after = reach(replace(one, sites=(badly, one.sites[1])))
    np.testing.assert_allclose(
        after.checks[1].covariance_m2 - check.covariance_m2, np.eye(3) / check.points, atol=1e-9
    )


def test_corners_of_every_image_move_by_less_than_its_model_was_off(one: Draw, plain: SiteReach) -> None:
    assert len(plain.corners) == 2 * len(one.images)
    of_orthos = [np.hypot(*corner.moved_m.T) for corner in plain.corners if "ortho" in corner.image]
    assert 0.0 < np.median(of_orthos) < np.max(of_orthos) < 4.5


def test_one_site_alone_has_no_check(one: Draw) -> None:
    with pytest.raises(InputError, match="1 known site given, at least 2"):
        reach(one, 1)
