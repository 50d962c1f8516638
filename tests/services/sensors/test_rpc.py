"""The RPC agrees with two other implementations and with itself, also at the limits of its range."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rpcfast
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import RPCTransformer

from amers.services.errors import FormatError
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.geodesy import ecef_from_lon_lat_h, lon_lat_h_from_east_north_up
from amers.services.sensors.rpc import RpcModel, check_rpc
from amers.services.types import Array

MODEL = parse_rpc_text((Path(__file__).parents[2] / "golden" / "invented_RPC.TXT").read_text())

a_nanopixel = 1e-9
a_millionth_of_a_pixel = 1e-6
a_nanodegree = 1e-9
gdal_first_pixel = 0.5
"""GDAL counts from the corner of the first pixel: its centre is (0.5, 0.5)."""

within = st.floats(-1.0, 1.0)


def ground_of(model: RpcModel, n: int = 2000, extent: float = 1.0) -> Array:
    normalised = np.random.default_rng(7).uniform(-extent, extent, (n, 3))
    return model.ground_offset + normalised * model.ground_scale


def fast(model: RpcModel) -> rpcfast.RPCModel:
    rpc = gdal_rpc(model)
    names = ["line_off", "samp_off", "lat_off", "long_off", "height_off"]
    names += ["line_scale", "samp_scale", "lat_scale", "long_scale", "height_scale"]
    names += ["line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff"]
    return rpcfast.RPCModel(**{name: np.asarray(getattr(rpc, name)) for name in names})


def test_project_agrees_with_another_library() -> None:
    ground = ground_of(MODEL)
    sample, line = rpcfast.project(fast(MODEL), *ground.T)
    np.testing.assert_allclose(
        MODEL.project(ground), np.column_stack([line, sample]), rtol=0.0, atol=a_nanopixel
    )


def test_project_agrees_with_gdal_except_for_its_half_pixel() -> None:
    ground = ground_of(MODEL)
    with RPCTransformer(gdal_rpc(MODEL)) as gdal:
        line, sample = gdal.rowcol(*ground.T, op=lambda x: x)
    by_gdal = np.column_stack([line, sample]) - gdal_first_pixel
    np.testing.assert_allclose(MODEL.project(ground), by_gdal, rtol=0.0, atol=a_millionth_of_a_pixel)


@given(within, within, within)
def test_locate_inverts_project(x: float, y: float, z: float) -> None:
    ground = (MODEL.ground_offset + np.array([x, y, z]) * MODEL.ground_scale)[None, :]
    line_sample = MODEL.project(ground)
    located = MODEL.locate(line_sample, ground[:, 2])
    np.testing.assert_allclose(located[:, :2], ground[:, :2], rtol=0.0, atol=a_nanodegree)
    assert located[0, 2] == ground[0, 2]
    assert np.abs(MODEL.project(located) - line_sample).max() < a_millionth_of_a_pixel


@pytest.mark.parametrize("far", [1e6, 1e9, 1e12, 1e300, math.inf, math.nan])
def test_positions_far_away_are_nan_and_do_not_affect_others(far: float) -> None:
    near = [13000.0, 13000.0]
    line_sample = np.array([[far, 0.0], [0.0, -far], [far, far], near])
    located = MODEL.locate(line_sample, np.full(4, 300.0))
    assert np.isnan(located[:3]).all()
    assert np.isfinite(located[3]).all()
    ground = np.array([[far, 42.0, 300.0], [12.3, far, 300.0], [12.3, 41.9, far], [12.3, 41.9, 300.0]])
    projected = MODEL.project(ground)
    assert np.isnan(projected[:3]).all()
    assert np.isfinite(projected[3]).all()
    assert np.isnan(MODEL.project_derivative(ground)[:3]).all()


def test_arrays_of_any_memory_layout_are_accepted() -> None:
    ground = ground_of(MODEL, 50)
    columns_first = np.asfortranarray(ground)
    np.testing.assert_array_equal(MODEL.project(columns_first), MODEL.project(ground))


@pytest.mark.parametrize("centre", [179.99, -179.99])
def test_a_scene_over_the_antimeridian_has_the_same_precision(centre: float) -> None:
    model = replace(MODEL, ground_offset=np.array([centre, *MODEL.ground_offset[1:]]))
    ground = ground_of(model)
    wrapped = ground.copy()
    wrapped[:, 0] = (ground[:, 0] + 180.0) % 360.0 - 180.0
    assert (wrapped[:, 0] < 0).any()
    assert (wrapped[:, 0] > 0).any()
    expected = MODEL.project(ground - model.ground_offset + MODEL.ground_offset)
    np.testing.assert_allclose(model.project(wrapped), expected, rtol=0.0, atol=a_millionth_of_a_pixel)
    located = model.locate(expected, wrapped[:, 2])
    assert (np.abs(located[:, 0]) <= 180.0).all()
    np.testing.assert_allclose(located, wrapped, rtol=0.0, atol=a_nanodegree)


def test_the_derivative_agrees_with_differences_on_the_ground() -> None:
    ground, step_m = ground_of(MODEL, 50), 1.0
    derivative = MODEL.project_derivative(ground)
    for axis in range(3):
        step = np.zeros((1, 3))
        step[0, axis] = step_m
        after = np.concatenate([lon_lat_h_from_east_north_up(step, point) for point in ground])
        before = np.concatenate([lon_lat_h_from_east_north_up(-step, point) for point in ground])
        by_steps = (MODEL.project(after) - MODEL.project(before)) / (2.0 * step_m)
        np.testing.assert_allclose(derivative[:, :, axis], by_steps, rtol=0.0, atol=1e-6)


def test_lines_of_sight_pass_through_the_located_ground() -> None:
    line_sample = np.array([[100.0, 200.0], [13000.0, 13000.0], [25000.0, 20000.0]])
    origin, direction = MODEL.line_of_sight(line_sample)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-15)
    low, _ = MODEL.height_range_m
    bottom = ecef_from_lon_lat_h(MODEL.locate(line_sample, np.full(3, low)))
    along = bottom - origin
    miss_m = np.linalg.norm(along - (along * direction).sum(axis=1)[:, None] * direction, axis=1)
    assert (miss_m < 1e-6).all()
    assert ((along * direction).sum(axis=1) > 0).all()


def test_a_good_model_passes_its_check_unchanged() -> None:
    assert check_rpc(MODEL, "invented") is MODEL


def spoiled(**changes: object) -> RpcModel:
    return replace(MODEL, **changes)


den_through_zero = np.zeros(20)
den_through_zero[:2] = 0.5, 1.0


@pytest.mark.parametrize(
    ("model", "says"),
    [
        (spoiled(line_den=np.zeros(20)), "line denominator of the RPC vanishes"),
        (spoiled(sample_den=den_through_zero), "sample denominator of the RPC vanishes"),
        (spoiled(line_num=np.full(20, math.nan)), "not finite"),
        (spoiled(image_scale=np.array([0.0, 1.0])), "scale that is zero or negative"),
        (spoiled(ground_scale=np.array([0.1, -0.1, 100.0])), "scale that is zero or negative"),
        (spoiled(ground_offset=np.array([12.0, 91.0, 0.0])), "outside the Earth"),
        (spoiled(sample_num=MODEL.line_num, sample_den=MODEL.line_den), "cannot be inverted"),
        (spoiled(line_num=np.zeros(20)), "cannot be inverted"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_unusable_model_is_refused_with_the_reason(model: RpcModel, says: str) -> None:
    with pytest.raises(FormatError, match=f"a file: .*{says}"):
        check_rpc(model, "a file")
