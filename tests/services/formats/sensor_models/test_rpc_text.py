"""RPC text files survive a round trip; a bad file raises a FormatError and nothing else."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from amers.services.errors import FormatError
from amers.services.formats.sensor_models.rpc_text import (
    format_rpb,
    format_rpc_text,
    parse_rpb,
    parse_rpc_text,
    rpb_satellite,
)
from amers.services.formats.text_files import parse_number
from amers.services.sensors.rpc import RpcModel

TEXT = (Path(__file__).parents[3] / "golden" / "invented_RPC.TXT").read_text()
RPB = (Path(__file__).parents[3] / "golden" / "invented.RPB").read_text()

numbers = st.floats(allow_nan=False, allow_infinity=False)
errors = st.one_of(st.just(math.nan), st.floats(1e-300, 1e300))


def array(size: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, size, elements=numbers)


models = st.builds(RpcModel, *[array(20)] * 4, array(2), array(2), array(3), array(3), errors, errors)


def assert_same(a: RpcModel, b: RpcModel) -> None:
    for field in fields(RpcModel):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_the_numbers_of_the_golden_text_are_read() -> None:
    model = parse_rpc_text(TEXT)
    assert model.image_offset.tolist() == [12999.5, 13249.25]
    assert model.image_scale.tolist() == [13000.0, 13250.0]
    assert model.ground_offset.tolist() == [12.3456789, 41.9012345, 310.0]
    assert model.ground_scale.tolist() == [0.0801, 0.0602, 420.0]
    assert model.line_num[:3].tolist() == [2.1e-3, 0.0183, -1.021]
    assert model.sample_den[:4].tolist() == [1.0, 4.4e-4, 2.6e-4, -3.1e-5]
    assert (model.error_bias_m, model.error_random_m) == (2.5, 0.25)


def test_rpb_and_text_hold_the_same_model() -> None:
    assert_same(parse_rpb(RPB), parse_rpc_text(TEXT))
    assert rpb_satellite(RPB) == "WV02"


@given(models)
@pytest.mark.long
def test_every_number_survives_the_text(model: RpcModel) -> None:
    assert_same(parse_rpc_text(format_rpc_text(model)), model)


@given(models)
@pytest.mark.long
def test_every_number_survives_the_rpb(model: RpcModel) -> None:
    text = format_rpb(model, "GE01")
    assert_same(parse_rpb(text), model)
    assert rpb_satellite(text) == "GE01"


def test_unknown_errors_are_omitted_from_the_text() -> None:
    model = replace(parse_rpc_text(TEXT), error_bias_m=math.nan, error_random_m=math.nan)
    assert "ERR_" not in format_rpc_text(model)


def test_a_negative_error_means_unknown() -> None:
    model = parse_rpc_text(TEXT.replace("ERR_BIAS: 2.5", "ERR_BIAS: -1"))
    assert math.isnan(model.error_bias_m)


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("LAT_OFF: 41.9012345 degrees\n", "", "LAT_OFF is missing"),
        ("LAT_OFF: 41.9012345 degrees\n", "LAT_OFF: 41,9\n", "line 5: expected 'KEY: number'"),
        ("LAT_OFF: 41.9012345 degrees\n", "LAT_OFF: nan\n", "line 5: expected 'KEY: number'"),
        ("LAT_OFF: 41.9012345 degrees\n", "LONG_OFF: 1\n", "LONG_OFF is given twice"),
    ],
)
def test_a_wrong_line_of_the_text_is_named(was: str, becomes: str, says: str) -> None:
    assert was in TEXT
    with pytest.raises(FormatError, match=says):
        parse_rpc_text(TEXT.replace(was, becomes))


@pytest.mark.parametrize(
    ("was", "becomes", "says"),
    [
        ("RPC00B", "RPC00A", "SpecId: expected RPC00B, found RPC00A"),
        ("\tlineOffset = 12999.5;\n", "", "LINE_OFF is missing"),
        ("\t\t\t+1.017000000000000E+00,\n", "", "SAMP_NUM_COEFF_20 is missing"),
        ("+1.017000000000000E+00", "one", "SAMP_NUM_COEFF_2: expected a number, found 'one'"),
    ],
)
def test_a_wrong_field_of_the_rpb_is_named(was: str, becomes: str, says: str) -> None:
    assert was in RPB
    with pytest.raises(FormatError, match=says):
        parse_rpb(RPB.replace(was, becomes))


@pytest.mark.parametrize("blank", ["\t", "\x1c", "\x1d", "\x1e", "\x1f", "\x85", "\u00a0", "\u2003"])
def test_whatever_text_calls_blank_may_stand_around_a_number(blank: str) -> None:
    assert parse_number(f"{blank}12.5{blank}", "height", "a file") == 12.5


def read_or_refuse(parse, text: str) -> None:
    try:
        parse(text)
    except FormatError:
        return


@given(st.integers(0, len(TEXT) - 80), st.integers(0, len(RPB) - 80))
def test_a_truncated_file_is_a_format_error(text_size: int, rpb_size: int) -> None:
    with pytest.raises(FormatError):
        parse_rpc_text(TEXT[:text_size])
    with pytest.raises(FormatError):
        parse_rpb(RPB[:rpb_size])


@settings(max_examples=200)
@given(st.data(), st.sampled_from([(parse_rpc_text, TEXT), (parse_rpb, RPB)]))
def test_a_garbled_file_gives_a_model_or_a_format_error(data, kind) -> None:
    parse, text = kind
    start = data.draw(st.integers(0, len(text)))
    size = data.draw(st.integers(0, 200))
    read_or_refuse(parse, text[:start] + data.draw(st.text(max_size=50)) + text[start + size :])


@given(st.text())
def test_any_text_gives_a_model_or_a_format_error(text: str) -> None:
    read_or_refuse(parse_rpc_text, text)
    read_or_refuse(parse_rpb, text)
