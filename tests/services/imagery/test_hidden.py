"""Ground that a catalogue says is hidden has no pixels."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from amers.services.imagery.hidden import OutlinedImage, without_hidden_ground
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.types import Acquisition
from tests.factories import affine_model
from tests.services.production.test_image_pairs import SIDE, strip


def test_pixels_inside_outlines_are_missing_in_every_window() -> None:
    image = ArrayImage(np.ones((50, 60), dtype=np.float32))
    triangle = np.array([[10.0, 10.0], [10.0, 30.0], [30.0, 10.0]])
    whole = OutlinedImage(image, (triangle,)).read(Window(0, 0, 50, 60))
    assert np.isnan(whole[15, 15])
    assert not np.isnan(whole[29, 29])
    assert abs(np.isnan(whole).sum() - 200.0) < 40.0
    part = OutlinedImage(image, (triangle,)).read(Window(12, 5, 20, 20))
    np.testing.assert_array_equal(np.isnan(part), np.isnan(whole[12:32, 5:25]))


def test_a_cloud_of_the_catalogue_hides_its_ground() -> None:
    scene = strip(0, 0.0)
    corners = np.array([[20.0, 20.0], [20.0, 40.0], [40.0, 40.0], [40.0, 20.0]])
    lon_lat = scene.model.locate(corners, np.zeros(4))[:, :2]
    pixels = without_hidden_ground(scene, shapely.MultiPolygon([shapely.Polygon(lon_lat)])).image.read(
        Window(0, 0, SIDE, SIDE)
    )
    assert np.isnan(pixels[30, 30])
    assert abs(np.isnan(pixels).sum() - 441) <= 42
    assert not np.isnan(pixels[45:, :]).any()


def test_a_cloud_is_placed_at_the_middle_height_of_the_model() -> None:
    """Seen from the side, that of sea level would lie 120 pixels beside it."""
    model = replace(affine_model(np.array([5.0, 43.0])), image_offset=np.full(2, 150.0))
    scene = Scene(ArrayImage(np.ones((300, 300), dtype=np.float32)), model, Acquisition("a"), 5.0)
    corners = np.array([[100.0, 120.0], [100.0, 160.0], [130.0, 160.0], [130.0, 120.0]])
    height_m = sum(model.height_range_m) / 2.0
    lon_lat = model.locate(corners, np.full(4, height_m))[:, :2]
    hidden = without_hidden_ground(scene, shapely.Polygon(lon_lat)).image
    lost = np.isnan(hidden.read(Window(0, 0, 300, 300)))
    assert lost[101:129, 121:159].all()
    assert lost.sum() == pytest.approx(31 * 41, abs=80)


def test_nothing_hidden_leaves_the_scene_as_it_is() -> None:
    scene = strip(0, 0.0)
    assert without_hidden_ground(scene, None) is scene
    assert without_hidden_ground(scene, shapely.MultiPolygon()) is scene
