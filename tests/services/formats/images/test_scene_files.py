"""Scenes: the model is found, shifted to a crop and written back; accuracy and acquisition are read."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from amers.services.errors import FormatError
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.images.scenes import prior_sigma_m, read_scene
from amers.services.formats.sensor_models.dimap import format_dimap_rpc
from amers.services.formats.sensor_models.geom import format_geom
from amers.services.formats.sensor_models.rpc_files import read_rpc, write_model
from amers.services.formats.sensor_models.rpc_text import format_rpb, format_rpc_text, parse_rpc_text
from amers.services.imagery.scene import scene_centre, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.sensors.correction import fold_into_rpc, no_correction
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array

GOLDEN = Path(__file__).parents[3] / "golden"
FULL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())
GEOM = (GOLDEN / "invented.geom").read_text()
V2 = (GOLDEN / "RPC_invented_v2.XML").read_text()
ORIGIN = (9000.0, 15000.0)
CROP = replace(FULL, image_offset=FULL.image_offset - np.array(ORIGIN))
PIXELS = np.random.default_rng(6).integers(1, 4000, (60, 80)).astype(np.uint16)

a_nanopixel = 1e-9
a_millionth_of_a_pixel = 1e-6
a_hundredth_of_a_degree = 0.01

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def write_image(
    path: Path,
    tagged: RpcModel | None = None,
    placed: bool = False,
    first: float = 0.0,
    **tags: str,
) -> Path:
    transform = Affine(1, 0, ORIGIN[1] + first, 0, 1, ORIGIN[0] + first) if placed else None
    with rasterio.open(
        path, "w", "GTiff", PIXELS.shape[1], PIXELS.shape[0], 1, dtype="uint16", transform=transform
    ) as file:
        file.write(PIXELS, 1)
        if tagged is not None:
            file.rpcs = gdal_rpc(tagged)
        file.update_tags(**tags)
    return path


def misfit_px(a: RpcModel, b: RpcModel) -> float:
    axis = np.linspace(-0.9, 0.9, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ground: Array = FULL.ground_offset + grid * FULL.ground_scale
    return float(np.abs(a.project(ground) - b.project(ground)).max())


@pytest.mark.parametrize(
    ("sidecar", "text", "convention"),
    [
        ("IMG_a_RPC.TXT", format_rpc_text(CROP), "text"),
        ("img_A_rpc.txt", format_rpc_text(CROP), "text"),
        ("IMG_a.RPB", format_rpb(CROP), "rpb"),
        ("IMG_a_RPC.XML", format_dimap_rpc(V2, CROP), "dimap"),
        ("RPC_a.XML", format_dimap_rpc(V2, CROP), "dimap"),
        ("IMG_a.geom", format_geom(CROP, GEOM), "geom"),
    ],
)
def test_a_model_beside_the_image_is_found(
    tmp_path: Path, sidecar: str, text: str, convention: str
) -> None:
    path = write_image(tmp_path / "IMG_a.tif")
    (tmp_path / sidecar).write_text(text)
    delivered = read_rpc(path)
    assert delivered.convention == convention
    assert delivered.path.name == sidecar
    assert delivered.crop_origin == (0.0, 0.0)
    assert misfit_px(delivered.model, CROP) < a_millionth_of_a_pixel


def test_without_a_model_the_message_lists_the_files_searched_for(tmp_path: Path) -> None:
    path = write_image(tmp_path / "IMG_a_R1C1.tif")
    with pytest.raises(
        FormatError,
        match=r"no file IMG_a_R1C1\.RPB, .*_RPC\.TXT, RPC_a\.XML, .*, IMG_a_R1C1\.geom, .* lies beside",
    ):
        read_rpc(path)


def test_a_model_that_vanishes_is_refused_with_the_name_of_its_file(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif")
    (tmp_path / "a_RPC.TXT").write_text(format_rpc_text(replace(CROP, line_den=np.zeros(20))))
    with pytest.raises(FormatError, match=r"a_RPC\.TXT: the line denominator of the RPC vanishes"):
        read_scene(path)


def test_a_model_of_another_region_is_refused(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif")
    elsewhere = replace(CROP, image_offset=CROP.image_offset + 90_000.0)
    (tmp_path / "a_RPC.TXT").write_text(format_rpc_text(elsewhere))
    with pytest.raises(FormatError, match=r"does not cover the image a\.tif: 4 of its 4 corners"):
        read_rpc(path)


@pytest.mark.parametrize(("delivered", "origin"), [(FULL, ORIGIN), (CROP, (0.0, 0.0))])
def test_a_crop_is_read_right_whether_its_model_is_the_full_scene_s_or_its_own(
    tmp_path: Path, delivered: RpcModel, origin: tuple[float, float]
) -> None:
    path = write_image(tmp_path / "a.tif", tagged=delivered, placed=True)
    read = read_rpc(path)
    assert read.crop_origin == origin
    np.testing.assert_allclose(read.model.image_offset, CROP.image_offset, rtol=0, atol=a_nanopixel)
    assert "line 9000, sample 15000" in read.note


def test_a_crop_placed_by_the_centre_of_its_first_pixel_is_the_same_crop(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif", placed=True, first=-0.5)
    (tmp_path / "a.geom").write_text(GEOM)
    read = read_rpc(path)
    assert (read.convention, read.crop_origin) == ("geom", ORIGIN)
    np.testing.assert_allclose(read.model.image_offset, CROP.image_offset, rtol=0, atol=a_nanopixel)


def test_a_whole_image_placed_by_the_centre_of_its_first_pixel_is_no_crop(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", "GTiff", 80, 60, 1, dtype="uint16", transform=Affine(1, 0, -0.5, 0, 1, -0.5)
    ) as file:
        file.write(PIXELS, 1)
    (tmp_path / "a.geom").write_text(GEOM)
    assert read_rpc(path).crop_origin == (0.0, 0.0)


def test_a_crop_with_an_ambiguous_model_needs_its_origin(tmp_path: Path) -> None:
    half_way = replace(FULL, image_offset=FULL.image_offset - np.array(ORIGIN) / 2.0)
    path = write_image(tmp_path / "a.tif", tagged=half_way, placed=True)
    with pytest.raises(FormatError, match=r"give crop_origin=\(0, 0\) or crop_origin=\(9000, 15000\)"):
        read_rpc(path)
    np.testing.assert_allclose(
        read_rpc(path, crop_origin=(0, 0)).model.image_offset, half_way.image_offset
    )
    shifted = read_rpc(path, crop_origin=ORIGIN).model
    np.testing.assert_allclose(shifted.image_offset, half_way.image_offset - np.array(ORIGIN))


def test_a_tile_of_an_image_in_several_files_needs_its_origin(tmp_path: Path) -> None:
    (tmp_path / "RPC_a.XML").write_text(V2)
    first = write_image(tmp_path / "IMG_a_R1C1.tif")
    second = write_image(tmp_path / "IMG_a_R2C1.tif")
    assert read_rpc(first).crop_origin == (0.0, 0.0)
    with pytest.raises(FormatError, match="the image is a tile, and its RPC is for the whole image"):
        read_rpc(second)
    model = read_rpc(second, crop_origin=(8192.0, 0.0)).model
    np.testing.assert_allclose(model.image_offset, FULL.image_offset - [8192.0, 0.0])


def test_a_scene_sees_the_ground_its_model_says(tmp_path: Path) -> None:
    scene = read_scene(write_image(tmp_path / "a.tif", tagged=CROP))
    assert scene.image.shape == PIXELS.shape
    np.testing.assert_array_equal(scene.image.read(Window(0, 0, 60, 80)), PIXELS)
    centre = scene_centre(scene)[None, :]
    np.testing.assert_allclose(scene.model.project(centre), [[29.5, 39.5]], atol=a_millionth_of_a_pixel)
    assert 0.4 < scene_gsd_m(scene) < 0.6


def test_ground_moved_along_the_viewing_direction_stays_in_the_image(tmp_path: Path) -> None:
    scene = read_scene(write_image(tmp_path / "a.tif", tagged=CROP))
    derivative = CROP.project_derivative(scene_centre(scene)[None, :])[0]
    east, north = np.linalg.solve(derivative[:, :2], -derivative[:, 2])
    incidence_deg = np.degrees(np.arctan(np.hypot(east, north)))
    azimuth_deg = np.degrees(np.arctan2(east, north)) % 360.0
    assert scene.acquisition.incidence_deg == pytest.approx(incidence_deg, abs=a_hundredth_of_a_degree)
    assert scene.acquisition.azimuth_deg == pytest.approx(azimuth_deg, abs=a_hundredth_of_a_degree)


PRODUCT = """<Dimap_Document><Raster_Data><Raster_Display>
<Special_Value><SPECIAL_VALUE_TEXT>NODATA</SPECIAL_VALUE_TEXT>
<SPECIAL_VALUE_COUNT>{nodata}</SPECIAL_VALUE_COUNT></Special_Value>
<Special_Value><SPECIAL_VALUE_TEXT>SATURATED</SPECIAL_VALUE_TEXT>
<SPECIAL_VALUE_COUNT>{saturated}</SPECIAL_VALUE_COUNT></Special_Value>
</Raster_Display></Raster_Data></Dimap_Document>"""


def test_the_product_says_which_values_have_no_data_and_which_are_saturated(tmp_path: Path) -> None:
    path = write_image(tmp_path / "IMG_a.tif")
    (tmp_path / "RPC_a.XML").write_text(format_dimap_rpc(V2, CROP))
    plain = read_scene(path).image
    pixels = plain.read(Window(0, 0, *plain.shape))
    assert np.isfinite(pixels).all()
    low, high = int(pixels.min()), int(pixels.max())
    (tmp_path / "DIM_a.XML").write_text(PRODUCT.format(nodata=low, saturated=high))
    stated = read_scene(path).image.read(Window(0, 0, *plain.shape))
    np.testing.assert_array_equal(np.isnan(stated), pixels == low)
    np.testing.assert_array_equal(stated == np.inf, pixels == high)
    for odd in ("", "many", "-1", "4095.5", "9" * 30):
        (tmp_path / "DIM_a.XML").write_text(PRODUCT.format(nodata=odd, saturated=odd))
        np.testing.assert_array_equal(read_scene(path).image.read(Window(0, 0, *plain.shape)), pixels)


@pytest.mark.parametrize(
    ("stated", "sensor", "sigma_m"),
    [
        ((2.5, 0.25), "PHR1B", math.hypot(2.5, 0.25)),
        ((2.5, math.nan), "", 2.5),
        ((math.nan, math.nan), "PHR1B", 8.5 / 2.1460),
        ((math.nan, math.nan), "WV03", 5.0 / 2.1460),
        ((math.nan, math.nan), "unheard of", 50.0),
    ],
)
def test_the_accuracy_is_the_stated_one_else_that_of_the_sensor(
    stated: tuple[float, float], sensor: str, sigma_m: float
) -> None:
    model = replace(FULL, error_bias_m=stated[0], error_random_m=stated[1])
    assert prior_sigma_m(model, sensor) == pytest.approx(sigma_m, rel=1e-4)


def test_the_accuracy_the_user_gives_comes_first(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif", tagged=CROP)
    assert read_scene(path, sigma_m=12.0).sigma_m == 12.0
    assert read_scene(path, sigma_m=12.0, ortho_sigma_m=3.0).sigma_m == 12.0


def refined(model: RpcModel) -> RpcModel:
    parameters = np.array([[40.0, 2.0, 0.0], [-25.0, 0.0, -1.0]])
    return fold_into_rpc(model, replace(no_correction(PIXELS.shape), parameters=parameters))


def test_the_refined_model_of_a_crop_is_in_the_pixels_of_the_crop(tmp_path: Path) -> None:
    path = write_image(tmp_path / "IMG_a.tif", placed=True)
    (tmp_path / "RPC_a.XML").write_text(V2)
    delivered = read_rpc(path)
    assert delivered.crop_origin == ORIGIN
    model = refined(delivered.model)
    for file in write_model(delivered, model, tmp_path / "out"):
        again = read_rpc(path, file)
        assert again.crop_origin == (0.0, 0.0)
        assert misfit_px(again.model, model) < a_millionth_of_a_pixel


def test_refined_tags_become_the_text_that_gdal_prefers_to_them(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif", tagged=CROP)
    model = refined(read_rpc(path).model)
    written = write_model(read_rpc(path), model, tmp_path / "out")
    assert [file.name for file in written] == ["refined_RPC.TXT", "a_RPC.TXT"]
    with rasterio.open(path) as before:
        assert before.rpcs.line_num_coeff == CROP.line_num.tolist()
    shutil.copy(written[1], tmp_path)
    with rasterio.open(path) as after:
        np.testing.assert_allclose(after.rpcs.line_num_coeff, model.line_num, rtol=1e-14)


def test_refined_tags_are_written_to_a_copy_when_the_image_is_given(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif", tagged=CROP)
    model = refined(read_rpc(path).model)
    written = write_model(read_rpc(path), model, tmp_path / "out", image_path=path)
    assert [file.name for file in written] == ["refined_RPC.TXT", "a_RPC.TXT", "a.tif"]
    assert misfit_px(read_rpc(tmp_path / "out" / "a.tif").model, model) < a_millionth_of_a_pixel
    assert misfit_px(read_rpc(path).model, CROP) < a_millionth_of_a_pixel


def test_the_delivered_model_is_never_overwritten(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif")
    (tmp_path / "a.RPB").write_text(format_rpb(CROP))
    delivered = read_rpc(path)
    with pytest.raises(FormatError, match="the delivered model would be overwritten"):
        write_model(delivered, refined(CROP), tmp_path)


def test_a_latin_1_document_stays_latin_1(tmp_path: Path) -> None:
    path = write_image(tmp_path / "IMG_a.tif")
    text = format_dimap_rpc(V2, CROP).replace("UTF-8", "ISO-8859-1").replace("invented", "invent\u00e9")
    (tmp_path / "RPC_a.XML").write_bytes(text.encode("latin-1"))
    delivered = read_rpc(path)
    written = write_model(delivered, refined(delivered.model), tmp_path / "out")
    assert "invent\u00e9".encode("latin-1") in written[1].read_bytes()
