"""Images of a block at a site: their errors, laid over the terrain, against the ortho-image."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from services.errors import InputError
from services.imagery.scene import Scene
from services.quality.planimetry import planimetric_quality
from services.quality.site_errors import Site
from services.quality.site_images import image_errors, least_inclined
from services.sensors.correction import CorrectedModel, no_correction
from services.types import Frame
from tests.services.registration.test_on_reference import reference, terrain
from tests.services.simulated import block_views

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
