"""Ground is hidden where higher ground stands between it and the sensor, looked at step by step."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from amers.services.imagery.source import ArrayImage, Window
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.mapping import map_into_image, occluded_ground
from amers.services.terrain import Terrain
from amers.services.types import Array
from tests.services.conftest import METRE_DEG, FlatModel

SIDE, POSTING_M = 90, 3.0


@dataclass(frozen=True)
class Leaning(FlatModel):
    """A plane seen from the side: what lies a metre higher moves by (2,) metres east, north."""

    moved: tuple[float, float] = (0.0, 0.0)

    def project(self, lon_lat_h: Array) -> Array:
        east_north = lon_lat_h[:, :2] + np.outer(lon_lat_h[:, 2], self.moved) * METRE_DEG
        return super().project(np.column_stack([east_north, lon_lat_h[:, 2]]))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        at = super().locate(line_sample, height_m)
        at[:, :2] -= np.outer(height_m, self.moved) * METRE_DEG
        return at


def grid(step_m: float, turn_deg: float, size: int, centre_m: tuple[float, float]) -> MapGrid:
    """A map whose lines go to the south, turned, around a place."""
    turn = np.radians(turn_deg)
    south, east = np.array([np.sin(turn), -np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    step = np.column_stack([south, east]) * step_m * METRE_DEG
    origin = np.array(centre_m) * METRE_DEG - step @ np.full(2, (size - 1) / 2.0)
    return MapGrid("EPSG:4326", origin, step, (size, size))


def heights() -> Array:
    """Level ground with a wall, a tower and some waves."""
    line, sample = np.indices((SIDE, SIDE)).astype(float)
    ground = 100.0 + 2.0 * np.sin(line / 4.0) * np.cos(sample / 5.0)
    ground[20:60, 40:43] += 30.0
    ground[70:74, 60:64] += 45.0
    return ground


def truly_hidden(model: Leaning, ground: Terrain, pixels_of: MapGrid, window: Window) -> Array:
    """By how much the ground towards the sensor rises above each line of sight, at most, metres."""
    at = np.moveaxis(np.indices((window.lines, window.samples)), 0, -1).reshape(-1, 2).astype(float)
    lon_lat = pixels_of.lon_lat(at + [window.line, window.sample])
    values = heights()

    def height_at(places: Array) -> Array:
        line, sample = ground.grid.line_sample(places).T
        found = map_coordinates(values, [line, sample], order=1, mode="constant", cval=-1e3)
        return np.asarray(found, dtype=np.float64)

    start_m, over_m = height_at(lon_lat), np.full(len(lon_lat), -np.inf)
    for rise_m in np.arange(0.25, 50.0, 0.25):
        # A line of sight leads to where a higher point is shown at the same place of the image.
        places = lon_lat - rise_m * np.array(model.moved) * METRE_DEG
        over_m = np.maximum(over_m, height_at(places) - (start_m + rise_m))
    return over_m.reshape(window.lines, window.samples)


@pytest.mark.parametrize("moved", [(0.9, 0.0), (-0.7, 0.3), (0.2, 0.8), (-0.4, -0.9)])
@pytest.mark.parametrize("turn_deg", [0.0, 30.0])
def test_ground_is_hidden_behind_what_rises_above_its_line_of_sight(
    moved: tuple[float, float], turn_deg: float
) -> None:
    model = Leaning(moved=moved)
    ground = Terrain(grid(POSTING_M, 0.0, SIDE, (0.0, 0.0)), ArrayImage(heights().astype(np.float32)))
    pixels_of = grid(1.0, turn_deg, 200, (4.0, -7.0))
    window = Window(9, 31, 135, 100)
    mapping = map_into_image(model, ground, pixels_of, window, 0.1)
    assert mapping is not None
    hidden = occluded_ground(model, ground, pixels_of, window, mapping.height_m)
    over_m = truly_hidden(model, ground, pixels_of, window)
    assert 300 < (over_m > 1.0).sum() < 0.5 * over_m.size
    assert hidden[over_m > 1.0].mean() > 0.995
    assert hidden[over_m < 0.0].mean() < 0.005


def test_a_plane_seen_from_the_side_or_waves_from_above_hide_nothing() -> None:
    pixels_of, window = grid(1.0, 0.0, 100, (0.0, 0.0)), Window(0, 0, 100, 100)
    level = np.full((SIDE, SIDE), 100.0, dtype=np.float32)
    for moved, values in (((0.9, 0.0), level), ((0.0, 0.0), heights().astype(np.float32))):
        ground = Terrain(grid(POSTING_M, 0.0, SIDE, (0.0, 0.0)), ArrayImage(values))
        mapping = map_into_image(Leaning(moved=moved), ground, pixels_of, window, 0.1)
        assert mapping is not None
        hidden = occluded_ground(Leaning(moved=moved), ground, pixels_of, window, mapping.height_m)
        assert not hidden.any()
