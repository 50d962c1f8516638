"""The error that all measures share is stated, along its directions."""

from dataclasses import replace

import numpy as np
import pytest

from services.matching.systematic_error import (
    COMMON_SIGMA_PX,
    HEIGHT_SIGMA_PX,
    SHADOW_SIGMA_PX,
    common_covariance_px2,
)
from services.types import Acquisition, Array, Views

NORTH, EAST, SOUTH = 0.0, 90.0, 180.0
LIKE_THE_SCENE = Acquisition("scene", "", None, 20.0, NORTH, 60.0, SOUTH)


def views_of(image: Acquisition, count: int = 20) -> Views:
    return Views(
        np.arange(count + 1),
        np.full(count, 2.0),
        np.zeros(count, dtype=np.int64),
        np.full(count, image.incidence_deg),
        np.full(count, image.azimuth_deg),
        np.ones(count),
        (image,),
    )


def common(image: Acquisition, offset: Array | None = None) -> Array:
    views = views_of(image)
    n = len(views.gsd_m)
    offset = np.zeros((n, 2)) if offset is None else offset
    return common_covariance_px2(LIKE_THE_SCENE, views, np.arange(n), offset, np.ones(n, dtype=bool))


def test_views_taken_like_the_scene_have_the_smallest_error_of_a_single_image() -> None:
    np.testing.assert_allclose(common(LIKE_THE_SCENE), 4.0 * COMMON_SIGMA_PX**2 * np.eye(2), atol=1e-12)


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


def test_offsets_between_images_show_how_well_their_mean_is_known() -> None:
    views = replace(
        views_of(LIKE_THE_SCENE), image=np.arange(20) % 2, images=(LIKE_THE_SCENE, LIKE_THE_SCENE)
    )
    offset = np.where((np.arange(20) % 2 == 0)[:, None], [0.3, 0.0], [-0.3, 0.0])
    covariance_px2 = common_covariance_px2(
        LIKE_THE_SCENE, views, np.arange(20), offset, np.ones(20, dtype=bool)
    )
    # Two means, each 0.3 px from their mean: a variance of 2 * 0.3^2 over two coordinates and two means.
    assert covariance_px2[0, 0] == pytest.approx(COMMON_SIGMA_PX**2 + 0.3**2 / 2.0)


def test_without_a_measure_the_error_is_the_smallest() -> None:
    empty = common_covariance_px2(
        LIKE_THE_SCENE, views_of(LIKE_THE_SCENE), np.arange(0), np.zeros((0, 2)), np.zeros(0, dtype=bool)
    )
    np.testing.assert_allclose(empty, COMMON_SIGMA_PX**2 * np.eye(2))
