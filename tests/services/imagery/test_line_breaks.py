"""Lost and repeated lines are seen in the pixels, at their lines, and nothing else is taken for them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.line_breaks import line_breaks
from amers.services.imagery.source import ArrayImage, Window
from amers.services.types import FloatImage
from tests.services.imagery.textures import Watched

LINES, SAMPLES = 900, 700
REAL_VIEWS = (
    "phr_calanques_triplet/img_01.tif",
    "phr_calanques_triplet/img_03.tif",
    "phr_gizeh_pair/img1.tif",
    "phr_iceland_pair/img_02.tif",
    "phr_ventoux_pair/left_image.tif",
)


def ground(seed: int, shape: tuple[int, int] = (LINES, SAMPLES), noise: float = 3.0) -> FloatImage:
    """Pixels of ground that a sensor blurs, with its noise."""
    rng = np.random.default_rng(seed)
    fine = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), 1.2)
    coarse = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), 6.0)
    image = 500.0 + 300.0 * fine + 900.0 * coarse + noise * rng.normal(size=shape)
    return np.asarray(image, dtype=np.float32)


def broken(pixels: FloatImage, line: int, lost: int) -> FloatImage:
    """The image without some lines from one on; a negative number of them is repeated."""
    return np.concatenate([pixels[:line], pixels[line + lost :]])


def found(pixels: FloatImage) -> list[int]:
    return line_breaks(ArrayImage(pixels)).tolist()


@pytest.mark.parametrize("lost", [2, 3, 10, 100, -3, -10, -100])
def test_lost_and_repeated_lines_are_seen_at_their_line(lost: int) -> None:
    """From the first line on, and from the last."""
    for seed in range(4):
        line = int(np.random.default_rng(seed).integers(150, LINES - 250))
        pixels = broken(ground(seed), line, lost)
        assert found(pixels) == [line]
        assert found(pixels[::-1]) == [len(pixels) - line]


@pytest.mark.parametrize(("line", "told"), [(4, False), (8, False), (9, True), (20, True)])
def test_nearer_than_eight_lines_to_the_first_and_to_the_last_nothing_is_told(
    line: int, told: bool
) -> None:
    for seed in range(4):
        pixels = broken(ground(seed), line, 30)
        assert found(pixels) == ([line] if told else [])
        assert found(pixels[::-1]) == ([len(pixels) - line] if told else [])


@pytest.mark.long
def test_an_image_that_is_whole_has_no_breaks() -> None:
    assert not any(found(ground(seed)) for seed in range(20))


def test_each_of_several_breaks_is_seen() -> None:
    twice = broken(broken(ground(1), 600, 20), 200, -7)
    assert found(twice) == [200, 607]


def test_a_break_is_seen_where_half_of_the_image_has_no_pixels_or_is_saturated() -> None:
    pixels = broken(ground(2), 400, 12)
    pixels[:, : SAMPLES // 4] = np.nan
    pixels[:, -SAMPLES // 4 :] = np.inf
    assert found(pixels) == [400]


def test_bad_lines_are_no_breaks() -> None:
    pixels = ground(3)
    pixels[[120, 300, 555]] = np.random.default_rng(3).normal(500.0, 50.0, (3, SAMPLES))
    assert not found(pixels)


@pytest.mark.long
def test_a_sensor_that_changes_its_gain_or_its_offset_breaks_nothing() -> None:
    across = np.linspace(-300.0, 300.0, SAMPLES, dtype=np.float32)
    for seed in range(4):
        for gain, offset in ((1.0, 60.0), (1.2, 0.0), (0.9, across)):
            pixels = ground(seed)
            pixels[450:] = gain * pixels[450:] + offset
            assert not found(pixels)


@pytest.mark.parametrize(("parts", "told"), [(8, True), (5, False)])
def test_what_chance_makes_at_some_line_of_many_is_no_break(parts: int, told: bool) -> None:
    """Of 8 parts, 5 differ most at a given line once in 30,000: at some of 900 in every 30th image."""
    width = SAMPLES // 32
    for seed in range(4):
        pixels = ground(seed)
        pixels[:, : parts * width] = broken(ground(seed, (LINES + 12, SAMPLES)), 450, 12)[
            :, : parts * width
        ]
        pixels[:, 8 * width :] = np.nan
        assert found(pixels) == ([450] if told else [])


def test_a_break_is_seen_where_the_sensor_changes_its_gain() -> None:
    pixels = broken(ground(5), 450, 12)
    pixels[450:] = 1.2 * pixels[450:] + 60.0
    assert found(pixels) == [450]


def test_blocks_of_a_compression_are_no_breaks() -> None:
    pixels = ground(4)
    level = np.random.default_rng(4).normal(0.0, 60.0, (LINES // 8 + 1, SAMPLES // 8 + 1))
    blocks = np.kron(level, np.ones((8, 8)))[:LINES, :SAMPLES]
    assert not found(pixels + blocks.astype(np.float32))


@pytest.mark.parametrize(("every", "told"), [(40, False), (200, True)])
def test_lines_that_differ_no_more_than_others_of_the_image_are_no_breaks(
    every: int, told: bool
) -> None:
    """Seven of 300 lines begin other ground, as tiles of a compression would: none of them is broken."""
    lines = np.arange(every, 300, every)
    for seed in range(4):
        pixels = np.concatenate(
            [ground(10 * seed + k, (300, SAMPLES))[:every] for k in range(len(lines) + 1)]
        )[:300]
        assert found(pixels) == (lines.tolist() if told else [])


def test_an_edge_of_the_ground_along_a_line_is_no_break() -> None:
    pixels = ground(5)
    pixels[450:, : SAMPLES // 3] += 400.0
    assert not found(pixels)


def test_an_image_of_one_value_or_of_few_lines_has_no_breaks() -> None:
    assert not found(np.full((300, 300), 7.0, dtype=np.float32))
    assert not found(np.full((300, 300), np.nan, dtype=np.float32))
    assert not found(ground(6, (10, 300)))
    assert not found(ground(6, (300, 5)))


@pytest.mark.thorough
def test_of_a_wide_image_strips_are_read_piece_by_piece() -> None:
    lines = 2500
    image = Watched(broken(ground(7, (lines + 30, 6000)), 1800, 30))
    assert line_breaks(image).tolist() == [1800]
    assert max(one.lines * one.samples for one in image.windows) < 1_000_000
    assert sum(one.samples for one in image.windows if one.line == 0) < 2_500


@pytest.mark.real_data
@pytest.mark.parametrize("file", REAL_VIEWS)
def test_real_images_are_whole_until_lines_are_taken_out(real_data: Path, file: str) -> None:
    image = read_scene(real_data / file).image
    pixels = image.read(Window(0, 0, *image.shape))
    assert not found(pixels)
    assert not found(np.ascontiguousarray(pixels.T))
    rng = np.random.default_rng(1)
    drawn = [(int(rng.integers(130, len(pixels) - 130)), lost) for lost in (3, 8, 40, -5, -25) * 3]
    seen = [found(broken(pixels, line, lost)) == [line] for line, lost in drawn]
    assert np.mean(seen) > 0.9
