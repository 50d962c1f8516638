"""A registered model against ground that had no part in it."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import CoverageError
from amers.services.geodesy import wrapped_degrees
from amers.services.quality.check_points import (
    MARKING_SIGMA_PX,
    CheckPoints,
    check_model,
    with_check_points,
)
from amers.services.quality.qualification import QualificationOptions, qualify
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import UNKNOWN_FRAME, Array, Frame
from tests.services.conftest import GSD_M, METRE_DEG, SHAPE, FlatModel, Make, Registered

LIMIT = 3.0


def check_points(
    scene: Registered, n: int, noise_px: float, moved_px: tuple[float, float] = (0.0, 0.0), seed: int = 7
) -> CheckPoints:
    """Points of known ground where the true model shows them, marked with noise, and moved."""
    rng = np.random.default_rng(seed)
    delivered = rng.uniform(0.0, 1.0, (n, 2)) * (np.array(SHAPE) - 1.0)
    marks = scene.truth.apply(delivered) + rng.normal(0.0, noise_px, (n, 2)) + moved_px
    ground = FlatModel().locate(delivered, np.zeros(n))
    return CheckPoints(ground, marks, np.full((n, 3), np.nan), np.full(n, noise_px))


def checked(scene: Registered, points: CheckPoints, frame: Frame = UNKNOWN_FRAME):
    model = CorrectedModel(FlatModel(), scene.adjustment.correction)
    return check_model(model, scene.adjustment, points, frame)


def test_honest_statements_predict_the_size_of_the_residuals(registered):
    scene = registered()
    result = checked(scene, check_points(scene, n=200, noise_px=0.3))
    assert result.accuracy.n == result.residual_px.xy.n == 200
    assert result.normalised.lower < result.normalised.mean_square < result.normalised.upper
    assert result.accuracy.le90_m is None


def test_the_accuracy_on_the_ground_is_that_of_the_marks_seen_through_the_model(registered):
    scene = registered(noise_px=0.01)
    moved_line_px, moved_sample_px = 2.0, -3.0
    result = checked(scene, check_points(scene, 50, 1e-6, (moved_line_px, moved_sample_px)))
    east_m, north_m = result.accuracy.bias_m
    model_px = 0.01
    assert east_m == pytest.approx(moved_sample_px * GSD_M, abs=model_px)
    assert north_m == pytest.approx(-moved_line_px * GSD_M, abs=model_px)
    assert result.residual_px.y.mean == pytest.approx(moved_line_px, abs=model_px)
    assert result.residual_px.x.mean == pytest.approx(moved_sample_px, abs=model_px)


def test_points_that_contradict_a_registration_take_its_verdict_of_good_away(registered):
    scene = registered()
    rng = np.random.default_rng(3)
    good = qualify(scene.adjusted(), QualificationOptions(), rng)
    assert good.verdict == "good"
    agreeing = with_check_points(good, checked(scene, check_points(scene, 40, 0.3)), LIMIT)
    assert agreeing.verdict == "good"
    moved = checked(scene, check_points(scene, 40, 0.3, (2.0, 0.0)))
    contradicted = with_check_points(good, moved, LIMIT)
    assert contradicted.verdict == "usable"
    (criterion,) = [c for c in contradicted.criteria if not c.met]
    assert criterion.name == "check_points"
    assert criterion.value > LIMIT


def test_what_points_and_their_frame_state_is_expected_of_them(registered):
    scene = registered()
    points = check_points(scene, 40, 0.3, (2.0, 0.0))
    strict = checked(scene, points).normalised.mean_square
    in_a_frame_of_a_metre = checked(scene, points, Frame.from_sigmas(1.0, 1.0)).normalised.mean_square
    stated = replace(points, sigma_m=np.ones((40, 3)))
    assert in_a_frame_of_a_metre < strict / 4.0
    assert checked(scene, stated).normalised.mean_square == pytest.approx(in_a_frame_of_a_metre)


def test_points_known_half_as_well_are_a_quarter_of_the_evidence(registered: Make) -> None:
    scene = registered()
    points = check_points(scene, 40, 0.3, (20.0, 0.0))
    found = [
        checked(scene, replace(points, sigma_m=np.full((40, 3), m))).normalised.mean_square
        for m in (20.0, 40.0)
    ]
    assert found[0] / found[1] == pytest.approx(4.0, rel=1e-2)


def test_residuals_twice_as_large_as_stated_are_within_a_limit_of_three(registered: Make) -> None:
    scene = registered()
    good = qualify(scene.adjusted(), QualificationOptions(), np.random.default_rng(3))
    points = check_points(scene, 200, 1.0)
    half = replace(points, sigma_px=points.sigma_px / 2.0)
    judged = with_check_points(good, checked(scene, half), LIMIT)
    assert judged.verdict == "good"
    assert judged.criteria[-1].value == pytest.approx(2.0, rel=0.1)


def test_marks_without_a_sigma_have_that_of_a_person(registered):
    scene = registered()
    points = check_points(scene, 200, MARKING_SIGMA_PX)
    unstated = replace(points, sigma_px=np.full(200, np.nan))
    assert checked(scene, unstated) == checked(scene, points)


class AcrossTheDateLine(FlatModel):
    """The same view where the middle column of the image lies at 180 degrees."""

    east_deg = 180.0 - (SHAPE[1] - 1.0) / 2.0 * GSD_M * METRE_DEG

    def project(self, lon_lat_h: Array) -> Array:
        lon_deg = wrapped_degrees(lon_lat_h[:, 0] - self.east_deg)
        return super().project(np.column_stack([lon_deg, lon_lat_h[:, 1:]]))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        ground = super().locate(line_sample, height_m)
        ground[:, 0] = wrapped_degrees(ground[:, 0] + self.east_deg)
        return ground


def test_errors_on_the_ground_are_small_across_180_degrees(registered):
    scene = registered()
    model = AcrossTheDateLine()
    rng = np.random.default_rng(4)
    delivered = rng.uniform(0.0, 1.0, (40, 2)) * (np.array(SHAPE) - 1.0)
    delivered[:, 1] = (SHAPE[1] - 1.0) / 2.0 + rng.uniform(-0.2, 0.2, 40)
    marks = scene.truth.apply(delivered) + rng.normal(0.0, 0.3, (40, 2))
    points = CheckPoints(
        model.locate(delivered, np.zeros(40)), marks, np.full((40, 3), np.nan), np.full(40, 0.3)
    )
    corrected = CorrectedModel(model, scene.adjustment.correction)
    found_m = check_model(corrected, scene.adjustment, points, UNKNOWN_FRAME).accuracy
    assert max(found_m.rmse_m) < 2.0 * 0.3 * GSD_M
    assert set(np.sign(points.lon_lat_h[:, 0])) == {-1.0, 1.0}


def test_a_point_beside_the_scene_leaves_the_others(registered: Make) -> None:
    scene = registered()
    points = check_points(scene, 40, 0.3)
    ground = points.lon_lat_h.copy()
    ground[0] = np.nan
    result = checked(scene, replace(points, lon_lat_h=ground))
    assert result.accuracy.n == result.residual_px.xy.n == result.normalised.n == 39


def test_points_beside_the_scene_are_refused_by_number(registered):
    scene = registered()
    points = check_points(scene, 3, 0.3)
    nowhere = replace(points, lon_lat_h=np.full((3, 3), np.nan))
    with pytest.raises(CoverageError, match="none of the 3 check points"):
        checked(scene, nowhere)
