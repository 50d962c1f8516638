"""What is said of the errors of a block at sites, from errors that are put in."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.matching.reference_image import Reference
from amers.services.quality.planimetry import PlanimetricQuality, planimetric_quality
from amers.services.quality.site_errors import (
    POINTS,
    UNKNOWN_FRAME_SIGMA_M,
    Site,
    SiteErrors,
    expected_reach_m,
)
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, Frame
from tests.factories import control_points

FRAME = Frame.from_sigmas(1.0, 1.0)


def at_site(
    name: str, error_m: Array, *, sigma_m: float = 1.0, control: bool = False, frame_m: float = 0.0
) -> SiteErrors:
    """Errors of points of one site, declared with a sigma of each coordinate."""
    n = len(error_m)
    covariance_m2 = np.tile(sigma_m**2 * np.eye(2), (n, 1, 1))
    frame_m2 = frame_m**2 * np.eye(2)
    place = np.zeros((n, 2))
    return SiteErrors(name, control, POINTS, np.nan, n, 9.0, place, error_m, covariance_m2, frame_m2, ())


def quality(*sites: SiteErrors) -> PlanimetricQuality:
    return planimetric_quality(sites, "points", FRAME)


def test_honest_errors_of_three_points_are_found_honest_although_their_mean_is_taken_off() -> None:
    rng = np.random.default_rng(51)
    shifted = [
        quality(at_site("a", [40.0, -7.0] + rng.normal(0.0, 2.0, (3, 2)), sigma_m=2.0))
        for _ in range(200)
    ]
    assert_allclose(np.mean([one.normalised.mean_square for one in shifted]), 1.0, atol=0.1)


def test_a_wrong_point_moves_neither_the_shift_nor_the_errors_of_the_others() -> None:
    error_m = np.tile([3.0, -4.0], (21, 1))
    error_m[0] += [500.0, 500.0]
    found = quality(at_site("a", error_m))
    assert_allclose([found.shift_east_m, found.shift_north_m], [3.0, -4.0])
    assert_allclose(found.relative.ce90_m.value, 0.0, atol=1e-9)
    assert_allclose(found.groups[0].accuracy.ce90_m.value, 5.0)


def test_errors_at_check_only_sites_are_not_those_at_control_sites() -> None:
    near, far = np.tile([1.0, 0.0], (40, 1)), np.tile([0.0, 6.0], (40, 1))
    found = quality(at_site("known", near, control=True), at_site("new", far))
    figures = {group.name: group.accuracy.ce90_m.value for group in found.groups}
    assert figures == {"all sites": 6.0, "check-only sites": 6.0, "control sites": 1.0}
    for control, name in ((True, "control sites"), (False, "check-only sites")):
        (only,) = quality(at_site("one", near, control=control)).groups
        assert only.name == name


def test_errors_twice_as_large_as_declared_are_told_as_twice() -> None:
    error_m = np.random.default_rng(52).normal(0.0, 2.0, (4000, 2))
    found = quality(at_site("a", error_m))
    assert_allclose(found.typical_ratio, 2.0, rtol=0.05)
    assert_allclose(found.normalised.mean_square, 4.0, rtol=0.1)
    assert_allclose(found.declared_ce90_m, 2.1460, rtol=1e-3)


def test_the_frame_of_a_block_is_judged_with_that_of_the_ortho_images_of_all_sites() -> None:
    """Ortho-images of four sites are off by half together, if they err apart."""
    error_m = np.tile([3.0, 0.0], (5, 1))
    one = quality(at_site("a", error_m, frame_m=2.0))
    four = quality(*(at_site(name, error_m, frame_m=2.0) for name in "abcd"))
    assert_allclose(one.normalised_frame.mean_square, 9.0 / (1.0 + 4.0) / 2.0)
    assert_allclose(four.normalised_frame.mean_square, 9.0 / (1.0 + 1.0) / 2.0)


def reach_m(block_m: float, ortho_m: float, point_m: float) -> float:
    """Of a block and an ortho-image whose errors have these sigmas a coordinate."""
    points = control_points(20, np.random.default_rng(53), (5.0, 43.0, 5.1, 43.1))
    covariance_m2 = np.tile(np.diag([point_m**2, point_m**2, 100.0]), (20, 1, 1))
    here = replace(points, covariance_m2=covariance_m2, frames=(Frame.from_sigmas(block_m, 50.0),))
    grid = MapGrid("EPSG:32631", np.zeros(2), np.array([[0.0, 1.0], [-1.0, 0.0]]), (10, 10))
    image, frame = ArrayImage(np.zeros((10, 10), dtype=np.float32)), Frame.from_sigmas(ortho_m, 1.0)
    return expected_reach_m(
        here, Site("a", False, Reference(image, OrthoModel(grid), None, 0.1, 0.0, frame))
    )


def test_errors_are_searched_up_to_three_sigmas_of_block_ortho_image_and_points() -> None:
    for sigmas in ((4.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, 4.0)):
        assert_allclose(reach_m(*sigmas), 12.0)
    assert_allclose(reach_m(3.0, 2.0, 6.0), 3.0 * 7.0)
    assert_allclose(reach_m(np.nan, np.nan, 0.0), 3.0 * UNKNOWN_FRAME_SIGMA_M)
