"""Points and images at a simulated site with relief and buildings: the true errors are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from amers.services.errors import InputError
from amers.services.geodesy import metres_per_degree_at, move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, sample_image
from amers.services.quality.planimetry import planimetric_quality
from amers.services.quality.site_errors import Site, point_errors
from amers.services.quality.site_images import image_errors, least_inclined
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.simulation.view import simulate_view, true_ground
from amers.services.types import Frame
from tests.services.registration.test_on_reference import grid, positions, reference, terrain
from tests.services.simulated import block, block_views, plan, production, world

SHIFT_PX = np.array([2.0, -3.0])
a_tenth_of_a_pixel_m = 0.1

pytestmark = pytest.mark.long


def site() -> Site:
    return Site("world", False, replace(reference(), frame=Frame.from_sigmas(0.2, 0.2)))


def view(number: int, shift_px: np.ndarray) -> Scene:
    """A view with its true model, shifted in the image."""
    seen = block_views()[number]
    correction = no_correction(seen.image.shape)
    parameters = correction.parameters.copy()
    parameters[:, 0] = shift_px
    model = CorrectedModel(seen.geometry.true_model, replace(correction, parameters=parameters))
    return Scene(seen.image, model, seen.geometry.acquisition, 3.0)


def test_the_error_of_a_model_is_found_on_the_ground_whatever_the_relief() -> None:
    true = image_errors(view(1, np.zeros(2)), site(), terrain(), 8.0)
    wrong = image_errors(view(1, SHIFT_PX), site(), terrain(), 8.0)
    assert len(wrong.error_m) > 0.7 * wrong.tried > 50
    assert_allclose(np.median(true.error_m, axis=0), [0.0, 0.0], atol=a_tenth_of_a_pixel_m)
    scene = view(1, SHIFT_PX)
    ground = np.column_stack([wrong.lon_lat, terrain().height_m(wrong.lon_lat)])
    derivative = scene.model.project_derivative(ground)[:, :, :2]
    # What the model projects too far, it locates too near.
    expected_m = np.linalg.solve(derivative, np.tile(-SHIFT_PX, (len(ground), 1))[:, :, None])[:, :, 0]
    assert_allclose(np.median(wrong.error_m - expected_m, axis=0), [0.0, 0.0], atol=a_tenth_of_a_pixel_m)
    quality = planimetric_quality([true, wrong], "images", Frame.from_sigmas(1.0, 1.0))
    assert [image.name for image in quality.sites[0].images] == [scene.acquisition.image_id] * 2
    assert quality.normalised.n == 0  # nothing is declared for the places of an image


def test_the_least_inclined_images_come_first() -> None:
    views = [view(number, np.zeros(2)) for number in range(3)]
    inclined = [scene.acquisition.incidence_deg for scene in least_inclined(views, site(), terrain(), 2)]
    all_of_them = sorted(scene.acquisition.incidence_deg for scene in views)
    assert_allclose(inclined, all_of_them[:2])


def test_images_with_a_parallax_need_a_terrain() -> None:
    with pytest.raises(InputError, match="terrain"):
        image_errors(view(1, np.zeros(2)), site(), None, 8.0)


@cache
def vertical_ortho() -> Site:
    """A site with an ortho-image of a vertical view, which shows no walls."""
    geometry = plan("nadir", incidence_deg=0.0, shape=(1000, 1000))
    nadir = simulate_view(world(), geometry, np.random.default_rng(3))
    pixels = grid(1.0)
    lon_lat = pixels.lon_lat(positions(pixels).astype(float))
    ground = np.column_stack([lon_lat, world().height_m(lon_lat)])
    seen = nadir.geometry.true_model.project(ground).reshape(*pixels.shape, 2)
    image = ArrayImage(sample_image(nadir.image, seen, 1.0))
    exact = replace(reference(), image=image, sigma_m=0.1, frame=Frame.from_sigmas(0.1, 0.1))
    return Site("nadir", False, exact)


def test_a_point_that_is_not_found_takes_nothing_from_the_others() -> None:
    """It stands before them, and each of them declares something else."""
    points, chips = block()
    points = points.take(np.arange(8))
    step = np.where(np.arange(8)[:, None] == 0, [60.0, 60.0, 0.0], 0.0)
    own_m2 = np.arange(1.0, 9.0)[:, None, None] * np.diag([1.0, 4.0, 9.0])
    lost = replace(points, lon_lat_h=move_metres(points.lon_lat_h, step), covariance_m2=own_m2)
    exact = replace(lost, covariance_m2=0.0 * own_m2)
    found, measured = (point_errors(of, chips, vertical_ortho()) for of in (lost, exact))
    row = [np.flatnonzero((points.lon_lat_h[:, :2] == at).all(axis=1))[0] for at in found.lon_lat]
    assert len(row) > 4
    assert 0 not in row
    declared_m2 = found.covariance_m2 - measured.covariance_m2
    assert_allclose(declared_m2, own_m2[row, :2, :2], atol=1e-9)


def test_points_of_inclined_views_lie_as_far_off_as_they_truly_do() -> None:
    points, chips = block()
    true_m = []
    for model, seen in zip(production().adjustment.models, block_views(), strict=True):
        shown = true_ground(seen, world(), model.project(points.lon_lat_h))
        off_deg = points.lon_lat_h[:, :2] - shown[:, :2]
        true_m.append(np.nanmedian(off_deg * metres_per_degree_at(points.lon_lat_h), axis=0))
    errors = point_errors(points, chips, vertical_ortho())
    assert errors.tried == len(points)
    assert len(errors.error_m) >= 0.95 * errors.tried
    quality = planimetric_quality([errors], "points", points.frames[0])
    shift_m = np.array([quality.shift_east_m, quality.shift_north_m])
    assert_allclose(shift_m, np.median(true_m, axis=0), atol=2 * a_tenth_of_a_pixel_m)
    assert quality.relative.ce90_m.value < quality.declared_ce90_m
    assert quality.normalised_frame.mean_square < quality.normalised_frame.upper
