"""Where an image has several models the one that GDAL takes is used, with GDAL's positions."""

import itertools
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

from amers.services.errors import FormatError
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.formats.sensor_models.model_order import SAME_PX
from amers.services.formats.sensor_models.product_files import scenes_in, whole_product
from amers.services.formats.sensor_models.product_image import files_to_send
from amers.services.formats.sensor_models.rpc_files import read_rpc, write_model
from amers.services.imagery.source import Window
from amers.services.sensors.rpc import RpcModel
from tests.services.formats.images.test_scene_files import misfit_px, refined
from tests.services.formats.statements.scene_files import (
    CROP,
    FORMATS,
    GOLDEN,
    SHAPE,
    dim,
    part,
    write,
    write_image,
)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

NAMES = {
    "text": "IMG_a_R1C1_RPC.TXT",
    "rpb": "IMG_a_R1C1.RPB",
    "isd": "IMG_a_R1C1.XML",
    "dimap 2": "RPC_a.XML",
    "aux": "IMG_a_R1C1.{}.aux.xml",
    "rpc": "IMG_a_R1C1.rpc",
}
CORNER_OF_FIRST_PIXEL = 0.5
a_hundredth_of_a_pixel = 0.01


def gdal_px(image: Path, ground: np.ndarray) -> np.ndarray:
    """Lines and samples by GDAL with all files beside the image, from the centre of the first pixel."""
    with rasterio.open(image) as file:
        rpcs = file.rpcs
        assert rpcs is not None
        with RPCTransformer(rpcs) as gdal:
            line, sample = gdal.rowcol(*ground.T, op=np.asarray)
    return np.column_stack([line, sample]) - CORNER_OF_FIRST_PIXEL


def assert_as_gdal(image: Path) -> None:
    model = read_rpc(image).model
    line, sample = np.meshgrid([0.0, 30.0, 59.0], [0.0, 40.0, 79.0])
    positions = np.column_stack([line.ravel(), sample.ravel()])
    ground = model.locate(positions, np.full(len(positions), model.ground_offset[2] + 100.0))
    np.testing.assert_allclose(gdal_px(image, ground), positions, rtol=0, atol=a_hundredth_of_a_pixel)


def made(folder: Path, kinds: tuple[str, ...], driver: str) -> Path:
    """An image with models 100 lines apart."""
    suffix = {"GTiff": "TIF", "JP2OpenJPEG": "JP2", "NITF": "NTF"}[driver]
    models = {kind: part(9000.0 + 100.0 * k) for k, kind in enumerate(kinds)}
    for kind, model in models.items():
        if kind != "tags":
            text = FORMATS["text" if kind == "rpc" else kind](model)
            write(folder / NAMES[kind].format(suffix), text)
    with rasterio.Env(GDAL_PAM_ENABLED="NO"):
        return write_image(folder / f"IMG_a_R1C1.{suffix}", models.get("tags"), driver=driver)


@pytest.mark.parametrize("kinds", itertools.combinations(["tags", *NAMES], 2), ids="-".join)
def test_of_two_models_of_a_geotiff_that_of_gdal_is_used_and_the_other_named(
    tmp_path: Path, kinds: tuple[str, str]
) -> None:
    image = made(tmp_path, kinds, "GTiff")
    assert_as_gdal(image)
    used, other = read_rpc(image).statements[:2]
    assert (used.use, other.use) == ("used", "not used")
    assert "100.00 px from" in other.note


@pytest.mark.parametrize("kinds", itertools.combinations(NAMES, 2), ids="-".join)
def test_of_two_models_of_a_jpeg_2000_that_of_gdal_is_used(
    tmp_path: Path, kinds: tuple[str, str]
) -> None:
    assert_as_gdal(made(tmp_path, kinds, "JP2OpenJPEG"))


@pytest.mark.parametrize("kind", ["text", "rpb", "isd", "rpc", "aux"])
def test_of_a_nitf_with_rpc00b_the_model_of_gdal_is_used(tmp_path: Path, kind: str) -> None:
    image = tmp_path / "IMG_a_R1C1.NTF"
    image.write_bytes((GOLDEN / "invented_rpc00b.ntf").read_bytes())
    own = read_rpc(image).model
    other = moved(own, 4.0, 3.0)
    write(tmp_path / NAMES[kind].format("NTF"), FORMATS["text" if kind == "rpc" else kind](other))
    model = read_rpc(image).model
    ground = model.locate(np.array([[10.0, 20.0]]), model.ground_offset[2:])
    np.testing.assert_allclose(gdal_px(image, ground), [[10.0, 20.0]], atol=a_hundredth_of_a_pixel)


def test_models_that_are_the_same_are_not_named(tmp_path: Path) -> None:
    image = write_image(tmp_path / "a.tif", CROP)
    near = replace(CROP, image_offset=CROP.image_offset + 0.5 * SAME_PX)
    write(tmp_path / "a_RPC.TXT", FORMATS["text"](near))
    assert [statement.use for statement in read_rpc(image).statements] == ["used"]


def test_a_tile_of_dimap_is_where_gdal_places_it(tmp_path: Path) -> None:
    files = [(f"IMG_a_R{row}C1.TIF", row, 1) for row in (1, 2)]
    for name, _, _ in files:
        write_image(tmp_path / name)
    write(tmp_path / "DIM_a.XML", dim(files, (120, 80), SHAPE))
    write(tmp_path / "RPC_a.XML", FORMATS["dimap 2"](CROP))
    for name, _, _ in files:
        assert_as_gdal(tmp_path / name)


@pytest.mark.parametrize("kind", ["text", "rpb", "isd", "dimap 2", "geom", "aux", "tags"])
@pytest.mark.parametrize("driver", ["GTiff", "JP2OpenJPEG"])
def test_a_refined_model_beside_the_image_is_used_by_the_next_command(
    tmp_path: Path, driver: str, kind: str
) -> None:
    if kind == "tags" and driver != "GTiff":
        pytest.skip("a JPEG 2000 has no tags")
    names = {**NAMES, "geom": "IMG_a_R1C1.geom"}
    suffix = "TIF" if driver == "GTiff" else "JP2"
    if kind != "tags":
        write(tmp_path / names[kind].format(suffix), FORMATS[kind](CROP))
    with rasterio.Env(GDAL_PAM_ENABLED="NO"):
        model = CROP if kind == "tags" else None
        image = write_image(tmp_path / f"IMG_a_R1C1.{suffix}", model, driver=driver)
    delivered = read_rpc(image)
    expected = refined(delivered.model)
    plain, *others = write_model(delivered, expected, tmp_path / "out")
    assert plain.name == "refined_RPC.TXT"
    assert misfit_px(read_rpc(image, plain).model, expected) < 1e-6
    for file in others:
        file.replace(tmp_path / file.name)
    assert misfit_px(read_rpc(image).model, expected) < 1e-6


def test_a_refined_model_of_a_tile_is_in_the_pixels_of_the_file_that_it_replaces(tmp_path: Path) -> None:
    files = [(f"IMG_a_R{row}C1.TIF", row, 1) for row in (1, 2)]
    write(tmp_path / "DIM_a.XML", dim(files, (120, 80), SHAPE))
    write(tmp_path / "RPC_a.XML", FORMATS["dimap 2"](CROP))
    image = write_image(tmp_path / "IMG_a_R2C1.TIF")
    delivered = read_rpc(image)
    expected = moved(delivered.model, 3.0, -2.0)
    plain, named = write_model(delivered, expected, tmp_path / "out")
    assert_same(read_rpc(image, plain).model, expected)
    named.replace(tmp_path / named.name)
    assert_same(read_rpc(image).model, expected)


def moved(model: RpcModel, line: float, sample: float) -> RpcModel:
    return replace(model, image_offset=model.image_offset + np.array([line, sample]))


def assert_same(a: RpcModel, b: RpcModel) -> None:
    np.testing.assert_allclose(a.image_offset, b.image_offset, rtol=0, atol=1e-6)
    np.testing.assert_allclose(a.image_scale, b.image_scale, rtol=1e-9)


def product(folder: Path) -> Path:
    """Six tiles of an image of 150 x 170 pixels whose grey is that of the whole."""
    line, sample = np.indices((150, 170))
    whole = (3 * line + 2 * sample + 1).astype(np.uint16)
    files = []
    for row in range(3):
        for column in range(2):
            name = f"IMG_a_R{row + 1}C{column + 1}.TIF"
            pixels = whole[60 * row : 60 * row + 60, 100 * column : 100 * column + 100]
            folder.mkdir(exist_ok=True)
            with rasterio.open(
                folder / name, "w", "GTiff", pixels.shape[1], pixels.shape[0], 1, dtype="uint16"
            ) as file:
                file.write(pixels, 1)
            files.append((name, row + 1, column + 1))
    write(folder / "RPC_a.XML", FORMATS["dimap 2"](CROP))
    return write(folder / "DIM_a.XML", dim(files, (150, 170), (60, 100)))


def test_a_product_in_tiles_is_one_image_in_every_window_and_in_another_process(tmp_path: Path) -> None:
    image = read_scene(product(tmp_path)).image
    again = pickle.loads(pickle.dumps(image))
    line, sample = np.indices((150, 170))
    whole = np.pad((3 * line + 2 * sample + 1).astype(np.float32), 20, constant_values=np.nan)
    rng = np.random.default_rng(4)
    for _ in range(50):
        first, size = rng.integers(-20, 140, 2), rng.integers(1, 40, 2)
        size = np.minimum(size, [170 - first[0], 190 - first[1]])
        window = Window(int(first[0]), int(first[1]), int(size[0]), int(size[1]))
        rows = slice(first[0] + 20, first[0] + 20 + size[0])
        expected = whole[rows, first[1] + 20 : first[1] + 20 + size[1]]
        for source in (image, again):
            np.testing.assert_array_equal(source.read(window), expected)


def test_a_folder_with_a_product_has_one_scene_beside_other_images(tmp_path: Path) -> None:
    document = product(tmp_path)
    other = write_image(tmp_path / "other.tif", CROP)
    assert scenes_in(tmp_path) == [document, other]
    assert whole_product(tmp_path / "IMG_a_R2C1.TIF") == document
    assert [file.name for file in files_to_send(document)][:2] == ["IMG_a_R1C1.TIF", "IMG_a_R1C2.TIF"]
    with pytest.raises(FormatError, match="2 images found"):
        read_scene(tmp_path)


def test_a_tile_whose_product_is_incomplete_stays_a_tile(tmp_path: Path) -> None:
    product(tmp_path)
    (tmp_path / "IMG_a_R3C2.TIF").unlink()
    assert whole_product(tmp_path / "IMG_a_R2C1.TIF") == tmp_path / "IMG_a_R2C1.TIF"
    scene = read_scene(tmp_path / "IMG_a_R2C1.TIF")
    assert_same(scene.model, part(9060.0))  # type: ignore[arg-type]


def test_two_images_called_alike_are_two_scenes(tmp_path: Path) -> None:
    for name in ("first", "second"):
        write_image(tmp_path / name / "IMAGERY.TIF", CROP)
    assert scene_name(tmp_path / "first" / "IMAGERY.TIF") == "first"
    assert read_scene(tmp_path / "second" / "IMAGERY.TIF").acquisition.image_id == "second"
