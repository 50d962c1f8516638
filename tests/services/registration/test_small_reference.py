"""A small scene on a reference image: from the level that its error asks for down to the finest."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import NoConsensus, RescaledImage
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.reference_image import NO_HEIGHT_SIGMA_M, Reference
from amers.services.registration.context import SearchStage
from amers.services.registration.on_points import Registration
from amers.services.registration.on_reference import (
    _points_around,
    _ReferenceContext,
    register_on_reference,
)
from amers.services.registration.options import ReferenceOptions, RegistrationOptions
from amers.services.registration.reference_points import reference_points
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, no_progress
from tests.services.registration.small_ground import GRID, GSD_M, resampled, scene, whole

OPTIONS = RegistrationOptions(reference=ReferenceOptions(places=100, leading_places=36))
OFF_M = np.array([52.0, -38.0])
SIGMA_M = 25.0


def reference() -> Reference:
    image = whole()
    return Reference(image.image, image.model, None, sigma_m=0.3, common_sigma_m=0.1)


def registered(of: Scene, options: RegistrationOptions = OPTIONS) -> Registration:
    return register_on_reference(of, reference(), options)


def error_px(registration: Registration, of: Scene, off_m: Array) -> float:
    """Largest distance between the registered and the true positions of the corners of the scene."""
    lines, samples = of.image.shape
    corners = np.array(
        [[0.0, 0.0], [0.0, samples - 1.0], [lines - 1.0, 0.0], [lines - 1.0, samples - 1.0]]
    )
    ground = of.model.locate(corners, np.zeros(4))
    true = corners + np.array([-off_m[1], off_m[0]]) / GSD_M
    return float(np.hypot(*(registration.model.project(ground) - true).T).max())


def stages_of(of: Scene, options: RegistrationOptions = OPTIONS) -> list[SearchStage]:
    return list(registered(of, options).search_stages)


@pytest.mark.parametrize(("factor", "words"), [(2.0, "2 times finer"), (0.5, "2 times coarser")])
def test_an_image_with_other_pixels_than_its_model_is_named(factor: float, words: str) -> None:
    of = resampled(factor, sigma_m=6.0)
    with pytest.raises(RescaledImage, match=f"the pixels of the image are {words} than its model says"):
        registered(of)


def test_a_scene_is_brought_onto_the_reference_from_few_coarse_places_to_all_fine_ones() -> None:
    """Three sigmas are 38 pixels; 16 of a level are searched, which has half as many."""
    of = scene(OFF_M, SIGMA_M)
    made = registered(of)
    assert error_px(made, of, OFF_M) < 0.1
    first, last = made.search_stages
    assert (first.name, last.name) == ("reference", "reference")
    assert first.chip_gsd_m == pytest.approx(2.0 * GSD_M, rel=0.01)
    assert last.chip_gsd_m == pytest.approx(GSD_M, rel=0.01)
    assert first.needed_radius_m == pytest.approx(3.0 * SIGMA_M)
    assert 75.0 < first.search_radius_m < 75.0 + 4.0 * first.chip_gsd_m
    assert (first.tried, last.tried) == (36, 100)
    assert first.displacement_rms_m == pytest.approx(np.hypot(*OFF_M), rel=0.02)
    assert last.displacement_rms_m < 0.2


@pytest.mark.parametrize(("samples", "tried"), [(130, 100), (170, 36)])
def test_all_places_lead_where_less_than_a_quarter_of_the_few_are_seen(samples: int, tried: int) -> None:
    """Two columns of six are a third of them."""
    of = scene(OFF_M, SIGMA_M)
    pixels = of.image.read(Window(0, 0, 400, 400))
    pixels[:, samples:] = np.nan
    assert stages_of(replace(of, image=ArrayImage(pixels)))[0].tried == tried


@pytest.mark.parametrize(
    ("settled_px", "fine_stages", "count"), [(0.25, 3, 2), (0.0, 2, 3), (0.0, 3, 4)]
)
def test_fine_searches_go_on_until_one_hardly_moves_the_image(
    settled_px: float, fine_stages: int, count: int
) -> None:
    fine = replace(OPTIONS.reference, settled_px=settled_px, fine_stages=fine_stages)
    assert len(stages_of(scene(OFF_M, SIGMA_M), replace(OPTIONS, reference=fine))) == count


def test_a_scene_of_other_ground_is_refused_by_its_first_search() -> None:
    of = scene(OFF_M, SIGMA_M)
    other = replace(of, image=ArrayImage(of.image.read(Window(0, 0, 400, 400))[::-1].copy()))
    stages: list[SearchStage] = []
    with pytest.raises(
        NoConsensus, match="the reference does not agree with the scene on one correction"
    ):
        register_on_reference(other, reference(), OPTIONS, stages=stages)
    assert {stage.inliers for stage in stages} <= {0, 1, 2, 3, 4}


@pytest.mark.parametrize("off_m", [[105.0, 0.0], [0.0, -105.0]])
def test_a_scene_farther_off_than_it_states_is_refused(off_m: list[float]) -> None:
    with pytest.raises(NoConsensus):
        registered(scene(np.array(off_m), SIGMA_M))


def test_a_scene_off_by_much_of_its_size_is_searched_all_around_first() -> None:
    of, off_m = scene(np.array([350.0, -260.0]), 150.0), np.array([350.0, -260.0])
    made = registered(of)
    assert error_px(made, of, off_m) < 0.1
    far, *near = made.search_stages
    assert far.name == "far"
    assert far.search_radius_m > 450.0
    assert {stage.name for stage in near} == {"reference"}
    assert max(stage.search_radius_m for stage in near) < 150.0


def test_progress_grows_by_a_tenth_for_each_search_before_the_finest_level() -> None:
    told: list[tuple[float, str]] = []

    def progress(fraction: float, message: str) -> None:
        told.append((fraction, message))

    of = scene(np.array([350.0, -260.0]), 150.0)
    register_on_reference(of, reference(), OPTIONS, progress=progress)
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert max(fractions) <= 1.0
    around, *_ = [fraction for fraction, message in told if "within" in message]
    leading, *_ = [fraction for fraction, message in told if "places at 1:" in message]
    np.testing.assert_allclose([around, leading], [0.0, 0.1])
    assert min(fraction for fraction in fractions if fraction > 0.2) == pytest.approx(0.5)


@pytest.mark.parametrize("ratio", [2, 3])
def test_no_level_is_finer_than_the_reference(ratio: int) -> None:
    fine = whole()
    side = 1024 // ratio
    pixels = fine.image.read(Window(0, 0, side * ratio, side * ratio))
    means = pixels.reshape(side, ratio, side, ratio).mean(axis=(1, 3))
    origin = GRID.origin_xy + GRID.step_xy @ np.full(2, (ratio - 1) / 2.0)
    grid = replace(GRID, origin_xy=origin, step_xy=ratio * GRID.step_xy, shape=(side, side))
    coarse = replace(reference(), image=ArrayImage(means), model=OrthoModel(grid))
    of = scene(OFF_M, SIGMA_M)
    made = register_on_reference(of, coarse, OPTIONS)
    assert error_px(made, of, OFF_M) < 0.1 * ratio
    assert made.search_stages[-1].chip_gsd_m == pytest.approx(ratio * GSD_M, rel=0.01)


def test_places_that_were_found_before_are_searched_again_where_they_lie() -> None:
    """Five of them, each in place of that of its part; those without room for a window are left out."""
    of = scene(OFF_M, SIGMA_M)
    at = np.array([[351.3, 351.7], [420.2, 600.1], [512.6, 480.4], [650.8, 390.9], [633.3, 655.5]])
    beside = [[20.0, 20.0], [330.0, 500.0], [500.0, 694.0]]
    earlier = whole().model.locate(np.concatenate([at, beside]), np.zeros(8))
    made = register_on_reference(of, reference(), OPTIONS, earlier_places=earlier)
    found = made.measures.lon_lat_h
    apart_deg = np.abs(found[:, None, :2] - earlier[None, :, :2]).max(axis=2).min(axis=0)
    pixel_deg = GSD_M / 70_000.0
    assert (apart_deg[:5] < pixel_deg).all()
    assert (apart_deg[5:] > pixel_deg).all()
    assert len(found) == len(register_on_reference(of, reference(), OPTIONS).measures.lon_lat_h)


@pytest.mark.parametrize(("sigma_m", "factor"), [(10.5, 1), (10.9, 2)])
def test_the_first_level_has_three_sigmas_within_sixteen_of_its_pixels(
    sigma_m: float, factor: int
) -> None:
    first = stages_of(scene(np.array([7.0, -5.0]), sigma_m))[0]
    assert first.chip_gsd_m == pytest.approx(factor * GSD_M, rel=0.01)


@pytest.mark.parametrize("gsd_m", [GSD_M, 3.0 * GSD_M])
def test_points_around_a_scene_have_their_chips_in_the_reference(gsd_m: float) -> None:
    """As many pixels of the reference are left at its border as half a chip has, and hardly more."""
    of = scene(np.zeros(2), 150.0)
    context = _ReferenceContext(of, OPTIONS, no_progress, [], None, reference(), 1)
    points, chips = _points_around(context, gsd_m)
    at = whole().model.project(points.lon_lat_h)
    left_px = np.minimum(at, 1023.0 - at).min()
    half_px = CHIP_SIZE / 2.0 * gsd_m / GSD_M
    assert half_px - 1.0 < left_px < half_px + 60.0
    assert np.isclose(points.views.gsd_m, gsd_m).all()
    assert (chips.read("reference", 3, 1) > 0).mean() > 0.95


def test_places_are_as_precise_as_the_reference_and_as_high_as_its_terrain_says() -> None:
    ground = whole().model.locate(np.array([[300.0, 300.0], [500.0, 600.0]]), np.zeros(2))
    points = reference_points(ground, reference())
    expected = np.diag([0.3**2, 0.3**2, NO_HEIGHT_SIGMA_M**2])
    np.testing.assert_allclose(points.covariance_m2, [expected] * 2)
    np.testing.assert_allclose(points.views.gsd_m, GSD_M, rtol=1e-3)
    assert points.frames == (reference().frame,)
