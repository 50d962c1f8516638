"""Points from marks in images whose models are off: truth within the stated covariance."""

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from amers.services.adjustment.intersected_marks import (
    EXACT_MODEL,
    IntersectedMarks,
    ModelErrors,
    intersect_marks,
)
from amers.services.types import Array, Observations
from tests.services.simulated import ring_of_geometries
from tests.services.ties import Ties, difference_m, make_ties, whitened_square

NOISE_PX = 0.5
SHIFT_PX = 4.0
a_millimetre = 1e-3
OFF = ModelErrors(SHIFT_PX**2 * np.eye(2), np.zeros(2))


def marked(images: int, seed: int, points: int = 30, shift_px: float = 0.0) -> tuple[list, Ties]:
    rng = np.random.default_rng([5, seed])
    geometries = ring_of_geometries(images)
    shifts = rng.normal(0.0, 1.0, (images, 2)) * shift_px
    ties = make_ties(geometries, rng, points, NOISE_PX, shift_px=shifts)
    return [one.rpc for one in geometries], ties


def moved(ties: Ties, rows: list[int], off_px: Array) -> Observations:
    line_sample = ties.observations.line_sample.copy()
    line_sample[rows] += off_px
    return replace(ties.observations, line_sample=line_sample)


@pytest.mark.parametrize("images", [2, 3, 5])
def test_errors_of_points_are_what_the_covariance_of_exact_models_says(images: int) -> None:
    models, ties = marked(images, 1, points=400)
    found = intersect_marks(models, [EXACT_MODEL] * images, ties.observations, 400)
    square = whitened_square(difference_m(found.lon_lat_h, ties.lon_lat_h), found.joint_m2)
    assert 0.9 < square.mean() < 1.1
    assert found.scale == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(found.marks_m2, found.joint_m2)


@pytest.mark.parametrize("images", [2, 3])
def test_errors_of_models_are_in_the_covariance_of_each_point_and_not_between_the_points(
    images: int,
) -> None:
    """Points of one draw are off together: many draws show the stated covariance."""
    joint, apart = [], []
    for seed in range(60):
        models, ties = marked(images, seed, points=20, shift_px=SHIFT_PX)
        found = intersect_marks(models, [OFF] * images, ties.observations, 20)
        error_m = difference_m(found.lon_lat_h, ties.lon_lat_h)
        joint.append(whitened_square(error_m, found.joint_m2).mean())
        # A point relative to the mean of the others has the errors of its own marks and of theirs.
        apart.append(whitened_square(error_m - error_m.mean(axis=0), found.marks_m2 * 19 / 20).mean())
    assert 0.7 < np.mean(joint) < 1.5
    assert 0.9 < np.mean(apart) < 1.1


def test_a_wrong_mark_is_named_among_models_that_are_off_by_more() -> None:
    models, ties = marked(3, 3, shift_px=SHIFT_PX)
    marks = moved(ties, [13], np.array([6.0, -6.0]))
    found = intersect_marks(models, [OFF] * 3, marks, 30)
    assert np.flatnonzero(found.rejected).tolist() == [13]
    assert np.linalg.norm(found.residual_px[13] - [6.0, -6.0]) < 6.0 * NOISE_PX
    assert found.found.all()
    good = intersect_marks(models, [OFF] * 3, ties.observations, 30)
    assert not good.rejected.any()
    assert np.abs(difference_m(found.lon_lat_h, good.lon_lat_h))[4].max() < 6.0 * NOISE_PX


def test_many_wrong_marks_are_all_named_and_few_others() -> None:
    models, ties = marked(4, 4, points=100)
    wrong = np.arange(0, 400, 20)
    off_px = np.random.default_rng(0).uniform(8.0, 60.0, (20, 2))
    found = intersect_marks(models, [OFF] * 4, moved(ties, wrong.tolist(), off_px), 100)
    assert np.flatnonzero(found.rejected).tolist() == wrong.tolist()
    assert (found.alternative == -1).all()


def test_correct_marks_are_kept_also_where_they_scatter_more_than_stated() -> None:
    models, ties = marked(3, 5, points=200)
    careless = replace(ties.observations, sigma_px=ties.observations.sigma_px / 3.0)
    found = intersect_marks(models, [OFF] * 3, careless, 200)
    assert found.rejected.sum() <= 2
    assert found.scale == pytest.approx(3.0, abs=0.3)
    assert found.scale_chance < 1e-6


def test_of_two_marks_that_disagree_neither_is_named() -> None:
    models, ties = marked(2, 6)
    error = ties.observations.line_sample * 0.0
    error[10] = [8.0, 8.0]
    marks = replace(ties.observations, line_sample=ties.observations.line_sample + error)
    found = intersect_marks(models, [OFF] * 2, marks, 30)
    assert not found.rejected.any()
    assert np.flatnonzero(found.disagree).tolist() == [5]


@pytest.mark.parametrize("images", [2, 3])
@pytest.mark.parametrize("beyond", [0.98, 1.02])
def test_a_mark_is_wrong_beyond_the_chance_of_a_file_in_a_thousand(images: int, beyond: float) -> None:
    """A pair has one free number, of the normal law; a mark beside two others has two, of Rayleigh's."""
    rng, one = np.random.default_rng(9), [EXACT_MODEL] * images
    geometries = ring_of_geometries(images)
    models, ties = [view.rpc for view in geometries], make_ties(geometries, rng, 30, 0.0).observations
    exact, chance = replace(ties, sigma_px=np.full(len(ties), NOISE_PX)), 1e-3 / len(ties)
    largest = NormalDist().inv_cdf(1.0 - chance / 2.0) if images == 2 else np.sqrt(-2.0 * np.log(chance))

    def found(off_px: float) -> IntersectedMarks:
        moved_px = np.where(np.arange(len(exact)) == 10, off_px, 0.0)[:, None]
        return intersect_marks(models, one, replace(exact, line_sample=exact.line_sample + moved_px), 30)

    off_px = 0.1 * beyond * largest / np.sqrt(found(0.1).test[10])
    told = found(off_px)
    assert told.disagree.any() == (images == 2 and beyond > 1.0)
    assert told.rejected.any() == (images == 3 and beyond > 1.0)


def test_where_two_of_three_marks_may_be_wrong_both_are_named() -> None:
    """An error along the base of an image that is far from the others in one direction alone."""
    models, ties = marked(3, 7)
    twins = [models[0], models[1], models[1]]
    rows = np.flatnonzero(ties.observations.image < 2)
    pair = ties.observations.take(rows)
    third = replace(pair.take(pair.image == 1), image=np.full(30, 2))
    every = np.argsort(np.concatenate([pair.point, third.point]), kind="stable")
    noise = np.random.default_rng(1).normal(0.0, NOISE_PX, (30, 2))
    marks = Observations(
        np.concatenate([pair.point, third.point])[every],
        np.concatenate([pair.image, third.image])[every],
        np.concatenate([pair.line_sample, third.line_sample + noise])[every],
        np.full(90, NOISE_PX),
    )
    line_sample = marks.line_sample.copy()
    line_sample[14] += [9.0, -9.0]
    found = intersect_marks(twins, [EXACT_MODEL] * 3, replace(marks, line_sample=line_sample), 30)
    assert set(np.flatnonzero(found.rejected)) <= {13, 14}
    assert found.rejected.any()
    row = int(np.flatnonzero(found.rejected)[0])
    assert {row, int(found.alternative[row])} >= {14}


def test_a_point_of_one_mark_has_no_position_and_changes_no_other() -> None:
    models, ties = marked(3, 8, shift_px=SHIFT_PX)
    lone = ties.observations.take(~np.isin(np.arange(90), [1, 2]))
    found = intersect_marks(models, [OFF] * 3, lone, 30)
    assert np.flatnonzero(~found.found).tolist() == [0]
    rest = ties.observations.take(np.arange(3, 90))
    without = intersect_marks(models, [OFF] * 3, replace(rest, point=rest.point - 1), 29)
    assert np.abs(difference_m(found.lon_lat_h[1:], without.lon_lat_h)).max() < a_millimetre


def test_base_over_height_is_that_of_the_angles() -> None:
    pair = ring_of_geometries(2, incidence_deg=15.0)
    ties = make_ties(pair, np.random.default_rng(0), 20, NOISE_PX)
    found = intersect_marks([g.rpc for g in pair], [EXACT_MODEL] * 2, ties.observations, 20)
    np.testing.assert_allclose(found.base_to_height, 2.0 * np.tan(np.radians(15.0)), atol=0.01)
