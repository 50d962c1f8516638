"""The correction of a scene from a few marks."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import CoverageError
from amers.services.geodesy import move_metres
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.marked_scene import MarkedScene, MarkPriors, adjust_marks
from amers.services.quality.normal_law import normal_ce90
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.types import Array
from tests.services.simulated import ring_of_geometries

GEOMETRY = ring_of_geometries(1)[0]
MODEL, SHAPE = GEOMETRY.rpc, GEOMETRY.plan.shape
FRAME = no_correction(SHAPE)
PRIORS = MarkPriors(shift_px=20.0, slope_px=0.1)
BLUNDER_PX = np.array([36.0, 48.0])
of_survey_m, of_a_map_m = 0.1, 3.0
of_a_pick_px = 0.3
places = np.stack(np.meshgrid(*(np.linspace(0.0, size - 1.0, 5) for size in SHAPE)), axis=-1)
places = places.reshape(-1, 2)


def truth(rng: np.random.Generator, slope_px: float = PRIORS.slope_px) -> ImageCorrection:
    """What the model is off by: 40 px, and drift and skew."""
    slopes = rng.normal(0.0, slope_px, (2, 2))
    return replace(FRAME, parameters=np.column_stack([[24.0, -32.0], slopes]))


def marks_of(
    rng: np.random.Generator, count: int, sigma_m: float, true: ImageCorrection
) -> ControlObservations:
    """Marks at random places, with the errors that they state."""
    computed = rng.uniform([30.0, 30.0], np.array(SHAPE) - 30.0, (count, 2))
    ground = MODEL.locate(computed, rng.uniform(50.0, 150.0, count))
    by_ground = MODEL.project_derivative(ground) @ rng.normal(0.0, sigma_m, (count, 3, 1))
    picked = true.apply(computed) + by_ground[:, :, 0] + rng.normal(0.0, of_a_pick_px, (count, 2))
    covariance_m2 = np.tile(np.eye(3) * sigma_m**2, (count, 1, 1))
    return ControlObservations(ground, picked, np.full(count, of_a_pick_px), covariance_m2)


def with_blunder(marks: ControlObservations) -> ControlObservations:
    """The marks, of which the first is 60 px off."""
    line_sample = marks.line_sample.copy()
    line_sample[0] += BLUNDER_PX
    return replace(marks, line_sample=line_sample)


def errors_px(marked: MarkedScene, true: ImageCorrection) -> Array:
    """Errors (n, 2) of the correction all over the image."""
    return np.asarray(marked.adjustment.correction.apply(places) - true.apply(places))


@pytest.mark.parametrize("sigma_m", [of_survey_m, of_a_map_m])
@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_the_stated_accuracy_holds_true_errors(count, sigma_m):
    rng = np.random.default_rng(count)
    inside, normalised = [], []
    for _ in range(150):
        true = truth(rng)
        marked = adjust_marks(MODEL, SHAPE, marks_of(rng, count, sigma_m, true), PRIORS)
        error = errors_px(marked, true)
        covariance = marked.adjustment.covariance_at(true.apply(places))
        inside.append(np.hypot(*error.T) <= normal_ce90(covariance))
        normalised.append((error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(axis=1))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.07)
    assert np.mean(normalised) / 2.0 == pytest.approx(1.0, abs=0.25)


def test_one_mark_gives_a_shift_known_best_at_the_mark():
    rng = np.random.default_rng(0)
    marks = marks_of(rng, 1, of_survey_m, truth(rng))
    marked = adjust_marks(MODEL, SHAPE, marks, PRIORS)
    assert marked.adjustment.order == "shift"
    assert marked.held.tolist() == [[False, True, True]] * 2
    assert np.isnan(marked.left_out_px).all()
    off = np.linalg.norm(places - marks.line_sample, axis=1)
    ce90_px = normal_ce90(marked.adjustment.covariance_at(places))
    assert ce90_px[np.argmax(off)] > ce90_px[np.argmin(off)]


@pytest.mark.parametrize("sigma_m", [of_survey_m, of_a_map_m])
@pytest.mark.parametrize("count", [3, 5, 8])
def test_a_blunder_is_rejected_and_no_other_mark(count, sigma_m):
    rng = np.random.default_rng(count)
    rejected = np.zeros(count)
    for _ in range(50):
        marks = with_blunder(marks_of(rng, count, sigma_m, truth(rng)))
        marked = adjust_marks(MODEL, SHAPE, marks, PRIORS)
        rejected += ~marked.adjustment.active
    assert rejected[0] >= (43 if count == 5 and sigma_m == of_a_map_m else 48)
    assert rejected[1:].sum() <= 1


def test_of_two_marks_that_disagree_nothing_shows_which_is_wrong():
    rng = np.random.default_rng(0)
    true = truth(rng)
    marked = adjust_marks(MODEL, SHAPE, with_blunder(marks_of(rng, 2, of_survey_m, true)), PRIORS)
    assert marked.disagree
    assert marked.adjustment.active.all()
    ce90_px = normal_ce90(marked.adjustment.covariance_at(places))
    assert (np.hypot(*errors_px(marked, true).T) < ce90_px).all()


def test_two_pairs_that_contradict_each_other_are_in_doubt():
    rng = np.random.default_rng(0)
    marks = marks_of(rng, 4, of_survey_m, truth(rng))
    line_sample = marks.line_sample + np.repeat([BLUNDER_PX, -BLUNDER_PX], 2, axis=0)
    marked = adjust_marks(MODEL, SHAPE, replace(marks, line_sample=line_sample), PRIORS)
    assert marked.disagree
    assert marked.adjustment.active.all()


def test_drift_beyond_what_models_have_is_followed_where_marks_show_it():
    rng = np.random.default_rng(0)
    true = truth(rng, slope_px=5.0)
    marked = adjust_marks(MODEL, SHAPE, marks_of(rng, 8, of_survey_m, true), PRIORS)
    assert marked.adjustment.active.all()
    assert marked.adjustment.order == "affine"
    assert marked.priors.slope_px > 1.0
    assert np.abs(errors_px(marked, true)).max() < 4.0 * of_a_pick_px


def test_a_mark_left_out_is_compared_with_the_solution_of_the_others():
    rng = np.random.default_rng(0)
    marks = marks_of(rng, 5, of_survey_m, truth(rng))
    marked = adjust_marks(MODEL, SHAPE, marks, PRIORS)
    used = np.arange(5) != 2
    without = adjust_marks(MODEL, SHAPE, replace(marks, usable=used), PRIORS, like=marked)
    assert without.adjustment.residual_px[2] == pytest.approx(marked.left_out_px[2], abs=1e-9)


@pytest.mark.parametrize("towards", np.eye(3), ids=["east", "north", "up"])
def test_ground_that_is_off_along_an_axis_moves_lines_and_samples_as_the_model_does(towards):
    rng = np.random.default_rng(1)
    marks = marks_of(rng, 5, of_survey_m, truth(rng))
    off_m = np.tile(of_a_map_m * towards, (5, 1))
    vague = replace(marks, covariance_m2=off_m[:, :, None] * off_m[:, None, :])
    moved_px = MODEL.project(move_metres(marks.lon_lat_h, off_m)) - MODEL.project(marks.lon_lat_h)
    stated_px = adjust_marks(MODEL, SHAPE, vague, PRIORS).adjustment.point_sigma_px
    assert stated_px == pytest.approx(np.sqrt((moved_px**2).mean(axis=0)), rel=0.01, abs=1e-3)


def test_marks_of_other_ground_are_refused():
    marks = ControlObservations(
        np.full((1, 3), np.nan), np.zeros((1, 2)), np.ones(1), np.zeros((1, 3, 3))
    )
    with pytest.raises(CoverageError, match="none of 1 marks lies on ground where the model"):
        adjust_marks(MODEL, SHAPE, marks, PRIORS)
