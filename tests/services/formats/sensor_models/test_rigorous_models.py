"""Readers of rigorous models find the satellite that wrote the metadata, or say what is wrong."""

import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import Rotation

from amers.services.errors import FormatError
from amers.services.formats.sensor_models.dimap_rigorous import parse_dimap_rigorous
from amers.services.formats.sensor_models.phr_dimap import parse_phr_dimap
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.formats.sensor_models.rpc_files import read_rpc, write_model
from amers.services.formats.sensor_models.spot_dimap import parse_spot_dimap
from amers.services.formats.sensor_models.worldview_isd import (
    parse_isd_acquisition,
    parse_worldview_isd,
)
from amers.services.sensors.light_path import GEOMETRIC, LightPath
from amers.services.sensors.pushbroom import PushbroomModel
from tests.services.formats.sensor_models import simulated_metadata as simulated

ALL = LightPath(velocity_aberration=True, light_time=True, refraction=True)
Reader = Callable[[str, str], PushbroomModel]
Writer = Callable[[PushbroomModel], str]
PRODUCTS: dict[str, tuple[Writer, Reader, LightPath]] = {
    "ISD": (simulated.worldview_isd, parse_worldview_isd, ALL),
    "PHRDIMAP": (simulated.phr_dimap, parse_phr_dimap, GEOMETRIC),
    "SPOT 5": (simulated.spot5_dimap, parse_spot_dimap, GEOMETRIC),
    "SPOT 4": (simulated.spot4_dimap, parse_spot_dimap, GEOMETRIC),
    "DIMAP 2": (simulated.dimap_v2, parse_dimap_rigorous, GEOMETRIC),
}
a_thousandth_of_a_pixel = 1e-3
"""Times in the metadata have seven decimals: 0.05 microseconds are 0.0005 lines."""


@pytest.mark.parametrize("product", PRODUCTS)
def test_the_model_of_a_simulated_satellite_is_read_from_its_metadata(product: str) -> None:
    write, read, light_path = PRODUCTS[product]
    true = simulated.truth(light_path)
    found = read(write(true), product)
    rng = np.random.default_rng(2)
    image = rng.uniform(0.0, 1.0, (500, 2)) * simulated.SHAPE
    height = rng.uniform(0.0, 4000.0, 500)
    seen = found.project(true.locate(image, height))
    np.testing.assert_allclose(seen, image, atol=a_thousandth_of_a_pixel)


def test_lines_of_sight_begin_at_the_perspective_centre_beside_the_middle_of_the_satellite() -> None:
    true = simulated.truth(GEOMETRIC)
    text = simulated.worldview_isd(true)
    aside = text.replace("<CX>0<", "<CX>3.5<").replace("<CY>0<", "<CY>-2<").replace("<CZ>0<", "<CZ>1.5<")
    image = np.random.default_rng(5).uniform(0.0, 1.0, (50, 2)) * simulated.SHAPE
    (plain, direction), (moved, moved_direction) = (
        parse_worldview_isd(one, light_path=GEOMETRIC).line_of_sight(image) for one in (text, aside)
    )
    body = Rotation.from_quat(true.attitude(true.line_time(image[:, 0])[:, 0]))
    centre_m = body.inv().apply(moved - plain)
    np.testing.assert_allclose(centre_m, np.tile([3.5, -2.0, 1.5], (50, 1)), atol=1e-3)
    np.testing.assert_allclose(moved_direction, direction, atol=1e-12)


def test_a_turned_row_of_detectors_sees_what_a_camera_turned_as_much_sees() -> None:
    text, angle = simulated.worldview_isd(simulated.truth(GEOMETRIC)), np.radians(20.0)
    of_camera = text.replace("<QCS3>0<", f"<QCS3>{np.sin(angle / 2.0)}<")
    of_camera = of_camera.replace("<QCS4>1<", f"<QCS4>{np.cos(angle / 2.0)}<")
    of_row = text.replace("<DETROTANGLE>0<", f"<DETROTANGLE>{np.degrees(angle)}<")
    x, y = (float(text.partition(f"<DETORIGIN{axis}>")[2].partition("<")[0]) for axis in "XY")
    turned = Rotation.from_rotvec([0.0, 0.0, angle]).apply([x, y, 0.0])
    for axis, value in zip("XY", turned, strict=False):
        of_row = re.sub(f"<DETORIGIN{axis}>[^<]*<", f"<DETORIGIN{axis}>{value}<", of_row)
    image = np.random.default_rng(5).uniform(0.0, 1.0, (50, 2)) * simulated.SHAPE
    expected, found = (parse_worldview_isd(one).line_of_sight(image) for one in (of_camera, of_row))
    np.testing.assert_allclose(found[1], expected[1], atol=1e-12)


def test_sensor_time_and_sun_of_a_worldview_product_are_not_those_of_the_satellite() -> None:
    values = {"SATID": "WV02", "FIRSTLINETIME": "2012-03-04T10:36:09.123456Z"}
    angles = {"MEANSUNAZ": 142.5, "MEANSUNEL": 52.25, "MEANSATAZ": 230.0, "MEANSATEL": 71.0}
    entries = "".join(f"<{name}>{value}</{name}>" for name, value in (values | angles).items())
    found = parse_isd_acquisition(f"<isd><IMD><IMAGE>{entries}</IMAGE></IMD></isd>", "image")
    assert (found.image_id, found.sensor) == ("image", "WV02")
    assert found.acquired_at == datetime(2012, 3, 4, 10, 36, 9, 123_456, tzinfo=UTC)
    assert (found.sun_azimuth_deg, found.sun_elevation_deg) == (142.5, 52.25)


@pytest.mark.parametrize("product", PRODUCTS)
@pytest.mark.long
def test_truncated_and_garbled_metadata_are_refused_or_read(product: str) -> None:
    write, read, light_path = PRODUCTS[product]
    text = write(simulated.truth(light_path))
    rng = np.random.default_rng(6)
    messages = []
    for _ in range(25):
        start = int(rng.integers(len(text)))
        end = start + int(rng.integers(1, 40))
        for damaged in (text[:start], text[:start] + text[end:], text[:start] + "7<" + text[start:]):
            try:
                read(damaged, "damaged.xml")
            except FormatError as error:
                messages.append(str(error))
    assert len(messages) > 40
    assert all(message.startswith("damaged.xml: ") for message in messages)
    assert not [message for message in messages if re.search(r"\b(nan|inf)\b", message)]


@pytest.mark.parametrize(
    ("product", "pattern", "new", "message"),
    [
        ("ISD", "<isd>", "<isd><isd>", "well-formed"),
        ("ISD", "<?xml version", "<!DOCTYPE a><?xml version", "DOCTYPE"),
        ("ISD", "<PD>13246.0</PD>", "", "expected one PRINCIPAL_DISTANCE/PD"),
        ("ISD", "<PD>13246.0</PD>", "<PD>nan</PD>", "PD: expected a number, found 'nan'"),
        ("ISD", "<PD>13246.0</PD>", "<PD>1e999</PD>", "PD: 1e999 found, 1 to 1e"),
        ("ISD", "<PD>13246.0</PD>", "<PD>-3</PD>", "-3 found, 1 to 1e"),
        ("ISD", "<POLYORDER>-1", "<POLYORDER>3", "only -1"),
        ("ISD", "<NUMPOINTS>101", "<NUMPOINTS>100", "101 EPHEMLIST found, 100 "),
        ("ISD", "<NUMPOINTS>101", "<NUMPOINTS>1e9", "NUMPOINTS: 1e9 found, 8 to"),
        ("ISD", "<NUMROWS>4000", "<NUMROWS>4000.5", "4000.5 found, a whole number"),
        ("ISD", "<TLCLIST>0.0 0.0", "<TLCLIST>9e9 0.0", "lines of TLCLIST"),
        ("ISD", "<TLCTIME>2021", "<TLCTIME>noon 2021", "a time like"),
        ("ISD", "<TLCTIME>2021", "<TLCTIME>1950", "is not usable"),
        ("PHRDIMAP", "<SCALE>", "<SCALE>-", "SCALE: -"),
        ("PHRDIMAP", "<START>2021-06", "<START>2021-13", "a time like"),
        ("PHRDIMAP", "<Q2>", "<Q1>", "well-formed"),
        ("PHRDIMAP", "<COEFFICIENTS>0.0<", "<COEFFICIENTS><", "0 numbers found"),
        ("PHRDIMAP", "<COEFFICIENTS>0.0<", "<COEFFICIENTS>1e300<", "is not usable"),
        ("PHRDIMAP", "unit='m'>", "unit='m'>1 ", "4 numbers found, 3 expected"),
        ("PHRDIMAP", "PHR_Dimap_Document>", "Dimap_Document>", "expected <PHR_Dimap_Document>"),
        ("SPOT 5", 'version="1.1"', 'version="2.1"', "expected a DIMAP document of version 1"),
        ("SPOT 5", "LEVEL>1A", "LEVEL>1B", "PROCESSING_LEVEL: '1B' found, '1A' expected"),
        ("SPOT 5", "<DETECTOR_ID>2<", "<DETECTOR_ID>1<", "DETECTOR_ID: entry 2 is 0 after"),
        ("SPOT 5", "<NCOLS>3000", "<NCOLS>6000", "those of the 6000 columns expected"),
        ("SPOT 5", "<Location>", "<Place>", "well-formed"),
        ("SPOT 5", "<X>", "<X>x", "Location/X: expected a number, found 'x"),
        ("SPOT 4", ">N</OUT", ">Y</OUT", "Angles_List/Angles: 0 found, at least 1 expected"),
        ("DIMAP 2", "<PITCH>0.0", "<PITCH>0.1", "PITCH: 0.1 found, 0 to 0 expected"),
        ("DIMAP 2", '"microsecond"', '"hour"', "unit 'hour' found, one of microsecond"),
        ("DIMAP 2", "XLOS_", "XLOT_", "XLOS_0 is missing"),
        ("DIMAP 2", "<Q0>", "<Q0>7", "found, -1.1 to 1.1 expected"),
    ],
)
def test_the_message_names_file_field_value_and_expectation(
    product: str, pattern: str, new: str, message: str
) -> None:
    write, read, light_path = PRODUCTS[product]
    text = write(simulated.truth(light_path))
    assert pattern in text
    with pytest.raises(FormatError, match=re.escape(message)) as refusal:
        read(text.replace(pattern, new), "product.xml")
    assert str(refusal.value).startswith("product.xml: ")


@pytest.mark.parametrize("product", PRODUCTS)
def test_the_format_of_a_file_is_recognised(product: str, tmp_path: Path) -> None:
    write, read, light_path = PRODUCTS[product]
    text = write(simulated.truth(light_path))
    path = tmp_path / "METADATA.DIM"
    path.write_text(text)
    image = np.array([[10.0, 20.0]])
    height = np.array([1000.0])
    found = read_rigorous_model(path).locate(image, height)
    np.testing.assert_array_equal(found, read(text, "METADATA.DIM").locate(image, height))


def test_a_file_without_a_rigorous_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "RPC.XML"
    path.write_text("<Dimap_Document><METADATA_FORMAT version='3.0'/></Dimap_Document>")
    with pytest.raises(FormatError, match=re.escape("<Dimap_Document> of version unknown found")):
        read_rigorous_model(path)


@pytest.mark.parametrize("product", PRODUCTS)
def test_an_image_takes_the_rpc_fitted_to_the_rigorous_model_of_its_product(
    product: str, tmp_path: Path
) -> None:
    write, read, light_path = PRODUCTS[product]
    text = write(simulated.truth(light_path))
    (tmp_path / "product.xml").write_text(text)
    with rasterio.open(
        tmp_path / "image.tif", "w", driver="GTiff", width=300, height=400, count=1, dtype="uint8"
    ) as image:
        image.write(np.ones((1, 400, 300), dtype=np.uint8))
    delivered = read_rpc(tmp_path / "image.tif", tmp_path / "product.xml")
    assert delivered.convention == "rigorous"
    assert "RPC fitted to it within" in delivered.note
    rng = np.random.default_rng(9)
    positions = rng.uniform(0.0, 1.0, (200, 2)) * simulated.SHAPE
    ground = read(text, product).locate(positions, rng.uniform(0.0, 4000.0, 200))
    a_hundredth_of_a_pixel = 0.01
    np.testing.assert_allclose(delivered.model.project(ground), positions, atol=a_hundredth_of_a_pixel)
    written = write_model(delivered, delivered.model, tmp_path / "out")
    assert [path.name for path in written] == ["refined_RPC.TXT"]
