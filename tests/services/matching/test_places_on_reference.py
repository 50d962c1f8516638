"""Places of a scene are found where a reference ortho-image shows their ground."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.imagery.resampling import resample, spline_coefficients
from amers.services.imagery.source import ArrayImage, reduce_image
from amers.services.map_grid import MapGrid
from amers.services.matching.correlate import FOUND
from amers.services.matching.reference_image import (
    Reference,
    ReferenceMatchingOptions,
    locate_on_terrain,
    match_places,
    visible_places,
)
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.orbit import pushbroom_over
from tests.services.production.displaced_details import GSD_M, Details
from tests.services.textures import as_pixels, moved, texture

SIDE = 256
GROUND = texture(np.random.default_rng(4), SIDE, 3.0)
MODEL = Details(np.zeros((2, 2, 1, 1))).model
"""An image of 256 lines and samples, north up."""
REFERENCE_PIXELS = as_pixels(GROUND)
REFERENCE = Reference(ArrayImage(REFERENCE_PIXELS), MODEL, None, 0.3, common_sigma_m=0.4)
OPTIONS = ReferenceMatchingOptions()
SHIFT_PX = np.array([2.3, -1.6])
"""Rows and columns by which the scene shows all ground off its model."""
SCENE = ArrayImage(as_pixels(moved(GROUND, *SHIFT_PX)))
AXIS = np.linspace(70.0, 180.0, 4)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 2)
a_twentieth_of_a_pixel = 0.05


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("reduced", [False, True])
def test_places_are_found_where_the_scene_shows_their_ground(factor: int, reduced: bool) -> None:
    """Displacements are east and north, in metres, positions in pixels of the scene at each level."""
    places = visible_places(MODEL, REFERENCE, GRID, factor, OPTIONS.window_px)
    image = reduce_image(SCENE, factor) if reduced else SCENE
    matches = match_places(image, places, 6, OPTIONS)
    assert (matches.reason == FOUND).all()
    off_px = matches.line_sample - places.line_sample
    np.testing.assert_allclose(off_px, np.tile(SHIFT_PX, (16, 1)), atol=factor * a_twentieth_of_a_pixel)
    east_north_m = off_px[:, ::-1] * [GSD_M, -GSD_M]
    np.testing.assert_allclose(matches.displacement_m, east_north_m, rtol=2e-3)


def test_what_the_reference_shares_with_all_places_is_alike_in_each_coordinate() -> None:
    places = visible_places(MODEL, REFERENCE, GRID, 1, OPTIONS.window_px)
    matches = match_places(SCENE, places, 4, OPTIONS)
    np.testing.assert_allclose(matches.common_covariance_m2, np.diag([0.4**2, 0.4**2]))


@pytest.mark.parametrize("factor", [1, 3])
def test_the_stated_sigma_is_that_of_the_positions_in_noise(factor: int) -> None:
    """White noise that has half of the ground's contrast in a pixel of the level."""
    rng = np.random.default_rng(6)
    shown = SCENE.pixels + rng.normal(0.0, 50.0 * factor, (SIDE, SIDE)).astype(np.float32)
    axis = np.linspace(70.0, 180.0, 12)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    places = visible_places(MODEL, REFERENCE, grid, factor, OPTIONS.window_px)
    matches = match_places(ArrayImage(shown), places, 5, OPTIONS)
    found = matches.reason == FOUND
    assert found.mean() > 0.9
    error = (matches.line_sample - places.line_sample - SHIFT_PX)[found] / matches.sigma_px[found, None]
    assert 0.5 < np.square(error).mean() < 2.0


def test_the_centre_of_a_place_is_that_of_the_pixels_it_covers() -> None:
    """Pixel c of a level covers the pixels 4 c to 4 c + 3 of the scene."""
    wanted = np.array([[120.0, 123.0], [123.49, 119.5], [119.49, 123.51]])
    places = visible_places(MODEL, REFERENCE, wanted, 4, 21)
    np.testing.assert_array_equal(places.cell, [[30, 30], [30, 30], [29, 31]])
    np.testing.assert_array_equal(places.line_sample, 4.0 * places.cell + 1.5)
    np.testing.assert_allclose(MODEL.project(places.lon_lat_h), places.line_sample, atol=1e-4)


def test_places_whose_windows_leave_the_reference_are_left_out() -> None:
    """A window of 41 pixels, of which lines of sight are known every four pixels: 20 on each side."""
    inside, outside = [21.0, 128.0, SIDE - 22.0], [19.0, SIDE - 20.0]
    for row in (*inside, *outside):
        for place in ([row, 128.0], [128.0, row]):
            places = visible_places(MODEL, REFERENCE, np.array([place]), 1, OPTIONS.window_px)
            assert len(places.cell) == (row in inside)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_a_reference_of_other_pixels_is_rendered_as_the_scene_shows_it(ratio: float) -> None:
    """Its ground sampling is that of the scene divided by the ratio."""
    side = round(SIDE * ratio)
    grid = MODEL.grid
    first_px = np.full(2, 0.5 / ratio - 0.5)
    corner_xy = grid.origin_xy + grid.step_xy @ first_px
    model = OrthoModel(MapGrid(grid.crs, corner_xy, grid.step_xy / ratio, (side, side)))
    at = np.stack(np.meshgrid(*[(np.arange(side) + 0.5) / ratio - 0.5] * 2, indexing="ij"), axis=-1)
    pixels = resample(spline_coefficients(REFERENCE_PIXELS), np.clip(at, 0.0, SIDE - 1.0))
    other = replace(REFERENCE, image=ArrayImage(pixels), model=model)
    places = visible_places(MODEL, other, GRID, 1, OPTIONS.window_px)
    matches = match_places(SCENE, places, 6, OPTIONS)
    assert (matches.reason == FOUND).all()
    off_px = matches.line_sample - places.line_sample
    np.testing.assert_allclose(off_px, np.tile(SHIFT_PX, (16, 1)), atol=a_twentieth_of_a_pixel)


def test_a_place_that_lies_farther_off_than_the_radius_is_not_found() -> None:
    places = visible_places(MODEL, REFERENCE, GRID, 1, OPTIONS.window_px)
    assert (match_places(SCENE, places, 4, OPTIONS).reason == FOUND).all()
    lost = match_places(SCENE, places, 2, OPTIONS)
    assert (lost.reason != FOUND).all()
    assert np.isnan(lost.line_sample).all()
    assert np.isnan(lost.sigma_px).all()
    assert not lost.views.any()


@pytest.mark.parametrize(("window_px", "is_accepted"), [(11, True), (9, False), (12, False)])
def test_windows_have_a_centre_and_content(window_px: int, is_accepted: bool) -> None:
    if is_accepted:
        assert ReferenceMatchingOptions(window_px=window_px).window_px == window_px
    else:
        with pytest.raises(InputError, match="window_px"):
            ReferenceMatchingOptions(window_px=window_px)


def test_without_a_terrain_a_scene_with_a_parallax_is_refused() -> None:
    at = np.full((1, 2), 128.0)
    np.testing.assert_array_equal(locate_on_terrain(MODEL, at, None)[:, 2], [0.0])
    leaning = pushbroom_over(np.array([15.0, 50.5, 0.0]), (256, 256), GSD_M, (20.0, 90.0), (0.0, 10.0))
    with pytest.raises(InputError, match="terrain model is needed"):
        locate_on_terrain(leaning, at, None)
