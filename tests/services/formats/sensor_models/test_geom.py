"""OSSIM keyword lists give the RPC that OSSIM computes with; a bad value is refused by its key."""

import math
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amers.services.errors import FormatError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.geom import (
    format_geom,
    is_geom,
    parse_geom,
    parse_geom_acquisition,
)
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array

GOLDEN = Path(__file__).parents[3] / "golden"
MODEL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())
TEXT = (GOLDEN / "invented.geom").read_text()
TEXT_A = (GOLDEN / "invented_a.geom").read_text()
GROUND = MODEL.ground_offset + MODEL.ground_scale * np.random.default_rng(1).uniform(-1, 1, (50, 3))

a_nanopixel = 1e-9


def ossim(ground: Array, adjusted: dict[str, float]) -> Array:
    """The formula of `ossimRpcModel::worldToLineSample` on the golden polynomials, without rotation."""
    plain = (MODEL.project(ground) - MODEL.image_offset) / MODEL.image_scale
    scale = MODEL.image_scale + [adjusted["intrack_scale"], adjusted["crtrack_scale"]]
    offset = MODEL.image_offset + [adjusted["intrack_offset"], adjusted["crtrack_offset"]]
    return np.asarray(plain * scale + offset)


def with_value(text: str, key: str, value: str) -> str:
    changed, count = re.subn(rf"(?m)^{re.escape(key)}: .*$", f"{key}:  {value}", text)
    assert count == 1
    return changed


@pytest.mark.parametrize("text", [TEXT, TEXT_A])
def test_both_orders_of_the_terms_give_the_model_of_the_other_formats(text: str) -> None:
    model, mended = parse_geom(text)
    np.testing.assert_allclose(model.project(GROUND), MODEL.project(GROUND), rtol=0, atol=a_nanopixel)
    assert (model.error_bias_m, model.error_random_m) == (2.5, 0.25)
    assert mended == ""


def test_sensor_time_and_sun_are_read() -> None:
    acquisition = parse_geom_acquisition(TEXT, "a")
    assert acquisition.sensor == "PHR1B"
    assert acquisition.acquired_at == datetime(2024, 5, 28, 10, 25, 7, 400_000, tzinfo=UTC)
    assert (acquisition.sun_elevation_deg, acquisition.sun_azimuth_deg) == (60.2, 150.4)


def test_adjustments_change_the_model_as_in_ossim() -> None:
    text = with_value(TEXT, "adjustment_0.adj_param_0.parameter", "0.25")
    text = with_value(text, "adjustment_0.adj_param_1.center", "-3.5")
    text = with_value(text, "adjustment_0.adj_param_2.parameter", "0.02")
    model, mended = parse_geom(text)
    adjusted = {
        "intrack_offset": 12.5,
        "crtrack_offset": -3.5,
        "intrack_scale": 1.0,
        "crtrack_scale": 0.0,
    }
    np.testing.assert_allclose(model.project(GROUND), ossim(GROUND, adjusted), rtol=0, atol=a_nanopixel)
    assert mended == "its adjustment applied"


def test_only_the_current_adjustment_counts() -> None:
    second = "".join(
        line.replace("adjustment_0", "adjustment_1") + "\n"
        for line in TEXT.splitlines()
        if line.startswith("adjustment_0")
    )
    second = with_value(second, "adjustment_1.adj_param_0.center", "7")
    text = with_value(TEXT + second, "number_of_adjustments", "2")
    assert parse_geom(text)[0].image_offset.tolist() == MODEL.image_offset.tolist()
    chosen = parse_geom(with_value(text, "current_adjustment", "1"))[0]
    assert chosen.image_offset.tolist() == (MODEL.image_offset + [7.0, 0.0]).tolist()


def test_a_rotation_is_refused_not_ignored() -> None:
    text = with_value(TEXT, "adjustment_0.adj_param_4.parameter", "0.5")
    with pytest.raises(
        FormatError, match=r"a\.geom: .*adj_param_4 \(map_rotation\) is 0\.05, 0 expected"
    ):
        parse_geom(text, "a.geom")


def whole_product(kind: str, offset: float, scale: float, count: int) -> str:
    text = with_value(TEXT, "type", kind)
    for axis, size in (("line", "number_lines"), ("samp", "number_samples")):
        text = with_value(text, f"{axis}_off", repr(offset))
        text = with_value(with_value(text, f"{axis}_scale", repr(scale)), size, str(count))
    return text


@pytest.mark.parametrize(
    ("kind", "offset", "scale", "count", "right"),
    [
        ("ossimPleiadesModel", 31321.0, 31321.5, 62644, 31321.5),
        ("ossimPleiadesModel", 31321.5, 31321.5, 62644, 31321.5),
        ("ossimPleiadesModel", 3628.0, 3628.5, 7235, 3628.0),
        ("ossimPleiadesModel", 21109.5, 21137.5, 41801, 21109.5),
        ("ossimSpot6Model", 4848.0, 4848.0, 9696, 4847.0),
        ("ossimSpot6Model", 4847.0, 4848.0, 9696, 4847.0),
        ("ossimSpot6Model", 12388.0, 12388.5, 24777, 12387.5),
        ("ossimSpot6Model", 12387.0, 12388.5, 24777, 12387.5),
        ("ossimRpcModel", 31321.0, 31321.5, 62644, 31321.0),
    ],
)
def test_a_lost_part_of_a_pixel_is_mended_where_the_size_of_the_product_tells_it(
    kind: str, offset: float, scale: float, count: int, right: float
) -> None:
    model, mended = parse_geom(whole_product(kind, offset, scale, count))
    assert model.image_offset.tolist() == [right, right]
    assert (f"line_off {offset:g} taken as {right:g}" in mended) == (offset != right)


@pytest.mark.parametrize(
    "missing", ["bias_error", "rand_error", "rect", "number_lines", "sensor", "type"]
)
def test_optional_keys_may_be_missing(missing: str) -> None:
    model, _ = parse_geom(re.sub(rf"(?m)^{missing}:.*\n", "", TEXT))
    assert model.image_offset.tolist() == MODEL.image_offset.tolist()
    assert math.isnan(model.error_bias_m) == (missing == "bias_error")


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("line_num_coeff_07", "one", "a.geom: line_num_coeff_07: expected a number, found 'one'"),
        ("long_off", "nan", "a.geom: long_off: expected a number, found 'nan'"),
        ("polynomial_format", "C", "a.geom: polynomial_format: expected A or B, found C"),
        (
            "current_adjustment",
            "-1",
            "a.geom: current_adjustment: expected a count up to 999, found '-1'",
        ),
        ("adjustment_0.adj_param_0.sigma", "x", "adj_param_0.sigma: expected a number, found 'x'"),
        ("number_lines", "many", "a.geom: number_lines: expected a number, found 'many'"),
    ],
)
def test_a_wrong_value_is_named(key: str, value: str, says: str) -> None:
    with pytest.raises(FormatError, match=re.escape(says)):
        parse_geom(with_value(TEXT, key, value), "a.geom")


def test_a_missing_a_double_and_a_broken_line_are_named() -> None:
    with pytest.raises(FormatError, match=r"a\.geom: samp_den_coeff_19 is missing, a number expected"):
        parse_geom(re.sub(r"samp_den_coeff_19:.*\n", "", TEXT), "a.geom")
    with pytest.raises(FormatError, match=r"line 2: type is given twice"):
        parse_geom("type: ossimRpcModel\n" + TEXT, "a.geom")
    with pytest.raises(FormatError, match=r"line 1: expected 'key: value', found 'words'"):
        parse_geom("words\n" + TEXT, "a.geom")


def test_a_list_of_a_rigorous_model_says_that_it_has_no_rpc() -> None:
    with pytest.raises(FormatError, match=r"a \.geom of ossimSpot5Model without one holds no RPC"):
        parse_geom("type:  ossimSpot5Model\nnumber_lines:  6000\n")


def test_a_refined_model_is_written_without_the_old_adjustment_and_reads_back_to_the_bit() -> None:
    refined: RpcModel = replace(MODEL, image_offset=MODEL.image_offset - [9000.25, 15000.75])
    adjusted = with_value(TEXT, "adjustment_0.adj_param_0.parameter", "0.25")
    text = format_geom(refined, adjusted)
    again, mended = parse_geom(text)
    np.testing.assert_array_equal(again.project(GROUND), refined.project(GROUND))
    assert mended == ""
    assert is_geom(text)
    assert parse_geom_acquisition(text, "a").sensor == "PHR1B"


@settings(max_examples=200)
@given(st.data(), st.sampled_from([TEXT, TEXT_A]))
def test_a_garbled_file_is_a_model_or_a_format_error(data: st.DataObject, text: str) -> None:
    start = data.draw(st.integers(0, len(text)))
    size = data.draw(st.integers(0, 200))
    read_or_refuse(text[:start] + data.draw(st.text(max_size=50)) + text[start + size :])


def read_or_refuse(text: str) -> None:
    try:
        parse_geom(text)
        parse_geom_acquisition(text, "a")
    except FormatError:
        return


@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_geom_of_otb_is_the_dimap_of_the_same_image(real_data: Path) -> None:
    folder = real_data / "phr_ventoux_pair"
    image, geom = folder / "left_image.tif", folder / "left_image.geom"
    own = read_rpc(image, geom)
    dimap = read_rpc(image, next(folder.glob("RPC_*.XML")))
    assert (own.convention, own.crop_origin) == ("geom", dimap.crop_origin)
    ground = dimap.model.ground_offset + dimap.model.ground_scale * np.random.default_rng(2).uniform(
        -1, 1, (200, 3)
    )
    a_millionth_of_a_pixel = 1e-6
    np.testing.assert_allclose(
        own.model.project(ground), dimap.model.project(ground), rtol=0, atol=a_millionth_of_a_pixel
    )
    acquisition = read_scene(image, geom).acquisition
    assert acquisition.sensor == "PHR1B"
    assert acquisition.acquired_at == datetime(2013, 8, 5, 10, 42, 19, 400_000, tzinfo=UTC)


@pytest.mark.real_data
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("view", ["1", "2"])
def test_the_geom_of_a_full_scene_is_shifted_to_the_crop(real_data: Path, view: str) -> None:
    image = real_data / "phr_gizeh_pair" / f"img{view}.tif"
    own, full = read_rpc(image), read_rpc(image, image.with_suffix(".geom"))
    assert full.crop_origin == {"1": (5000.0, 20500.0), "2": (5476.0, 20501.0)}[view]
    np.testing.assert_allclose(full.model.image_offset, own.model.image_offset, rtol=0, atol=a_nanopixel)


@pytest.mark.real_data
def test_every_delivered_geom_is_read_and_a_rigorous_model_refused(real_data: Path) -> None:
    folder = real_data / "rigorous_metadata" / "otb_geom"
    text = {file.stem: file.read_text("latin-1") for file in sorted(folder.glob("*/*.geom"))}
    with pytest.raises(FormatError, match="ossimSpot5Model without one holds no RPC"):
        parse_geom(text.pop("spot5-1"))
    read = {name: parse_geom(content, name) for name, content in text.items()}
    assert len(read) >= 11
    assert read["pleiades-1"][0].image_offset.tolist() == [31321.5, 20999.5]
    assert read["maido"][0].image_offset.tolist() == [3628.0, 2177.5]
    a, b = (read[f"spot6-{k}"][0].image_offset.tolist() for k in (1, 2))
    assert a == b == [4847.0, 4825.0]
