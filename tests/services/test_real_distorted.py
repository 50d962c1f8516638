"""Distorted crops of real views: the truth at ties is right, and clean crops are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks._distortions import NOT_DISTORTED, Drawn
from benchmarks._real_distorted import (
    RealScene,
    prepare_real,
    real_scene,
    register_real,
)
from benchmarks._real_views import RealView, real_view
from benchmarks.distorted import distorted_log

pytestmark = [pytest.mark.long, pytest.mark.real_data]

SEED = 1
a_tenth_of_a_pixel = 0.1
a_hundredth_of_a_pixel = 0.01


@pytest.fixture(scope="module")
def gizeh(real_data: Path) -> RealView:
    return real_view(real_data, "gizeh_2")


def planned(view: RealView, drawn: Drawn = NOT_DISTORTED) -> RealScene:
    """The sixth clean scene, which is a crop of the second view of Gizeh."""
    plan = real_scene("clean_0005", SEED, view)
    assert plan.view == "gizeh_2"
    return replace(plan, drawn=drawn)


def test_ties_tell_where_the_image_shows_the_ground_to_a_tenth_of_a_pixel(gizeh: RealView) -> None:
    """The points were measured by correlation, the ties are features: both agree on one affine."""
    assert len(gizeh.ground) > 300
    assert gizeh.noise_px < a_tenth_of_a_pixel
    model = gizeh.scene.model
    design = np.column_stack([np.ones(len(gizeh.ground)), gizeh.line_sample / 1000.0])
    misfit = gizeh.line_sample - model.project(gizeh.ground)
    rest = misfit - design @ np.linalg.lstsq(design, misfit, rcond=None)[0]
    assert np.median(np.linalg.norm(rest, axis=1)) < a_tenth_of_a_pixel


def test_a_point_has_chips_of_the_other_view_only(gizeh: RealView) -> None:
    views = gizeh.block.points.views
    used = {views.images[k].image_id for k in views.image.tolist()}
    assert used
    assert gizeh.scene.acquisition.image_id not in used
    assert len(gizeh.block.chips) == len(views.gsd_m)


def test_a_clean_crop_is_right_by_the_ties(gizeh: RealView) -> None:
    plan = planned(gizeh)
    prepared, outcome, registration = register_real(plan, gizeh, SEED)
    assert registration is not None
    assert outcome.delivered
    assert not outcome.wrong
    assert outcome.wrong_share == 0.0
    assert outcome.ce90_before_m > 3.0
    assert outcome.ce90_m < 0.5 * outcome.ce90_before_m
    truth = prepared.truth
    error_px = registration.model.project(truth.on_earth) - truth.line_sample
    assert np.abs(np.median(error_px, axis=0)).max() < a_tenth_of_a_pixel


def test_the_truth_of_a_distorted_crop_differs_by_its_distortion(gizeh: RealView) -> None:
    clean, bent = (prepare_real(planned(gizeh, d), gizeh, SEED) for d in (Drawn(), Drawn("bow", 5.0)))
    pixels = bent.truth.line_sample
    back = bent.distortion.undistorted(pixels)
    ground = [tuple(g) for g in bent.truth.on_earth.tolist()]
    place = dict(zip(map(tuple, clean.truth.on_earth.tolist()), clean.truth.line_sample, strict=True))
    both = [(place[g], at) for g, at in zip(ground, back, strict=True) if g in place]
    assert len(both) > 100
    straight, undistorted = (np.array(column) for column in zip(*both, strict=True))
    np.testing.assert_allclose(straight, undistorted, atol=a_hundredth_of_a_pixel)
    assert np.linalg.norm(pixels - back, axis=1).max() == pytest.approx(5.0, rel=0.2)


@pytest.mark.parametrize("kind", ["swapped", "mirrored"])
def test_an_image_stored_in_another_order_is_not_delivered(gizeh: RealView, kind: str) -> None:
    _, outcome, _ = register_real(planned(gizeh, Drawn(kind)), gizeh, SEED)
    assert not outcome.delivered


def test_outcomes_are_read_back(gizeh: RealView, tmp_path: Path) -> None:
    plan = planned(gizeh, Drawn("mirrored"))
    outcome = register_real(plan, gizeh, SEED)[1]
    log = distorted_log(tmp_path / "outcomes.jsonl")
    log.append(plan.name, (plan, outcome))
    log.file.write_text(log.file.read_text() + '{"code": "a", "sc')
    kept = log.read()
    assert list(kept) == [plan.name]
    assert kept[plan.name][0] == plan
    assert repr(kept[plan.name][1]) == repr(outcome)
