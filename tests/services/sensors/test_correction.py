"""Corrections in image space: inverted exactly, folded exactly, refused where that is impossible."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.sensors.correction import (
    CorrectedModel,
    ImageCorrection,
    fold_into_rpc,
    no_correction,
)
from amers.services.sensors.displacement import DisplacementGrid

MODEL = parse_rpc_text((Path(__file__).parents[2] / "golden" / "invented_RPC.TXT").read_text())
SHAPE = (26000, 26500)

a_nanopixel = 1e-9
rounding_of_the_image_px = 1e-8
"""Some hundred roundings of a coordinate of 26,000 px."""

a_fiftieth_of_its_size = 0.02

pixels = st.floats(-100.0, 100.0)


def correction(rows: list[list[float]]) -> ImageCorrection:
    return replace(no_correction(SHAPE), parameters=np.array(rows))


def ground() -> np.ndarray:
    axis = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return MODEL.ground_offset + grid * MODEL.ground_scale


def test_displacements_at_the_edges_and_the_centre_follow_from_the_parameters() -> None:
    moved = correction([[3.0, 2.0, 0.5], [-1.0, 0.25, 4.0]])
    centre = (np.array(SHAPE) - 1.0) / 2.0
    bottom, right = centre + [SHAPE[0] / 2.0, 0.0], centre + [0.0, SHAPE[1] / 2.0]
    at = np.array([centre, bottom, right])
    expected = [[3.0, -1.0], [5.0, -0.75], [3.5, 3.0]]
    np.testing.assert_allclose(moved.apply(at) - at, expected, rtol=0.0, atol=rounding_of_the_image_px)


@given(st.lists(st.lists(pixels, min_size=3, max_size=3), min_size=2, max_size=2))
def test_invert_is_the_inverse_of_apply(rows: list[list[float]]) -> None:
    at = np.random.default_rng(3).uniform(0.0, 26000.0, (50, 2))
    moved = correction(rows)
    back = moved.invert(moved.apply(at))
    np.testing.assert_allclose(back, at, rtol=0.0, atol=rounding_of_the_image_px)


@given(pixels, pixels, pixels, pixels)
def test_a_shift_and_a_drift_fold_into_the_rpc_exactly(a: float, b: float, c: float, d: float) -> None:
    moved = correction([[a, b, 0.0], [c, 0.0, d]])
    folded = fold_into_rpc(MODEL, moved)
    expected = CorrectedModel(MODEL, moved).project(ground())
    atol = rounding_of_the_image_px
    np.testing.assert_allclose(folded.project(ground()), expected, rtol=0.0, atol=atol)
    np.testing.assert_array_equal(folded.line_den, MODEL.line_den)
    np.testing.assert_array_equal(folded.image_offset, MODEL.image_offset)


@pytest.mark.parametrize("rows", [[[1, 0, 0.1], [1, 0, 0]], [[1, 0, 0], [1, -0.1, 0]]])
def test_a_correction_that_mixes_lines_and_samples_does_not_fold(rows: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="mixes lines and samples does not fold"):
        fold_into_rpc(MODEL, correction(rows))


def test_a_corrected_model_is_consistent_with_itself() -> None:
    model = CorrectedModel(MODEL, correction([[40.0, 2.0, 0.7], [-25.0, -0.4, 1.5]]))
    at = ground()
    line_sample = model.project(at)
    located = model.locate(line_sample, at[:, 2])
    atol = rounding_of_the_image_px
    np.testing.assert_allclose(model.project(located), line_sample, rtol=0.0, atol=10 * atol)
    assert model.height_range_m == MODEL.height_range_m
    base_origin, base_direction = MODEL.line_of_sight(model.correction.invert(line_sample))
    origin, direction = model.line_of_sight(line_sample)
    np.testing.assert_array_equal(origin, base_origin)
    np.testing.assert_array_equal(direction, base_direction)


def test_the_derivative_of_a_corrected_model_agrees_with_differences() -> None:
    model = CorrectedModel(MODEL, correction([[40.0, 900.0, 700.0], [-25.0, -400.0, 1500.0]]))
    at = np.array([MODEL.ground_offset])
    up = np.array([[0.0, 0.0, 1.0]])
    by_steps = (model.project(at + up) - model.project(at - up))[0] / 2.0
    np.testing.assert_allclose(model.project_derivative(at)[0, :, 2], by_steps, rtol=0.0, atol=1e-6)


def broken_grid() -> DisplacementGrid:
    """Lines behind line 100 lie 5 lines and 2 samples farther on; along the samples it rises by 1 px."""
    line, sample = np.array([0.0, 99.9, 100.1, 200.0]), np.array([0.0, 300.0])
    moved = np.array([0.0, 0.0, 1.0, 1.0])[:, None, None] * [5.0, 2.0] + [[[0.0, 0.0], [0.0, 1.0]]]
    return DisplacementGrid(line, sample, moved, np.zeros_like(moved), np.array([100.0]))


def test_a_chip_beside_a_break_shows_the_side_of_its_middle() -> None:
    middles = np.array([[95.0, 150.0], [99.0, 150.0], [101.0, 150.0], [105.0, 150.0]])
    shown = broken_grid().averaged(middles, 20.0)
    expected = [[0.0, 0.5], [0.0, 0.5], [5.0, 2.5], [5.0, 2.5]]
    np.testing.assert_allclose(shown, expected, atol=a_nanopixel)


def test_a_displacement_is_constant_beyond_its_nodes_and_so_is_its_derivative() -> None:
    grid, step = broken_grid(), 0.01
    outside = np.array([[250.0, 150.0], [50.0, -20.0], [50.0, 400.0], [-9.0, 150.0], [250.0, 400.0]])
    at = np.concatenate([outside, [[50.0, 150.0], [100.0, 150.0]]])
    by_difference = [(grid.at(at + one) - grid.at(at - one)) / (2.0 * step) for one in step * np.eye(2)]
    derivative = grid.derivative(at)
    np.testing.assert_allclose(derivative, np.stack(by_difference, axis=-1), atol=a_nanopixel)
    assert not derivative[-3].any()
    np.testing.assert_array_equal(grid.at(outside[4:]), grid.at(np.array([[200.0, 300.0]])))


def uneven_grid() -> DisplacementGrid:
    """Random displacements at nodes that are not evenly apart."""
    rng = np.random.default_rng(1)
    nodes = [np.cumsum(rng.uniform(20.0, 90.0, count)) for count in (6, 5)]
    return DisplacementGrid(*nodes, *rng.normal(size=(2, 6, 5, 2)))


def inside(grid: DisplacementGrid, margin: float) -> np.ndarray:
    """Positions (200, 2) within the nodes."""
    low, high = (
        np.array([nodes[end] for nodes in (grid.line, grid.sample)]) + shift
        for end, shift in ((0, margin), (-1, -margin))
    )
    return low + np.random.default_rng(2).random((200, 2)) * (high - low)


@pytest.mark.parametrize("of", ["displacement_px", "variance_px2"])
def test_a_displacement_is_bilinear_between_its_nodes_as_another_library_has_it(of: str) -> None:
    grid = uneven_grid()
    at = np.concatenate([inside(grid, 0.0), [[grid.line[2], grid.sample[3]]]])
    expected = RegularGridInterpolator((grid.line, grid.sample), getattr(grid, of))(at)
    found = grid.at(at) if of == "displacement_px" else grid.variance_at(at)
    np.testing.assert_allclose(found, expected, atol=a_nanopixel)


def test_the_derivative_of_a_displacement_is_that_of_its_differences() -> None:
    grid, step = uneven_grid(), 1e-3
    at = inside(grid, 1.0)
    near_a_node = [
        np.abs(at[:, k, None] - nodes).min(axis=1) for k, nodes in enumerate((grid.line, grid.sample))
    ]
    beyond = [
        inside(grid, 1.0)[:5] + shift for shift in 1e4 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ]
    at = np.concatenate([at[np.min(near_a_node, axis=0) > step], *beyond])
    by_difference = [(grid.at(at + one) - grid.at(at - one)) / (2.0 * step) for one in step * np.eye(2)]
    np.testing.assert_allclose(grid.derivative(at), np.stack(by_difference, axis=-1), atol=a_nanopixel)


def test_a_chip_shows_the_mean_of_what_lies_under_it_where_lines_and_samples_move_apart() -> None:
    nodes = np.linspace(0.0, 400.0, 401)
    moved = np.sin(nodes / 25.0)[:, None, None] * [1.0, 0.5] + np.cos(nodes / 40.0)[:, None] * [0.5, 1.0]
    grid = DisplacementGrid(nodes, nodes, moved, np.zeros_like(moved))
    middles, side = np.random.default_rng(3).uniform(60.0, 340.0, (20, 2)), 80.0
    over = (np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 101)] * 2), -1) * side).reshape(-1, 2)
    means = [grid.at(middle + over).mean(axis=0) for middle in middles]
    np.testing.assert_allclose(grid.averaged(middles, side), means, atol=a_fiftieth_of_its_size)
    assert np.abs(grid.at(middles) - means).max() > 0.3


def test_a_displacement_is_inverted_where_lines_and_samples_keep_their_order() -> None:
    """Of nodes some tens of pixels apart that move by up to a pixel, beside an affine correction."""
    moved = correction([[40.0, 300.0, -200.0], [-25.0, 100.0, 400.0]])
    moved = replace(moved, displacement=uneven_grid())
    at = np.concatenate([inside(uneven_grid(), 0.0), [[-500.0, 90.0], [9000.0, 20_000.0]]])
    assert np.abs(uneven_grid().at(at)).max() > 1.0
    np.testing.assert_allclose(moved.invert(moved.apply(at)), at, atol=rounding_of_the_image_px)


def test_no_correction_changes_nothing() -> None:
    at = np.array([[0.0, 0.0], [123.0, 456.0]])
    np.testing.assert_allclose(no_correction(SHAPE).apply(at), at, rtol=0.0, atol=a_nanopixel)


def test_no_position_has_less_variance_than_what_parts_of_the_image_are_off_by() -> None:
    """What the affine parameters share with a displacement is taken off its variance, at most all."""
    line, sample = (np.array([0.0, size - 1.0]) for size in SHAPE)
    grid = DisplacementGrid(line, sample, np.zeros((2, 2, 2)), np.full((2, 2, 2), -5.0))
    moved = replace(no_correction(SHAPE), displacement=grid)
    covariance = np.zeros((6, 6))
    covariance[0, 0], covariance[3, 3] = 4.0, 9.0
    (at_centre,) = moved.covariance_at(moved.centre[None, :], covariance, np.array([0.5, 2.0]))
    np.testing.assert_allclose(at_centre, np.diag([0.5**2, 9.0 - 5.0 + 2.0**2]))
