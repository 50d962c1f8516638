"""The error that all measures share is stated, along its directions."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.matching.systematic_error import (
    COMMON_SIGMA_PX,
    HEIGHT_SIGMA_PX,
    IMAGE_SIGMA_PX,
    SHADOW_SIGMA_PX,
    common_covariance_px2,
)
from amers.services.types import Acquisition, Array, BoolArray, Views
from tests.services.simulated import views_of_points

NORTH, EAST, SOUTH = 0.0, 90.0, 180.0
NINETY_PERCENT = 2.0 * np.log(10.0)
"""Square of the radius of the 90 % region of the plane, in units of sigma."""

LIKE_THE_SCENE = Acquisition("scene", "", None, 20.0, NORTH, 60.0, SOUTH)


def views_of(image: Acquisition, count: int = 20) -> Views:
    return views_of_points(count, [2.0], image.incidence_deg, image.azimuth_deg, images=(image,))


def common(image: Acquisition, offset: Array | None = None) -> Array:
    views = views_of(image)
    n = len(views.gsd_m)
    offset = np.zeros((n, 2)) if offset is None else offset
    return common_covariance_px2(LIKE_THE_SCENE, views, np.arange(n), offset, np.ones(n))


def test_views_taken_like_the_scene_have_the_smallest_error_of_a_single_image() -> None:
    # An estimate of one degree of freedom: its 90 % region is that much larger.
    of_image = 99.0 / np.log(100.0) * IMAGE_SIGMA_PX**2
    expected = (COMMON_SIGMA_PX**2 + of_image) * np.eye(2)
    np.testing.assert_allclose(common(LIKE_THE_SCENE), expected, atol=1e-12)


def test_another_direction_of_view_adds_an_error_along_the_parallax() -> None:
    added_px2 = common(replace(LIKE_THE_SCENE, azimuth_deg=SOUTH)) - common(LIKE_THE_SCENE)
    along_px = HEIGHT_SIGMA_PX * 2.0 * np.tan(np.radians(20.0))
    np.testing.assert_allclose(added_px2, [[0.0, 0.0], [0.0, along_px**2]], atol=1e-12)


def test_another_sun_adds_an_error_along_the_difference_of_the_shadows() -> None:
    added_px2 = common(replace(LIKE_THE_SCENE, sun_elevation_deg=30.0)) - common(LIKE_THE_SCENE)
    along_px = SHADOW_SIGMA_PX * (1.0 / np.tan(np.radians(30.0)) - 1.0 / np.tan(np.radians(60.0)))
    np.testing.assert_allclose(added_px2, [[0.0, 0.0], [0.0, along_px**2]], atol=1e-12)


def test_an_unknown_sun_adds_an_error_in_all_directions() -> None:
    unknown = replace(LIKE_THE_SCENE, sun_elevation_deg=float("nan"))
    added_px2 = common(unknown) - common(LIKE_THE_SCENE)
    assert added_px2[0, 0] == added_px2[1, 1] > 0.0


def seen_views(seen: BoolArray) -> tuple[Views, Array]:
    """A view of each point (n,) by each image (k,) that sees it, and its weight in the point."""
    point, image = np.nonzero(seen)
    views = Views(
        np.concatenate([[0], np.cumsum(seen.sum(axis=1))]),
        np.full(len(point), 2.0),
        image,
        np.full(len(point), 20.0),
        np.full(len(point), NORTH),
        np.ones(len(point)),
        (LIKE_THE_SCENE,) * seen.shape[1],
    )
    return views, 1.0 / seen.sum(axis=1)[point]


def stated_and_true_px(seen: BoolArray, image_offset: Array) -> tuple[Array, Array]:
    """Stated covariance (2, 2) and true error (2,) of a mean of points; offsets (k, 2) of images."""
    views, weight = seen_views(seen)
    point = np.nonzero(seen)[0]
    measure = np.zeros((len(seen), 2))
    np.add.at(measure, point, weight[:, None] * image_offset[views.image])
    offset = image_offset[views.image] - measure[point]
    stated = common_covariance_px2(LIKE_THE_SCENE, views, np.arange(len(point)), offset, weight)
    return stated, measure.mean(axis=0)


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("dominant", [False, True])
@pytest.mark.parametrize("images", [2, 3, 4, 6])
def test_the_stated_error_covers_the_offsets_of_images_of_any_share(images: int, dominant: bool) -> None:
    rng = np.random.default_rng(7)
    chance = np.full(images, 0.3 if dominant else 1.0)
    chance[0] = 1.0
    for offset_px in (0.1, 0.15):
        squares = []
        for _ in range(600):
            seen = rng.random((60, images)) < chance
            stated, error_px = stated_and_true_px(seen, offset_px * rng.standard_normal((images, 2)))
            squares.append(error_px @ np.linalg.solve(stated, error_px))
        assert np.mean(squares) / 2.0 < 1.25
        # The floor of the stated error makes small offsets of many images safe.
        assert (np.array(squares) < NINETY_PERCENT).mean() > 0.86


@pytest.mark.monte_carlo
def test_two_images_that_lie_further_apart_than_expected_are_believed() -> None:
    """Ten times as far as is expected of an image: no prior makes less of what is seen."""
    rng = np.random.default_rng(8)
    seen = np.ones((60, 2), dtype=bool)
    squares = []
    for _ in range(600):
        stated, error_px = stated_and_true_px(seen, 10.0 * IMAGE_SIGMA_PX * rng.standard_normal((2, 2)))
        squares.append(error_px @ np.linalg.solve(stated, error_px))
    assert np.mean(squares) / 2.0 == pytest.approx(1.0, abs=0.25)
    assert (np.array(squares) < NINETY_PERCENT).mean() > 0.88


def test_scatter_of_the_views_is_no_offset_of_their_images() -> None:
    """A view scatters by 0.3 px: the medians of 20 views of an image seem to be 0.08 px apart."""
    rng = np.random.default_rng(8)
    views, weight = seen_views(np.ones((20, 4), dtype=bool))
    row, none = np.arange(80), np.zeros((80, 2))
    without = common_covariance_px2(LIKE_THE_SCENE, views, row, none, weight)
    stated = []
    for _ in range(100):
        view = rng.normal(0.0, 0.3, (20, 4, 2))
        offset = (view - view.mean(axis=1, keepdims=True)).reshape(-1, 2)
        stated.append(common_covariance_px2(LIKE_THE_SCENE, views, row, offset, weight)[0, 0])
    assert np.median(stated) < 1.1 * without[0, 0]


def test_the_offset_of_an_image_that_dominates_is_stated_though_hardly_seen() -> None:
    both = np.ones((20, 2), dtype=bool)
    one_dominates = both.copy()
    one_dominates[5:, 1] = False
    apart_px = np.array([[0.3, 0.0], [-0.3, 0.0]])
    even, _ = stated_and_true_px(both, apart_px)
    uneven, error_px = stated_and_true_px(one_dominates, apart_px)
    # The mean of two images alike has half the variance of an image, which two offsets hardly show:
    # the 90 % region of an estimate of two degrees of freedom has four times the area.
    half_px2 = 0.3**2 / 2.0
    assert half_px2 < even[0, 0] < 4.2 * half_px2
    assert error_px[0] == pytest.approx(0.225)
    assert error_px[0] ** 2 < uneven[0, 0] < 4.2 * error_px[0] ** 2


def test_views_count_by_their_weights_in_what_parallax_makes_of_heights() -> None:
    """A quarter of the weight looks from the other side; what agrees with nothing has none."""
    n = 30
    views = views_of(LIKE_THE_SCENE, n)
    kind = np.arange(n) % 3
    azimuth_deg = np.choose(kind, [NORTH, SOUTH, EAST])
    weight = np.choose(kind, [0.75, 0.25, 0.0])
    turned = replace(views, azimuth_deg=azimuth_deg)
    before, after = (
        common_covariance_px2(LIKE_THE_SCENE, of, np.arange(n), np.zeros((n, 2)), weight)
        for of in (views, turned)
    )
    along_px = 0.25 * HEIGHT_SIGMA_PX * 2.0 * np.tan(np.radians(20.0))
    np.testing.assert_allclose(after - before, [[0.0, 0.0], [0.0, along_px**2]], atol=1e-12)


def test_an_unknown_sun_is_worse_than_one_with_other_shadows() -> None:
    """Shadows that are known get less weight; those that are not keep theirs."""
    lower_deg = np.degrees(np.arctan(1.0 / (1.0 / np.tan(np.radians(60.0)) + 1.0 / 3.0)))
    unknown, lower = (
        common(replace(LIKE_THE_SCENE, sun_elevation_deg=deg)) - common(LIKE_THE_SCENE)
        for deg in (float("nan"), lower_deg)
    )
    assert 2.0 * lower[1, 1] < unknown[1, 1] < 8.0 * lower[1, 1]


@pytest.mark.parametrize("count", [0, 12])
def test_without_a_view_that_agrees_the_error_is_the_smallest(count: int) -> None:
    across = views_of(replace(LIKE_THE_SCENE, azimuth_deg=SOUTH, sun_elevation_deg=20.0), 12)
    none = np.zeros((count, 2))
    found = common_covariance_px2(LIKE_THE_SCENE, across, np.arange(count), none, none[:, 0])
    np.testing.assert_allclose(found, COMMON_SIGMA_PX**2 * np.eye(2), atol=1e-12)
