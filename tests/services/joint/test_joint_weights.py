"""How much ties and control points of a block count, and what their residuals are taken for."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.joint.block import JointBlock, adjust_together
from amers.services.joint.fitting import scene_fit
from amers.services.joint.measured import MeasuredScene
from amers.services.joint.model_errors import _variance
from amers.services.joint.registration import _uncertainty_m
from amers.services.joint.results import ground_misfits_m, tie_residual_px
from amers.services.quality.stability import image_places
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, Frame, Observations
from tests.services.joint.test_joint_block import FRAME, GSD_M, OPTIONS, SHAPE, observed, truth_of

TIE_NOISE_PX = 0.2


@cache
def scenes_and_ties() -> tuple[list[MeasuredScene], Observations]:
    rng = np.random.default_rng(14)
    return observed(truth_of(rng), rng)


@cache
def whole() -> JointBlock:
    return adjust_together(*scenes_and_ties(), OPTIONS)


def test_residuals_are_as_large_as_the_positions_of_tie_points_leave_of_what_is_stated() -> None:
    """Each coordinate in units of its sigma; three of those of a point place it on the ground."""
    block = whole()
    vague = replace(block, ties=replace(block.ties, sigma_px=2.0 * block.ties.sigma_px))
    coordinates = 2.0 * np.bincount(block.ties.point)[block.ties.point]
    for number in range(3):
        own, fit = block.of_ties(number), scene_fit(block, number)
        left = np.sqrt(np.mean(1.0 - 3.0 / coordinates[own]))
        assert fit.normalised == pytest.approx(left, rel=0.1)
        assert 0.9 * fit.ties < fit.used_ties < fit.ties == len(own)
        assert 8 * fit.used_control == pytest.approx(fit.used_ties, rel=0.2)
        assert scene_fit(vague, number).normalised == pytest.approx(left * 0.6, rel=0.15)


def test_a_point_is_as_uncertain_in_a_scene_of_a_block_as_the_model_and_as_its_ground() -> None:
    block, points = whole(), scenes_and_ties()[0][1].points
    n = len(points)

    def squares_m2(sigmas_m: tuple[float, float, float]) -> Array:
        own = replace(points, covariance_m2=np.tile(np.diag(sigmas_m) ** 2, (n, 1, 1)))
        return _uncertainty_m(block, 1, own) ** 2

    exact, level = squares_m2((0.0, 0.0, 0.0)), squares_m2((3.0, 3.0, 0.0))
    assert (exact > 0.0).all()
    assert np.sqrt(exact).max() < 1.0
    np.testing.assert_allclose(level - exact, 9.0, rtol=0.1)
    # Seen 8 degrees from the vertical, a height moves a point by its tangent.
    high = squares_m2((0.0, 0.0, 30.0)) - exact
    assert (high < 1.1 * (30.0 * np.tan(np.radians(8.0))) ** 2).all()
    assert (high > 0.4 * (30.0 * np.tan(np.radians(8.0))) ** 2).all()


def no_ties() -> Observations:
    ties = scenes_and_ties()[1]
    return ties.take(np.zeros(len(ties), dtype=bool))


def test_ties_are_as_precise_as_their_residuals_whatever_is_stated() -> None:
    scenes, ties = scenes_and_ties()
    for stated in (0.5, 1.0, 2.0):
        block = adjust_together(scenes, replace(ties, sigma_px=ties.sigma_px * stated), OPTIONS)
        np.testing.assert_allclose(block.ties.sigma_px, TIE_NOISE_PX, rtol=0.25)
        assert block.tie_sigma * stated == pytest.approx(1.0, rel=0.25)


def test_ties_of_a_scene_are_as_uncertain_as_what_moves_its_lines() -> None:
    """By three times their noise: those of the other scenes are not."""
    scenes, ties = list(scenes_and_ties()[0]), scenes_and_ties()[1]
    line, sample = (np.array([0.0, side - 1.0]) for side in SHAPE)
    variance_px2 = np.full((2, 2, 2), 9.0 * TIE_NOISE_PX**2)
    grid = DisplacementGrid(line, sample, np.zeros((2, 2, 2)), variance_px2)
    alone = scenes[0].alone
    assert alone is not None
    moved = replace(alone, correction=replace(alone.correction, displacement=grid))
    scenes[0] = replace(scenes[0], alone=moved)
    block = adjust_together(scenes, ties, OPTIONS)
    sigma_px = [np.unique(block.ties.sigma_px[block.of_ties(k)].round(9)) for k in range(3)]
    assert [len(one) for one in sigma_px] == [1, 1, 1]
    assert sigma_px[0] / sigma_px[1] == pytest.approx(np.sqrt(1.0 + 9.0))
    assert sigma_px[2] == pytest.approx(sigma_px[1])


@pytest.mark.parametrize("axis", [0, 1])
def test_ties_where_a_motion_is_unknown_tell_no_more_together_than_one_of_them(axis: int) -> None:
    """A displacement that is uncertain by 5 px on the last quarter of the lines, or of the samples.

    It errs alike over eight of its nodes: on sixteen of them all ties tell as much as two.
    """
    scenes, ties = list(scenes_and_ties()[0]), scenes_and_ties()[1]
    nodes, ends = np.linspace(0.0, SHAPE[axis] - 1.0, 65), np.array([0.0, SHAPE[axis] - 1.0])
    unknown = np.where(nodes > 0.75 * SHAPE[axis], 25.0, 0.0)
    variance_px2 = np.tile(unknown[:, None, None], (1, 2, 2))
    line, sample = nodes, ends
    if axis == 1:
        line, sample, variance_px2 = ends, nodes, variance_px2.transpose(1, 0, 2)
    grid = DisplacementGrid(line, sample, np.zeros_like(variance_px2), variance_px2)
    alone = scenes[0].alone
    assert alone is not None
    moved = replace(alone, correction=replace(alone.correction, displacement=grid))
    scenes[0] = replace(scenes[0], alone=moved)
    block = adjust_together(scenes, ties, OPTIONS)
    of_scene = block.of_ties(0)
    sigma_px, at = block.ties.sigma_px[of_scene], block.ties.line_sample[of_scene, axis]
    there = at > 0.75 * SHAPE[axis] + np.diff(nodes)[0]
    assert there.sum() > 30
    assert 1.0 < 25.0 * (sigma_px[there] ** -2.0).sum() < 4.0
    np.testing.assert_allclose(sigma_px[at < 0.74 * SHAPE[axis]], TIE_NOISE_PX, rtol=0.25)


def test_control_of_four_times_the_variance_places_a_scene_as_much_worse() -> None:
    """What neighbouring points share does not average out: fewer of them are independent."""
    measured = scenes_and_ties()[0][0]
    alone = measured.alone
    assert alone is not None
    variance = []
    for factor in (1.0, 4.0):
        shared = replace(alone.shared, factor=factor)
        own = replace(measured, alone=replace(alone, shared=shared, apart_px=0.1))
        block = adjust_together([own], no_ties(), OPTIONS)
        at = image_places(SHAPE)
        ground = block.model(0).locate(at, np.full(len(at), 150.0))
        variance.append(_variance(block, 0, ground))
    # Drifts and skews are known to a pixel beforehand, which does not change.
    ratio = variance[1] / variance[0]
    assert 2.5 < ratio.min() < ratio.max() < 4.4


def test_blocks_of_points_lie_apart_by_the_frames_of_both() -> None:
    """Where nobody stated one of them, by a pixel; that of most points places the scenes."""
    scenes = scenes_and_ties()[0]

    def frames(second: Frame, most: int = 0) -> tuple[Frame, ...]:
        parts = []
        for one in scenes:
            of_search = one.search.points
            block = np.where(of_search.id % 3 == 0, 1 - most, most)
            own = replace(of_search, block=block, frames=(FRAME, second))
            points = replace(one.points, frames=(FRAME, second))
            parts.append(replace(one, points=points, search=replace(one.search, points=own)))
        return adjust_together(parts, no_ties(), OPTIONS).control.frames

    first, apart = frames(Frame.from_sigmas(3.0, 1.0))
    assert not first.covariance_m2.any()
    assert apart.sigma_m == pytest.approx(np.hypot(3.0, FRAME.sigma_m))
    assert apart.sigma_up_m == pytest.approx(np.hypot(1.0, FRAME.sigma_up_m))
    others, datum = frames(Frame.from_sigmas(3.0, 1.0), most=1)
    assert not datum.covariance_m2.any()
    assert others.sigma_m == pytest.approx(apart.sigma_m)
    _, unstated = frames(Frame.from_sigmas(np.nan, np.nan))
    assert unstated.sigma_m == pytest.approx(GSD_M, rel=0.1)


def test_ties_scatter_as_in_the_worse_coordinate_of_those_that_agree() -> None:
    block, rng = whole(), np.random.default_rng(5)
    rows = block.of_ties(1)
    residual_px = block.adjustment.residual_px.copy()
    residual_px[rows] = rng.normal(0.0, [0.3, 0.1], (len(rows), 2)) + [2.0, 0.0]
    active = block.adjustment.active.copy()
    active[rows[::7]] = False
    residual_px[rows[::7]] = 50.0
    for axes in ([0, 1], [1, 0]):
        adjustment = replace(block.adjustment, residual_px=residual_px[:, axes], active=active)
        found_px = tie_residual_px(replace(block, adjustment=adjustment), 1)
        assert found_px == pytest.approx(0.3, rel=0.15)
    none = replace(block.adjustment, active=np.zeros_like(active))
    assert np.isnan(tie_residual_px(replace(block, adjustment=none), 1))


def test_one_scene_measures_no_ground_and_two_measure_what_both_show() -> None:
    scenes = scenes_and_ties()[0]
    assert len(ground_misfits_m(adjust_together(scenes[:1], no_ties(), OPTIONS), 0)) == 0
    block = whole()
    used = [set(block.scenes[k].search.points.id[block.active(k)].tolist()) for k in range(3)]
    for number, own in enumerate(used):
        others = set().union(*(ids for k, ids in enumerate(used) if k != number))
        assert 5 < len(ground_misfits_m(block, number)) == len(own & others) < len(own)
