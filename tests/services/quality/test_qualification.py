"""The figures of a qualification against a registration whose truth is known, and its verdicts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely

from amers.services.errors import NotEnoughPoints
from amers.services.quality.cell_stability import measure_cell_stability
from amers.services.quality.criteria import verdict_scope
from amers.services.quality.held_area import TriedPoints, held_area
from amers.services.quality.normal_law import CIRCULAR_CE90
from amers.services.quality.predicted import predict_accuracy
from amers.services.quality.qualification import (
    QualificationOptions,
    count_points,
    image_coverage,
    qualify,
    qualify_repeated,
    unexplained_px,
)
from amers.services.quality.stability import measure_stability, stability_of
from amers.services.types import Frame
from tests.services.conftest import GSD_M, Make

a_millionth_px = 1e-6
DEFAULT = QualificationOptions()


def qualified(scene, options=DEFAULT, refit=None):
    """The qualification of a synthetic registration."""
    rng = np.random.default_rng(3)
    return qualify(scene.adjusted(refit), options, rng)


def failed(qualification):
    """Names of the criteria that were not met, with what they are needed for."""
    return {(c.name, c.needed_for) for c in qualification.criteria if not c.met}


def test_criteria_show_hundredths_of_pixels_and_metres_and_whole_percents(registered: Make) -> None:
    """What a reader compares with a limit has the digits in which limits are given."""
    scene = registered().adjusted()
    criteria = qualify(scene, DEFAULT, np.random.default_rng(3)).criteria
    digits = {"px": 2, "m": 2, "%": 0}
    of_a_unit = [one for one in criteria if one.unit]
    assert {one.unit for one in of_a_unit} >= {"px", "%"}
    for one in of_a_unit:
        assert one.decimals == digits[one.unit], one.name


def test_visible_matched_and_active_points_are_counted(registered):
    counts = count_points(registered(n=60, lost=8, wrong=4).measures)
    assert (counts.visible, counts.matched) == (60, 52)
    assert 46 <= counts.active <= 48
    assert counts.active_of_matched == counts.active / 52
    assert counts.active_of_visible == counts.active / 60


def test_ratios_over_nothing_are_not_invented(registered):
    measures = registered().measures
    nothing = replace(measures, matched=np.zeros(60, bool), active=np.zeros(60, bool))
    assert np.isnan(count_points(nothing).active_of_matched)


def test_residuals_of_the_image_are_x_along_samples_and_y_along_lines(registered):
    scene = registered()
    active = scene.measures.active
    residual = np.tile([3.0, -4.0], (60, 1))
    measures = replace(scene.measures, residual_px=residual, residual_m=residual[:, ::-1] / 2.0)
    result = qualified(replace(scene, measures=measures))
    assert (result.image_residuals_px.y.mean, result.image_residuals_px.x.mean) == (3.0, -4.0)
    assert (result.image_residuals_px.xy.mean, result.image_residuals_px.xy.std) == (5.0, 0.0)
    assert result.image_residuals_px.xy.n == active.sum()
    assert (result.ground_residuals_m.east.mean, result.ground_residuals_m.north.mean) == (-2.0, 1.5)
    assert result.ground_residuals_m.horizontal.mean == 2.5


def test_residuals_count_active_points_only(registered):
    scene = registered()
    residual = np.where(scene.measures.active[:, None], [0.1, 0.1], 1000.0)
    result = qualified(replace(scene, measures=replace(scene.measures, residual_px=residual)))
    assert result.image_residuals_px.x.mean == pytest.approx(0.1)


def test_held_out_residuals_have_the_size_of_the_noise(registered):
    stability = qualified(registered(n=400, noise_px=0.3)).stability
    assert stability.held_out_px.x.std == pytest.approx(0.3, rel=0.1)
    assert stability.held_out_px.x.n == stability.draws * stability.held_out_per_draw
    assert stability.held_out_m.y.std == pytest.approx(stability.held_out_px.y.std / 2.0)


def test_held_out_points_take_no_part_in_the_adjustment_that_judges_them(registered):
    scene = registered()
    masks = []

    def refit(mask):
        masks.append(mask)
        return scene.refit(mask)

    stability = measure_stability(scene.adjusted(refit), 10, 0.8, np.random.default_rng(3))
    active = scene.measures.active
    assert len(masks) == 10
    for mask in masks:
        assert not (mask & ~active).any()
        assert mask.sum() == active.sum() - stability.held_out_per_draw
    assert stability.held_out_per_draw == pytest.approx(0.2 * active.sum(), abs=1)


def test_displacements_are_those_of_the_corners_and_the_centre(registered):
    scene = registered()
    moved = replace(
        scene.adjustment.correction,
        parameters=scene.adjustment.correction.parameters + [[0.0, 0.3, 0.0], [0.4, 0.0, 0.0]],
    )
    adjusted = scene.adjusted(lambda mask: replace(scene.adjustment, correction=moved))
    stability = measure_stability(adjusted, 5, 0.8, np.random.default_rng(3))
    at = {place.place: place for place in stability.displacements}
    assert at["centre"].median_px == pytest.approx(0.4, abs=a_millionth_px)
    assert at["top left"].max_px == pytest.approx(0.5, rel=1e-3)
    assert at["bottom right"].max_m == pytest.approx(0.25, rel=1e-3)


def test_an_adjustment_that_cannot_be_redone_has_a_note(registered):
    def refit(mask):
        raise NotEnoughPoints(3, 4)

    scene = registered()
    stability = qualified(scene, refit=refit).stability
    assert (stability.draws, stability.failed_draws, stability.displacements) == (0, 10, ())
    assert "gave no solution in any draw" in stability.note
    assert np.isnan(stability.held_out_px.x.mean)


def test_a_bug_in_the_adjustment_is_not_taken_for_an_instability(registered):
    def refit(mask):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        qualified(registered(), refit=refit)


@pytest.mark.long
def test_the_predicted_accuracy_is_honest_about_the_true_correction(registered):
    """The true error at a corner stays within the predicted CE90 nine times in ten."""
    inside = []
    for seed in range(60):
        scene = registered(n=40, seed=seed, wrong=0)
        predicted = predict_accuracy(scene.adjusted(), 7)
        corner = np.array([[0.0, scene.shape[1] - 1.0]])
        error = scene.adjustment.correction.apply(corner) - scene.truth.apply(corner)
        inside.append(np.hypot(*error[0]) <= predicted.ce90_px[0, -1])
    three_standard_errors = 3.0 * np.sqrt(0.9 * 0.1 / 60)
    assert np.mean(inside) == pytest.approx(0.9, abs=three_standard_errors)


def test_the_prediction_of_a_shift_is_the_same_all_over_the_image(registered):
    scene = registered()
    covariance = np.zeros((6, 6))
    covariance[0, 0] = covariance[3, 3] = 0.04
    adjustment = replace(scene.adjustment, covariance=covariance)
    frame = Frame.from_sigmas(2.0, 2.0)
    result = predict_accuracy(replace(scene, adjustment=adjustment, frame=frame).adjusted(), 5)
    assert result.std_line_px == pytest.approx(np.full((5, 5), 0.2))
    assert result.worst_px == pytest.approx(result.overall_px)
    assert result.worst_m == pytest.approx(0.5 * 0.2 * 2.1460, rel=1e-3)
    on_the_earth_m = np.hypot(2.0, 0.5 * 0.2) * 2.1460
    assert result.on_the_earth_worst_m == pytest.approx(on_the_earth_m, rel=1e-3)
    assert result.on_the_earth_overall_m == pytest.approx(on_the_earth_m, rel=1e-3)


def test_the_prediction_grows_towards_the_edge_along_a_drift(registered):
    scene = registered()
    covariance = np.diag([0.01, 0.03, 0.0, 0.01, 0.0, 0.0])
    adjustment = replace(scene.adjustment, covariance=covariance)
    result = predict_accuracy(replace(scene, adjustment=adjustment).adjusted(), 3)
    for row, line in ((0, 0.0), (1, (scene.shape[0] - 1.0) / 2.0)):
        delivered = adjustment.correction.invert(np.array([[line, 0.0]]))
        along = (delivered - adjustment.correction.centre)[0, 0] / adjustment.correction.half_size[0]
        expected_px = np.sqrt(0.01 + 0.03 * along**2)
        assert result.std_line_px[row, 0] == pytest.approx(expected_px, rel=1e-3)
    assert result.std_line_px[0, 0] > 1.9 * result.std_line_px[1, 0]
    assert result.std_sample_px == pytest.approx(np.full((3, 3), 0.1))
    assert np.isnan(result.on_the_earth_worst_m)


def test_points_are_counted_in_cells_beside_the_share_of_the_image_that_they_hold(registered):
    line_sample = np.array([[-0.5, -0.5], [10.0, 10.0], [99.4, 199.4], [50.0, np.nan]])
    agree, nothing = np.ones(3, dtype=bool), np.zeros(3, dtype=bool)
    held = held_area(TriedPoints(line_sample[:3], agree, nothing, nothing), (100, 200), 0.0)
    scene = registered().adjusted()
    active = replace(scene.measures.take(np.arange(4)), line_sample=line_sample)
    coverage = image_coverage(scene.model, active, held, 5)
    assert (coverage.cells[0, 0], coverage.cells[4, 4]) == (2, 1)
    assert coverage.percent == held.percent
    places = np.random.default_rng(1).uniform(0.0, 100.0, (500, 2)) * [1.0, 2.0]
    np.testing.assert_array_equal(coverage.holds(places), held.holds(places))


def test_the_area_on_the_ground_is_where_the_registered_model_has_it(registered):
    """Places of the ground lie in it where the image holds them; holes included."""
    scene = registered().adjusted()
    coverage = qualified(registered()).coverage
    height_m = float(np.median(scene.measures.lon_lat_h[scene.measures.active, 2]))
    area = shapely.MultiPolygon([(rings[0], rings[1:]) for rings in coverage.polygons_lon_lat])
    assert area.is_valid
    rng = np.random.default_rng(2)
    places = rng.uniform(-0.1, 1.1, (2000, 2)) * scene.shape
    lon_lat = scene.model.locate(places, np.full(2000, height_m))[:, :2]
    inside = shapely.contains_xy(area, lon_lat)
    assert (inside != coverage.holds(places)).mean() < 0.005
    assert 0.1 < inside.mean() < 0.9


@pytest.mark.parametrize(
    ("field", "limit", "lost"),
    [
        ("good_active_points", 1000, ("active_points", "good")),
        ("good_coverage_percent", 101.0, ("coverage_percent", "good")),
        ("good_active_of_matched", 1.01, ("active_of_matched", "good")),
        ("good_residual_std_px", 0.01, ("residual_std_px", "good")),
        ("good_displacement_px", 0.0001, ("displacement_px", "good")),
        ("good_ce90_px", 0.001, ("predicted_ce90_px", "good")),
        ("good_unit_weight", 0.1, ("unit_weight", "good")),
        ("usable_active_points", 1000, ("active_points", "usable")),
        ("usable_residual_std_px", 0.01, ("residual_std_px", "usable")),
        ("usable_displacement_px", 0.0001, ("displacement_px", "usable")),
        ("usable_ce90_px", 0.001, ("predicted_ce90_px", "usable")),
    ],
)
def test_each_threshold_costs_its_verdict(registered, field, limit, lost):
    in_pixels = replace(
        DEFAULT, good_displacement_m=0.0, good_ce90_m=0.0, usable_displacement_m=0.0, usable_ce90_m=0.0
    )
    result = qualified(registered(), replace(in_pixels, **{field: limit}))
    assert failed(result) == {lost}
    assert result.verdict == ("usable" if lost[1] == "good" else "failed")


def test_the_place_that_moves_most_when_points_are_held_out_counts(registered: Make) -> None:
    scene = registered().adjusted()
    stability = measure_stability(scene, 5, 0.8, np.random.default_rng(1))
    of_cells = measure_cell_stability(scene)
    still = [replace(one, median_px=0.01) for one in stability.displacements]
    for place in range(5):
        moved = (*still[:place], replace(still[place], median_px=9.0), *still[place + 1 :])
        shown = replace(stability, displacements=moved)
        result = qualify_repeated(scene, DEFAULT, shown, of_cells)
        values = {one.value for one in result.criteria if one.name == "displacement_px"}
        assert values == {9.0}


def test_displacements_are_of_the_repetition_along_samples_and_lines(registered: Make) -> None:
    scene = registered(lost=0, wrong=0).adjusted()
    correction = scene.adjustment.correction
    line_px, sample_px = 3.0, -1.0
    shift = np.array([[line_px, 0.0, 0.0], [sample_px, 0.0, 0.0]])
    moved = replace(correction, parameters=correction.parameters + shift)
    shown = stability_of(scene, 0.8, [(np.arange(5), replace(scene.adjustment, correction=moved))])
    for place in shown.displacements:
        assert (place.x_m, place.y_m) == pytest.approx((sample_px * GSD_M, line_px * GSD_M))
        assert place.max_m == pytest.approx(np.hypot(line_px, sample_px) * GSD_M)
    measures = scene.measures
    left_px = (measures.line_sample - moved.apply(measures.predicted))[:5].mean(axis=0)
    assert shown.held_out_px.y.mean == pytest.approx(left_px[0])
    assert shown.held_out_px.x.mean == pytest.approx(left_px[1])
    assert shown.group_means.rms_px == pytest.approx(np.hypot(*left_px))


@pytest.mark.monte_carlo
def test_means_of_points_that_are_held_out_are_what_independent_errors_give(registered: Make) -> None:
    means = [
        measure_stability(
            registered(n=200, lost=0, wrong=0, seed=seed).adjusted(), 10, 0.8, np.random.default_rng(2)
        ).group_means
        for seed in range(6)
    ]
    assert 0.8 < np.mean([one.over_independent for one in means]) < 1.2
    assert 0.8 < np.mean([one.over_stated for one in means]) < 1.2


def test_many_points_are_usable_although_many_others_disagree(registered: Make) -> None:
    """Of few points most must agree, of many more than are needed for a good scene half."""
    scene = registered(n=90, lost=0, wrong=35)
    share = scene.measures.active.sum() / scene.measures.matched.sum()
    assert DEFAULT.good_active_of_matched < share < DEFAULT.usable_active_of_few
    assert scene.measures.active.sum() > DEFAULT.good_active_points
    lost = failed(qualified(scene))
    assert not lost & {("active_of_matched", "usable"), ("active_of_matched", "good")}
    many = replace(DEFAULT, good_active_points=1000)
    assert ("active_of_matched", "usable") in failed(qualified(scene, many))


def test_of_many_points_that_scatter_most_must_agree_too(registered: Make) -> None:
    """Where many are left out of points that hardly agree, those left may agree by chance."""
    few_agree = registered(n=90, lost=0, wrong=35, noise_px=1.5)
    assert ("active_of_matched", "usable") in failed(qualified(few_agree))
    most_agree = failed(qualified(registered(n=90, lost=0, wrong=10, noise_px=1.5)))
    assert ("residual_std_px", "good") in most_agree
    assert ("active_of_matched", "usable") not in most_agree


def test_what_points_of_three_metres_are_known_to_give_is_good(registered):
    """SRP: scenes of 0.5 m on points of 3 m CE90: corners within 0.3 m, CE90 of 0.4 m."""
    points_px = 3.0 / CIRCULAR_CE90 / GSD_M
    result = qualified(registered(n=500, lost=0, wrong=0, points_px=points_px))
    assert result.image_residuals_px.x.std == pytest.approx(points_px, rel=0.2)
    assert max(place.median_m for place in result.stability.displacements) < 0.3
    assert result.predicted.overall_m < 0.4
    assert result.predicted.worst_m < 0.75
    assert result.verdict == "good"


@pytest.mark.parametrize("stated_px", [0.2, 1.0, 2.0, 3.0, 6.0, 20.0])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("error", [{"bend_px": 2.6}, {"points_px": 2.6}])
@pytest.mark.long
def test_points_that_state_large_sigmas_hide_no_error(registered, error, seed, stated_px):
    """20 points with errors of 2.6 px, of the model or of their own, never make a good registration."""
    scene = registered(n=20, lost=0, wrong=0, seed=seed, stated_px=stated_px, **error)
    assert qualified(scene, replace(DEFAULT, good_coverage_percent=0.0)).verdict != "good"


def test_a_scene_finer_than_its_chips_is_usable_by_the_limits_of_a_scene_as_coarse(registered):
    scene = registered().adjusted()

    def limits_m(control_gsd_m, needed_for):
        on_chips = replace(scene, control_gsd_m=control_gsd_m)
        criteria = qualify(on_chips, DEFAULT, np.random.default_rng(3)).criteria
        names = ("residual_std_px", "displacement_px", "predicted_ce90_px")
        limits = {c.name: c.limit * GSD_M for c in criteria if c.needed_for == needed_for}
        return [pytest.approx(limits[name]) for name in names]

    assert limits_m(2.0, "usable") == [4.0, 4.0, 6.0]
    for finer_m in (0.0, 0.1, GSD_M):
        assert limits_m(finer_m, "usable") == [1.0, 1.0, 1.5]
    assert limits_m(2.0, "good") == limits_m(0.0, "good")


def test_a_user_sets_a_limit_in_metres_alone(registered):
    options = replace(DEFAULT, usable_ce90_px=0.0, usable_ce90_m=2.5)
    scene = replace(registered().adjusted(), control_gsd_m=2.0)
    criteria = qualify(scene, options, np.random.default_rng(3)).criteria
    limit = next(c.limit for c in criteria if c.name == "predicted_ce90_px" and c.needed_for == "usable")
    assert limit * GSD_M == pytest.approx(2.5)


@pytest.mark.parametrize("gsd_m", [0.1, 0.5, 10.0])
@pytest.mark.parametrize("needed_for", ["good", "usable"])
@pytest.mark.parametrize("name", ["displacement", "ce90"])
def test_a_limit_is_the_larger_of_one_in_pixels_and_one_in_metres(
    registered: Make, name: str, needed_for: str, gsd_m: float
) -> None:
    """Fine pixels are held to metres on the ground, coarse ones to parts of themselves."""
    limits: dict[str, Any] = {f"{needed_for}_{name}_px": 3.0, f"{needed_for}_{name}_m": 1.5}
    options = replace(DEFAULT, **limits)
    scene = replace(registered().adjusted(), gsd_m=gsd_m, control_gsd_m=gsd_m)
    criteria = qualify(scene, options, np.random.default_rng(3)).criteria
    of_name = {"displacement": "displacement_px", "ce90": "predicted_ce90_px"}[name]
    (limit_px,) = [c.limit for c in criteria if (c.name, c.needed_for) == (of_name, needed_for)]
    assert limit_px * gsd_m == pytest.approx(max(1.5, 3.0 * gsd_m))


@pytest.mark.parametrize("seed", range(3))
def test_points_worse_than_stated_make_a_scene_usable_that_says_so(registered, seed):
    """60 points of 2.5 px that state 1 px: what the scene shows of them is in its accuracy."""
    scene = registered(n=60, lost=0, wrong=0, seed=seed, stated_px=1.0, points_px=2.5)
    result = qualified(scene)
    assert result.verdict == "usable"
    assert ("residual_std_px", "good") in failed(result)
    note = next(c.note for c in result.criteria if c.name == "residual_std_px" and not c.met)
    assert "times less accurate than they state" in note
    place = np.array([[500.0, 500.0]])
    error_px = scene.truth.apply(place) - scene.adjustment.correction.apply(place)
    assert np.hypot(*error_px[0]) < 3.0 * result.predicted.overall_px


def test_few_points_of_which_many_disagree_are_not_usable(registered):
    few = registered(n=18, lost=0, wrong=0)
    disagreeing = replace(few.measures, active=np.arange(18) < 10)
    assert ("active_of_matched", "usable") in failed(qualified(replace(few, measures=disagreeing)))
    assert ("active_of_matched", "usable") not in failed(qualified(few))


def test_stated_sigmas_of_the_points_move_no_limit(registered):
    scene = registered(n=100)

    def limits(stated_px):
        adjustment = replace(scene.adjustment, point_sigma_px=np.full(2, stated_px))
        return [c.limit for c in qualified(replace(scene, adjustment=adjustment)).criteria]

    assert limits(0.0) == limits(30.0)


@pytest.mark.parametrize("stated_px", [0.1, 2.0, 30.0])
def test_an_error_of_the_model_is_no_scatter_of_points(registered, stated_px):
    """Neighbours share an error of the model, but not the errors of points."""
    measures = registered(n=300, lost=0, wrong=0).measures
    measures = replace(measures, active=np.ones(300, dtype=bool))
    amplitude_px = 2.6
    wave_px = amplitude_px * np.sin(measures.line_sample / 500.0)
    scatter_px = np.random.default_rng(1).normal(0.0, amplitude_px, (300, 2))
    shared = unexplained_px(replace(measures, residual_px=wave_px), np.full(2, stated_px))
    scattered = unexplained_px(replace(measures, residual_px=scatter_px), np.full(2, stated_px))
    assert shared > 1.5
    explained_px = min(stated_px, amplitude_px)
    unexplained = max(amplitude_px**2 - (1.0 + 2.0 * np.sqrt(2.0 / 300)) * explained_px**2, 0.0)
    assert scattered == pytest.approx(np.sqrt(unexplained), abs=0.5)


def test_nineteen_active_points_are_never_good(registered):
    scene = registered(n=19, lost=0, wrong=0)
    result = qualified(scene, replace(DEFAULT, good_coverage_percent=0.0))
    assert result.point_counts.active <= 19
    assert ("active_points", "good") in failed(result)
    assert result.verdict == "usable"


def test_points_in_a_corner_are_never_good(registered):
    result = qualified(registered(n=100, extent=0.5))
    assert 20.0 < result.coverage.percent < 45.0
    assert ("coverage_percent", "good") in failed(result)
    assert result.verdict != "good"


def test_without_active_points_every_figure_is_absent_and_the_verdict_is_failed(registered):
    scene = registered()
    measures = replace(scene.measures, active=np.zeros(60, bool))
    result = qualified(replace(scene, measures=measures))
    assert result.verdict == "failed"
    assert np.isnan(result.image_residuals_px.x.mean)
    assert result.stability.note == "0 active points leave none to hold out"
    assert ("residual_std_px", "usable") in failed(result)


def test_a_criterion_without_a_value_is_not_met(registered):
    unknown = replace(registered().adjustment, covariance=np.full((6, 6), np.nan))
    result = qualified(replace(registered(), adjustment=unknown))
    assert failed(result) == {("predicted_ce90_px", "good"), ("predicted_ce90_px", "usable")}
    assert result.verdict == "failed"


def test_a_limit_on_the_earth_counts_when_the_user_sets_one(registered):
    scene = replace(registered(), frame=Frame.from_sigmas(10.0, 10.0))
    without = qualified(scene)
    assert without.verdict == "good"
    assert verdict_scope(without.criteria) == "relative to the control points"
    for limit_m, verdict in ((30.0, "good"), (20.0, "failed")):
        limited = qualified(scene, replace(DEFAULT, max_ce90_on_earth_m=limit_m))
        assert limited.verdict == verdict
        assert verdict_scope(limited.criteria) == "relative to the control points and on the Earth"
        (criterion,) = [c for c in limited.criteria if c.name == "ce90_on_earth_m"]
        assert criterion.value == pytest.approx(without.predicted.on_the_earth_worst_m)
        assert criterion.note == ""


def test_a_frame_that_nobody_stated_does_not_meet_a_limit_on_the_earth(registered):
    result = qualified(registered(), replace(DEFAULT, max_ce90_on_earth_m=1000.0))
    assert result.verdict == "failed"
    (criterion,) = [c for c in result.criteria if not c.met]
    assert criterion.note == "unknown: the sigma of the control points' common error is not stated"
