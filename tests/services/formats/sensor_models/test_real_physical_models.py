"""Physical models of real products against what their producers computed."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio

from services.formats.sensor_models.phr_dimap import parse_phr_dimap
from services.formats.sensor_models.worldview_isd import parse_worldview_isd
from services.formats.text_files import read_text
from services.sensors.base import SensorModel
from services.sensors.rpc import RpcModel

pytestmark = pytest.mark.real_data

a_hundredth_of_a_pixel = 0.01


def grid_of_image(shape: tuple[int, int], heights_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 2) over an image, at each of the heights (n,)."""
    line, sample, height = np.meshgrid(
        np.linspace(0.0, shape[0] - 1.0, 15), np.linspace(0.0, shape[1] - 1.0, 15), heights_m
    )
    return np.column_stack([line.ravel(), sample.ravel()]), height.ravel()


def worldview_rpc(text: str) -> RpcModel:
    """The RPC of the vendor within an ISD document."""
    (image,) = ElementTree.fromstring(text).findall("RPB/IMAGE")

    def values(*names: str) -> np.ndarray:
        return np.array([float(word) for name in names for word in image.findtext(name, "").split()])

    return RpcModel(
        *(values(f"{name}COEFList/{name}COEF") for name in ("LINENUM", "LINEDEN", "SAMPNUM", "SAMPDEN")),
        values("LINEOFFSET", "SAMPOFFSET"),
        values("LINESCALE", "SAMPSCALE"),
        values("LONGOFFSET", "LATOFFSET", "HEIGHTOFFSET"),
        values("LONGSCALE", "LATSCALE", "HEIGHTSCALE"),
    )


def image_difference(model: SensorModel, other: SensorModel, shape, heights_m) -> np.ndarray:
    """Differences (n, 2) in the image of another model from a model, over image and heights."""
    image, height = grid_of_image(shape, heights_m)
    return other.project(model.locate(image, height)) - image


def test_pleiades_agrees_with_the_location_grid_of_cnes(real_data: Path) -> None:
    folder = real_data / "rigorous_metadata" / "pleiades_dimap"
    name = "P1BP--2018122638935449CP"
    model = parse_phr_dimap(read_text(folder / f"PHRDIMAP_{name}.XML"), name)
    with rasterio.open(folder / "loc_grids_ellipsoide" / name / f"GRID_{name}.tif") as grid:
        bands, step, tags = grid.read(), grid.transform, grid.tags()
    sample, line = np.meshgrid(np.arange(bands.shape[2]) * step.a, np.arange(bands.shape[1]) * step.e)
    image = np.column_stack([line.ravel(), sample.ravel()])
    for k in range(0, len(bands), 2):
        height = np.full(len(image), float(tags[f"ALTITUDE_B{k}"]))
        ground = np.column_stack([bands[k].ravel(), bands[k + 1].ravel(), height])
        np.testing.assert_allclose(model.project(ground), image, atol=a_hundredth_of_a_pixel)


@pytest.mark.parametrize(
    "name",
    ["WV1.XML", "WV2.XML", "WV3.XML", "wv_mvp_1.xml", "wv_mvp_2.xml", "wv_test1.xml", "wv_test2.xml"],
)
def test_worldview_agrees_with_the_rpc_of_the_vendor(real_data: Path, name: str) -> None:
    text = read_text(real_data / "rigorous_metadata" / "worldview_isd" / name)
    model, rpc = parse_worldview_isd(text, name), worldview_rpc(text)
    heights_m = rpc.ground_offset[2] + np.linspace(-0.9, 0.9, 5) * rpc.ground_scale[2]
    difference = image_difference(model, rpc, model.image_shape, heights_m)
    assert np.abs(difference.mean(axis=0)).max() < 0.1
    assert difference.std(axis=0).max() < 0.4
