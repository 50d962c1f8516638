"""Ortho-images as images of a production: alone with heights, and beside a stereo pair."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.control import Control
from amers.services.production.image_production import Production, produce_points
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array
from tests.services.production.simulated_control import CHI2_3, scenes, views
from tests.services.production.test_ortho_control import heights, reference
from tests.services.simulated import OPTIONS
from tests.services.ties import difference_m

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SEED = 21
SIGMA_M = 1.0


def ortho(name: str, rng: np.random.Generator) -> Scene:
    """The vertical ortho-image with noise of its own, on a map that is off as it declares."""
    exact = reference()
    off = exact.model.grid.origin_xy + rng.normal(0.0, SIGMA_M, 2)
    pixels = exact.image.pixels + rng.normal(0.0, 4.0, exact.image.shape)
    image = ArrayImage(np.maximum(pixels, 1.0).astype(np.float32))
    model = OrthoModel(replace(exact.model.grid, origin_xy=off))
    return Scene(image, model, Acquisition(name), SIGMA_M)


def error_m(made: Production, image: int) -> Array:
    """Errors (n, 2) on the Earth of the points: the true ground of what an ortho-image shows there."""
    at = made.points.lon_lat_h
    truth = reference().model.locate(made.adjustment.models[image].project(at), at[:, 2])
    return difference_m(at, truth)[:, :2]


def test_ortho_images_alone_make_points_with_the_heights_of_an_elevation_model() -> None:
    rng = np.random.default_rng([SEED, 11])
    images = [ortho("one", rng), ortho("other", rng)]
    with pytest.raises(NotEnoughPoints, match=r"show have no height.*--control-dem"):
        produce_points(images, OPTIONS)
    made = produce_points(images, OPTIONS, control=Control(heights=(heights(SEED),)))
    assert len(made.points) > 40
    between_m = error_m(made, 0) - error_m(made, 1)
    print("between both", np.abs(between_m).mean(axis=0), "error", error_m(made, 0).mean(axis=0))
    assert np.abs(between_m).mean() < 0.1
    frame = made.points.frames[0]
    assert frame.sigma_m <= 1.05 * SIGMA_M
    assert np.hypot(*error_m(made, 0).mean(axis=0)) < 3.0 * frame.sigma_m
    height_m = views(SEED)[0].geometry.true_model.height_range_m
    assert (
        (made.points.lon_lat_h[:, 2] > height_m[0]) & (made.points.lon_lat_h[:, 2] < height_m[1])
    ).all()
    assert np.isfinite(made.relative_accuracy.before_px)


def test_an_ortho_image_places_a_stereo_pair_as_an_image_of_the_block() -> None:
    images = [*scenes(SEED)[:2], ortho("ortho", np.random.default_rng([SEED, 12]))]
    made = produce_points(images, OPTIONS)
    frame_m2 = made.points.frames[0].covariance_m2[:2, :2]
    error = error_m(made, 2).mean(axis=0)
    print("error", error, "frame", np.sqrt(np.diagonal(frame_m2)))
    # Its own images are 5 m off.
    assert np.sqrt(np.diagonal(frame_m2)).max() < 1.2 * SIGMA_M
    assert error @ np.linalg.solve(frame_m2, error) < CHI2_3
    assert (made.points.views.image == 2).sum() > 20
