"""The surface at the centre of a chip has the height that its parts agree on, and the sigma of these."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.matching.surface_heights import surface_height
from amers.services.types import Acquisition, Array
from tests.services.conftest import GSD_M, METRE_DEG, FlatModel
from tests.services.textures import as_pixels, texture


@dataclass(frozen=True)
class Seen(FlatModel):
    """A plane seen from the side: content that lies a metre higher moves by (2,) metres east, north."""

    moved: tuple[float, float] = (0.0, 0.0)

    def project(self, lon_lat_h: Array) -> Array:
        east_north = lon_lat_h[:, :2] + np.outer(lon_lat_h[:, 2], self.moved) * METRE_DEG
        return super().project(np.column_stack([east_north, lon_lat_h[:, 2]]))

    def project_derivative(self, lon_lat_h: Array) -> Array:
        flat = np.array(super().project_derivative(lon_lat_h))
        flat[:, :, 2] = flat[:, :, :2] @ np.array(self.moved)
        return flat

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        at = super().locate(line_sample, height_m)
        at[:, :2] -= np.outer(height_m, self.moved) * METRE_DEG
        return at


SIDE_PX, PART_PX = 160, 13
FROM = (0.25, -0.15), (-0.35, 0.15), (0.45, -0.85)
"""Of three views, by how much (east, north) they move what is a metre higher."""
LARGEST = float(np.hypot(*np.subtract(FROM[2], FROM[0]))) / GSD_M
"""Of the parallaxes against the first view, chip pixels a metre."""


def surface_of_parts(part_m: Array) -> tuple[float, float]:
    """What is stated of a surface whose nine parts (3, 3) lie at these heights above the point."""
    ground = texture(np.random.default_rng(5), SIDE_PX, 1.5)
    middle = (SIDE_PX - 1) // 2
    row, column = np.indices((SIDE_PX, SIDE_PX)).astype(float)
    place = np.clip((np.stack([row, column]) - middle + 1.5 * PART_PX) // PART_PX, 0, 2).astype(int)
    height_m = part_m[place[0], place[1]]
    scenes = []
    for east, north in FROM:
        shown = [row + north / GSD_M * height_m, column - east / GSD_M * height_m]
        pixels = as_pixels(map_coordinates(ground, shown, order=5, mode="grid-wrap"))
        scenes.append(Scene(ArrayImage(pixels), Seen(moved=(east, north)), Acquisition("a"), 1.0))
    point = FlatModel().locate(np.full((1, 2), float(middle)), np.zeros(1))[0]
    return surface_height(scenes, point, GSD_M)


@pytest.mark.parametrize("above_m", [-2.0, 0.0, 1.5])
def test_a_level_surface_is_found_at_its_height_as_well_as_parts_are_matched(above_m: float) -> None:
    found_m, sigma_m = surface_of_parts(np.full((3, 3), above_m))
    assert 0.04 < sigma_m * LARGEST < 0.06, "pixels of the largest parallax"
    assert found_m == pytest.approx(above_m, abs=2.0 * sigma_m)


def test_a_rough_surface_is_stated_by_what_its_parts_scatter_around_a_plane() -> None:
    """The median of the parts is off by 0.4 of their variance, which nine parts tell, less three."""
    place = np.column_stack([np.ones(9), np.indices((3, 3)).reshape(2, 9).T])
    ratios = []
    for seed in range(8):
        part_m = 1.0 + np.random.default_rng(seed).normal(0.0, 0.12 / LARGEST, (3, 3))
        found_m, sigma_m = surface_of_parts(part_m)
        assert found_m == pytest.approx(np.median(part_m), abs=2.0 * sigma_m)
        left_m = part_m.ravel() - place @ np.linalg.lstsq(place, part_m.ravel())[0]
        variance_m2 = float(left_m @ left_m) / (9 - 3)
        ratios.append(sigma_m / np.hypot(np.sqrt(0.4 * variance_m2), 0.05 / LARGEST))
    assert 0.85 < np.mean(ratios) < 1.1, "parts show a little of their neighbours"


def test_parts_on_a_roof_and_beside_it_state_no_surface() -> None:
    roof = np.zeros((3, 3))
    roof[:, 2] = roof[1, 1] = 1.5 / LARGEST
    assert np.isnan(surface_of_parts(roof)).all()
