"""DIMAP: both versions give the same model, and a refined document is free of contradictions."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amers.services.errors import FormatError
from amers.services.formats.sensor_models.dimap import (
    format_dimap_rpc,
    parse_dimap_acquisition,
    parse_dimap_rpc,
)
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.sensors.correction import ImageCorrection, fold_into_rpc, no_correction
from amers.services.sensors.rpc import RpcModel, cubic_terms
from amers.services.types import Array

GOLDEN = Path(__file__).parents[3] / "golden"
V2 = (GOLDEN / "RPC_invented_v2.XML").read_text()
V3 = (GOLDEN / "RPC_invented_v3.XML").read_text()
MODEL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())

a_nanopixel = 1e-9
a_hundredth_of_a_pixel = 0.01

both_versions = pytest.mark.parametrize("text", [V2, V3], ids=["v2", "v3"])


def ground_of(model: RpcModel, extent: float = 0.9) -> Array:
    axis = np.linspace(-extent, extent, 6)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return model.ground_offset + grid * model.ground_scale


def corrected(parameters: list[list[float]]) -> RpcModel:
    correction: ImageCorrection = replace(no_correction((26000, 26500)), parameters=np.array(parameters))
    return fold_into_rpc(MODEL, correction)


def misfit_px(a: RpcModel, b: RpcModel) -> float:
    ground = ground_of(MODEL)
    return float(np.abs(a.project(ground) - b.project(ground)).max())


def locate_by_direct_model(text: str, line_sample: Array, height_m: Array) -> Array:
    """Longitudes and latitudes by the model to the ground, which the project does not read."""
    root = ElementTree.fromstring(text)
    places = root.findall(".//Direct_Model") + root.findall(".//ImagetoGround_Values")
    names = ("SAMP", "LINE") if places[0].tag == "Direct_Model" else ("LON", "LAT")

    def number(key: str) -> float:
        return float(root.findtext(f".//{key}"))

    first = 1.0 if places[0].tag == "Direct_Model" else 0.0
    normalised = np.column_stack(
        [
            (line_sample[:, 1] + first - number("SAMP_OFF")) / number("SAMP_SCALE"),
            (line_sample[:, 0] + first - number("LINE_OFF")) / number("LINE_SCALE"),
            (height_m - number("HEIGHT_OFF")) / number("HEIGHT_SCALE"),
        ]
    )
    sides = []
    for name, side in zip(names, ("LONG", "LAT"), strict=True):
        num, den = (
            np.array([float(places[0].findtext(f"{name}_{part}_COEFF_{i}")) for i in range(1, 21)])
            for part in ("NUM", "DEN")
        )
        ratio = cubic_terms(normalised) @ num / (cubic_terms(normalised) @ den)
        sides.append(ratio * number(f"{side}_SCALE") + number(f"{side}_OFF"))
    return np.column_stack(sides)


def contradiction_px(text: str, over: RpcModel = MODEL) -> float:
    """Distance in the image between the two models of a document, over the range of one."""
    model = parse_dimap_rpc(text)
    ground = ground_of(over)
    line_sample = model.project(ground)
    back = np.column_stack([locate_by_direct_model(text, line_sample, ground[:, 2]), ground[:, 2]])
    return float(np.abs(model.project(back) - line_sample).max())


@both_versions
def test_the_first_pixel_is_one_one_in_version_2_and_zero_zero_in_version_3(text: str) -> None:
    model = parse_dimap_rpc(text)
    np.testing.assert_array_equal(model.image_offset, MODEL.image_offset)
    np.testing.assert_array_equal(model.line_num, MODEL.line_num)
    assert misfit_px(model, MODEL) == 0.0


def test_version_3_may_start_at_one() -> None:
    text = V3.replace(">0</FIRST_", ">1</FIRST_")
    np.testing.assert_array_equal(parse_dimap_rpc(text).image_offset, MODEL.image_offset - 1.0)


@both_versions
def test_a_shift_and_a_drift_move_both_models_of_the_document(text: str) -> None:
    assert contradiction_px(text) < a_hundredth_of_a_pixel
    model = corrected([[40.0, 2.0, 0.0], [-25.0, 0.0, -1.5]])
    written = format_dimap_rpc(text, model)
    assert misfit_px(parse_dimap_rpc(written), model) < 1e3 * a_nanopixel
    assert contradiction_px(written) < a_hundredth_of_a_pixel
    changed = [(a, b) for a, b in zip(text.splitlines(), written.splitlines(), strict=True) if a != b]
    assert len(changed) == 4
    assert all("_OFF" in a or "_SCALE" in a for a, _ in changed)


@both_versions
def test_a_model_that_mixes_lines_and_samples_is_written_in_both_directions(text: str) -> None:
    mixed = replace(MODEL, line_num=MODEL.line_num + 1e-3 * MODEL.sample_num)
    written = format_dimap_rpc(text, mixed)
    np.testing.assert_array_equal(parse_dimap_rpc(written).line_num, mixed.line_num)
    assert misfit_px(parse_dimap_rpc(written), mixed) == 0.0
    assert contradiction_px(text) < a_hundredth_of_a_pixel
    assert contradiction_px(written) < a_hundredth_of_a_pixel
    changed = [(a, b) for a, b in zip(text.splitlines(), written.splitlines(), strict=True) if a != b]
    assert all("_COEFF_" in a or "_OFF" in a for a, _ in changed)
    assert len(changed) > 80


@both_versions
def test_a_contradictory_model_to_the_ground_is_removed(text: str, monkeypatch) -> None:
    monkeypatch.setattr("amers.services.formats.sensor_models.dimap.TO_GROUND_LIMIT_PX", 0.0)
    mixed = replace(MODEL, line_num=MODEL.line_num + 1e-3 * MODEL.sample_num)
    written = format_dimap_rpc(text, mixed)
    assert misfit_px(parse_dimap_rpc(written), mixed) == 0.0
    assert "Direct_Model>" not in written
    assert "ImagetoGround_Values" not in written
    assert "<!-- invented -->" in written


@both_versions
def test_a_document_takes_the_model_of_another_region(text: str) -> None:
    elsewhere = replace(MODEL, ground_offset=MODEL.ground_offset + np.array([5.0, -3.0, 100.0]))
    read = parse_dimap_rpc(format_dimap_rpc(text, elsewhere))
    np.testing.assert_array_equal(read.ground_offset, elsewhere.ground_offset)


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("<Dimap_Document>", "<!DOCTYPE x [<!ENTITY a 'b'>]><Dimap_Document>", "document type"),
        ('version="2.15"', 'version="1.1"', "expected a DIMAP document of version 2 or 3"),
        ("Dimap_Document>", "Other_Document>", "found <Other_Document>"),
        ("<LINE_OFF>", "<LINE_OFF>1</LINE_OFF><LINE_OFF>", "expected one LINE_OFF .* found 2"),
        ("LONG_SCALE>", "LON_SCALE>", "expected one LONG_SCALE .* found 0"),
        ("<LINE_OFF>13000.5", "<LINE_OFF>inf", "LINE_OFF: expected a number, found 'inf'"),
        ("</Dimap_Document>", "", "expected a well-formed XML document"),
    ],
)
def test_a_wrong_document_is_refused_with_a_reason(was: str, becomes: str, says: str) -> None:
    assert was in V2
    with pytest.raises(FormatError, match=says):
        parse_dimap_rpc(V2.replace(was, becomes))


@given(st.integers(0, len(V2) - 20))
def test_a_truncated_document_is_a_format_error(size: int) -> None:
    with pytest.raises(FormatError):
        parse_dimap_rpc(V2[:size])


@settings(max_examples=200)
@given(st.data(), st.sampled_from([V2, V3]))
def test_a_garbled_document_gives_a_model_or_a_format_error(data, text: str) -> None:
    start = data.draw(st.integers(0, len(text)))
    size = data.draw(st.integers(0, 200))
    garbled = text[:start] + data.draw(st.text(max_size=50)) + text[start + size :]
    for read in (parse_dimap_rpc, lambda t: parse_dimap_acquisition(t, "image")):
        try:
            read(garbled)
        except FormatError:
            continue


def test_sensor_time_and_sun_are_read_from_a_product_document() -> None:
    text = (
        '<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.15"/>'
        "<METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification><Strip_Source>"
        "<MISSION>PHR</MISSION><MISSION_INDEX>1A</MISSION_INDEX><IMAGING_DATE>2021-03-04</IMAGING_DATE>"
        "<IMAGING_TIME>10:36:09.1Z</IMAGING_TIME></Strip_Source>"
        "<Located_Geometric_Values><LOCATION_TYPE>TopCenter</LOCATION_TYPE><Solar_Incidences>"
        "<SUN_AZIMUTH>1</SUN_AZIMUTH><SUN_ELEVATION>2</SUN_ELEVATION></Solar_Incidences>"
        "</Located_Geometric_Values><Located_Geometric_Values><LOCATION_TYPE>Center</LOCATION_TYPE>"
        "<Solar_Incidences><SUN_AZIMUTH>142.5</SUN_AZIMUTH><SUN_ELEVATION>52.25</SUN_ELEVATION>"
        "</Solar_Incidences></Located_Geometric_Values></Dimap_Document>"
    )
    acquisition = parse_dimap_acquisition(text, "image")
    assert (acquisition.image_id, acquisition.sensor) == ("image", "PHR1A")
    assert acquisition.acquired_at == datetime(2021, 3, 4, 10, 36, 9, 100_000, tzinfo=UTC)
    assert (acquisition.sun_azimuth_deg, acquisition.sun_elevation_deg) == (142.5, 52.25)


def test_an_rpc_document_gives_the_family_of_the_sensor_only() -> None:
    acquisition = parse_dimap_acquisition(V3, "image")
    assert (acquisition.sensor, acquisition.acquired_at) == ("PNEO", None)


@pytest.mark.real_data
@pytest.mark.parametrize("folder", ["phr_rpc_only/calanques", "phr_rpc_only/toulouse"])
def test_both_models_of_a_delivered_document_still_agree(real_data: Path, folder: str) -> None:
    path = sorted((real_data / folder).glob("RPC*.XML"))[0]
    text = path.read_text()
    own = parse_dimap_rpc(text)
    mixed = replace(own, line_num=own.line_num + 1e-4 * own.sample_num)
    written = format_dimap_rpc(text, mixed)
    delivered_px, written_px = contradiction_px(text, own), contradiction_px(written, own)
    assert written_px < a_hundredth_of_a_pixel
    assert written_px < 2.0 * delivered_px + 0.001
