"""Scenes registered on a reference ortho-image and its terrain instead of points."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import CoverageError, InputError
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, sample_image
from amers.services.map_grid import MapGrid, utm_of
from amers.services.matching.reference_image import Reference
from amers.services.registration.on_points import Registration
from amers.services.registration.on_reference import register_on_reference
from amers.services.registration.options import ReferenceOptions, RegistrationOptions
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.view import true_ground
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
