"""What is wrong with pixels is named with its place and size; ground, files and weather are not."""

from collections.abc import Callable
from itertools import cycle

import cv2
import numpy as np
import pytest

from amers.services.imagery.jump_sizes import jump_px
from amers.services.imagery.line_profiles import TransposedImage, line_profile
from amers.services.imagery.pixel_checks import (
    Fault,
    PixelFinding,
    pixel_findings,
    pixel_statistics,
)
from amers.services.imagery.source import ArrayImage
from amers.services.types import FloatImage
from tests.services.imagery.textures import (
    SHAPE,
    TEXTURES,
    Watched,
    changed,
    compressed,
    hazy,
    interlaced,
    lost,
    moved,
    pasted,
    repeated,
    rounded,
    seen_twice,
    texture,
)

DTYPES = ("uint8", "uint16", "float32")
PLACES = (0.1, 0.5, 0.9)
STORED = tuple(zip(TEXTURES, cycle(DTYPES)))
"""Textures as they are stored: each in one way, each way twice."""
STRUCTURED = tuple(one for one in STORED if one[0] != "speckle")


def found(pixels: FloatImage) -> list[PixelFinding]:
    return list(pixel_findings(ArrayImage(np.asarray(pixels, np.float32))).findings)


def kinds(pixels: FloatImage) -> list[Fault]:
    return [one.kind for one in found(pixels)]


@pytest.mark.parametrize(("name", "dtype"), STORED)
def test_repeated_lines_are_named_with_their_lines(name: str, dtype: str) -> None:
    pixels = texture(name, 1)
    for place in PLACES:
        for count in (1, 3, 40):
            first = int(place * SHAPE[0])
            (one,) = found(rounded(repeated(pixels, first, count), dtype))
            assert (one.kind, one.line, one.lines) == (Fault.REPEATED_LINES, first, count)
            assert (one.sample, one.samples, one.amount_px) == (0, SHAPE[1], count)
            assert f"line{'s' if count > 1 else ''} {first} " in one.words


def test_repeated_samples_are_named_with_their_samples() -> None:
    pixels = repeated(texture("rough", 2).T, 300, 7).T
    (one,) = found(rounded(pixels, "uint8"))
    assert (one.kind, one.sample, one.samples) == (Fault.REPEATED_SAMPLES, 300, 7)
    assert (one.line, one.lines) == (0, SHAPE[0])


def test_a_line_that_is_sent_again_and_again_is_one_finding() -> None:
    pixels = rounded(texture("fractal", 3), "uint16")
    pixels[200:212] = pixels[200]
    (one,) = found(pixels)
    assert (one.kind, one.line, one.lines) == (Fault.REPEATED_LINES, 201, 11)


@pytest.mark.parametrize(("name", "dtype"), STRUCTURED)
def test_lost_lines_are_named_between_their_neighbours(name: str, dtype: str) -> None:
    for place in (0.02, *PLACES):
        for count in (5, 30):
            first = int(place * SHAPE[0])
            (one,) = found(rounded(lost(texture(name, 4), first, count), dtype))
            assert (one.kind, one.line, one.lines) == (Fault.LOST_LINES, first - 1, 2)
            assert one.amount_px >= 1.0


@pytest.mark.parametrize("axis", [0, 1])
def test_so_many_lines_are_lost_as_the_difference_of_others_tells(axis: int) -> None:
    """Of a ramp, of which lines differ by as many steps as they are apart; 32 of them at most."""
    ramp = np.arange(400.0, dtype=np.float32)[:, None] * np.ones(200, np.float32)
    for count in (1, 2, 7, 31, 32, 40):
        for first in (50, 150):
            pixels = lost(ramp, first, count)
            image = ArrayImage(pixels) if axis == 0 else TransposedImage(ArrayImage(pixels.T))
            assert jump_px(image, first) == min(count, 32)


def test_pixels_of_flat_blocks_differ_from_one_neighbour_at_most() -> None:
    """In blocks of eight they tell that a line varies, and nothing of its detail."""
    blocks = np.repeat(np.arange(20.0, dtype=np.float32), 8)[None] * np.ones((3, 1), np.float32)
    ramp = np.arange(160.0, dtype=np.float32)[None] * np.ones((3, 1), np.float32)
    for pixels, varying, detailed in ((blocks, 19, 0), (ramp, 159, 158)):
        profile = line_profile(ArrayImage(pixels))
        assert profile.varying.tolist() == [varying] * 3
        assert profile.detailed.tolist() == [detailed] * 3
        assert profile.equal.tolist() == [False, True, True]


def test_lines_repeated_before_a_compression_are_named_as_repeated() -> None:
    (one,) = found(compressed(repeated(texture("fractal", 5), 320, 24), 85))
    assert (one.kind, one.amount_px) == (Fault.REPEATED_LINES, 24.0)


@pytest.mark.parametrize(("name", "dtype"), STRUCTURED)
def test_odd_lines_and_samples_aside_are_measured(name: str, dtype: str) -> None:
    for apart in (0.3, -1.0, 12.0):
        (one,) = found(rounded(interlaced(texture(name, 6), apart), dtype))
        assert one.kind is Fault.ODD_LINES
        assert one.amount_px == pytest.approx(abs(apart), abs=0.05)
        (one,) = found(rounded(interlaced(texture(name, 6).T, apart).T, dtype))
        assert one.kind is Fault.ODD_SAMPLES


@pytest.mark.parametrize("name", TEXTURES)
def test_a_second_image_is_measured(name: str) -> None:
    for line, sample in ((5, 5), (0, 9), (30, -41), (0, 80)):
        (one,) = found(rounded(seen_twice(texture(name, 7), line, sample), "uint16"))
        assert one.kind is Fault.SECOND_IMAGE
        assert one.amount_px == pytest.approx(np.hypot(line, sample), abs=0.01)


@pytest.mark.parametrize(("name", "dtype"), STRUCTURED[:4])
def test_a_part_of_another_image_is_named_at_a_corner(name: str, dtype: str) -> None:
    for corner in ((64, 48), (256, 208)):
        for apart in (5, 20):
            (one,) = found(rounded(pasted(texture(name, 8), corner, 224, apart), dtype))
            assert one.kind is Fault.PART
            borders = (corner[0], corner[0] + 224, corner[1], corner[1] + 224)
            assert min(abs(one.line - borders[0]), abs(one.line + one.lines - borders[1])) <= 2
            assert min(abs(one.sample - borders[2]), abs(one.sample + one.samples - borders[3])) <= 2


def test_a_part_that_shows_what_lies_beside_it_has_its_displacement() -> None:
    (one,) = found(pasted(texture("fractal", 9), (200, 160), 224, 9))
    assert one.amount_px == pytest.approx(9.0 * np.sqrt(2.0), abs=0.01)
    assert "+9 px in line and +9 px in sample" in one.words


@pytest.mark.parametrize(("line", "sample"), [(1.5, 0.0), (0.0, -0.5), (20.0, 31.0)])
def test_bands_that_lie_apart_are_measured(line: float, sample: float) -> None:
    pixels = texture("fields", 10)
    bands = [ArrayImage(pixels), ArrayImage(moved(4000.0 - 0.5 * pixels, line, sample))]
    (one,) = pixel_findings(bands[0], bands).findings
    assert one.kind is Fault.BANDS
    assert one.amount_px == pytest.approx(np.hypot(line, sample), abs=0.05)


def test_bands_that_lie_on_each_other_or_show_different_things_are_not_accused() -> None:
    pixels = texture("fields", 11)
    on_it = ArrayImage(moved(pixels, 0.1, -0.1))
    other = ArrayImage(texture("rough", 12))
    assert not pixel_findings(ArrayImage(pixels), [ArrayImage(pixels), on_it, other]).findings


def _enlarged(factor: float, how: int) -> Callable[[FloatImage], FloatImage]:
    return lambda pixels: np.asarray(
        cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=how), np.float32
    )


def _rotated(pixels: FloatImage) -> FloatImage:
    """A rotated ortho-image: no data in its corners."""
    lines, samples = pixels.shape
    matrix = cv2.getRotationMatrix2D((samples / 2, lines / 2), 12.0, 1.0)
    turned, inside = (
        cv2.warpAffine(one, matrix, (samples, lines), flags=flags)
        for one, flags in ((pixels, cv2.INTER_CUBIC), (np.ones_like(pixels), cv2.INTER_NEAREST))
    )
    turned[inside == 0.0] = np.nan
    return np.asarray(turned)


def _with_water(pixels: FloatImage) -> FloatImage:
    """Ground with flat water and snow, of which lines are equal, and lost pixels around."""
    out = pixels.copy()
    out[200:330, :300], out[400:, 300:] = 37.0, 4000.0
    out[:20], out[:, -33:] = np.nan, np.nan
    return out


def _saturated(pixels: FloatImage) -> FloatImage:
    return np.where(pixels > np.percentile(pixels, 85.0), np.float32(np.inf), pixels)


CLEAN: dict[str, Callable[[FloatImage], FloatImage]] = {
    **{dtype: lambda pixels, dtype=dtype: rounded(pixels, dtype) for dtype in DTYPES},  # type: ignore[misc]
    "jpeg 90": lambda pixels: compressed(pixels, 90),
    "jpeg 50": lambda pixels: compressed(pixels, 50),
    "jpeg 15": lambda pixels: compressed(pixels, 15),
    "twice, linear": _enlarged(2.0, cv2.INTER_LINEAR),
    "twice, cubic": _enlarged(2.0, cv2.INTER_CUBIC),
    "1.5 times": _enlarged(1.5, cv2.INTER_CUBIC),
    "reduced": _enlarged(0.7, cv2.INTER_LINEAR),
    "rotated": _rotated,
    "water": _with_water,
    "saturated": _saturated,
    "mirrored": lambda pixels: np.pad(pixels[7:-9, 5:-11], ((7, 9), (5, 11)), mode="reflect"),
    "other gain": lambda pixels: np.concatenate([pixels[:300], 1.2 * pixels[300:] + 60.0]),
    "changed": lambda pixels: changed(pixels, 300, 100),
    "haze": lambda pixels: hazy(pixels, 300, 0.4),
}


@pytest.mark.parametrize("name", TEXTURES)
@pytest.mark.parametrize("way", CLEAN)
def test_what_people_do_with_images_and_what_ground_does_is_no_fault(name: str, way: str) -> None:
    if (name, way) == ("town", "water"):
        pytest.skip("outlines along the axes that end at flat water along them are taken for a part")
    assert not kinds(CLEAN[way](texture(name, 13)))


@pytest.mark.parametrize("factor", [2.0, 3.0, 1.5])
def test_an_image_enlarged_by_nearest_neighbour_is_named_as_a_whole(factor: float) -> None:
    for name in TEXTURES:
        (one,) = found(_enlarged(factor, cv2.INTER_NEAREST)(rounded(texture(name, 14), "uint8")))
        assert (one.kind, one.line, one.sample) == (Fault.DOUBLED, 0, 0)
        assert "the whole image" in one.words


def test_equal_lines_of_flat_ground_are_no_evidence() -> None:
    assert not kinds(np.full((300, 300), 7.0))
    assert not kinds(np.full((300, 300), np.nan))
    flat = texture("rough", 15)
    flat[100:400] = np.repeat(np.arange(35, dtype=np.float32), 16)
    assert Fault.REPEATED_LINES not in kinds(flat)


def test_a_bad_line_is_no_lost_line() -> None:
    pixels = texture("fractal", 16)
    pixels[[120, 300, 555]] = np.random.default_rng(3).normal(400.0, 50.0, (3, SHAPE[1]))
    assert not kinds(pixels)


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (200, 3), (40, 40), (70, 300)])
def test_images_of_few_pixels_have_no_findings(shape: tuple[int, int]) -> None:
    assert not kinds(texture("blurred", 17, (300, 300))[: shape[0], : shape[1]])


def test_blur_and_compression_are_numbers() -> None:
    pixels = texture("fractal", 18)
    sharp = pixel_findings(ArrayImage(pixels))
    soft = pixel_findings(ArrayImage(cv2.GaussianBlur(pixels, (0, 0), 1.5)))
    coarse = pixel_findings(ArrayImage(compressed(pixels, 40)))
    assert np.sqrt(soft.blur_px**2 - sharp.blur_px**2) == pytest.approx(1.5, rel=0.1)
    assert sharp.blocking < 0.1 < coarse.blocking


@pytest.mark.thorough
def test_a_large_image_is_read_by_pieces_and_its_faults_are_seen() -> None:
    large = np.tile(texture("rough", 19, (2048, 2048)), (2, 2))[:3600, :4000]
    large += np.random.default_rng(19).normal(0.0, 3.0, large.shape).astype(np.float32)
    image = Watched(lost(large, 1800, 12))
    statistics = pixel_statistics(image)
    assert int(statistics.jumps[0].argmax()) == 1800
    assert max(one.lines * one.samples for one in image.windows) < 600_000
    assert sum(one.lines * one.samples for one in image.windows) < 20_000_000
