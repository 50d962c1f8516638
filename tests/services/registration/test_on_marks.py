"""A scene registered on what a person marked in its image."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.registration.on_marks import register_on_marks
from amers.services.registration.on_points import Registration
from amers.services.registration.scene_marks import SceneMarks, with_marks
from amers.services.types import UNKNOWN_FRAME, Array, Frame, SurfaceHeights
from tests.factories import control_points
from tests.services.simulated import ring_of_geometries

GEOMETRY = ring_of_geometries(1, shape=(600, 800))[0]
MODEL = GEOMETRY.rpc
SCENE = Scene(
    ArrayImage(np.ones(GEOMETRY.plan.shape, np.float32)), MODEL, GEOMETRY.acquisition, sigma_m=10.0
)
OFF_PX = np.array([24.0, -32.0])
FRAME = Frame.from_sigmas(0.05, 0.05)
of_a_pick_px = 0.3


def marks_at(picked: Array, sigma_m: float = 0.1, frame: Frame = FRAME) -> SceneMarks:
    """Marks (n, 2) without error, in an image that is 40 px off its model."""
    count = len(picked)
    ground = MODEL.locate(picked - OFF_PX, np.full(count, 100.0))
    return SceneMarks(
        names=tuple(f"GCP{k}" for k in range(count)),
        lon_lat_h=ground,
        line_sample=picked,
        sigma_m=np.full((count, 3), sigma_m),
        sigma_px=np.full(count, of_a_pick_px),
        frame=frame,
    )


def eight(seed: int = 0) -> Array:
    """Places in the image."""
    return np.random.default_rng(seed).uniform([60.0, 60.0], [540.0, 740.0], (8, 2))


def moved(marks: SceneMarks, row: int, by_px: Array) -> SceneMarks:
    line_sample = marks.line_sample.copy()
    line_sample[row] += by_px
    return replace(marks, line_sample=line_sample)


def words(registration: Registration) -> str:
    assert registration.marks is not None
    return "; ".join(registration.marks.words)


def test_the_model_follows_the_marks():
    registration = register_on_marks(SCENE, marks_at(eight()))
    corner = np.array([[0.0, 0.0], [599.0, 799.0]])
    ground = MODEL.locate(corner, np.full(2, 100.0))
    assert registration.model.project(ground) == pytest.approx(corner + OFF_PX, abs=0.02)
    assert registration.qualification.verdict == "usable"
    assert registration.frame == FRAME


def test_residuals_on_the_ground_are_those_in_the_image():
    """Of a mark that is 3 px off in line, and of the others: ground moved by them is seen as far off."""
    measures = register_on_marks(SCENE, moved(marks_at(eight()), 0, np.array([3.0, 0.0]))).measures
    step = np.column_stack([measures.residual_m, np.zeros(8)])
    seen = MODEL.project(move_metres(measures.lon_lat_h, step)) - MODEL.project(measures.lon_lat_h)
    assert np.abs(measures.residual_px).max() > 1.0
    np.testing.assert_allclose(seen, measures.residual_px, atol=0.01)


def test_the_mark_that_it_asks_for_brings_what_it_states():
    marks = marks_at(eight())
    registration = register_on_marks(SCENE, marks)
    assert registration.marks is not None
    promised = registration.marks.next_mark
    place = np.array([[promised.line, promised.sample]])
    nine = register_on_marks(SCENE, marks_at(np.concatenate([eight(), place])))
    assert nine.qualification.predicted.worst_m == pytest.approx(promised.ce90_m, rel=0.01)
    for other in eight(seed=1)[:4]:
        elsewhere = register_on_marks(SCENE, marks_at(np.concatenate([eight(), other[None]])))
        assert elsewhere.qualification.predicted.worst_m >= 0.999 * promised.ce90_m
    shown = registration.model.project(np.array([[promised.lon, promised.lat, 100.0]]))
    assert shown == pytest.approx(place, abs=0.01)


def test_a_blunder_is_named():
    registration = register_on_marks(SCENE, moved(marks_at(eight()), 3, np.array([36.0, 48.0])))
    assert "Mark GCP3 is not used: it is 60.0 px off the other marks" in words(registration)
    assert registration.marks is not None
    assert [mark.status for mark in registration.marks.marks] == ["used"] * 3 + ["rejected"] + [
        "used"
    ] * 4
    assert registration.qualification.verdict == "usable"


def test_marks_in_doubt_fail():
    registration = register_on_marks(SCENE, moved(marks_at(eight()[:2]), 1, np.array([36.0, 48.0])))
    assert registration.qualification.verdict == "failed"
    assert "The 2 marks disagree beyond their sigmas, by up to 60.0 px" in words(registration)
    assert "One more mark like these" not in words(registration)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_marks_are_usable_with_the_accuracy_that_they_have(count):
    registration = register_on_marks(SCENE, marks_at(eight()[:count]))
    assert registration.qualification.verdict == "usable"
    assert "drift and skew" in words(registration)
    names = {one.name for one in registration.qualification.criteria}
    repeated = {"displacement_px", "residual_std_px"}
    assert repeated & names == (repeated if count >= 3 else set())
    assert ("A single mark is used, and nothing checks it" in words(registration)) == (count == 1)


def test_marks_less_precise_than_pixels_are_as_good_as_they_state():
    registration = register_on_marks(SCENE, marks_at(eight(), sigma_m=4.0))
    assert registration.qualification.verdict == "usable"
    assert registration.qualification.predicted.worst_m > 2.0


def test_accuracy_on_the_earth_needs_the_frame_of_the_marks():
    registration = register_on_marks(SCENE, marks_at(eight(), frame=UNKNOWN_FRAME))
    assert np.isnan(registration.qualification.accuracy.on_the_earth.ce90_m)


def test_marks_stand_behind_the_points_of_a_base_as_a_block_of_their_own():
    """Two blocks of points, of which some have a surface; marks have none, and no views."""
    base = control_points(5, np.random.default_rng(1))
    surface = SurfaceHeights(np.arange(5.0), np.ones(5))
    base = replace(base, block=np.array([0, 1, 0, 1, 1]), frames=2 * base.frames, surface=surface)
    marks = marks_at(eight()[:3])
    both = with_marks(base, marks)
    assert both.block.tolist() == [0, 1, 0, 1, 1, 2, 2, 2]
    assert both.frames == (*base.frames, FRAME)
    assert both.id.tolist() == [0, 1, 2, 3, 4, -1, -2, -3]
    np.testing.assert_array_equal(np.diff(both.views.start), [6] * 5 + [0] * 3)
    np.testing.assert_array_equal(both.surface.height_m, [0, 1, 2, 3, 4] + [np.nan] * 3)
    np.testing.assert_array_equal(both.lon_lat_h, np.concatenate([base.lon_lat_h, marks.lon_lat_h]))
    np.testing.assert_allclose(both.covariance_m2[5:], [0.1**2 * np.eye(3)] * 3)
    some = marks.take(np.array([2, 0]))
    assert (some.names, some.numbers.tolist()) == (("GCP2", "GCP0"), [-3, -1])
    np.testing.assert_array_equal(some.line_sample, marks.line_sample[[2, 0]])
