"""Where an ortho-image shows the details of images, and how well that is known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.control_ground import ControlGround
from amers.services.errors import NotEnoughPoints
from amers.services.imagery.source import ArrayImage
from amers.services.matching.reference_image import Reference
from amers.services.production.ortho_control import ControlOrtho, known_on_ortho
from amers.services.sensors.ortho import OrthoModel
from amers.services.tasks import Work
from amers.services.types import Array, Frame, no_progress
from tests.services.production.displaced_details import (
    GSD_M,
    Details,
    drawn_details,
    east_north_m,
    map_moved,
)

SIDE = 6
LOCAL_M = 1.6
SHIFT_M = np.array([14.0, -9.0])
OWN = Frame.from_sigmas(4.0, 5.0)
MAP = Frame.from_sigmas(3.0, 2.0)
EXACT = Reference(ArrayImage(np.zeros((1, 1))), None, None, 0.0, 0.0, MAP)  # type: ignore[arg-type]
a_twentieth_of_a_pixel_m = 0.05 * GSD_M


def details() -> Details:
    return drawn_details(SIDE)


@cache
def displaced_m() -> Array:
    return np.random.default_rng(6).normal(0.0, LOCAL_M, (SIDE**2, 2))


def known(
    reference: Reference = EXACT,
    shift_m: Array = SHIFT_M,
    own: Frame = OWN,
    local_m: float = 1.0,
    noise: float = 0.02,
    times: int = 1,
    without_px: int = 0,
) -> ControlGround:
    """Details that an image shows in their places, and an ortho-image off by its map and by each.

    The ortho-image may lack some of its easternmost columns.
    """
    shown, model = details(), map_moved(details().model, shift_m)
    pixels, grid = shown.image(local_m * displaced_m(), noise).pixels, model.grid
    pixels = pixels[:, : pixels.shape[1] - without_px].copy()
    cut = OrthoModel(replace(grid, shape=pixels.shape))
    reference = replace(reference, image=ArrayImage(pixels), model=cut)
    return known_on_ortho(
        [shown.scene("image", np.zeros((SIDE**2, 2)), own.sigma_m)],
        own,
        np.tile(shown.lon_lat_h, (times, 1)),
        ControlOrtho("map.tif", reference),
        gsd_m=GSD_M,
        name="ortho",
        work=Work(),
        progress=no_progress,
    )


@cache
def exact() -> ControlGround:
    return known()


def test_details_are_known_where_the_ortho_image_shows_them() -> None:
    found = exact()
    assert len(found.point) >= 3 * SIDE**2 // 4
    moved_m = east_north_m(details().lon_lat_h[found.point], found.lon_lat_h)
    expected_m = SHIFT_M + displaced_m()[found.point]
    np.testing.assert_allclose(moved_m, expected_m, atol=2.0 * a_twentieth_of_a_pixel_m)


def test_the_noise_of_the_image_is_in_the_sigmas() -> None:
    """Drawn stronger than the detail, so that a tenth of a pixel is seen."""
    found = known(noise=2.0)
    moved_m = east_north_m(details().lon_lat_h[found.point], found.lon_lat_h)
    error_m = moved_m - SHIFT_M - displaced_m()[found.point]
    sigma_m = np.sqrt(found.covariance_m2[:, [0, 1], [0, 1]])
    assert 0.7 < np.sqrt(np.mean((error_m / sigma_m) ** 2)) < 1.4


def test_every_part_of_the_ground_keeps_its_points() -> None:
    """Points go by 64; the same ones given twice are found twice, in their own rows."""
    found = known(times=2)
    once = exact()
    np.testing.assert_array_equal(found.point, np.concatenate([once.point, once.point + SIDE**2]))
    np.testing.assert_allclose(found.lon_lat_h, np.tile(once.lon_lat_h, (2, 1)), rtol=0.0, atol=1e-7)


def test_each_is_off_by_what_is_stated_and_measured_and_its_height_is_unknown() -> None:
    measured_m2 = exact().covariance_m2
    assert (np.sqrt(measured_m2[:, 0, 0]) < a_twentieth_of_a_pixel_m * 2.0).all()
    assert np.isposinf(measured_m2[:, 2, 2]).all()
    stated_m2 = known(replace(EXACT, sigma_m=3.0)).covariance_m2
    for axis in range(2):
        added_m2 = stated_m2[:, axis, axis] - measured_m2[:, axis, axis]
        np.testing.assert_allclose(added_m2, 9.0, rtol=1e-6)


def test_all_are_off_together_by_the_map_and_by_what_leans_alike() -> None:
    """Roofs and shadows lean the same way all over an ortho-image; no height is measured on it."""
    (alone,), (leaning,) = exact().frames, known(replace(EXACT, common_sigma_m=1.5)).frames
    np.testing.assert_allclose(alone.covariance_m2, MAP.covariance_m2)
    assert leaning.sigma_m == pytest.approx(np.hypot(3.0, 1.5))
    assert leaning.covariance_m2[0, 1] == 0.0
    assert leaning.sigma_up_m == MAP.sigma_up_m


def test_the_shift_is_searched_as_far_as_both_frames_reach() -> None:
    """Within three standard deviations of 30 and of 40 m, and no farther."""
    both = {
        "reference": replace(EXACT, frame=Frame.from_sigmas(40.0, 2.0)),
        "own": Frame.from_sigmas(30.0, 5.0),
    }
    north = np.array([0.0, 1.0])
    found = known(shift_m=145.0 * north, **both)  # type: ignore[arg-type]
    moved_m = east_north_m(details().lon_lat_h[found.point], found.lon_lat_h)
    np.testing.assert_allclose(moved_m.mean(axis=0), 145.0 * north, atol=3.0 * LOCAL_M)
    with pytest.raises(NotEnoughPoints, match=r"a shift of at most 150 m"):
        known(shift_m=220.0 * north, **both)  # type: ignore[arg-type]


def test_details_are_searched_where_their_shifted_surroundings_lie_on_the_ortho_image() -> None:
    """Chips and their search need 116 m to each side.

    Those in the west have 128 m where they lie on the ortho-image, 14 m east of their places, where they
    would have 114 m. Those in the east have 112 m, and would have 126 m.
    """
    column = known(local_m=0.0, without_px=8).point % SIDE
    assert set(column.tolist()) == set(range(SIDE - 1))


def test_details_that_lie_apart_from_each_other_show_no_shift() -> None:
    """They are found, as far as 15 m; two chip pixels are an agreement."""
    with pytest.raises(NotEnoughPoints, match=r"map\.tif: it shows other ground"):
        known(shift_m=np.zeros(2), local_m=4.0)
