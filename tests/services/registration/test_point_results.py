"""What became of every point: its residual in the image and on the ground, or why it has none."""

from functools import cache

import numpy as np

from amers.services.geodesy import move_metres
from amers.services.joint.measured import MeasuredScene
from amers.services.registration.point_results import point_results
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Measures
from tests.services.joint.test_joint_block import observed, truth_of


@cache
def measured() -> MeasuredScene:
    """A scene of which a sixth of the points are found in wrong places, and others not at all."""
    rng = np.random.default_rng(15)
    return observed(truth_of(rng, wrong=0.15), rng)[0][2]


@cache
def results() -> Measures:
    of = measured()
    assert of.alone is not None
    return point_results(of.scene, of.points, of.search, of.alone)


def test_residuals_on_the_ground_are_those_in_the_image_under_the_adjusted_model() -> None:
    of, found = measured(), results()
    assert of.alone is not None
    model = CorrectedModel(of.scene.model, of.alone.correction)
    rows = np.flatnonzero(found.active)
    assert len(rows) > 20
    steps_m = np.column_stack([found.residual_m[rows], np.zeros(len(rows))])
    ground = found.lon_lat_h[rows]
    moved_px = model.project(move_metres(ground, steps_m)) - model.project(ground)
    np.testing.assert_allclose(moved_px, found.residual_px[rows], atol=1e-3)
    left_px = found.line_sample[rows] - model.project(ground)
    np.testing.assert_allclose(left_px, found.residual_px[rows], atol=1e-6)


def test_points_are_expected_where_the_delivered_model_shows_them() -> None:
    expected = measured().scene.model.project(results().lon_lat_h)
    np.testing.assert_allclose(results().predicted, expected)


def test_every_point_is_active_or_has_a_reason() -> None:
    found = results()
    np.testing.assert_array_equal(found.reason == "", found.active)
    np.testing.assert_array_equal(found.reason == "deactivated", found.matched & ~found.active)
    assert (found.reason == "deactivated").sum() > 3
    assert set(found.reason[~found.matched]) == {"low_score"}
    assert not (found.active & ~found.matched).any()
    for values in (found.line_sample, found.residual_px, found.sigma_px[:, None]):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), found.matched)
    assert (found.views[found.matched] >= 1).all()
    np.testing.assert_array_equal(found.point_id, measured().points.id)
