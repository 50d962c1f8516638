"""Simulated scenes are registered with the stated accuracy, or refused with a reason."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.intersection import intersect
from amers.services.errors import ComputationError, CoverageError, NoConsensus, NotEnoughPoints
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.matching.control_points import MatchingOptions
from amers.services.registration.on_points import Registration, register_scene
from amers.services.simulation.view import SimulatedView, simulate_view
from amers.services.types import Array, Observations
from tests.services.simulated import block, block_views, plan, production, spoiled_view, world

pytestmark = pytest.mark.long

half_a_pixel = 0.5
a_quarter_of_a_pixel = 0.25
a_micropixel = 1e-6
SIGMA_M = 15.0


@cache
def frame_m() -> Array:
    """East, north and up from the true ground to the ground of the block."""
    made = production()
    ground = made.points.lon_lat_h
    n, count = len(ground), len(made.adjustment.models)
    seen = np.stack([model.project(ground) for model in made.adjustment.models], axis=1).reshape(-1, 2)
    observations = Observations(
        np.repeat(np.arange(n), count), np.tile(np.arange(count), n), seen, np.ones(n * count)
    )
    true = intersect([view.geometry.true_model for view in block_views()], observations, n).lon_lat_h
    return np.asarray((ground - true).mean(axis=0) * per_degree())


def per_degree() -> Array:
    lat = float(world().centre_lon_lat[1])
    return np.array([*metres_per_degree(lat, 180.0), 1.0])


def errors_px(view: SimulatedView, registered: Registration) -> tuple[Array, Array]:
    """Image positions all over a view, and the errors of the registered model there.

    The truth is that of the frame of the block: the ground that the true model locates, moved as the
    block is.
    """
    rng = np.random.default_rng(0)
    image = rng.uniform(0.03, 0.97, (400, 2)) * view.geometry.plan.shape
    ground = view.geometry.true_model.locate(image, rng.uniform(*world().height_range_m, 400))
    return image, registered.model.project(ground + frame_m() / per_degree()) - image


def ce90_px(view: SimulatedView, registered: Registration) -> float:
    return float(np.quantile(np.hypot(*errors_px(view, registered)[1].T), 0.9))


VIEWS = {
    "31 m east, 24 m south, skewed": {},
    "40 m west, 30 m north, skewed": {"ground_error_m": (-40.0, 30.0), "skew_px": -2.0, "seed": 12},
    "5 m east, 4 m south": {"ground_error_m": (5.0, -4.0), "skew_px": 0.0, "seed": 13},
}
names = pytest.mark.parametrize("name", list(VIEWS))


@cache
def view_of(name: str) -> SimulatedView:
    return spoiled_view(**VIEWS[name])  # type: ignore[arg-type]


@cache
def registration(name: str) -> Registration:
    return register_scene(view_of(name).as_scene(SIGMA_M), *block())


FIRST = next(iter(VIEWS))


@names
def test_a_scene_is_registered_in_the_frame_of_the_block(name: str) -> None:
    assert ce90_px(view_of(name), registration(name)) < half_a_pixel
    assert registration(name).qualification.verdict == "good"


def test_a_skewed_scene_needs_an_affine() -> None:
    assert registration(FIRST).adjustment.order == "affine"


@names
def test_the_predicted_spread_is_that_of_the_errors(name: str) -> None:
    result = registration(name)
    image, error_px = errors_px(view_of(name), result)
    std_px = np.sqrt(np.diagonal(result.adjustment.covariance_at(image), axis1=1, axis2=2))
    ratio = np.sqrt((error_px**2).mean()) / np.sqrt((std_px**2).mean())
    assert 0.3 < ratio < 2.0


def test_blocks_whose_frames_differ_by_metres_both_keep_their_points() -> None:
    points, chips = block()
    second = np.arange(len(points)) % 4 == 0
    places = points.lon_lat_h.copy()
    places[second, 0] += 2.0 / per_degree()[0]
    two = replace(points, lon_lat_h=places, block=second.astype(np.int64), frames=2 * points.frames)
    active = registration(FIRST).measures.active
    of_both = register_scene(view_of(FIRST).as_scene(SIGMA_M), two, chips).measures.active
    for of_block in (second, ~second):
        assert of_both[of_block].sum() >= 0.9 * active[of_block].sum()


def test_a_scene_coarser_than_the_chips_is_registered_as_well() -> None:
    coarse = plan(shape=(350, 350), gsd_m=2.0)
    view = simulate_view(world(), coarse, np.random.default_rng(3), (31.0, -24.0))
    assert ce90_px(view, register_scene(view.as_scene(SIGMA_M), *block())) < half_a_pixel


def test_a_view_of_the_block_itself_finds_the_block_s_own_model() -> None:
    view, model = block_views()[0], production().adjustment.models[0]
    result = register_scene(view.as_scene(3.0), *block())
    ground = block()[0].lon_lat_h
    difference_px = result.model.project(ground) - model.project(ground)
    assert np.hypot(*difference_px.T).max() < a_quarter_of_a_pixel


@names
def test_measures_are_consistent(name: str) -> None:
    result = registration(name)
    measures = result.measures
    assert not (measures.active & ~measures.matched).any()
    assert np.isfinite(measures.line_sample[measures.matched]).all()
    assert np.isnan(measures.line_sample[~measures.matched]).all()
    assert np.isnan(measures.residual_px[~measures.matched]).all()
    assert np.isnan(measures.sigma_px[~measures.matched]).all()
    assert (measures.sigma_px[measures.matched] > 0.0).all()
    assert (measures.views[measures.matched] >= 1).all()
    assert ((measures.reason == "") == measures.active).all()
    assert set(measures.reason[measures.matched & ~measures.active]) <= {"deactivated"}
    assert set(measures.point_id) <= set(block()[0].id)
    assert len(set(measures.point_id)) == len(measures.point_id)


@names
def test_every_view_that_was_tried_is_reported(name: str) -> None:
    result = registration(name)
    measures, views = result.measures, result.views
    assert (np.diff(views.point) >= 0).all()
    agreeing = np.bincount(views.point[views.agreed], minlength=len(measures.point_id))
    np.testing.assert_array_equal(agreeing[measures.matched], measures.views[measures.matched])
    assert not views.agreed[~measures.matched[views.point]].any()
    assert (views.reason[views.agreed] == "").all()
    options = MatchingOptions()
    by_gradient = measures.by_gradient[views.point]
    least = np.where(by_gradient, options.min_gradient_score, options.correlation.min_score)
    assert (views.score >= least)[views.agreed].all()


@names
def test_residuals_are_found_minus_computed(name: str) -> None:
    result = registration(name)
    measures = result.measures
    computed = result.model.project(measures.lon_lat_h)
    matched = measures.matched
    # A displacement is that of where a point was found, or of where the affine part puts it.
    is_affine = result.adjustment.correction.displacement is None
    np.testing.assert_allclose(
        measures.residual_px[matched],
        (measures.line_sample - computed)[matched],
        atol=a_micropixel if is_affine else 2e-3,
    )
    np.testing.assert_allclose(
        measures.predicted, view_of(name).geometry.delivered.project(measures.lon_lat_h)
    )
    # On the ground: moved by its residual, a point is computed where it was found.
    moved_m = np.column_stack([measures.residual_m, np.zeros(len(matched))])[matched]
    moved = result.model.project(measures.lon_lat_h[matched] + moved_m / per_degree())
    np.testing.assert_allclose(moved, measures.line_sample[matched], atol=1e-3 if is_affine else 3e-3)


@names
def test_residuals_of_active_points_are_small_and_without_bias(name: str) -> None:
    measures = registration(name).measures
    residual_px = measures.residual_px[measures.active]
    assert len(residual_px) >= 20
    assert residual_px.std() < half_a_pixel
    assert np.abs(residual_px.mean(axis=0)).max() < a_quarter_of_a_pixel / 2.0


def test_searches_begin_far_and_end_near() -> None:
    stages = registration(FIRST).search_stages
    assert [stage.name for stage in stages] == ["coarse", "fine", "fine"]
    assert stages[0].search_radius_m > 40.0
    assert stages[0].displacement_rms_m > 30.0
    assert stages[1].search_radius_m < 10.0
    assert stages[-1].displacement_rms_m < 1.0
    for stage in stages:
        assert stage.tried >= stage.matched >= stage.inliers > 0


def test_a_scene_that_is_nearly_right_needs_no_coarse_search() -> None:
    scene = view_of("5 m east, 4 m south").as_scene(5.0)
    stages = register_scene(scene, *block()).search_stages
    assert [stage.name for stage in stages] == ["fine", "fine"]


def test_the_same_scene_is_registered_the_same() -> None:
    again = register_scene(view_of(FIRST).as_scene(SIGMA_M), *block())
    first = registration(FIRST)
    np.testing.assert_array_equal(
        again.adjustment.correction.parameters, first.adjustment.correction.parameters
    )
    np.testing.assert_array_equal(again.measures.line_sample, first.measures.line_sample)
    np.testing.assert_array_equal(again.measures.reason, first.measures.reason)
    assert again.qualification.verdict == first.qualification.verdict


@pytest.mark.thorough
def test_a_scene_of_another_world_finds_no_consensus() -> None:
    scene = spoiled_view(world_seed=5).as_scene(SIGMA_M)
    with pytest.raises(NoConsensus, match=r"not agree on one correction: .*low_score"):
        register_scene(scene, *block())


def with_pixels(pixels: Array) -> Scene:
    return replace(view_of(FIRST).as_scene(SIGMA_M), image=ArrayImage(pixels.astype(np.float32)))


def test_noise_finds_no_consensus() -> None:
    noise = np.random.default_rng(0).normal(1000.0, 100.0, (700, 700))
    with pytest.raises(ComputationError, match="tried"):
        register_scene(with_pixels(noise), *block())


def test_points_elsewhere_do_not_cover_the_scene() -> None:
    points, chips = block()
    scene = view_of(FIRST).as_scene(SIGMA_M)
    far = replace(points, lon_lat_h=points.lon_lat_h + [1.0, 0.0, 0.0])
    with pytest.raises(CoverageError, match=f"none of the {len(points)} control points"):
        register_scene(scene, far, chips)
    with pytest.raises(CoverageError, match="no control point"):
        register_scene(scene, points.take(np.array([], dtype=np.int64)), chips)


def test_points_beyond_the_scene_are_left_aside() -> None:
    points, chips = block()
    rows = np.arange(2 * len(points)) % len(points)
    doubled = replace(points.take(rows), id=np.arange(len(rows)))
    doubled.lon_lat_h[len(points) :, 0] += 1.0
    result = register_scene(view_of(FIRST).as_scene(SIGMA_M), doubled, chips)
    assert result.measures.point_id.max() < len(points)
    np.testing.assert_allclose(
        result.adjustment.correction.parameters,
        registration(FIRST).adjustment.correction.parameters,
        atol=a_micropixel,
    )


def test_five_points_are_too_few() -> None:
    points, chips = block()
    scene = view_of("5 m east, 4 m south").as_scene(3.0)
    with pytest.raises(NotEnoughPoints, match=r"^[0-5] usable points found, 6 needed"):
        register_scene(scene, points.take(np.arange(5)), chips)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["bright", "missing"])
def test_a_scene_mostly_under_clouds_is_registered_and_judged_where_it_shows(kind: str) -> None:
    # Of the five columns of cells that the coverage counts, three are covered.
    pixels = view_of(FIRST).pixels.astype(np.float64)
    cloud = np.random.default_rng(0).normal(3500.0, 100.0, (700, 420))
    pixels[:, :420] = cloud if kind == "bright" else np.nan
    result = register_scene(with_pixels(pixels), *block())
    # Where pixels are missing there is no image: the share that points support is that of what is left.
    assert (result.qualification.coverage.percent > 60.0) == (kind == "missing")
    assert kind == "missing" or result.qualification.verdict != "good"
    image, error_px = errors_px(view_of(FIRST), result)
    clear = image[:, 1] > 470.0
    assert np.quantile(np.hypot(*error_px[clear].T), 0.9) < 3.0 * half_a_pixel
    measures = result.measures
    covered = measures.predicted[:, 1] < 320.0
    assert not measures.active[covered].any()
    assert set(measures.reason[covered]) <= {"low_score", "nodata", "border_peak", "ambiguous"}
    assert ("nodata" in measures.reason) == (kind == "missing")


@pytest.mark.parametrize("sigma_m", [1.0, 4.0, 8.0])
def test_a_stated_sigma_far_below_the_error_of_the_model_is_an_error(sigma_m: float) -> None:
    # The model is 39 m wrong: outside three times each of these sigmas.
    with pytest.raises(ComputationError, match="tried"):
        register_scene(view_of(FIRST).as_scene(sigma_m), *block())


def test_progress_only_grows_and_arrives() -> None:
    fractions: list[float] = []
    scene = view_of("5 m east, 4 m south").as_scene(5.0)
    register_scene(scene, *block(), progress=lambda fraction, message: fractions.append(fraction))
    assert fractions[-1] == 1.0
    assert (np.diff(fractions) >= -1e-9).all()
