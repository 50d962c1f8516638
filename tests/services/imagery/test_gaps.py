"""Gaps of images: small ones are bridged, large ones are lost, and nothing else changes."""

import cv2
import numpy as np
import pytest

from amers.services.imagery.gaps import bridged, filled, lost_pixels
from amers.services.imagery.resampling import resample, spline_coefficients
from amers.services.imagery.source import ArrayImage, low_pass, sample_image
from amers.services.types import FloatImage

a_tenth_of_the_contrast = 0.1


def ground(side: int = 200) -> FloatImage:
    """Noise with the detail of a well-focused image: mean 1000, standard deviation 200."""
    noise = np.random.default_rng(3).normal(0.0, 1.0, (side, side)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.asarray(1000.0 + 200.0 * smooth / smooth.std(), dtype=np.float32)


def test_pixels_without_gaps_are_returned_as_they_are() -> None:
    pixels = ground()
    assert bridged(pixels) is pixels


@pytest.mark.parametrize("lost", [np.nan, np.inf])
@pytest.mark.parametrize(
    "hole", [np.s_[50:51, 60:61], np.s_[50:52, 60:62], np.s_[50:51, 60:63], np.s_[:, 60:61]]
)
def test_a_hole_of_two_pixels_and_a_dead_column_are_bridged(lost: float, hole) -> None:
    pixels = ground()
    truth = pixels.copy()
    pixels[hole] = lost
    mended = bridged(pixels)
    valid = np.isfinite(pixels)
    np.testing.assert_array_equal(mended[valid], truth[valid])
    assert np.isfinite(mended).all()
    assert np.abs(mended - truth)[hole].mean() < 200.0


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_an_area_is_lost_and_the_valid_pixels_beside_it_are_kept(lost: float) -> None:
    pixels = ground()
    truth = pixels.copy()
    pixels[50:60, 60:75] = lost
    mended = bridged(pixels)
    area = np.zeros(pixels.shape, dtype=bool)
    area[50:60, 60:75] = True
    np.testing.assert_array_equal(mended[~area], truth[~area])
    inside = mended[51:59, 61:74]
    assert (inside == np.inf).all() if lost == np.inf else np.isnan(inside).all()


def test_an_area_has_the_kind_of_most_of_its_pixels() -> None:
    pixels = ground()
    pixels[20:30, 20:40] = np.inf
    pixels[20:30, 26:28] = np.nan
    pixels[60:70, 20:40] = np.nan
    pixels[64, 30] = np.inf
    lost = lost_pixels(pixels, 2.0)
    assert (lost[25, 22:38] == np.inf).all()
    assert np.isnan(lost[65, 22:38]).all()


def test_all_pixels_lost_are_filled_with_zeros() -> None:
    np.testing.assert_array_equal(filled(np.full((5, 7), np.inf, np.float32)), np.zeros((5, 7)))


def test_a_gap_has_the_weighted_mean_of_the_valid_pixels_within_four() -> None:
    """By the definition, at single gaps and in a large one; far from any valid pixel the mean of all."""
    rng = np.random.default_rng(6)
    pixels = rng.normal(100.0, 10.0, (30, 36)).astype(np.float32)
    pixels[rng.random(pixels.shape) < 0.1] = np.nan
    pixels[4:, 14:] = np.inf
    pixels[20, 30] = 7.0
    valid = np.isfinite(pixels)
    expected = np.where(valid, pixels, pixels[valid].mean())
    for i, j in np.argwhere(~valid):
        lines, samples = np.nonzero(valid)
        near = (np.abs(lines - i) <= 4) & (np.abs(samples - j) <= 4)
        if near.any():
            apart = (lines[near] - i) ** 2 + (samples[near] - j) ** 2
            weight = np.exp(-0.5 * apart / 0.8**2)
            expected[i, j] = weight @ pixels[lines[near], samples[near]] / weight.sum()
    np.testing.assert_allclose(filled(pixels), expected, rtol=1e-6)


@pytest.mark.parametrize("lost", [np.nan, np.inf])
@pytest.mark.parametrize("ratio", [0.7, 1.0, 1.8, 2.5, 4.0, 9.0])
def test_scattered_gaps_change_samples_little_and_lose_none(lost: float, ratio: float) -> None:
    pixels = ground(400)
    axis = np.arange(60.0, 340.0, ratio) + 0.37
    positions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    truth = sample_image(ArrayImage(pixels), positions, ratio)
    damaged = pixels.copy()
    damaged[np.random.default_rng(1).random(pixels.shape) < 0.003] = lost
    sampled = sample_image(ArrayImage(damaged), positions, ratio)
    assert np.isfinite(sampled).mean() > 0.999
    difference = (sampled - truth)[np.isfinite(sampled)]
    assert np.sqrt(np.mean(difference**2)) < a_tenth_of_the_contrast * truth.std()


@pytest.mark.parametrize(("lost", "is_kind"), [(np.nan, np.isnan), (np.inf, np.isposinf)])
@pytest.mark.parametrize("ratio", [0.7, 1.0, 2.5, 9.0])
@pytest.mark.parametrize("phase", [0.0, 0.37])
def test_samples_in_an_area_have_its_kind_and_those_outside_their_values(
    lost: float, is_kind, ratio: float, phase: float
) -> None:
    pixels = ground(400)
    axis = np.arange(60.0, 340.0, ratio) + phase
    positions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    truth = sample_image(ArrayImage(pixels), positions, ratio)
    damaged = pixels.copy()
    damaged[150:250, 150:250] = lost
    sampled = sample_image(ArrayImage(damaged), positions, ratio)
    outside = np.abs(positions - 199.5).max(axis=2) - 50.0
    assert is_kind(sampled[outside < -1.0]).all()
    away = outside > 2.5 + 2.0 * ratio
    assert np.isfinite(sampled[away]).all()
    assert np.abs(sampled - truth)[away].max() < a_tenth_of_the_contrast * truth.std()


def test_a_gap_has_the_same_effect_in_every_window() -> None:
    pixels = ground(400)
    pixels[np.random.default_rng(1).random(pixels.shape) < 0.01] = np.nan
    image = ArrayImage(pixels)
    axis = np.arange(100.0, 300.0, 2.5)
    positions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    whole, part = sample_image(image, positions, 2.5), sample_image(image, positions[20:60, 20:60], 2.5)
    np.testing.assert_allclose(part, whole[20:60, 20:60], atol=0.05)


def test_a_low_pass_bridges_gaps_and_keeps_areas_lost() -> None:
    pixels = ground()
    truth = low_pass(pixels, 3.0)
    pixels[50, 50] = np.inf
    pixels[100:120, 100:120] = np.nan
    smooth = low_pass(pixels, 3.0)
    assert abs(smooth[50, 50] - truth[50, 50]) < a_tenth_of_the_contrast * truth.std()
    assert np.isnan(smooth[102:118, 102:118]).all()
    assert np.isfinite(smooth[:98]).all()


@pytest.mark.parametrize(("lost", "is_kind"), [(np.nan, np.isnan), (np.inf, np.isposinf)])
def test_a_position_has_a_value_when_none_of_the_pixels_of_its_spline_is_lost(
    lost: float, is_kind
) -> None:
    """Four by four pixels around it: those two beside the position count as those next to it do."""
    pixels = ground(60)
    pixels[20:32, 24:40] = lost
    missing = ~np.isfinite(spline_coefficients(pixels))
    axis = np.arange(8.25, 50.0, 0.5)
    positions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    first = np.floor(positions).astype(int) - 1
    count = sum(missing[first[..., 0] + i, first[..., 1] + j] for i in range(4) for j in range(4))
    sampled = resample(spline_coefficients(pixels), positions)
    np.testing.assert_array_equal(np.isfinite(sampled), count == 0)
    assert is_kind(sampled[count > 0]).all()
    assert ((count > 0) & (count < 4)).any()


def test_swapped_axes_and_whole_pixels_change_no_sample() -> None:
    pixels = ground(80)
    pixels[30:36, 40:50] = np.nan
    axis = np.arange(20.0, 60.0, 0.37)
    positions = np.stack(np.meshgrid(axis, axis + 0.11, indexing="ij"), axis=-1)
    plain = resample(spline_coefficients(pixels), positions)
    turned = resample(spline_coefficients(np.ascontiguousarray(pixels.T)), positions[..., ::-1])
    padded = np.pad(pixels, ((7, 0), (0, 5)), mode="edge")
    moved = resample(spline_coefficients(padded), positions + [7.0, 0.0])
    for other in (turned, moved):
        np.testing.assert_array_equal(np.isnan(other), np.isnan(plain))
        np.testing.assert_allclose(other, plain, atol=0.5)
