"""The surface of a point is that which its steepest view shows at the centre of the chip."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.point_views import surface_heights
from amers.services.types import Acquisition, Array, Views
from tests.services.conftest import GSD_M, FlatModel
from tests.services.matching.test_surfaces_of_parts import Seen
from tests.services.textures import as_pixels, texture

SIDE_PX = 160
MIDDLE = (SIDE_PX - 1) // 2
POINT_M, ABOVE_M, SLOPE = 2.0, 4.0, 0.15
"""Height of the point, that of the ground above it, and by how much the ground rises eastwards."""
POINT: Array = FlatModel().locate(np.full((1, 2), float(MIDDLE)), np.full(1, POINT_M))
INCIDENCE_DEG = np.array([27.0, 3.0, 35.0])
EAST = np.tan(np.radians(INCIDENCE_DEG)) * [1.0, 1.0, -1.0]
"""By how much each view moves to the east what is a metre higher."""


def views_of_a_slope() -> list[Scene]:
    """Each shows the ground where its line of sight meets it."""
    ground = texture(np.random.default_rng(5), SIDE_PX, 1.5)
    row, column = np.indices((SIDE_PX, SIDE_PX)).astype(float)
    scenes = []
    for east in EAST:
        seen_m = (column - MIDDLE) * GSD_M
        east_m = (seen_m - east * (POINT_M + ABOVE_M)) / (1.0 + east * SLOPE)
        pixels = map_coordinates(ground, [row, east_m / GSD_M + MIDDLE], order=5, mode="grid-wrap")
        model = Seen(moved=(float(east), 0.0))
        scenes.append(Scene(ArrayImage(as_pixels(pixels)), model, Acquisition("a"), 1.0))
    return scenes


def views(gsd_m: list[float], order: list[int]) -> Views:
    """Of one point, in the images of an order, each at its ground sampling."""
    return Views(
        start=np.array([0, len(order)]),
        gsd_m=np.array(gsd_m),
        image=np.array(order),
        incidence_deg=INCIDENCE_DEG[order],
        azimuth_deg=np.zeros(len(order)),
        health=np.ones(len(order)),
        images=(),
    )


def where_seen_m(image: int) -> float:
    """Height at which the line of sight of an image through the point meets the ground."""
    return float(POINT_M + ABOVE_M / (1.0 + EAST[image] * SLOPE))


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0]])
def test_the_surface_is_that_of_the_steepest_view_in_any_order(order: list[int]) -> None:
    of_point = views([GSD_M] * 3, order)
    found = surface_heights(views_of_a_slope(), POINT, of_point, GSD_M)
    assert abs(where_seen_m(2) - where_seen_m(1)) > 0.4
    assert found.height_m[0] == pytest.approx(where_seen_m(1), abs=0.1)
    assert 0.0 < found.sigma_m[0] < 0.2


def test_views_of_other_chips_do_not_count() -> None:
    """The steepest one has a coarse chip alone; of one view there is no surface."""
    scenes = views_of_a_slope()
    of_point = views([GSD_M, 4.0 * GSD_M, GSD_M], [0, 1, 2])
    found = surface_heights(scenes, POINT, of_point, GSD_M)
    assert found.height_m[0] == pytest.approx(where_seen_m(0), abs=0.1)
    alone = views([4.0 * GSD_M, 4.0 * GSD_M, GSD_M], [0, 1, 2])
    assert np.isnan(surface_heights(scenes, POINT, alone, GSD_M).height_m).all()


def test_each_point_has_the_surface_of_its_own_views() -> None:
    of_points = views([GSD_M] * 5, [0, 2, 1, 0, 2])
    of_points = replace(of_points, start=np.array([0, 2, 2, 5]))
    found = surface_heights(views_of_a_slope(), np.tile(POINT, (3, 1)), of_points, GSD_M)
    expected_m = [where_seen_m(0), np.nan, where_seen_m(1)]
    np.testing.assert_allclose(found.height_m, expected_m, atol=0.1)
