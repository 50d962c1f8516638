"""Ortho-images: recognition, band mixes, masks, and the corrected map grid."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import Affine

from amers.services.errors import FormatError
from amers.services.formats.images.bands import default_mix, parse_bands
from amers.services.formats.images.ortho import write_refined_ortho
from amers.services.formats.images.raster import map_grid_of, open_raster
from amers.services.formats.images.scenes import CE90_TO_SIGMA, model_files, read_scene
from amers.services.imagery.source import Window
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.ortho import OrthoModel, fold_into_ortho

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

a_micropixel = 1e-6
a_millionth_of_a_number = 1e-6

SHAPE = (80, 100)
ALL = Window(0, 0, *SHAPE)
NORTH_UP = Affine(10.0, 0.0, 330000.0, 0.0, -10.0, 5862000.0)
ROTATED = Affine(8.0, 6.0, 330000.0, 6.0, -8.0, 5862000.0)
PIXELS = np.random.default_rng(5).integers(1, 4000, (4, *SHAPE)).astype(np.uint16)


def write(
    path: Path,
    pixels: np.ndarray = PIXELS[:1],
    transform: Affine = NORTH_UP,
    crs: str = "EPSG:32633",
    driver: str = "GTiff",
    **options: object,
) -> Path:
    count, height, width = pixels.shape
    with rasterio.open(
        path,
        "w",
        driver=driver,
        count=count,
        height=height,
        width=width,
        dtype=pixels.dtype,
        crs=crs,
        transform=transform,
        **options,
    ) as file:
        file.write(pixels)
    return path


@pytest.mark.parametrize("transform", [NORTH_UP, ROTATED])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.tif", {"driver": "GTiff"}),
        ("a.cog.tif", {"driver": "COG"}),
        ("a.jp2", {"driver": "JP2OpenJPEG", "QUALITY": "100", "REVERSIBLE": "YES"}),
    ],
)
def test_an_image_on_a_map_is_an_ortho_scene(
    tmp_path: Path, name: str, options: dict, transform: Affine
) -> None:
    scene = read_scene(write(tmp_path / name, transform=transform, **options), sigma_m=5.0)
    assert isinstance(scene.model, OrthoModel)
    pixel = np.array([[0.0, 0.0], [79.0, 99.0], [13.25, 71.5]])
    x, y = transform @ (pixel[:, 1] + 0.5, pixel[:, 0] + 0.5)
    np.testing.assert_allclose(scene.model.grid.xy(pixel), np.column_stack([x, y]), atol=1e-6)
    assert scene.acquisition.incidence_deg == 0.0
    np.testing.assert_array_equal(scene.image.read(ALL), PIXELS[0])
    assert model_files(tmp_path / name) == []


def test_a_sensor_known_by_the_file_name_has_its_accuracy(tmp_path: Path) -> None:
    scene = read_scene(write(tmp_path / "x_S2A_20160608T153121_T33UUU_sub.tif"))
    assert scene.acquisition.sensor == "S2A"
    assert str(scene.acquisition.acquired_at).startswith("2016-06-08 15:31:21")
    assert scene.sigma_m == pytest.approx(17.5 * CE90_TO_SIGMA)


def test_a_landsat_scene_has_the_accuracy_of_tier_1_and_none_of_tier_2(tmp_path: Path) -> None:
    largest_radial_rms_m = 12.0
    scene = read_scene(write(tmp_path / "LC08_L1TP_193024_20200507_20200509_02_T1_B8.TIF"))
    assert scene.acquisition.sensor == "LC08"
    assert scene.sigma_m == pytest.approx(largest_radial_rms_m / 2.0**0.5, rel=1e-3)
    with pytest.raises(FormatError, match="sensor of this ortho-image is unknown"):
        read_scene(write(tmp_path / "LC08_L1TP_193024_20200507_20200509_02_T2_B8.TIF"))


def test_an_ortho_scene_of_an_unknown_sensor_needs_an_accuracy(tmp_path: Path) -> None:
    path = write(tmp_path / "a.tif")
    with pytest.raises(FormatError, match="sigma_m"):
        read_scene(path)
    assert read_scene(path, sigma_m=3.0).sigma_m == 3.0
    assert read_scene(path, sigma_m=8.0, ortho_sigma_m=3.0).sigma_m == 3.0


def test_an_image_without_map_grid_and_model_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", height=9, width=9, count=1, dtype="uint8") as file:
        file.write(np.ones((1, 9, 9), np.uint8))
    with pytest.raises(FormatError, match="has neither a map grid nor RPC tags"):
        read_scene(path)


def test_an_unusable_map_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="its centre is not on the Earth"):
        read_scene(write(tmp_path / "far.tif", transform=Affine(10, 0, 9e9, 0, -10, 9e9)), sigma_m=1.0)
    with pytest.raises(FormatError, match="on a line"):
        read_scene(write(tmp_path / "flat.tif", transform=Affine(10, 0, 3e5, 0, 0, 5e6)), sigma_m=1.0)


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326"])
@pytest.mark.parametrize("transform", [NORTH_UP, ROTATED])
def test_sidecar_and_copy_contain_the_correction(tmp_path: Path, crs: str, transform: Affine) -> None:
    if crs == "EPSG:4326":
        transform = (
            Affine.translation(12.0, 52.0)
            @ Affine.scale(1e-5)
            @ Affine(*transform[:2], 0.0, *transform[3:5], 0.0)
        )
    path = write(tmp_path / "a.tif", transform=transform, crs=crs)
    before = path.read_bytes()
    scene = read_scene(path, sigma_m=5.0)
    assert isinstance(scene.model, OrthoModel)
    correction = ImageCorrection(
        np.array([[2.5, 0.3, -0.2], [-1.5, 0.1, 0.4]]), np.array([39.5, 49.5]), np.array([40.0, 50.0])
    )
    corrected = CorrectedModel(scene.model, correction)
    refined = fold_into_ortho(scene.model, correction)
    sidecar, copy = write_refined_ortho(path, refined.grid, tmp_path / "out", copy=True)
    assert path.read_bytes() == before
    assert sidecar.name == "a.tif.aux.xml"
    ground = corrected.locate(np.random.default_rng(1).uniform(0, 79, (30, 2)), np.zeros(30))
    again = read_scene(copy, sigma_m=5.0).model
    np.testing.assert_allclose(again.project(ground), corrected.project(ground), atol=a_micropixel)
    # GDAL prefers the sidecar to the image, so that the delivered image moves too.
    beside = tmp_path / "beside"
    beside.mkdir()
    (beside / "a.tif").write_bytes(before)
    (beside / "a.tif.aux.xml").write_bytes(sidecar.read_bytes())
    with rasterio.open(beside / "a.tif") as file, rasterio.open(copy) as copied:
        assert file.crs == copied.crs
        assert tuple(file.transform) == pytest.approx(tuple(copied.transform), rel=1e-12)


def test_a_jpeg_2000_gets_a_sidecar_and_no_copy(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jp2", driver="JP2OpenJPEG")
    grid = map_grid_of(open_raster(path))
    assert grid is not None
    assert [file.name for file in write_refined_ortho(path, grid, tmp_path / "o")] == ["a.jp2.aux.xml"]
    with pytest.raises(FormatError, match="only a GeoTIFF"):
        write_refined_ortho(path, grid, tmp_path / "o", copy=True)
    with pytest.raises(FormatError, match="would be overwritten"):
        write_refined_ortho(path, grid, tmp_path)


@pytest.mark.parametrize(
    ("text", "bands", "weights"),
    [
        ("2", (2,), (1.0,)),
        (" 3, 1 ", (3, 1), (0.5, 0.5)),
        ("1:1,2:.5,4:2.5", (1, 2, 4), (0.25, 0.125, 0.625)),
    ],
)
def test_a_text_of_bands_is_parsed(text: str, bands: tuple, weights: tuple) -> None:
    mix = parse_bands(text)
    assert mix.bands == bands
    assert mix.weights == pytest.approx(weights)


@given(st.text(max_size=20))
def test_any_other_text_of_bands_is_refused(text: str) -> None:
    try:
        mix = parse_bands(text)
    except FormatError as error:
        assert "expected band numbers" in str(error)  # noqa: PT017 - either is right
    else:
        assert sum(mix.weights) == pytest.approx(1.0)
        assert min(mix.bands) >= 1


@pytest.mark.parametrize("text", ["", "0", "1,1", "1:0", "1:-2", "1:nan", "a", "1;2", "1:1e3"])
def test_impossible_bands_are_refused(text: str) -> None:
    with pytest.raises(FormatError, match="expected band numbers"):
        parse_bands(text)


def test_a_mix_is_the_weighted_mean_of_its_bands(tmp_path: Path) -> None:
    """Of those that have data, as in `dataset_mask` of GDAL: in colours, 0 is often a value of one."""
    pixels = PIXELS.copy()
    pixels[:, 40, 50:60] = int(PIXELS[2, 7, 9])
    path = write(tmp_path / "a.tif", pixels, nodata=int(PIXELS[2, 7, 9]))
    mixed = read_scene(path, sigma_m=1.0, bands=parse_bands("1:1,3:3")).image.read(ALL)
    weights = np.array([0.25, 0.75])[:, None, None] * (pixels[[0, 2]] != PIXELS[2, 7, 9])
    void = weights.sum(axis=0) == 0.0
    assert void.sum() == 10
    np.testing.assert_array_equal(np.isnan(mixed), void)
    with rasterio.open(path) as file:
        np.testing.assert_array_equal(void, ~file.read_masks([1, 3]).any(axis=0))
    expected = (weights * pixels[[0, 2]]).sum(axis=0)[~void] / weights.sum(axis=0)[~void]
    np.testing.assert_allclose(mixed[~void], expected, rtol=a_millionth_of_a_number)
    with pytest.raises(FormatError, match="band 5 requested, the image has 4 bands"):
        read_scene(path, sigma_m=1.0, bands=parse_bands("1,5"))


def test_the_default_of_a_colour_image_is_the_mean_of_its_colours(tmp_path: Path) -> None:
    """Bands that look alike and lie on each other."""
    smooth = cv2.GaussianBlur(PIXELS[0].astype(np.float32), (0, 0), 1.5)
    pixels = (np.stack([smooth, 0.8 * smooth, 0.5 * smooth, smooth])).astype(np.uint16)
    read = read_scene(write(tmp_path / "a.tif", pixels), sigma_m=1.0).image.read(ALL)
    np.testing.assert_allclose(read, pixels[:3].mean(axis=0), rtol=a_millionth_of_a_number)
    assert default_mix(("nir", "blue", "green", "red")).bands == (4, 3, 2)
    assert default_mix(("gray", "alpha")).bands == (1,)


@pytest.mark.parametrize(
    ("name", "options", "white"),
    [
        ("plain.tif", {}, 65535),
        ("ten.tif", {"NBITS": 10}, 1023),
        ("eleven.tif", {"NBITS": 11}, 2047),
        ("twelve.tif", {"NBITS": 12}, 4095),
        ("twelve.jp2", {"driver": "JP2OpenJPEG", "NBITS": 12, "QUALITY": 100, "REVERSIBLE": True}, 4095),
        ("eleven.ntf", {"driver": "NITF", "ABPP": 11}, 2047),
    ],
)
def test_saturated_pixels_are_infinite_and_nodata_nan(
    tmp_path: Path, name: str, options: dict, white: int
) -> None:
    pixels = np.minimum(PIXELS[:1], white - 1)
    pixels[0, 3:5, 6:9] = white
    pixels[0, 9, :5] = white - 1
    profile = {"driver": "GTiff", "nodata": int(pixels[0, 20, 20])} | options
    if profile["driver"] != "GTiff":
        del profile["nodata"]
    path = tmp_path / name
    with rasterio.open(
        path, "w", count=1, height=SHAPE[0], width=SHAPE[1], dtype="uint16", **profile
    ) as file:
        file.write(pixels)
    read = open_raster(path).read(ALL)
    np.testing.assert_array_equal(read == np.inf, pixels[0] == white)
    np.testing.assert_array_equal(np.isnan(read), pixels[0] == profile.get("nodata", -1))
    valid = np.isfinite(read)
    np.testing.assert_array_equal(read[valid], pixels[0][valid])


def test_a_largest_value_declared_as_nodata_is_nodata(tmp_path: Path) -> None:
    pixels = PIXELS[:1].copy()
    pixels[0, 3:5, 6:9] = 65535
    read = open_raster(write(tmp_path / "a.tif", pixels, nodata=65535)).read(ALL)
    np.testing.assert_array_equal(np.isnan(read), pixels[0] == 65535)
    assert not (read == np.inf).any()


def test_twelve_bits_in_sixteen_have_no_largest_value_unless_somebody_states_it(tmp_path: Path) -> None:
    pixels = np.minimum(PIXELS[:1], 4095)
    pixels[0, 3:5, 6:9] = 4095
    assert np.isfinite(open_raster(write(tmp_path / "a.tif", pixels)).read(ALL)).all()


@pytest.mark.parametrize("bits", ["0", "99", "9" * 20, "²", ""])
def test_impossible_bits_that_a_file_beside_the_image_states_are_those_of_the_pixels(
    tmp_path: Path, bits: str
) -> None:
    pixels = PIXELS[:1].copy()
    pixels[0, 3:5, 6:9] = 65535
    path = write(tmp_path / "a.tif", pixels)
    (tmp_path / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="1"><Metadata domain="IMAGE_STRUCTURE">'
        f'<MDI key="NBITS">{bits}</MDI></Metadata></PAMRasterBand></PAMDataset>'
    )
    read = open_raster(path).read(ALL)
    np.testing.assert_array_equal(read == np.inf, pixels[0] == 65535)


def test_a_mix_is_saturated_where_one_band_is_and_without_data_where_all_have_none(
    tmp_path: Path,
) -> None:
    pixels = PIXELS.copy()
    pixels[0, 3, 4:7] = 65535
    pixels[2, 3, 6:9] = int(PIXELS[2, 7, 9])
    pixels[:, 5, 5:9] = int(PIXELS[2, 7, 9])
    path = write(tmp_path / "a.tif", pixels, nodata=int(PIXELS[2, 7, 9]))
    read = open_raster(path, parse_bands("1,3")).read(ALL)
    void = (pixels[[0, 2]] == PIXELS[2, 7, 9]).all(axis=0)
    assert void.any()
    np.testing.assert_array_equal(np.isnan(read), void)
    np.testing.assert_array_equal(read == np.inf, pixels[0] == 65535)


def test_the_largest_value_is_valid_in_eight_bits_and_in_floating_point(tmp_path: Path) -> None:
    for dtype in (np.uint8, np.float32):
        pixels = np.full((1, *SHAPE), 255, dtype)
        read = read_scene(write(tmp_path / f"{dtype.__name__}.tif", pixels), sigma_m=1.0).image.read(ALL)
        assert np.isfinite(read).all()


@pytest.mark.parametrize("factor", [1, 4])
def test_pixels_that_a_mask_excludes_are_nan(tmp_path: Path, factor: int) -> None:
    cloud = (np.random.default_rng(2).random((1, SHAPE[0] // factor, SHAPE[1] // factor)) < 0.3).astype(
        np.uint8
    )
    mask = write(tmp_path / "mask.tif", 7 * cloud, NORTH_UP @ Affine.scale(factor))
    image = read_scene(write(tmp_path / "a.tif"), sigma_m=1.0, mask=mask).image
    hidden = np.kron(cloud[0], np.ones((factor, factor))) > 0
    np.testing.assert_array_equal(np.isnan(image.read(ALL)), hidden)
    part = image.read(Window(-5, 33, 20, 90))
    assert np.isnan(part[:5]).all()
    np.testing.assert_array_equal(np.isnan(part[5:, :67]), hidden[:15, 33:])


def test_a_mask_of_sixteen_bits_may_use_its_largest_value(tmp_path: Path) -> None:
    cloud = np.random.default_rng(2).random((1, *SHAPE)) < 0.3
    mask = write(tmp_path / "mask.tif", np.where(cloud, 65535, 0).astype(np.uint16))
    image = read_scene(write(tmp_path / "a.tif"), sigma_m=1.0, mask=mask).image
    np.testing.assert_array_equal(np.isnan(image.read(ALL)), cloud[0])


@pytest.mark.real_data
def test_sentinel_2_crops_agree_except_for_their_known_shift(real_data: Path) -> None:
    folder = real_data / "s2a_berlin_pair"
    june = read_scene(folder / "ref_S2A_20160608T153121_T33UUU_sub.tif")
    may = read_scene(folder / "tgt_S2A_20160529T153631_T33UUU_sub.tif")
    place = june.model.locate(np.array([[1200.0, 1300.0]]), np.zeros(1))
    assert june.acquisition.sensor == may.acquisition.sensor == "S2A"
    # 5440 m to the east, 4490 m to the north of the first pixel of the other.
    np.testing.assert_allclose(
        may.model.project(place), [[1200.0 + 449.0, 1300.0 - 544.0]], atol=a_micropixel
    )
