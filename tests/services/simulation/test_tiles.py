"""An image rendered by tiles is the same image, whatever is read first."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.imagery.source import Window
from amers.services.simulation.conditions import Conditions
from amers.services.simulation.render import Radiometry
from amers.services.simulation.tiles import TILE_PX, TiledView
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry, render_view
from amers.services.simulation.world import World

SHAPE = (210, 333)
ROUNDED_OTHERWISE = 1e-4
"""Share of the pixels whose light lies so close to half a number that its last digits decide."""


def geometry(world: World, gsd_m: float = 0.5, **changes: object) -> ViewGeometry:
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan("view", (lon, lat), SHAPE, gsd_m, incidence_deg=20.0, azimuth_deg=100.0)
    return plan_geometry(world, replace(plan, **changes), np.random.default_rng(0))  # type: ignore[arg-type]


@pytest.mark.parametrize("gsd_m", [0.3, 0.5, 1.7, 6.0])
@pytest.mark.thorough
def test_tiles_make_up_the_image_that_is_rendered_line_by_line(world: World, gsd_m: float) -> None:
    silent = Radiometry(noise_floor=0.0, noise_per_signal=0.0)
    taken = geometry(world, gsd_m, radiometry=silent)
    whole = np.concatenate([strip for _, strip in render_view(world, taken, np.random.default_rng(0))])
    tiled = TiledView(world, taken, 1).read(Window(0, 0, *SHAPE))
    assert np.abs(tiled - whole).max() <= 1.0
    assert np.mean(tiled != whole) < ROUNDED_OTHERWISE


def test_pixels_do_not_depend_on_the_windows_they_are_read_by(world: World) -> None:
    taken = geometry(world)
    hard = Conditions(haze=0.3, cloud_cover=0.3, season=0.5, noise=20.0)
    whole = TiledView(world, taken, 1, hard).read(Window(0, 0, *SHAPE))
    pieces = TiledView(world, taken, 1, hard)
    rng = np.random.default_rng(4)
    for _ in range(12):
        line, sample = rng.integers(0, SHAPE[0] - 40), rng.integers(0, SHAPE[1] - 90)
        window = Window(int(line), int(sample), 40, 90)
        expected = whole[line : line + 40, sample : sample + 90]
        np.testing.assert_array_equal(pieces.read(window), expected)


def test_pixels_outside_the_image_are_nan(world: World) -> None:
    view = TiledView(world, geometry(world), 1)
    pixels = view.read(Window(-10, SHAPE[1] - 20, 30, 40))
    assert np.isnan(pixels[:10]).all()
    assert np.isnan(pixels[:, 20:]).all()
    assert np.isfinite(pixels[10:, :20]).all()
    assert np.isnan(view.read(Window(-50, -50, 20, 20))).all()


def test_a_window_of_a_huge_image_renders_only_its_tiles(world: World) -> None:
    side = 40_000
    view = TiledView(world, geometry(world, shape=(side, side)), 1)
    pixels = view.read(Window(31_000, 22_000, 2 * TILE_PX, TILE_PX))
    assert view.shape == (side, side)
    assert np.isfinite(pixels).all()
    assert pixels.std() > 0.0


def test_two_seeds_give_the_same_ground_with_different_noise(world: World) -> None:
    taken = geometry(world)
    first, again, other = (
        TiledView(world, taken, seed).read(Window(0, 0, *SHAPE)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert np.mean(first == other) < 0.2
    assert np.corrcoef(first.ravel(), other.ravel())[0, 1] > 0.98
