"""Damaged pixels, displaced detectors, blur and another terrain are as large as requested."""

import cv2
import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.imagery.source import ArrayImage, Window
from amers.services.simulation.defects import Damage, DamagedImage
from amers.services.simulation.detectors import Detectors
from amers.services.simulation.render import BRIGHTEST
from amers.services.simulation.tiles import TILE_PX, TiledView
from amers.services.simulation.view import ViewGeometry
from amers.services.simulation.world import World, with_smoother_terrain
from amers.services.types import Array

SHAPE = (700, 900)
WHOLE = Window(0, 0, *SHAPE)
IMAGE = ArrayImage(
    np.random.default_rng(1).integers(1, BRIGHTEST, SHAPE).astype(np.float32)  # never the largest
)
rounding = 2.0


@pytest.mark.parametrize("share", [1e-3, 0.05])
@pytest.mark.parametrize("missing", [0.0, 0.3, 1.0])
def test_single_pixels_are_damaged_in_their_share(share: float, missing: float) -> None:
    pixels = DamagedImage(IMAGE, Damage(share=share, missing=missing), 5).read(WHOLE)
    n = pixels.size
    for part, expected in (
        (np.isnan(pixels), share * missing),
        (np.isinf(pixels), share * (1 - missing)),
    ):
        four_sigma = 4.0 * np.sqrt(expected * n)
        assert part.sum() == pytest.approx(expected * n, abs=four_sigma)
    whole = np.isfinite(pixels)
    np.testing.assert_array_equal(pixels[whole], IMAGE.pixels[whole])


def test_squares_are_damaged_as_a_whole() -> None:
    pixels = DamagedImage(IMAGE, Damage(share=0.05, patch_px=20), 5).read(WHOLE)
    squares = np.isinf(pixels).reshape(35, 20, 45, 20).mean(axis=(1, 3))
    assert set(np.unique(squares)) == {0.0, 1.0}
    assert squares.mean() == pytest.approx(0.05, abs=0.025)


def test_the_brightest_pixels_are_those_that_are_saturated() -> None:
    pixels = DamagedImage(IMAGE, Damage(share=0.02, brightest=True), 5).read(WHOLE)
    saturated = np.isinf(pixels)
    assert saturated.mean() == pytest.approx(0.02, abs=0.004)
    assert IMAGE.pixels[saturated].min() > IMAGE.pixels[~saturated].max()


@pytest.mark.parametrize("bits", [8, 10, 11, 12, 16])
def test_pixels_are_rounded_to_their_bits(bits: int) -> None:
    pixels = DamagedImage(IMAGE, Damage(bits=bits), 5).read(WHOLE)
    top = 2.0**bits - 1.0
    assert np.isfinite(pixels).all()
    assert (pixels == np.rint(pixels)).all()
    assert 1.0 <= pixels.min() <= pixels.max() <= top
    error = np.abs(pixels - IMAGE.pixels * top / BRIGHTEST)
    assert error[pixels > 1.0].max() < 0.51


def test_damage_does_not_depend_on_the_window_that_is_read() -> None:
    image = DamagedImage(IMAGE, Damage(8, 0.05, 0.5, 7), 5)
    whole = image.read(WHOLE)
    part = image.read(Window(333, 120, 50, 60))
    np.testing.assert_array_equal(part, whole[333:383, 120:180])
    outside = image.read(Window(-20, -20, 40, 40))
    assert np.isnan(outside[:20]).all()
    np.testing.assert_array_equal(outside[20:, 20:], whole[:20, :20])


@pytest.mark.parametrize("wrong", [{"share": 1.1}, {"missing": -0.1}, {"bits": 7}, {"patch_px": 0}])
def test_wrong_damage_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        Damage(**wrong)  # type: ignore[arg-type]


def test_a_part_of_the_detectors_shows_what_lies_beside(world: World, taken: ViewGeometry) -> None:
    perfect = TiledView(world, taken, 1).read(Window(0, 0, 300, 330))
    steps = np.array([[0.0, 0.0], [2.0, -3.0]])
    detectors = Detectors(steps)
    seamed = TiledView(world, taken, 1, detectors=detectors).read(Window(0, 0, 300, 330))
    seam = 3 * TILE_PX
    lines = slice(0, 250)
    assert np.abs(seamed[lines, :seam] - perfect[lines, :seam]).max() <= rounding
    np.testing.assert_allclose(
        seamed[:298, seam:330], perfect[2:300, seam - 3 : 327], rtol=0, atol=rounding
    )
    places = np.array([[10.0, seam - 1.0], [10.0, seam - 0.4], [10.0, 329.0]])
    np.testing.assert_array_equal(detectors.seen(places, 330) - places, steps[[0, 1, 1]])


@pytest.mark.parametrize("parts", [1, 2, 3, 6])
def test_parts_of_the_detectors_follow_one_another_over_the_image(parts: int) -> None:
    """Six tiles, the last of 10 samples; what lies beyond the image belongs to its first and last."""
    steps = np.arange(2.0 * parts).reshape(parts, 2)
    sample = np.array([-100.0, 0.0, 63.4, 63.6, 150.0, 200.0, 260.0, 319.4, 319.6, 329.0, 500.0])
    tile = np.array([0, 0, 0, 1, 2, 3, 4, 4, 5, 5, 5])
    places = np.column_stack([np.full(len(sample), 7.0), sample])
    moved = Detectors(steps).seen(places, 330) - places
    np.testing.assert_allclose(moved, steps[tile // (6 // parts)], atol=1e-9)


def test_a_blur_is_that_of_the_whole_image_and_has_no_tiles(world: World, taken: ViewGeometry) -> None:
    window = Window(0, 0, 300, 330)
    perfect = TiledView(world, taken, 1).read(window)
    blurred = TiledView(world, taken, 1, detectors=Detectors(np.zeros((1, 2)), (1.5, 0.8))).read(window)
    expected = cv2.GaussianBlur(perfect, (0, 0), sigmaX=0.8, sigmaY=1.5)
    inner = np.s_[8:-8, 8:-8]
    unclipped = cv2.dilate((perfect >= BRIGHTEST).astype(np.uint8), np.ones((15, 15)))[inner] == 0
    assert unclipped.mean() > 0.5
    assert np.abs(blurred - expected)[inner][unclipped].max() <= rounding


def test_another_terrain_differs_between_its_nodes_only_by_a_little(world: World) -> None:
    smoother = with_smoother_terrain(world, 60.0)
    difference_m: Array = smoother.terrain_m - world.terrain_m
    assert 0.02 < difference_m.std() < 2.0
    assert abs(difference_m.mean()) < 0.2 * difference_m.std()
    assert smoother.steepest_slope < 1.05 * world.steepest_slope
