"""RPC00B and RPC00A in NITF files, made from the standard; GDAL reads the same pixels and positions."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

from amers.services.errors import FormatError
from amers.services.formats.images.raster import open_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.imagery.source import Window
from amers.services.sensors.rpc import RpcModel

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

GOLDEN = Path(__file__).parents[3] / "golden"
PLACES = json.loads((GOLDEN / "invented_nitf_places.json").read_text())
GROUND, LINE_SAMPLE = np.array(PLACES["lon_lat_h"]), np.array(PLACES["line_sample"])

a_millionth_of_a_pixel = 1e-6
CORNER_OF_FIRST_PIXEL = 0.5
both_records = pytest.mark.parametrize("name", ["invented_rpc00b.ntf", "invented_rpc00a.ntf"])


@both_records
def test_a_record_is_read_as_in_the_standard(name: str) -> None:
    delivered = read_rpc(GOLDEN / name)
    model = delivered.model
    assert isinstance(model, RpcModel)
    np.testing.assert_allclose(model.project(GROUND), LINE_SAMPLE, atol=a_millionth_of_a_pixel, rtol=0)
    assert (model.error_bias_m, model.error_random_m) == (3.0, 0.5)
    assert (delivered.convention, delivered.crop_origin) == ("tags", (0.0, 0.0))


def test_gdal_agrees_with_its_pixels_counted_from_the_corner() -> None:
    with rasterio.open(GOLDEN / "invented_rpc00b.ntf") as file, RPCTransformer(file.rpcs) as gdal:
        line, sample = gdal.rowcol(*GROUND.T, op=np.asarray)
    actual = np.column_stack([line, sample]) - CORNER_OF_FIRST_PIXEL
    np.testing.assert_allclose(actual, LINE_SAMPLE, atol=a_millionth_of_a_pixel, rtol=0)


@both_records
def test_the_pixels_are_those_that_were_written(name: str) -> None:
    image = open_raster(GOLDEN / name)
    line, sample = np.indices((32, 48))
    assert image.shape == line.shape
    pixels = image.read(Window(0, 0, *line.shape))
    np.testing.assert_array_equal(pixels, (5 * line + 2 * sample) % 251 + 1)


@pytest.mark.parametrize("kept", [3, 50, 404, 900, 1900, 2500])
def test_a_truncated_file_is_a_format_error(tmp_path: Path, kept: int) -> None:
    (tmp_path / "a.ntf").write_bytes((GOLDEN / "invented_rpc00b.ntf").read_bytes()[:kept])
    with pytest.raises(FormatError):
        read_rpc(tmp_path / "a.ntf")


def test_a_record_with_letters_for_numbers_is_a_format_error(tmp_path: Path) -> None:
    whole = (GOLDEN / "invented_rpc00a.ntf").read_bytes()
    start = whole.index(b"RPC00A01041") + 11 + 81
    (tmp_path / "a.ntf").write_bytes(whole[:start] + b"+x.yzuvwE+1" + whole[start + 11 :])
    with pytest.raises(FormatError):
        read_rpc(tmp_path / "a.ntf")


@pytest.mark.parametrize(
    ("header", "time"),
    [
        ("20240101120000", datetime(2024, 1, 1, 12, tzinfo=UTC)),
        ("20240101------", None),
        ("20241301120000", None),
    ],
)
def test_the_time_of_a_scene_is_that_of_the_image_header(
    tmp_path: Path, header: str, time: datetime | None
) -> None:
    content = (GOLDEN / "invented_rpc00b.ntf").read_bytes()
    (tmp_path / "scene.ntf").write_bytes(content.replace(b"20240101120000", header.encode()))
    assert read_scene(tmp_path / "scene.ntf").acquisition.acquired_at == time
