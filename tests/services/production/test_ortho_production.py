"""Points of an ortho-image lie where its map places them, and are found in another image."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import InputError, NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, render_chip
from amers.services.map_grid import MapGrid
from amers.services.matching.multi_image import chip_inside
from amers.services.production.ortho_production import (
    GroundHeights,
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
)
from amers.services.registration.on_points import register_scene
from amers.services.sensors.ortho import OrthoModel
from amers.services.terrain import Terrain
from amers.services.types import Acquisition, Array
from tests.services.simulated import MemoryChips, block_views
from tests.services.textures import as_pixels, moved, texture

GSD_M = 10.0
SIDE = 768
FLAT = GroundHeights(None, 120.0, 15.0)
OPTIONS = OrthoPointOptions(points=60)
LOWER_LEFT_XY = (400_000.0, 5_800_000.0)
AT_180_DEGREES_XY = (162_300.0, 100_000.0)
"""Of UTM zone 1; longitude 180 is near its easting 166,000 there."""
MOVED_PX = (1.3, -2.6)
a_hundredth_of_a_pixel = 0.01


@cache
def land() -> Array:
    return texture(np.random.default_rng(4), SIDE, 1.5)


def ortho(pixels: Array, zone: int = 33, corner_xy: tuple[float, float] = LOWER_LEFT_XY) -> Scene:
    step_xy = np.array([[0.0, GSD_M], [-GSD_M, 0.0]])
    origin_xy = np.array(corner_xy) + [0.0, GSD_M * SIDE]
    grid = MapGrid(f"EPSG:326{zone:02d}", origin_xy, step_xy, (SIDE, SIDE))
    taken = Acquisition("land", incidence_deg=0.0, azimuth_deg=0.0)
    return Scene(ArrayImage(as_pixels(pixels)), OrthoModel(grid), taken, 5.0)


@cache
def made() -> OrthoPoints:
    return produce_ortho_points([ortho(land())], FLAT, OPTIONS)


def chips_of(found: OrthoPoints) -> MemoryChips:
    return MemoryChips(np.concatenate([found.chips(row) for row in range(len(found.points))]))


@pytest.mark.long
def test_the_frame_is_that_of_the_image_and_of_the_heights_as_stated() -> None:
    unknown = made().points.frames[0]
    assert unknown.sigma_m == ortho(land()).sigma_m
    assert np.isnan(unknown.sigma_up_m)
    stated = produce_ortho_points([ortho(land())], replace(FLAT, frame_sigma_m=2.5), OPTIONS)
    assert stated.points.frames[0].sigma_up_m == 2.5


def test_every_square_of_the_image_gets_a_point() -> None:
    seen = ortho(land()).model.project(made().points.lon_lat_h)
    assert len(made().points) >= 0.6 * OPTIONS.points  # those at the edges have no whole chip
    cell = np.floor(seen / SIDE * 4.0).astype(int)
    assert len(set(map(tuple, cell))) == 16
    assert (made().points.saliency >= OPTIONS.min_saliency).all()


def test_no_square_has_two_points() -> None:
    """Six rows and columns of squares of 128 pixels."""
    squares = replace(OPTIONS, spacing_m=128.0 * GSD_M)
    points = produce_ortho_points([ortho(land())], FLAT, squares).points
    seen = ortho(land()).model.project(points.lon_lat_h)
    square = np.floor((seen + 0.5) / 128.0).astype(int)
    assert len(np.unique(square, axis=0)) == len(points) >= 16


def test_points_have_the_height_of_the_ground_and_the_stated_sigmas() -> None:
    points = made().points
    assert (points.lon_lat_h[:, 2] == FLAT.flat_m).all()
    sigma_m = np.sqrt(np.diagonal(points.covariance_m2, 0, 1, 2))
    np.testing.assert_allclose(sigma_m[:, :2], 0.3 * GSD_M, rtol=1e-3)
    np.testing.assert_allclose(sigma_m[:, 2], FLAT.flat_sigma_m)


def test_chips_are_complete_and_show_the_image() -> None:
    scene, points = ortho(land()), made().points
    assert made().gsds_m == (10.0, 40.0)
    for row in range(len(points)):
        chips = made().chips(row)
        gsds_m = points.views.gsd_m[slice(*points.views.start[row : row + 2])]
        assert chips.shape == (len(gsds_m), CHIP_SIZE, CHIP_SIZE)
        assert chips.min() > 0
        for chip, gsd_m in zip(chips, gsds_m, strict=True):
            shown = render_chip(scene.image, scene.model, points.lon_lat_h[row], gsd_m)
            np.testing.assert_array_equal(chip, np.maximum(np.rint(shown), 1))
    assert (points.views.incidence_deg == 0.0).all()


def test_displaced_ground_is_found_at_its_displaced_position() -> None:
    scene = replace(ortho(moved(land(), *MOVED_PX)), sigma_m=30.0)
    found = register_scene(scene, made().points, chips_of(made()))
    middle = np.full((1, 2), (SIDE - 1) / 2.0)
    shift_px = (found.model.correction.apply(middle) - middle)[0]
    np.testing.assert_allclose(shift_px, MOVED_PX, atol=a_hundredth_of_a_pixel)
    assert found.qualification.point_counts.active >= 20


def test_missing_pixels_and_unknown_heights_give_no_points() -> None:
    pixels = land().copy()
    pixels[:, : SIDE // 2] = np.nan
    scene = ortho(pixels)
    heights = np.full((SIDE, SIDE), 40.0, dtype=np.float32)
    heights[: SIDE // 2] = np.nan
    grid = scene.model.grid  # type: ignore[attr-defined]
    known = GroundHeights(Terrain(grid, ArrayImage(heights), sigmas=3.0))
    points = produce_ortho_points([scene], known, replace(OPTIONS, points=100)).points
    seen = scene.model.project(points.lon_lat_h)
    # At most a tenth of a chip is missing.
    assert seen[:, 1].min() > SIDE / 2 + 0.4 * CHIP_SIZE - 1
    assert seen[:, 0].min() > SIDE / 2 - 1
    np.testing.assert_allclose(points.lon_lat_h[:, 2], 40.0)
    # A terrain model does not say whether roofs and trees are in it, and one image does not show it.
    assert points.surface is None


@pytest.mark.thorough
def test_scattered_saturated_pixels_cost_no_points() -> None:
    pixels = land().copy()
    pixels[np.random.default_rng(5).random(pixels.shape) < 300e-6] = np.inf
    found = produce_ortho_points([ortho(pixels)], FLAT, OPTIONS)
    assert len(found.points) == len(made().points)
    assert len(found.points.views.gsd_m) == len(made().points.views.gsd_m)
    scene = replace(ortho(moved(land(), *MOVED_PX)), sigma_m=30.0)
    active = [
        register_scene(scene, points.points, chips_of(points)).qualification.point_counts.active
        for points in (found, made())
    ]
    assert active[0] > 0.95 * active[1]


def test_a_patch_without_data_costs_the_points_that_it_covers() -> None:
    seen = ortho(land()).model.project(made().points.lon_lat_h)
    pixels = land().copy()
    for line, sample in seen.astype(int) + 15:  # beside every corner, 9 % of its chip
        pixels[line : line + 30, sample : sample + 30] = np.nan
    found = produce_ortho_points([ortho(pixels)], FLAT, OPTIONS)
    missing = np.array([(found.chips(row)[0] == 0).mean() for row in range(len(found.points))])
    assert len(missing) > 10
    assert (missing > 0.0).any()
    assert missing.max() <= 0.1


def test_points_on_both_sides_of_180_degrees_form_one_block() -> None:
    scene = ortho(land(), 1, AT_180_DEGREES_XY)
    found = produce_ortho_points([scene], FLAT, OPTIONS)
    lon = found.points.lon_lat_h[:, 0]
    assert (lon < -179.9).any()
    assert (lon > 179.9).any()
    assert np.ptp(found.outline[:, 0]) < 0.1
    assert chip_inside(scene.model, scene.image.shape, found.points.lon_lat_h, GSD_M).all()
    turned = lon[:, None] + [-360.0, 0.0, 360.0]
    west, east = found.outline[:, 0].min(), found.outline[:, 0].max()
    assert ((turned > west) & (turned < east)).any(axis=1).all()


def test_an_image_without_detail_gives_no_points() -> None:
    with pytest.raises(NotEnoughPoints, match="salient corners of known height in"):
        produce_ortho_points([ortho(np.zeros((SIDE, SIDE)))], FLAT, OPTIONS)


def test_an_image_that_is_not_rectified_is_refused() -> None:
    with pytest.raises(InputError, match="an ortho-image is needed: positions in this scene "):
        produce_ortho_points([block_views()[0].as_scene(5.0)], FLAT, OPTIONS)


def test_a_fine_sampling_above_the_coarse_one_is_refused() -> None:
    options = OrthoPointOptions(fine_gsd_m=20.0, coarse_gsd_m=10.0)
    with pytest.raises(InputError, match="20 and 10 m given: expected a fine one above 0 and below"):
        produce_ortho_points([ortho(land())], FLAT, options)
