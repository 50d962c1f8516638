"""Real images have no findings; distorted ones have, and changed ground and haze are not accused."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.images.band_registration import visible_bands
from amers.services.formats.images.raster import open_raster
from amers.services.imagery.pixel_checks import Fault, PixelFinding, pixel_findings
from amers.services.imagery.source import ArrayImage, Window
from amers.services.types import FloatImage
from tests.services.imagery.textures import (
    changed,
    hazy,
    interlaced,
    lost,
    pasted,
    repeated,
    seen_twice,
)

pytestmark = pytest.mark.real_data

FOLDERS = ("phr_*", "s2_*", "s2a_*", "wv3_*")
NO_IMAGES = ("grid", "mask", "lidar")
VIEWS = (
    "phr_calanques_triplet/img_02.tif",
    "phr_gizeh_pair/img1.tif",
    "phr_ventoux_pair/left_image.tif",
    "wv3_jacksonville/jax_001.tif",
    "wv3_ntf_crops/wv3_30.NTF",
)


def images(real_data: Path) -> Iterator[Path]:
    for pattern in FOLDERS:
        for folder in sorted(real_data.glob(pattern)):
            for path in sorted([*folder.glob("*.tif"), *folder.glob("*.NTF")]):
                if not any(word in path.name for word in NO_IMAGES):
                    yield path


def pixels_of(path: Path) -> FloatImage:
    image = open_raster(path, 1)
    pixels = image.read(Window(0, 0, *image.shape))
    image.close()
    return pixels


def found(pixels: FloatImage) -> list[PixelFinding]:
    return list(pixel_findings(ArrayImage(np.asarray(np.rint(pixels), np.float32))).findings)


def test_no_real_image_has_a_finding(real_data: Path) -> None:
    accused = {}
    paths = list(images(real_data))
    for path in paths:
        image = open_raster(path, None)
        findings = pixel_findings(image, visible_bands(image)).findings
        if findings:
            accused[path.name] = findings
        image.close()
    assert not accused
    assert len(paths) >= 25


@pytest.mark.parametrize("file", VIEWS)
def test_faults_of_real_images_are_named_at_their_place(real_data: Path, file: str) -> None:
    pixels = pixels_of(real_data / file)
    lines = len(pixels)
    for at in (0.02, 0.4, 0.95):
        first = int(at * lines)
        (one,) = found(repeated(pixels, first, 5))
        assert (one.kind, one.line, one.lines) == (Fault.REPEATED_LINES, first, 5)
        (one,) = found(lost(pixels, first, 8))
        assert (one.kind, one.line) == (Fault.LOST_LINES, first - 1)
    (one,) = found(interlaced(pixels, 0.5))
    assert one.kind is Fault.ODD_LINES
    assert one.amount_px == pytest.approx(0.5, abs=0.05)
    (one,) = found(seen_twice(pixels, 10, 10))
    assert (one.kind, round(one.amount_px, 2)) == (Fault.SECOND_IMAGE, 14.14)
    corner, side = int(0.3 * min(pixels.shape)), int(0.35 * min(pixels.shape))
    (one,) = found(pasted(pixels, (corner, corner), side, 12))
    assert one.kind is Fault.PART


@pytest.mark.parametrize("file", VIEWS)
def test_changed_ground_and_haze_are_not_accused(real_data: Path, file: str) -> None:
    pixels = pixels_of(real_data / file)
    for at in (0.1, 0.5, 0.9):
        line = int(at * len(pixels))
        assert not found(changed(pixels, line, len(pixels) // 8))
        assert not found(hazy(pixels, line, 0.3))
