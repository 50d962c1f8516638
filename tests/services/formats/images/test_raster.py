"""Image files: windows, bands and nodata are read; unusable files are refused."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.enums import Resampling
from rasterio.transform import Affine

from amers.services.errors import FormatError
from amers.services.formats.images.raster import (
    copy_with_rpc,
    map_grid_of,
    open_raster,
    write_raster,
)
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.imagery.source import ArrayImage, Window, quick_view

MODEL = parse_rpc_text((Path(__file__).parents[3] / "golden" / "invented_RPC.TXT").read_text())
PIXELS = np.random.default_rng(5).integers(1, 4000, (90, 120)).astype(np.uint16)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def write(path: Path, pixels: np.ndarray = PIXELS, driver: str = "GTiff", **options: object) -> Path:
    bands = pixels if pixels.ndim == 3 else pixels[None]
    count, height, width = bands.shape
    with rasterio.open(
        path, "w", driver=driver, count=count, height=height, width=width, dtype=pixels.dtype, **options
    ) as file:
        file.write(bands)
    return path


@given(st.integers(-100, 150), st.integers(-150, 200), st.integers(1, 200), st.integers(1, 200))
def test_any_window_of_a_file_is_the_window_of_the_array(
    tmp_path_factory: pytest.TempPathFactory, line: int, sample: int, lines: int, samples: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "windows.tif"
    if not path.exists():
        write(path)
    image, window = open_raster(path), Window(line, sample, lines, samples)
    read = image.read(window)
    image.close()
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, ArrayImage(PIXELS.astype(np.float32)).read(window))


@pytest.mark.parametrize("files", ["own", "world", "aux", "own world", "own aux", "world aux"])
def test_a_turned_map_is_where_gdal_has_it_whichever_files_state_it(tmp_path: Path, files: str) -> None:
    """Its pixels are oblong and askew, and each file states another place."""
    own, world, aux = (Affine(10.0 + k, 2.0, 5e5 + k, 3.0, -7.0, 4.8e6) for k in range(3))
    placed = {"transform": own} if "own" in files else {}
    path = write(tmp_path / "a.tif", crs="EPSG:32631", **placed)
    if "world" in files:
        centre = world @ Affine.translation(0.5, 0.5)
        numbers = (centre.a, centre.d, centre.b, centre.e, centre.c, centre.f)
        path.with_suffix(".tfw").write_text("\n".join(map(str, numbers)))
    if "aux" in files:
        text = ",".join(map(str, aux.to_gdal()))
        pam = f"<PAMDataset><GeoTransform>{text}</GeoTransform></PAMDataset>"
        (tmp_path / "a.tif.aux.xml").write_text(pam)
    with rasterio.open(path) as file:
        expected = file.transform
    image = open_raster(path)
    grid = map_grid_of(image)
    image.close()
    assert grid is not None
    at = np.array([[0.0, 0.0], [89.0, 0.0], [0.0, 119.0], [40.25, 7.5]])
    xy = [expected @ (sample + 0.5, line + 0.5) for line, sample in at.tolist()]
    np.testing.assert_allclose(grid.xy(at), xy, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "driver", "options"),
    [
        ("plain.tif", "GTiff", {}),
        (
            "tiled.tif",
            "GTiff",
            {"tiled": True, "compress": "deflate", "blockxsize": 32, "blockysize": 32},
        ),
        ("big.tif", "GTiff", {"BIGTIFF": "YES", "endianness": "big"}),
        ("cloud.tif", "COG", {}),
        ("image.jp2", "JP2OpenJPEG", {"QUALITY": "100", "REVERSIBLE": "YES"}),
        ("image.ntf", "NITF", {}),
    ],
)
def test_every_allowed_kind_of_file_is_read(
    tmp_path: Path, name: str, driver: str, options: dict
) -> None:
    image = open_raster(write(tmp_path / name, driver=driver, **options))
    assert image.shape == PIXELS.shape
    np.testing.assert_array_equal(image.read(Window(0, 0, *PIXELS.shape)), PIXELS)


def test_a_quick_view_is_of_an_overview_where_the_file_has_one(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.tile(PIXELS, (3, 2)))
    with rasterio.open(path, "r+") as file:
        file.build_overviews([2], Resampling.average)
    other = np.full(open_raster(path).shape, 7, dtype=np.uint16)
    with rasterio.open(path, "r+") as file:
        file.write(other, 1)
    view = quick_view(open_raster(path), 8)
    assert (view != 7.0).all()
    path = write(tmp_path / "b.tif", other)
    np.testing.assert_array_equal(quick_view(open_raster(path), 8), np.full(view.shape, 7.0))


def test_a_quick_view_has_no_data_where_a_mask_hides_it(tmp_path: Path) -> None:
    valid = np.zeros(PIXELS.shape, dtype=np.uint16)
    valid[:45] = 65535
    path = write(tmp_path / "a.tif", np.stack([PIXELS, valid]), photometric="MINISBLACK", ALPHA="YES")
    view = quick_view(open_raster(path), 5)
    np.testing.assert_array_equal(np.isfinite(view), np.arange(18)[:, None].repeat(24, axis=1) < 9)


def test_the_requested_band_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.stack([PIXELS, PIXELS + 1]))
    np.testing.assert_array_equal(open_raster(path, 2).read(Window(0, 0, *PIXELS.shape)), PIXELS + 1)
    with pytest.raises(FormatError, match="band 3 requested, the image has 2 bands"):
        open_raster(path, 3)


VRT = """<VRTDataset rasterXSize="10" rasterYSize="10"><VRTRasterBand dataType="Byte" band="1">
<SimpleSource><SourceFilename>/etc/hostname</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"""


@pytest.mark.parametrize(
    "content", [b"", b"II", VRT.encode(), b"\x89PNG\r\n\x1a\n", b"hello world, hello"]
)
def test_other_kinds_of_files_are_refused_whatever_their_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(FormatError, match=r"a\.tif: expected a GeoTIFF, JPEG 2000 or NITF image"):
        open_raster(tmp_path / "a.tif")


@pytest.mark.parametrize(
    "name",
    [
        "/vsicurl/http://localhost/a.tif",
        "/vsizip/a.zip/a.tif",
        "http://localhost/a.tif",
        "missing.tif",
        ".",
    ],
)
def test_urls_archives_and_folders_are_refused(name: str) -> None:
    with pytest.raises(FormatError, match="expected the name of an existing image file"):
        open_raster(Path(name))


@pytest.mark.parametrize("name", ["a#b.tif", "a?b.tif", "a!b.tif", "zip:a.tif", "GTIFF_DIR:1:a.tif"])
def test_a_file_is_read_whatever_its_name(tmp_path: Path, name: str) -> None:
    write(tmp_path / "plain.tif").rename(tmp_path / name)
    assert open_raster(tmp_path / name).shape == PIXELS.shape


def test_files_beside_say_which_pixels_are_valid_and_are_no_tags(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif")
    (tmp_path / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="1"><NoDataValue>7</NoDataValue></PAMRasterBand></PAMDataset>'
    )
    (tmp_path / "a_RPC.TXT").write_text(
        (Path(__file__).parents[3] / "golden/invented_RPC.TXT").read_text()
    )
    image = open_raster(path)
    assert image.dataset.nodata is None
    read = image.read(Window(0, 0, *PIXELS.shape))
    np.testing.assert_array_equal(np.isnan(read), PIXELS == 7)
    assert not image.dataset.tags(ns="RPC")


@pytest.mark.parametrize("driver", ["GTiff", "COG", "JP2OpenJPEG", "NITF"])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_image_is_refused_when_it_is_opened(
    tmp_path: Path, driver: str, part: float
) -> None:
    data = write(tmp_path / "whole", np.tile(PIXELS, (5, 5)), driver=driver).read_bytes()
    (tmp_path / "cut").write_bytes(data[: int(part * len(data))])
    with pytest.raises(FormatError, match="cut: "):
        open_raster(tmp_path / "cut")


def test_a_hole_in_the_middle_is_a_format_error_when_it_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif", np.tile(PIXELS, (8, 8)), compress="deflate")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 5000] = bytes(5000)
    path.write_bytes(data)
    image = open_raster(path)
    with pytest.raises(FormatError, match=r"a\.tif: truncated or damaged, readable pixels expected"):
        image.read(Window(0, 0, *image.shape))


def test_a_small_file_that_declares_an_enormous_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=100_000, height=100_000, count=1, dtype="uint8", SPARSE_OK=True
    ):
        pass
    with pytest.raises(FormatError, match="declares 100000 lines of 100000 samples"):
        open_raster(path)


@pytest.mark.parametrize("driver", ["GTiff", "COG"])
def test_a_copy_has_the_new_tags_and_the_same_pixels(tmp_path: Path, driver: str) -> None:
    path = write(tmp_path / "a.tif", driver=driver, nodata=7)
    before = path.read_bytes()
    copy_with_rpc(path, tmp_path / "b.tif", MODEL)
    assert path.read_bytes() == before
    with rasterio.open(tmp_path / "b.tif") as copy:
        np.testing.assert_array_equal(copy.read(1), PIXELS)
        assert copy.nodata == 7
        assert copy.rpcs.line_off == MODEL.image_offset[0]
        np.testing.assert_array_equal(copy.rpcs.samp_num_coeff, MODEL.sample_num)
        assert copy.rpcs.err_bias == MODEL.error_bias_m
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.tif", "b.tif"]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_a_written_raster_reads_back(tmp_path: Path, dtype: str) -> None:
    pixels = np.tile(PIXELS, (4, 4)).astype(dtype)
    write_raster(tmp_path / "a.tif", pixels, MODEL)
    image = open_raster(tmp_path / "a.tif")
    np.testing.assert_array_equal(image.read(Window(0, 0, *image.shape)), pixels)
    assert image.dataset.rpcs.samp_off == MODEL.image_offset[1]


def test_a_copy_replaces_an_older_one_but_never_the_image_itself(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif")
    (tmp_path / "b.tif").write_bytes(b"half a copy")
    copy_with_rpc(path, tmp_path / "b.tif", MODEL)
    assert open_raster(tmp_path / "b.tif").shape == PIXELS.shape
    with pytest.raises(FormatError, match="the delivered image would be overwritten"):
        copy_with_rpc(path, path, MODEL)


def test_only_a_geotiff_takes_rpc_tags(tmp_path: Path) -> None:
    nitf = write(tmp_path / "a.ntf", driver="NITF")
    with pytest.raises(FormatError, match="NITF found; only a GeoTIFF can be copied with new RPC tags"):
        copy_with_rpc(nitf, tmp_path / "b.tif", MODEL)
