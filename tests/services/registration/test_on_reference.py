"""Scenes registered on a reference ortho-image and its terrain instead of points."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import CoverageError, InputError, NoConsensus
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window, sample_image
from amers.services.map_grid import MapGrid, utm_of
from amers.services.matching.reference_image import Reference, ReferenceMatchingOptions
from amers.services.registration.on_points import Registration
from amers.services.registration.on_reference import register_on_reference
from amers.services.registration.options import ReferenceOptions, RegistrationOptions
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.view import SimulatedView, true_ground
from amers.services.terrain import Terrain
from tests.services.simulated import block_views, spoiled_view, world

pytestmark = pytest.mark.long

REFERENCE_GSD_M = 1.0
POSTING_M = 5.0
SIGMA_M = 25.0
REFERENCE_OPTIONS = ReferenceOptions(places=300)
OPTIONS = RegistrationOptions(reference=REFERENCE_OPTIONS)
ERROR_ALLOWED_PX = 0.1
"""Of the model, root mean square: roofs lean differently in the reference and in the scene."""
MAP_ALLOWED_PX = 0.1


@cache
def grid(posting_m: float) -> MapGrid:
    """A map of the middle of the world, on UTM."""
    lon, lat = world().centre_lon_lat
    crs = utm_of(lon, lat)
    centre = MapGrid(crs, np.zeros(2), np.eye(2), (2, 2)).line_sample(np.array([[lon, lat]]))[0]
    size = round(900.0 / posting_m)
    step = np.array([[0.0, posting_m], [-posting_m, 0.0]])
    return MapGrid(crs, centre - step @ np.full(2, (size - 1) / 2.0), step, (size, size))


def positions(of: MapGrid) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in of.shape), indexing="ij"), -1).reshape(-1, 2)


@cache
def terrain() -> Terrain:
    nodes = grid(POSTING_M)
    heights = world().height_m(nodes.lon_lat(positions(nodes).astype(float)))
    return Terrain(nodes, ArrayImage(heights.reshape(nodes.shape).astype(np.float32)), sigmas=1.0)


@cache
def reference() -> Reference:
    """The first view of the block, rectified through its true model."""
    pixels = grid(REFERENCE_GSD_M)
    lon_lat = pixels.lon_lat(positions(pixels).astype(float))
    ground = np.column_stack([lon_lat, world().height_m(lon_lat)])
    view = block_views()[0]
    seen = view.geometry.true_model.project(ground).reshape(*pixels.shape, 2)
    image = ArrayImage(sample_image(view.image, seen, 1.0))
    return Reference(image, OrthoModel(pixels), terrain(), sigma_m=0.3, common_sigma_m=0.15)


@cache
def registered() -> Registration:
    return register_on_reference(spoiled_view().as_scene(SIGMA_M), reference(), OPTIONS)


def shown_places() -> np.ndarray:
    """Places (144, 2) of the image."""
    axis = np.linspace(60.0, 640.0, 12)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def error_px(registration: Registration) -> np.ndarray:
    """Errors (n, 2) of the model at the ground that the image really shows."""
    shown = shown_places()
    return registration.model.project(true_ground(spoiled_view(), world(), shown)) - shown


def test_a_scene_forty_metres_off_is_brought_onto_the_reference() -> None:
    before = spoiled_view().as_scene(SIGMA_M).model
    shown = np.full((1, 2), 350.0)
    assert np.hypot(*(before.project(true_ground(spoiled_view(), world(), shown)) - shown)[0]) > 30.0
    error = error_px(registered())
    assert np.sqrt((error**2).sum(axis=1).mean()) < ERROR_ALLOWED_PX


def test_the_stated_accuracy_covers_the_error() -> None:
    covariance = registered().adjustment.covariance_at(shown_places())
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    assert (error_px(registered()) ** 2 / variance).mean() < 1.5


def test_levels_go_down_to_full_resolution_and_their_searches_shrink() -> None:
    stages = registered().search_stages
    assert {stage.name for stage in stages} == {"reference"}
    gsd_m = [stage.chip_gsd_m for stage in stages]
    assert gsd_m == sorted(gsd_m, reverse=True)
    assert gsd_m[0] > 1.5 * gsd_m[-1]
    assert stages[-1].search_radius_m < stages[0].search_radius_m / 4.0
    assert stages[-1].displacement_rms_m < 2.0 * gsd_m[-1]


def test_few_places_lead_to_the_finest_level_where_all_are_searched() -> None:
    first, *_, last = registered().search_stages
    assert first.tried <= REFERENCE_OPTIONS.leading_places
    assert last.tried > 2 * REFERENCE_OPTIONS.leading_places


def test_all_places_lead_where_few_of_the_few_are_to_be_seen() -> None:
    hidden = reference().image.read(Window(0, 0, *reference().image.shape)).copy()
    hidden[:, hidden.shape[1] // 4 :] = np.nan
    scene = spoiled_view().as_scene(SIGMA_M)
    result = register_on_reference(scene, replace(reference(), image=ArrayImage(hidden)), OPTIONS)
    assert result.search_stages[0].tried > REFERENCE_OPTIONS.leading_places


def test_the_last_search_is_one_that_hardly_moves_the_image() -> None:
    options = replace(OPTIONS, reference=replace(REFERENCE_OPTIONS, fine_stages=5))
    scene = spoiled_view().as_scene(SIGMA_M)
    settled = register_on_reference(scene, reference(), options)
    stages = settled.search_stages
    finest = [stage for stage in stages if stage.tried == stages[-1].tried]
    assert len(finest) < options.reference.fine_stages
    error = error_px(settled)
    assert np.sqrt((error**2).sum(axis=1).mean()) < ERROR_ALLOWED_PX


def crop_of(view: SimulatedView, sigma_m: float) -> Scene:
    """The middle 350 x 350 pixels of a view."""
    first, side = 175, 350
    delivered = view.geometry.delivered
    return Scene(
        ArrayImage(view.image.pixels[first : first + side, first : first + side]),
        replace(delivered, image_offset=delivered.image_offset - first),
        view.geometry.acquisition,
        sigma_m,
    )


@pytest.mark.thorough
def test_a_small_scene_off_by_most_of_its_size_ends_where_a_good_start_does() -> None:
    """The places that the scene shows lie beside the ground that its model predicts."""
    far = register_on_reference(crop_of(spoiled_view((215.0, -160.0)), 100.0), reference(), OPTIONS)
    near = register_on_reference(crop_of(spoiled_view((3.0, 2.0)), 10.0), reference(), OPTIONS)
    first = far.search_stages[0]
    assert first.name == "far"
    assert not first.limited
    assert first.displacement_rms_m > 250.0
    assert near.search_stages[0].name == "reference"
    ground = near.measures.lon_lat_h
    np.testing.assert_allclose(far.model.project(ground), near.model.project(ground), atol=0.1)


def test_places_found_before_are_the_first_to_be_searched_again() -> None:
    measures = registered().measures
    earlier = measures.lon_lat_h[measures.active][::7]
    again = register_on_reference(
        spoiled_view().as_scene(SIGMA_M), reference(), OPTIONS, earlier_places=earlier
    ).measures
    distance_deg = np.abs(earlier[:, None, :2] - again.lon_lat_h[None, :, :2]).max(axis=2).min(axis=1)
    one_pixel_deg = 1.0 / 70_000.0
    assert np.mean(distance_deg < one_pixel_deg) > 0.8


def test_an_ortho_scene_needs_no_terrain() -> None:
    moved_px = np.array([7.0, -4.0])
    first = reference()
    grid_off = replace(
        first.model.grid, origin_xy=first.model.grid.origin_xy - first.model.grid.step_xy @ moved_px
    )
    view = spoiled_view().as_scene(SIGMA_M)
    scene = replace(view, image=first.image, model=OrthoModel(grid_off), sigma_m=6.0)
    result = register_on_reference(scene, replace(first, terrain=None), OPTIONS)
    # The image is the reference's own: only the shift of the grid is to be found.
    shift = result.adjustment.correction.parameters[:, 0]
    assert np.abs(shift + moved_px).max() < MAP_ALLOWED_PX


def test_a_scene_with_parallax_needs_terrain() -> None:
    with pytest.raises(InputError, match="terrain model is needed"):
        register_on_reference(
            spoiled_view().as_scene(SIGMA_M), replace(reference(), terrain=None), OPTIONS
        )


def test_a_reference_of_another_place_is_refused() -> None:
    pixels = grid(REFERENCE_GSD_M)
    elsewhere = OrthoModel(replace(pixels, origin_xy=pixels.origin_xy + 3000.0))
    with pytest.raises(CoverageError, match="it lies elsewhere"):
        register_on_reference(
            spoiled_view().as_scene(SIGMA_M), replace(reference(), model=elsewhere), OPTIONS
        )


def test_a_reference_that_shows_something_else_is_not_believed() -> None:
    noise = np.random.default_rng(0).normal(500.0, 50.0, reference().image.shape).astype(np.float32)
    with pytest.raises(NoConsensus, match="does not agree with the scene"):
        register_on_reference(
            spoiled_view().as_scene(SIGMA_M), replace(reference(), image=ArrayImage(noise)), OPTIONS
        )


def test_windows_without_a_centre_are_refused() -> None:
    with pytest.raises(InputError, match="window_px: 40 given"):
        ReferenceMatchingOptions(window_px=40)


def with_pixels(pixels: np.ndarray) -> Scene:
    """The spoiled view with other pixels."""
    return replace(spoiled_view().as_scene(SIGMA_M), image=ArrayImage(pixels.astype(np.float32)))


def test_ground_that_moved_farther_than_the_last_search_is_named() -> None:
    """A quarter of the scene shows its ground 25 pixels aside."""
    pixels = spoiled_view().image.pixels.copy()
    pixels[150:500, 200:550] = pixels[150:500, 225:575].copy()
    result = register_on_reference(with_pixels(pixels), reference(), OPTIONS)
    (named,) = (one for one in result.qualification.findings if one.name == "points_elsewhere")
    assert "ground that moved" in named.words
    assert not result.qualification.coverage.holds(np.array([[325.0, 375.0]])).any()
    beside = error_px(result)[shown_places()[:, 0] > 520.0]
    assert np.sqrt((beside**2).sum(axis=1).mean()) < 3.0 * ERROR_ALLOWED_PX


def test_clouds_hide_lines_of_a_scene_but_lose_none() -> None:
    pixels = spoiled_view().image.pixels.copy()
    line, sample = np.indices(pixels.shape)
    border = 40.0 * np.sin(sample / 40.0)
    pixels[np.abs(line - 335.0 + border) < 90.0] = 1.5 * np.quantile(pixels, 0.999)
    result = register_on_reference(with_pixels(pixels), reference(), OPTIONS)
    under = np.abs(result.measures.predicted[:, 0] - 335.0) < 50.0
    assert (result.measures.reason[under] == "cloud").mean() > 0.9
    assert (result.measures.reason[~under] == "cloud").mean() < 0.5
    assert {one.name for one in result.qualification.findings} <= {"neighbours"}
    middle = np.column_stack([np.full(30, 335.0), np.linspace(50.0, 550.0, 30)])
    assert result.qualification.coverage.holds(middle).mean() < 0.5
