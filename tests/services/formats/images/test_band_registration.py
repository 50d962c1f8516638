"""Bands of a mix are compared before a panchromatic value is made of them."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.statements import Statement, Subject, Use
from amers.services.types import FloatImage
from tests.services.textures import as_pixels, moved, texture

SIDE = 400


@cache
def ground() -> FloatImage:
    """Grey values, periodic."""
    return as_pixels(texture(np.random.default_rng(5), SIDE, 2.0))


def scene(
    folder: Path, bands: Sequence[FloatImage], requested: str | None = None, **options: object
) -> tuple[Scene, Statement | None]:
    """The scene of an ortho-image with some bands, and what is said of them."""
    pixels = np.clip(np.rint(np.stack(list(bands))), 1, 65000).astype(np.uint16)
    profile = {"photometric": "RGB", **options} if len(bands) >= 3 else options
    with rasterio.open(
        folder / "a.tif",
        "w",
        driver="GTiff",
        height=SIDE,
        width=SIDE,
        count=len(bands),
        dtype="uint16",
        crs="EPSG:32633",
        transform=from_origin(330000.0, 5862000.0, 1.0, 1.0),
        **profile,
    ) as file:
        file.write(pixels)
    found = read_scene(
        folder / "a.tif", sigma_m=1.0, bands=None if requested is None else parse_bands(requested)
    )
    said = [one for one in found.statements if one.subject is Subject.BANDS]
    return found, said[0] if said else None


def at(line_px: float, sample_px: float) -> FloatImage:
    """The ground, moved by a fraction of a pixel."""
    return np.asarray(moved(ground(), line_px, sample_px), dtype=np.float32)


def noisy(pixels: FloatImage, seed: int, gain: float) -> FloatImage:
    noise = np.random.default_rng(seed).normal(0.0, 0.03 * pixels.std(), pixels.shape)
    return np.asarray(gain * pixels + 60.0 + noise, dtype=np.float32)


def three(apart: Sequence[tuple[float, float]]) -> list[FloatImage]:
    return [noisy(at(*px), k, 0.5 + 0.2 * k) for k, px in enumerate(apart)]


@pytest.mark.parametrize(
    ("apart", "px"),
    [
        ([(0, 0), (0, 0), (0, 0)], 0.0),
        ([(0.1, 0), (0, 0), (0, 0.1)], 0.14),
        ([(0.12, 0), (0, 0), (-0.12, 0)], 0.24),
    ],
)
def test_bands_that_lie_on_each_other_are_mixed_and_the_distance_is_stated(
    tmp_path: Path, apart: list[tuple[float, float]], px: float
) -> None:
    found, said = scene(tmp_path, three(apart))
    assert said is not None
    assert said.use is Use.USED
    assert said.value.startswith("mean of red, green, blue, which lie within ")
    assert float(said.value.split()[-5]) == pytest.approx(px, abs=0.03)
    assert found.image.mix.bands == (1, 2, 3)  # type: ignore[attr-defined]


@pytest.mark.parametrize("apart_px", [0.4, 0.7, 1.0, 1.5, 2.0, 3.6])
@pytest.mark.parametrize("band", [0, 1, 2])
def test_bands_that_lie_apart_give_the_middle_one_alone(
    tmp_path: Path, apart_px: float, band: int
) -> None:
    apart = [(0.0, 0.0)] * 3
    apart[band] = (0.6 * apart_px, -0.8 * apart_px)
    found, said = scene(tmp_path, three(apart))
    assert said is not None
    assert said.use is Use.ASSUMED
    assert said.value == "green alone"
    assert f"up to {apart_px:.1f}" in said.note
    assert found.image.mix.bands == (2,)  # type: ignore[attr-defined]
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(found.image.read(Window(0, 0, SIDE, SIDE)), file.read(2))


def test_bands_that_lie_apart_in_a_half_of_the_image_are_found(tmp_path: Path) -> None:
    bands = three([(0, 0), (0, 0), (0, 0)])
    bands[2][SIDE // 2 :] = noisy(at(0.0, 0.9), 9, 0.9)[SIDE // 2 :]
    _, said = scene(tmp_path, bands)
    assert said is not None
    assert said.value == "green alone"


def test_bands_that_a_caller_names_are_used_and_what_is_wrong_is_said(tmp_path: Path) -> None:
    found, said = scene(tmp_path, three([(0, 0), (0, 0), (1.5, 0)]), "1,3")
    assert said is not None
    assert (said.use, said.value) == (Use.ASSUMED, "mean of red, blue, as requested")
    assert "lie up to 1.50 px apart" in said.note
    assert found.image.mix.bands == (1, 3)  # type: ignore[attr-defined]


def test_bands_that_look_different_are_not_mixed(tmp_path: Path) -> None:
    """Noise in place of blue: nothing shows where it lies."""
    bands = three([(0, 0), (0, 0), (0, 0)])
    bands[2] = np.random.default_rng(3).uniform(1.0, 900.0, bands[2].shape).astype(np.float32)
    _, said = scene(tmp_path, bands)
    assert said is not None
    assert said.value == "green alone"
    assert "look alike in 0 of 25 windows only" in said.note


def test_nothing_is_measured_where_one_band_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amers.services.formats.images.band_registration._measure", None)
    assert scene(tmp_path, three([(0, 0)]))[1] is None
    _, said = scene(tmp_path, three([(0, 0), (2, 0), (0, 0)]), "2")
    assert said is not None
    assert said.use is Use.USED
    assert said.value == "green alone, as requested"


def test_pixels_without_data_take_no_part(tmp_path: Path) -> None:
    bands = three([(0, 0), (0, 0), (0, 0)])
    for one in bands:
        one[:, : SIDE // 2] = 7.0
    _, said = scene(tmp_path, bands, nodata=7)
    assert said is not None
    assert said.use is Use.USED


@pytest.mark.real_data
def test_bands_of_worldview_3_lie_within_a_third_of_a_pixel(real_data: Path) -> None:
    """Red, green and blue follow each other in the focal plane by steps of 0.1 px along the lines."""
    for name in ("jax_001", "jax_018"):
        found = read_scene(real_data / "wv3_jacksonville" / f"{name}.tif")
        (said,) = [one for one in found.statements if one.subject is Subject.BANDS]
        assert said.use is Use.USED
        assert 0.1 < float(said.value.split()[-5]) < 0.3
