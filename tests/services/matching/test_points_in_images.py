"""Points measured by their chips in several images, and how distinct a chip is."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.multi_image import (
    RefinementOptions,
    chip_inside,
    chip_saliency,
    nearly_whole,
    reference_chip,
    refine_on_chips,
    seen_whole,
)
from amers.services.registration.rescaled import rescaled_scene
from amers.services.types import Array, FloatImage
from tests.services.registration.small_ground import GSD_M, scene, whole
from tests.services.textures import as_pixels, texture

SIDE = 400
FIRST = (1024 - SIDE) // 2
AXIS = FIRST + np.linspace(80.0, 320.0, 4)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), -1).reshape(-1, 2)
OFF_M = np.array([[0.0, 0.0], [3.1, -2.2], [-4.0, 1.3]])
"""East and north by which the models of three images are off."""
INCIDENCE_DEG = (12.0, 4.0, 25.0)
NOISE = (60.0, 90.0, 120.0)


def ground() -> Array:
    return whole().model.locate(GRID, np.zeros(len(GRID)))


def images() -> list[Scene]:
    """Three images with noise of their own, the second of which is the most vertical."""
    made = []
    for number, (off_m, incidence_deg, noise) in enumerate(
        zip(OFF_M, INCIDENCE_DEG, NOISE, strict=True)
    ):
        one = scene(off_m, 5.0)
        added = np.random.default_rng(number).normal(0.0, noise, (SIDE, SIDE)).astype(np.float32)
        taken = replace(one.acquisition, image_id=f"image {number}", incidence_deg=incidence_deg)
        made.append(
            replace(
                one,
                image=ArrayImage(one.image.read(Window(0, 0, SIDE, SIDE)) + added),
                acquisition=taken,
            )
        )
    return made


def test_every_image_has_the_position_of_what_the_most_vertical_one_shows_at_the_point() -> None:
    found = refine_on_chips(images(), ground(), GSD_M).observations
    assert len(found) == 3 * len(GRID)
    # The most vertical image defines the detail, which its model shows at the point.
    detail = GRID - FIRST - OFF_M[1][::-1] * [-1.0, 1.0] / GSD_M
    for image in range(3):
        rows = found.image == image
        np.testing.assert_array_equal(np.sort(found.point[rows]), np.arange(len(GRID)))
        error_px = found.line_sample[rows] - detail[found.point[rows]]
        limit_px = 1e-3 if image == 1 else 0.3
        assert np.abs(error_px).max() < limit_px
        if image != 1:
            assert 0.5 < np.square(error_px / found.sigma_px[rows, None]).mean() < 2.0


def test_what_defines_a_detail_is_as_precise_as_the_best_of_the_others() -> None:
    found = refine_on_chips(images(), ground(), GSD_M).observations
    for point in range(len(GRID)):
        sigma_px = {int(found.image[k]): found.sigma_px[k] for k in np.flatnonzero(found.point == point)}
        assert sigma_px[1] == pytest.approx(min(sigma_px[0], sigma_px[2]), rel=1e-3)
    stated = [np.median(found.sigma_px[found.image == image]) for image in (0, 2)]
    assert stated[0] < stated[1], "noise of 60 and of 120"


def test_positions_and_sigmas_are_in_pixels_of_their_own_image() -> None:
    """The first image with pixels of half the size: both are twice as many, and the others stay."""
    plain = images()
    pixels = plain[0].image.read(Window(0, 0, SIDE, SIDE)).repeat(2, axis=0).repeat(2, axis=1)
    finer = replace(rescaled_scene(plain[0], 2.0), image=ArrayImage(pixels))
    before, after = (
        refine_on_chips(of, ground(), GSD_M).observations for of in (plain, [finer, *plain[1:]])
    )
    np.testing.assert_array_equal(after.image, before.image)
    own = before.image == 0
    times = np.where(own, 2.0, 1.0)
    place = before.line_sample * times[:, None] + 0.5 * own[:, None]
    np.testing.assert_allclose(after.line_sample, place, atol=0.1)
    np.testing.assert_allclose(after.sigma_px, before.sigma_px * times, rtol=0.1)


def test_no_measure_is_more_precise_than_is_believed() -> None:
    limits = RefinementOptions(min_sigma_px=0.5)
    found = refine_on_chips(images(), ground(), GSD_M, limits).observations
    np.testing.assert_allclose(found.sigma_px, 0.5, rtol=1e-3)


def test_points_that_one_image_shows_or_that_are_found_nowhere_else_are_not_measured() -> None:
    other = scene(np.array([60.0, 0.0]), 5.0)
    pair = [images()[0], replace(other, acquisition=replace(other.acquisition, image_id="off"))]
    measures = refine_on_chips(pair, ground(), GSD_M)
    assert len(measures.observations) == 0
    assert (measures.saliency > 0.0).any()
    alone = refine_on_chips(images()[:1], ground(), GSD_M)
    assert len(alone.observations) == 0
    assert not alone.saliency.any()


def test_images_that_show_a_whole_chip_are_those_with_room_for_it_the_most_vertical_first() -> None:
    """Half a chip and two pixels, 52 of them, fit on each side, or not."""
    at = np.array(
        [[200.0, 52.5], [200.0, 51.5], [52.5, 200.0], [347.5, 346.5], [346.5, 347.5], [200, 200]]
    )
    places = whole().model.locate(at + FIRST, np.zeros(len(at)))
    of = scene(np.zeros(2), 5.0)
    inside = chip_inside(of.model, of.image.shape, places, GSD_M)
    np.testing.assert_array_equal(inside, [True, False, True, False, False, True])
    farther = chip_inside(of.model, of.image.shape, places, GSD_M, margin_px=20)
    np.testing.assert_array_equal(farther, [False] * 5 + [True])
    unknown = replace(images()[0], acquisition=replace(of.acquisition, incidence_deg=float("nan")))
    assert seen_whole([unknown, *images()], places[-1:], GSD_M) == [[2, 1, 3, 0]]


def test_the_first_image_that_shows_a_chip_nearly_whole_defines_it_or_else_the_last() -> None:
    lost = images()
    for number in (0, 1):
        pixels = lost[number].image.read(Window(0, 0, SIDE, SIDE))
        pixels[190:210, 100:300] = np.nan
        lost[number] = replace(lost[number], image=ArrayImage(pixels))
    place = whole().model.locate(np.array([[FIRST + 200.0, FIRST + 200.0]]), np.zeros(1))[0]
    assert reference_chip(lost, [1, 0, 2], place, GSD_M)[0] == 2
    assert reference_chip(lost, [1, 2, 0], place, GSD_M)[0] == 2
    assert reference_chip(lost, [1, 0], place, GSD_M)[0] == 0
    assert reference_chip(images(), [1, 0], place, GSD_M)[0] == 1


def chip() -> FloatImage:
    return as_pixels(texture(np.random.default_rng(9), 128, 2.0))[:CHIP_SIZE, :CHIP_SIZE].copy()


def test_a_chip_is_nearly_whole_up_to_a_tenth_that_is_missing() -> None:
    pixels = chip()
    pixels.ravel()[: CHIP_SIZE**2 // 10] = np.nan
    assert nearly_whole(pixels)
    pixels.ravel()[: CHIP_SIZE**2 // 10 + 1] = np.inf
    assert not nearly_whole(pixels)
    assert chip_saliency(pixels) == 0.0


def test_the_saliency_is_what_the_core_lacks_of_being_elsewhere_in_the_chip() -> None:
    """All places of its inner 51 pixels but those within four pixels of the middle, one by one."""
    pixels = chip()
    core = pixels[25:76, 25:76].ravel().astype(np.float64)
    best = -1.0
    for row, column in np.ndindex(51, 51):
        if max(abs(row - 25), abs(column - 25)) > 4:
            under = pixels[row : row + 51, column : column + 51].ravel()
            best = max(best, float(np.corrcoef(core, under)[0, 1]))
    assert chip_saliency(pixels) == pytest.approx(1.0 - best, abs=1e-4)
    assert chip_saliency(pixels.T.copy()) == pytest.approx(chip_saliency(pixels), abs=1e-6)


def test_lines_patterns_and_even_ground_are_not_salient() -> None:
    line = np.tile(chip()[:, :1], (1, CHIP_SIZE))
    pattern = np.tile(as_pixels(texture(np.random.default_rng(1), 16, 1.5)), (7, 7))
    for pixels in (line, line.T.copy(), pattern[:CHIP_SIZE, :CHIP_SIZE].copy()):
        assert chip_saliency(pixels) < 0.01
    even = np.full((CHIP_SIZE, CHIP_SIZE), 500.0, dtype=np.float32)
    even[:20] += chip()[:20]
    assert chip_saliency(even) == 0.0
