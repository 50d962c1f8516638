"""Marks lie in their image, and their ground where it was taken."""

import math
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.imagery.marks import check_marks_inside, check_not_exchanged
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition

POINT, IMAGE = np.array(["a", "b"]), np.array(["left.tif", "left.tif"])
SHAPE = np.array([[100, 200], [100, 200]])


def scene(lon: float, lat: float) -> Scene:
    """A scene of 0.01 degrees with its corner at a place."""
    step = np.array([[0.0, 1e-4], [-1e-4, 0.0]])
    grid = MapGrid("EPSG:4326", np.array([lon, lat]), step, (100, 100))
    pixels = np.zeros((100, 100), dtype=np.float32)
    taken = Acquisition("left", "", datetime(2026, 1, 1, tzinfo=UTC), 0.0, 0.0)
    return Scene(ArrayImage(pixels), OrthoModel(grid), taken, math.nan)


def test_marks_up_to_the_edge_of_the_image_are_inside() -> None:
    check_marks_inside(np.array([[-0.5, 199.5], [99.5, -0.5]]), POINT, IMAGE, SHAPE, "f")


@pytest.mark.parametrize(
    ("mark", "advice"),
    [
        ((100.0, 5.0), "correct the mark or the image it names"),
        ((5.0, -0.6), "correct the mark or the image it names"),
        ((5853508.3, 342433.6), "mark the points in the raw image"),
        ((-4897240.7, 675380.1), "mark the points in the raw image"),
        ((-44.0, 5.0), "its line has the other sign"),
    ],
)
def test_marks_outside_are_refused_with_what_they_may_be(mark: tuple[float, float], advice: str) -> None:
    with pytest.raises(InputError, match=rf"^f, point b: line .*1 of 2 marks .*; .*{advice}"):
        check_marks_inside(np.array([[5.0, 5.0], mark]), POINT, IMAGE, SHAPE, "f")


@pytest.mark.parametrize("corner", [(5.0, 44.0), (179.995, 60.0), (-70.0, -33.0)])
def test_exchanged_coordinates_are_suspected_where_they_then_lie_on_the_scene(
    corner: tuple[float, float],
) -> None:
    lon, lat = corner
    lon_lat = np.array([[lon + 0.005, lat - 0.005], [lon + 0.5, lat]])
    check_not_exchanged(lon_lat, [scene(lon, lat)], "f")
    # One that lies on it in another turn of the Earth is enough, whatever the others do.
    for turn in (-360.0, 0.0, 360.0):
        both = np.array([lon_lat[0] + [turn, 0.0], lon_lat[0, ::-1]])
        check_not_exchanged(both, [scene(0.0, 0.0), scene(lon, lat)], "f")
    with pytest.raises(InputError, match=r"f: latitude and longitude seem exchanged: none of 2 .* 1 do"):
        check_not_exchanged(lon_lat[:, ::-1], [scene(lon, lat)], "f")


def test_points_of_another_place_are_not_taken_for_exchanged_ones() -> None:
    check_not_exchanged(np.array([[12.0, 13.0]]), [scene(5.0, 44.0)], "f")
