"""Tiles and windows of a grid cover it once, and two surfaces tell how the later one lies off."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from amers.services.imagery.source import ArrayImage, Window
from amers.services.map_grid import MapGrid
from amers.services.surface.difference import TwoSurfaces
from amers.services.surface.pairs import Pair, candidate_pairs, choose_pairs
from amers.services.surface.surface import SurfaceTile
from amers.services.surface.tiles import coarser, grid_over, part_of_grid, tiles_of, windows_of
from amers.services.types import Array, FloatImage
from tests.services.surface.worlds import scene

GRID = MapGrid("EPSG:32631", np.array([5e5, 4.8e6]), np.array([[0.0, 2.0], [-2.0, 0.0]]), (900, 1100))
WINDOW = Window(7, 211, 640, 830)


def counted(shape: tuple[int, int], windows: list[Window]) -> Array:
    """How many windows cover each cell."""
    count = np.zeros(shape, dtype=np.int64)
    for w in windows:
        assert min(w.line, w.sample) >= 0
        count[w.line : w.line + w.lines, w.sample : w.sample + w.samples] += 1
    return count


@pytest.mark.parametrize(("shape", "side"), [((640, 830), 256), ((256, 257), 256), ((1, 3), 2)])
def test_windows_cover_a_grid_once_and_are_of_about_one_size(shape: tuple[int, int], side: int) -> None:
    windows = windows_of(shape, side)
    assert (counted(shape, windows) == 1).all()
    for sizes in ([w.lines for w in windows], [w.samples for w in windows]):
        assert max(sizes) <= side
        assert max(sizes) - min(sizes) <= 1


def test_tiles_cover_their_window_once_and_are_smaller_where_heights_differ_more() -> None:
    """Heights between 0 and 20 m in the west, and up to 300 m in the east."""

    def around(grid: MapGrid) -> tuple[float, float]:
        east = (grid.origin_xy[0] - GRID.origin_xy[0]) / 2.0 + grid.shape[1] > 800.0
        return 0.0, 300.0 if east else 20.0

    tiles = list(tiles_of(GRID, WINDOW, around, 3e6 * 2.0))
    count = counted(GRID.shape, [tile.window for tile in tiles])
    expected = np.zeros(GRID.shape, dtype=np.int64)
    expected[7:647, 211:1041] = 1
    np.testing.assert_array_equal(count, expected)
    sizes = {
        height: [t.window.samples for t in tiles if t.heights_m == (0.0, height)]
        for height in (20.0, 300.0)
    }
    assert max(sizes[20.0]) > 3 * max(sizes[300.0])
    assert len({tile.name for tile in tiles}) == len(tiles)
    assert [tile.heights_m for tile in tiles_of(GRID, WINDOW, lambda _: None, 1.0)] == [None]


def test_parts_of_a_grid_and_coarser_ones_lie_where_it_lies() -> None:
    part = part_of_grid(GRID, WINDOW, 3)
    assert part.shape == (646, 836)
    np.testing.assert_allclose(part.xy(np.array([[3.0, 3.0]])), GRID.xy(np.array([[7.0, 211.0]])))
    coarse = coarser(GRID, 4)
    assert coarse.shape == (225, 275)
    corner = np.array([[-0.5, -0.5]])
    np.testing.assert_allclose(coarse.xy(corner), GRID.xy(corner))


@pytest.mark.parametrize("side_m", [0.5, 3.0])
def test_the_grid_of_a_surface_holds_what_a_pair_shows_and_no_more(side_m: float) -> None:
    scenes = [scene("left"), scene("right")]
    pairs = candidate_pairs(scenes, (140.0, 180.0), (0.1, 0.9))
    grid = grid_over(scenes, pairs, side_m)
    at = grid.line_sample(pairs[0].overlap)
    assert grid.contains(at).all()
    room = np.array([at.min(axis=0) + 0.5, np.array(grid.shape) - 0.5 - at.max(axis=0)])
    assert (room <= 1.0).all()
    np.testing.assert_allclose(grid.origin_xy / side_m % 1.0, 0.5)


def test_a_small_image_within_a_large_one_is_its_partner() -> None:
    """It shows a hundredth of the ground of the other: what counts is the share of the smaller one."""
    large, small = scene("left"), scene("right")
    pixels = small.image.read(Window(0, 0, *small.image.shape))
    few = replace(small, image=ArrayImage(pixels[:30, :30]))
    heights_m, bases = (140.0, 180.0), (0.1, 0.9)
    whole = candidate_pairs([large, small], heights_m, bases)
    for scenes in ([large, few], [few, large]):
        (pair,) = candidate_pairs(scenes, heights_m, bases)
        assert pair.base_to_height == pytest.approx(whole[0].base_to_height, abs=0.01)


def test_a_pair_is_half_as_good_after_sixty_days_whichever_image_is_the_first() -> None:
    first, second = scene("left"), scene("right")
    day = datetime(2024, 5, 1, 10, tzinfo=UTC)

    def merit(days: float) -> float:
        taken = replace(first.acquisition, acquired_at=day)
        other = replace(second.acquisition, acquired_at=day + timedelta(days=days))
        scenes = [replace(first, acquisition=taken), replace(second, acquisition=other)]
        (pair,) = candidate_pairs(scenes, (140.0, 180.0), (0.1, 0.9))
        assert pair.days == pytest.approx(abs(days))
        return pair.merit

    assert merit(60.0) == pytest.approx(merit(0.0) / 2.0) == merit(-60.0)


def test_images_that_no_pair_uses_yet_come_first_in_either_place_of_a_pair() -> None:
    """An image that is used leaves 0.8 of the merit of a pair."""
    outline = np.zeros((3, 2))
    for again in ((0, 3), (3, 0), (1, 3), (3, 1)):
        numbers = ((0, 1, 1.0), (*again, 0.9), (4, 5, 0.75))
        pairs = [Pair(a, b, 0.4, 0.0, outline, merit) for a, b, merit in numbers]
        assert [pairs.index(one) for one in choose_pairs(pairs, 3)] == [0, 2, 1]
        assert [pairs.index(one) for one in choose_pairs(pairs, 2)] == [0, 2]


@dataclass(frozen=True)
class Stated:
    """A surface in memory, of one sigma; every fiftieth line was filled."""

    grid: MapGrid
    height_m: FloatImage
    sigma_m: float

    def read(self, window: Window) -> SurfaceTile:
        place = np.s_[
            window.line : window.line + window.lines, window.sample : window.sample + window.samples
        ]
        height_m = self.height_m[place]
        views = np.full(self.height_m.shape, 2, dtype=np.uint8)
        views[::50] = 0
        sigma_m = np.full(height_m.shape, self.sigma_m, dtype=np.float32)
        return SurfaceTile(window, height_m, sigma_m, views[place], views[place] * 0)


def waves(grid: MapGrid, off_m: tuple[float, float, float], noise_m: float, seed: int) -> FloatImage:
    """Hills that lie off by metres east, north and up, with noise."""
    at = np.stack(np.indices(grid.shape), axis=-1).reshape(-1, 2).astype(np.float64)
    x, y = (grid.xy(at) - GRID.origin_xy - off_m[:2]).T
    height_m = 20.0 * np.sin(x / 60.0) + 15.0 * np.cos(y / 45.0) + off_m[2]
    noise = np.random.default_rng(seed).normal(0.0, noise_m, len(at))
    return (height_m + noise).reshape(grid.shape).astype(np.float32)


OFF_M = (1.2, -0.7, 0.5)


def two() -> TwoSurfaces:
    """The later one begins elsewhere, lies off, and is less exact."""
    earlier = replace(GRID, shape=(300, 360))
    later = replace(GRID, origin_xy=GRID.origin_xy + [-60.0, 80.0], shape=(330, 300))
    return TwoSurfaces(
        Stated(earlier, waves(earlier, (0.0, 0.0, 0.0), 0.2, 1), 0.3),
        Stated(later, waves(later, OFF_M, 0.2, 2), 0.4),
    )


def test_the_shift_of_a_later_surface_is_found_and_what_is_left_has_the_sigma_of_both() -> None:
    surfaces = two()
    found = surfaces.align()
    assert found.moved_horizontally
    assert (np.abs(found.shift_m + OFF_M) < 4.0 * found.sigma_m).all()
    tiles = list(surfaces.tiles(found.shift_m))
    assert (counted(surfaces.grid.shape, [tile.window for tile in tiles]) == 1).all()
    for tile in tiles:
        known = np.isfinite(tile.difference_m)
        np.testing.assert_allclose(tile.sigma_m[known], 0.5, rtol=1e-5)
        assert abs(tile.difference_m[known].mean()) < 0.02
