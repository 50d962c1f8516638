"""Marks of a person are observations of the same adjustment as points of a base, or as a reference."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.quality.marks import marks_beside_points
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.on_reference import register_on_reference
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.scene_marks import SceneMarks
from amers.services.types import Array, ControlPoints, Frame
from tests.services.conftest import register
from tests.services.registration.test_on_points import per_degree
from tests.services.registration.test_on_reference import REFERENCE_OPTIONS, reference
from tests.services.simulated import block, spoiled_view, world

pytestmark = pytest.mark.long

SIGMA_M = 15.0
BASE_OFF_M = np.array([2.0, -1.5, 0.0])
BASE = Frame.from_sigmas(2.0, 2.0)
SURVEY = Frame.from_sigmas(0.03, 0.03)
BLUNDER_PX = np.array([9.0, 12.0])


@cache
def base() -> ControlPoints:
    """The points of a base that lies 2.5 m off, which its frame covers."""
    points = block()[0]
    moved = points.lon_lat_h + BASE_OFF_M / per_degree()
    return replace(points, lon_lat_h=moved, frames=(BASE,) * len(points.frames))


def marks(count: int = 6, *, wrong: bool = False) -> SceneMarks:
    """Marks of a survey, of 0.05 m and 0.2 px."""
    rng = np.random.default_rng(5)
    picked = rng.uniform(60.0, 640.0, (count, 2))
    heights_m = rng.uniform(*world().height_range_m, count)
    ground = spoiled_view().geometry.true_model.locate(picked, heights_m)
    picked = picked + rng.normal(0.0, 0.2, (count, 2))
    if wrong:
        picked[1] += BLUNDER_PX
    return SceneMarks(
        names=tuple(f"GCP{k}" for k in range(count)),
        lon_lat_h=ground,
        line_sample=picked,
        sigma_m=np.full((count, 3), 0.05),
        sigma_px=np.full(count, 0.2),
        frame=SURVEY,
    )


@cache
def registered(with_marks: bool, wrong: bool = False) -> Registration:
    beside = marks(wrong=wrong) if with_marks else None
    return register_scene(spoiled_view().as_scene(SIGMA_M), base(), block()[1], marks=beside)


def off_m(registration: Registration) -> float:
    """Mean error of the model on the Earth, metres: its pixels are a metre."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.03, 0.97, (400, 2)) * spoiled_view().geometry.plan.shape
    ground = spoiled_view().geometry.true_model.locate(image, rng.uniform(*world().height_range_m, 400))
    return float(np.hypot(*(registration.model.project(ground) - image).mean(axis=0)))


def test_marks_of_a_survey_place_what_a_base_leaves_open() -> None:
    alone, both = registered(False), registered(True)
    assert off_m(alone) > 1.5
    assert off_m(both) < 0.8
    assert both.qualification.point_counts.active > alone.qualification.point_counts.active
    assert both.marks is not None
    assert [mark.status for mark in both.marks.marks] == ["used"] * 6
    assert np.isfinite([mark.left_out_px for mark in both.marks.marks]).all()


def test_the_points_of_the_base_are_what_they_were() -> None:
    alone, both = registered(False).measures, registered(True).measures
    count = len(alone.point_id)
    assert both.point_id[:count].tolist() == alone.point_id.tolist()
    assert both.point_id[count:].tolist() == [-1, -2, -3, -4, -5, -6]
    assert both.line_sample[:count] == pytest.approx(alone.line_sample, nan_ok=True)


def test_a_wrong_mark_is_rejected_by_name() -> None:
    both = registered(True, wrong=True)
    assert both.marks is not None
    assert [mark.name for mark in both.marks.marks if mark.status == "rejected"] == ["GCP1"]
    assert "Mark GCP1 is not used" in both.marks.words[0]
    assert off_m(both) < 0.8


def test_a_mark_is_stated_as_uncertain_in_the_image_as_its_ground_is_along_each_axis() -> None:
    """Seen from above in pixels of half a metre: east moves samples, north lines, and height nothing."""
    scene = register().adjusted()

    def variance_px2(sigma_m: tuple[float, ...]) -> Array:
        report = marks_beside_points(scene, ("A", "B"), np.tile(sigma_m, (2, 1)))
        return np.array([mark.left_out_sigma_px for mark in report.marks]) ** 2

    exact = variance_px2((0.0, 0.0, 0.0))
    for sigma_m, moved_px in (((3, 0, 0), [0, 6]), ((0, 3, 0), [6, 0]), ((0, 0, 3), [0, 0])):
        np.testing.assert_allclose(variance_px2(sigma_m) - exact, [np.square(moved_px)] * 2, atol=0.2)


def test_marks_are_added_to_the_places_of_a_reference() -> None:
    options = RegistrationOptions(reference=REFERENCE_OPTIONS)
    scene = spoiled_view().as_scene(SIGMA_M)
    both = register_on_reference(scene, reference(), options, marks=marks())
    assert both.marks is not None
    assert [mark.status for mark in both.marks.marks] == ["used"] * 6
    assert off_m(both) < 0.8
