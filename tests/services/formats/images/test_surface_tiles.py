"""Surfaces on the map of the web: tiles from the file, and heights at places."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.images.surface_tiles import draw_surface_tile, outline_of, surface_limits
from amers.services.formats.images.surfaces import BANDS, SurfaceImage, heights_crs, open_surface
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits, TilePlace
from amers.services.surface.relief import relief
from amers.services.types import Array, FloatImage

ORIGIN_XY = np.array([698_000.0, 4_792_000.0])
STEP_M, SHAPE = 0.5, (900, 1400)
RANGE_M = (80.0, 120.0)
a_step_of_colour = 3
a_gap = np.s_[300:500, 200:600]


def height_m(east: Array, north: Array) -> Array:
    """Hills, metres from the corner."""
    return np.asarray(100.0 + 12.0 * np.sin(east / 40.0) + 7.0 * np.cos(north / 60.0))


@pytest.fixture(scope="module")
def surface(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SurfaceImage]:
    path = tmp_path_factory.mktemp("surface") / "surface.tif"
    grid = MapGrid("EPSG:32631", ORIGIN_XY, np.array([[0.0, STEP_M], [-STEP_M, 0.0]]), SHAPE)
    north, east = -STEP_M * np.arange(SHAPE[0])[:, None], STEP_M * np.arange(SHAPE[1])[None, :]
    heights = height_m(east, north).astype(np.float32)
    heights[a_gap] = np.nan
    none = np.isnan(heights)
    bands = np.stack([heights, np.where(none, np.nan, 0.3), 2.0 * ~none, 7.0 * none])
    form = BandForm(4, "float32", float("nan"), names=BANDS, overviews="NEAREST")
    on_map = MapGrid(heights_crs(grid), grid.origin_xy, grid.step_xy, SHAPE)
    write_cog(path, on_map, [OrthoWindow(Window(0, 0, *SHAPE), bands.astype(np.float32), 0.0)], form)
    with open_surface(path) as opened:
        yield opened


def drawn(surface: SurfaceImage, level: TileLimits) -> FloatImage:
    """All tiles of a zoom as one picture, red, green, blue and opacity."""
    rows = []
    for row in range(level.first_row, level.last_row + 1):
        tiles = [
            cv2.imdecode(
                np.frombuffer(
                    draw_surface_tile(surface, TilePlace(level.zoom, row, column), RANGE_M), np.uint8
                ),
                cv2.IMREAD_UNCHANGED,
            )
            for column in range(level.first_column, level.last_column + 1)
        ]
        assert all(tile.shape == (TILE_PX, TILE_PX, 4) for tile in tiles)
        rows.append(np.hstack(tiles))
    return np.asarray(np.vstack(rows)[:, :, [2, 1, 0, 3]])


def test_tiles_show_the_heights_where_they_are_and_meet_without_seams(surface: SurfaceImage) -> None:
    finest = surface_limits(surface)[0]
    picture = drawn(surface, finest)
    grid = finest.grid()
    places = np.indices(grid.shape).reshape(2, -1).T.astype(np.float64)
    cells = surface.grid.line_sample(grid.lon_lat(places))
    inside = surface.grid.contains(cells)
    line, sample = np.floor(cells[inside] + 0.5).astype(int).clip(0, np.array(SHAPE) - 1).T
    gaps = np.zeros(SHAPE, dtype=bool)
    gaps[a_gap] = True
    shown = np.zeros(len(places), dtype=bool)
    shown[inside] = ~gaps[line, sample]
    opaque = picture[:, :, 3].ravel() == 255
    assert (opaque != shown).mean() < 0.001
    at = surface.grid.xy(cells) - ORIGIN_XY
    heights = np.where(shown, height_m(*at.T), np.nan).reshape(grid.shape).astype(np.float32)
    truth = relief(heights, grid.gsd_m, RANGE_M).astype(int)
    off = np.abs(picture[:, :, :3].astype(int) - truth[:, :, :3])[opaque.reshape(grid.shape)]
    assert np.median(off) <= a_step_of_colour
    # Slopes at the edges of tiles know the neighbour: no line of tiles is seen.
    joint = np.zeros(grid.shape, dtype=bool)
    joint[:, TILE_PX - 1 :: TILE_PX] = joint[:, ::TILE_PX] = True
    at_joints = np.abs(picture[:, :, :3].astype(int) - truth[:, :, :3])[
        joint & opaque.reshape(grid.shape)
    ]
    assert at_joints.mean() < 1.2 * off.mean()


def test_coarse_tiles_show_all_of_the_surface(surface: SurfaceImage) -> None:
    levels = surface_limits(surface)
    share = []
    for level in (levels[0], levels[-1]):
        picture = drawn(surface, level)
        share.append((picture[:, :, 3] == 255).sum() * level.grid().gsd_m ** 2)
    assert share[1] == pytest.approx(share[0], rel=0.02)


def test_heights_at_places_are_those_of_the_cells(surface: SurfaceImage) -> None:
    places = np.array([[10.0, 20.0], [10.4, 20.3], [400.0, 300.0], [-0.6, 5.0], [np.nan, 1.0]])
    height, sigma, views, reason = surface.at(places)
    truth = float(height_m(np.array(10.0), np.array(-5.0)))
    assert height[:2] == pytest.approx([truth, truth], abs=1e-3)
    assert sigma[:2] == pytest.approx(0.3)
    assert np.isnan(height[2:]).all()
    assert (views[2], reason[2]) == (0, 7)
    assert np.isnan(reason[3:]).all()
    assert np.isnan(surface.at(np.array([[-50.0, -50.0]]))).all()


def test_places_far_apart_get_heights_of_cells_near_them(surface: SurfaceImage) -> None:
    places = np.column_stack([np.linspace(0.0, 280.0, 30), np.linspace(0.0, 1399.0, 30)])
    height = surface.at(places, 49.0)[0]
    truth = height_m(STEP_M * places[:, 1], -STEP_M * places[:, 0])
    steepest, away_m = 0.35, 49.0 * STEP_M
    assert np.abs(height - truth).max() < steepest * away_m


def test_the_outline_runs_along_the_edges(surface: SurfaceImage) -> None:
    on_grid = surface.grid.line_sample(outline_of(surface))
    assert on_grid.min(axis=0) == pytest.approx([-0.5, -0.5], abs=1e-3)
    assert on_grid.max(axis=0) == pytest.approx(np.array(SHAPE) - 0.5, abs=1e-3)
