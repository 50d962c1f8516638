"""Images whose strips or tiles are large: unpacked once into a copy, or refused before they are."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

from amers.services.errors import FormatError
from amers.services.formats.images import working_copy
from amers.services.formats.images.layout import largest_piece_bytes
from amers.services.formats.images.masks import apply_mask
from amers.services.formats.images.raster import RasterImage, open_raster
from amers.services.imagery.source import Window

LINES, SAMPLES = 300, 400
ONE_STRIP = {"blockysize": LINES, "compress": "deflate"}
KILOBYTE = 1000


@pytest.fixture
def low_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that small images reach."""
    monkeypatch.setattr(working_copy, "READ_BY_WINDOWS_BYTES", 50 * KILOBYTE)
    monkeypatch.setattr(working_copy, "LARGEST_PIECE_BYTES", 500 * KILOBYTE)
    monkeypatch.setattr(working_copy, "LARGEST_COPY_BYTES", 1000 * KILOBYTE)


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files that were copied."""
    copied, names = working_copy._copied, list[str]()

    def noted(path: Path, dataset: rasterio.DatasetReader) -> rasterio.DatasetReader:
        names.append(path.name)
        return copied(path, dataset)

    monkeypatch.setattr(working_copy, "_copied", noted)
    return names


def pixels_of(dtype: str = "uint16", bands: int = 1) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.integers(0, 200, (bands, LINES, SAMPLES)).astype(dtype)


def written(path: Path, pixels: np.ndarray, mask: np.ndarray | None = None, **profile: object) -> Path:
    bands, lines, samples = pixels.shape
    shape = {"count": bands, "height": lines, "width": samples, "dtype": pixels.dtype}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK="YES"),
        rasterio.open(path, "w", driver="GTiff", **shape | profile) as file,
    ):
        file.write(pixels)
        if mask is not None:
            file.write_mask(mask)
    return path


def read_in_pieces(image: RasterImage) -> np.ndarray:
    rows = [
        np.hstack([image.read(Window(line, sample, 100, 100)) for sample in range(0, SAMPLES, 100)])
        for line in range(0, LINES, 100)
    ]
    image.close()
    return np.vstack(rows)


@pytest.mark.parametrize(
    "profile",
    [
        ONE_STRIP,
        ONE_STRIP | {"BIGTIFF": "YES"},
        ONE_STRIP | {"ENDIANNESS": "BIG"},
        ONE_STRIP | {"compress": "lzw"},
        ONE_STRIP | {"compress": "packbits"},
        ONE_STRIP | {"blockysize": 100},
        {"tiled": True, "blockxsize": 400, "blockysize": 304, "compress": "deflate"},
    ],
    ids=str,
)
@pytest.mark.usefixtures("low_limits")
def test_a_large_strip_or_tile_is_unpacked_once_and_read_as_it_is(
    profile: dict[str, object], tmp_path: Path, unpacked: list[str]
) -> None:
    pixels = pixels_of()
    image = open_raster(written(tmp_path / "image.tif", pixels, **profile))
    assert unpacked == []
    np.testing.assert_array_equal(read_in_pieces(image), pixels[0].astype(np.float32))
    assert unpacked == ["image.tif"]


@pytest.mark.parametrize("interleave", ["pixel", "band"])
@pytest.mark.usefixtures("low_limits")
def test_bands_without_data_are_read_from_the_copy_as_from_the_file(
    interleave: str, tmp_path: Path, unpacked: list[str]
) -> None:
    pixels = pixels_of("uint8", bands=3)
    profile = ONE_STRIP | {"interleave": interleave, "nodata": 7}
    image = open_raster(written(tmp_path / "image.tif", pixels, **profile), 2)
    expected = np.where(pixels[1] == 7, np.nan, pixels[1].astype(np.float32))
    np.testing.assert_array_equal(read_in_pieces(image), expected)
    assert unpacked == ["image.tif"]


@pytest.mark.usefixtures("low_limits")
def test_a_mask_inside_the_file_counts_too(tmp_path: Path, unpacked: list[str]) -> None:
    """The image has strips of one line, its mask one of all lines."""
    valid = np.random.default_rng(4).integers(0, 2, (LINES, SAMPLES)).astype(bool)
    pixels = pixels_of("uint8")
    path = written(tmp_path / "image.tif", pixels, valid, **ONE_STRIP)
    image = open_raster(path)
    expected = np.where(valid, pixels[0].astype(np.float32), np.nan)
    np.testing.assert_array_equal(read_in_pieces(image), expected)
    assert unpacked == ["image.tif"]


@pytest.mark.usefixtures("low_limits")
def test_the_mask_of_a_caller_is_unpacked_once(tmp_path: Path, unpacked: list[str]) -> None:
    excluded = pixels_of("uint8") > 100
    image = open_raster(written(tmp_path / "image.tif", pixels_of(), blockysize=1))
    mask = written(tmp_path / "mask.tif", excluded.astype("uint8"), **ONE_STRIP)
    masked = apply_mask(image, mask)
    for line in range(0, LINES, 100):
        read = masked.read(Window(line, 0, 100, SAMPLES))
        np.testing.assert_array_equal(np.isnan(read), excluded[0, line : line + 100])
    assert unpacked == ["mask.tif"]
    masked.close()


@pytest.mark.parametrize(
    "profile",
    [
        {"tiled": True, "compress": "deflate", "blockxsize": 128, "blockysize": 128},
        {"compress": "deflate", "blockysize": 1},
        {"blockysize": LINES},
    ],
    ids=["tiles", "lines", "a strip that is not compressed"],
)
@pytest.mark.usefixtures("low_limits")
def test_what_can_be_read_by_windows_is_not_copied(
    profile: dict[str, object], tmp_path: Path, unpacked: list[str]
) -> None:
    pixels = pixels_of()
    image = open_raster(written(tmp_path / "image.tif", pixels, **profile))
    np.testing.assert_array_equal(read_in_pieces(image), pixels[0].astype(np.float32))
    assert unpacked == []


@pytest.mark.usefixtures("low_limits")
def test_a_strip_beyond_the_limit_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    large = np.zeros((1, 800, 800), "uint8")
    path = written(tmp_path / "image.tif", large, blockysize=800, compress="deflate")
    with pytest.raises(
        FormatError, match=r"image\.tif: the largest strip or tile unpacks to .* in tiles"
    ):
        open_raster(path)


@pytest.mark.usefixtures("low_limits")
def test_an_image_of_many_large_strips_is_refused_beyond_the_limit_of_a_copy(tmp_path: Path) -> None:
    large = np.zeros((1, 1200, 900), "uint8")
    path = written(tmp_path / "image.tif", large, blockysize=200, compress="deflate")
    with pytest.raises(FormatError, match="in an image of"):
        open_raster(path)


def test_a_strip_of_a_gibibyte_is_told_from_its_tables_alone(tmp_path: Path) -> None:
    """As GDAL shows it, each strip is a line of 32 KiB."""
    path, size = tmp_path / "image.tif", 32768
    shape = {"count": 1, "height": size, "width": size, "dtype": "uint8"}
    with rasterio.open(
        path, "w", driver="GTiff", SPARSE_OK="TRUE", **shape, **ONE_STRIP | {"blockysize": size}
    ):
        pass
    assert largest_piece_bytes(path) == 1 << 30
    with rasterio.open(path) as image:
        assert image.block_shapes == [(1, size)]


def test_a_full_disk_is_not_blamed_on_the_image(
    tmp_path: Path, low_limits: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = open_raster(written(tmp_path / "image.tif", pixels_of(), **ONE_STRIP))

    def full(*_: object, **__: object) -> None:
        raise rasterio.errors.RasterioIOError("No space left on device")

    monkeypatch.setattr(rasterio.shutil, "copy", full)
    monkeypatch.setattr(working_copy, "LEAST_FREE_BYTES", 1 << 62)
    with pytest.raises(OSError, match="No space left"):
        image.read(Window(0, 0, 10, 10))


@pytest.mark.parametrize("length", range(0, 60, 3))
def test_a_file_that_was_cut_off_is_read_as_far_as_it_goes(length: int, tmp_path: Path) -> None:
    whole = written(tmp_path / "image.tif", pixels_of(), **ONE_STRIP).read_bytes()
    cut = tmp_path / "cut.tif"
    cut.write_bytes(whole[:length])
    assert largest_piece_bytes(cut) in (0, LINES * SAMPLES * 2)
