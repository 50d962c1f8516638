"""Ortho-images show each pixel where the model and the terrain place it."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio

from amers.services.errors import ComputationError, CoverageError
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.geodesy import metres_per_degree_at
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.lines_of_sight import intersect_terrain
from amers.services.map_grid import MapGrid
from amers.services.orthorectification import rectify as module
from amers.services.orthorectification.mapping import map_into_image, occluded_ground
from amers.services.orthorectification.point_terrain import terrain_of_points
from amers.services.orthorectification.rectify import (
    OrthoOptions,
    OrthoWindow,
    Window,
    choose_grid,
    orthorectify,
)
from amers.services.sensors.base import SensorModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Acquisition, Array, FloatImage
from tests.factories import affine_model
from tests.services.conftest import METRE_DEG, FlatModel

the_tolerance_px = 0.1
a_hundredth_of_a_pixel = 0.01
a_micropixel = 1e-6

SHAPE = (420, 380)
GSD_M = 2.0
DEM = MapGrid("EPSG:4326", np.array([5.19, 44.22]), np.array([[0.0, 1e-4], [-1e-4, 0.0]]), (320, 340))


def terrain(relief_m: float = 120.0) -> Terrain:
    line, sample = np.indices(DEM.shape)
    waves = np.sin(line / 9.0) * np.cos(sample / 11.0) + 0.3 * np.sin((line - 2 * sample) / 5.0)
    heights = (700.0 + relief_m * waves).astype(np.float32)
    return Terrain(DEM, ArrayImage(heights))


@cache
def scene(incidence_deg: float = 25.0, azimuth_deg: float = 100.0) -> Scene:
    lon, lat = DEM.lon_lat(np.array([[160.0, 170.0]]))[0]
    true = pushbroom_over(
        np.array([lon, lat, 700.0]), SHAPE, GSD_M, (incidence_deg, azimuth_deg), (100.0, 1300.0)
    )
    model = fit_rpc(true, SHAPE, (100.0, 1300.0)).model
    ramp = np.indices(SHAPE)[0].astype(np.float32)
    return Scene(ArrayImage(ramp), model, Acquisition("a"), 5.0)


def ramps() -> list[ArrayImage]:
    """Images of line and sample numbers: orthorectified, they show the mapping itself."""
    return [ArrayImage(axis.astype(np.float32)) for axis in np.indices(SHAPE)]


def assembled(
    images: list[ArrayImage],
    ground: Terrain,
    grid: MapGrid,
    model: SensorModel | None = None,
    **changes: object,
) -> FloatImage:
    out = np.zeros((len(images), *grid.shape), dtype=np.float32)
    options = replace(OrthoOptions(), **changes)  # type: ignore[arg-type]
    for ortho in orthorectify(images, model or scene().model, ground, grid, options):
        at = ortho.window
        assert ortho.error_px <= options.tolerance_px
        out[:, at.line : at.line + at.lines, at.sample : at.sample + at.samples] = ortho.pixels
    return out


def expected(ground: Terrain, grid: MapGrid) -> np.ndarray:
    """Line and sample by the model itself, at the height of each pixel."""
    pixels = np.stack(np.indices(grid.shape), axis=-1).reshape(-1, 2).astype(np.float64)
    lon_lat = grid.lon_lat(pixels)
    line_sample = scene().model.project(np.column_stack([lon_lat, ground.height_m(lon_lat)]))
    beyond = (line_sample < -0.5) | (line_sample > np.array(SHAPE) - 0.5)
    line_sample[beyond.any(axis=1)] = np.nan
    return np.clip(line_sample.reshape(*grid.shape, 2), 0.0, np.array(SHAPE) - 1.0).transpose(2, 0, 1)


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
@pytest.mark.parametrize("crs", [None, "EPSG:4326", "EPSG:2154"])
@pytest.mark.long
def test_every_map_pixel_shows_the_position_that_the_model_projects(
    kernel: str, crs: str | None
) -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground, crs)
    rendered, wanted = assembled(ramps(), ground, grid, kernel=kernel), expected(ground, grid)
    inside = np.isfinite(wanted).all(axis=0)
    assert inside.mean() > 0.5
    seen = np.isfinite(rendered).all(axis=0)
    # Pixels on the border itself may fall on either side of it.
    assert (seen != inside).sum() <= 0.002 * inside.sum()
    both = seen & inside
    assert np.abs(rendered - wanted)[:, both].max() < a_hundredth_of_a_pixel


def test_coarse_and_fine_tolerances_are_respected() -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    exact = map_into_image(scene().model, ground, grid, Window(100, 100, 200, 200), 1e-4)
    rough = map_into_image(scene().model, ground, grid, Window(100, 100, 200, 200), the_tolerance_px)
    assert exact is not None
    assert rough is not None
    assert exact.error_px <= 1e-4
    assert np.nanmax(np.abs(exact.line_sample - rough.line_sample)) <= the_tolerance_px
    wanted = expected(ground, grid)[:, 100:300, 100:300].transpose(1, 2, 0)
    inside = np.isfinite(wanted) & (wanted > 0.0) & (wanted < np.array(SHAPE) - 1.0)
    assert inside.mean() > 0.5
    assert np.abs(exact.line_sample - wanted)[inside].max() < 5e-4


def test_the_map_covers_the_ground_of_the_scene_and_little_more() -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    assert grid.crs == "EPSG:32631"
    pixels = np.random.default_rng(1).uniform(-0.5, np.array(SHAPE) - 0.5, (500, 2))
    met = intersect_terrain(scene().model, pixels, ground)
    assert grid.contains(grid.line_sample(met[:, :2])).all()
    assert grid.shape[0] * grid.shape[1] < 2.2 * SHAPE[0] * SHAPE[1]
    coarse = choose_grid(scene(), ground, gsd_m=7.0)
    np.testing.assert_allclose(np.abs(coarse.step_xy[[0, 1], [1, 0]]), 7.0)
    np.testing.assert_allclose((coarse.origin_xy / 7.0 - 0.5) % 1.0 % 1.0, 0.0, atol=1e-6)


@pytest.mark.parametrize(("centre_deg", "crs"), [(179.9995, "EPSG:32760"), (-179.9995, "EPSG:32701")])
@pytest.mark.parametrize("upright", [True, False])
def test_the_map_of_a_scene_across_180_degrees_is_as_large_as_that_of_another(
    centre_deg: float, crs: str, upright: bool
) -> None:
    """Its first pixel is in the north-west, or in the south-east; its zone is that of its middle."""
    model = replace(affine_model(np.array([centre_deg, -16.0])), image_offset=np.array(SHAPE) / 2.0)
    if not upright:
        model = replace(model, line_num=-model.line_num, sample_num=-model.sample_num)
    across = Scene(ArrayImage(np.zeros(SHAPE, dtype=np.float32)), model, Acquisition("a"), 5.0)
    places = np.array([[179.999, -16.0, 190.0], [-179.999, -16.001, 210.0], [179.9995, -15.999, 200.0]])
    ground = terrain_of_points(places, np.array([[179.99, -16.01], [180.01, -15.99]]))
    grid = choose_grid(across, ground)
    assert grid.crs == crs
    pixels = np.random.default_rng(1).uniform(-0.5, np.array(SHAPE) - 0.5, (200, 2))
    located = model.locate(pixels, np.full(200, 200.0))
    assert {-1.0, 1.0} == set(np.sign(located[:, 0]))
    assert grid.contains(grid.line_sample(located[:, :2])).all()
    assert grid.shape[0] * grid.shape[1] < 2.2 * SHAPE[0] * SHAPE[1]


def on_equator(shape: tuple[int, int]) -> MapGrid:
    """A map with pixels of 2 m."""
    step = np.array([[0.0, 1.0], [-1.0, 0.0]]) * 2.0 * METRE_DEG
    return MapGrid("EPSG:4326", np.zeros(2), step, shape)


@dataclass(frozen=True)
class BentByHeight(FlatModel):
    """A plane whose samples move by a power of the height: by `moved_px` at 100 m."""

    moved_px: float = 0.0
    power: int = 3

    def project(self, lon_lat_h: Array) -> Array:
        moved = self.moved_px * (lon_lat_h[:, 2] / 100.0) ** self.power
        return super().project(lon_lat_h) + moved[:, None] * [0.0, 1.0]


@pytest.mark.parametrize(("cubic_px", "followed"), [(0.2, True), (1.0, False)])
def test_a_model_that_heights_bend_beyond_the_tolerance_is_refused(
    cubic_px: float, followed: bool
) -> None:
    """A quadratic through three heights of 200 m misses 0.38 of what a cubic does at 100 m."""
    grid = on_equator((150, 150))
    heights = np.linspace(-100.0, 100.0, 150 * 150, dtype=np.float32).reshape(150, 150)
    ground = Terrain(grid, ArrayImage(heights))
    window, model = Window(10, 10, 100, 100), BentByHeight(moved_px=cubic_px)
    if not followed:
        with pytest.raises(ComputationError, match=r"cannot be interpolated within 0\.1 px"):
            map_into_image(model, ground, grid, window, the_tolerance_px)
        return
    mapping = map_into_image(model, ground, grid, window, the_tolerance_px)
    assert mapping is not None
    pixels = np.stack(np.indices((100, 100)), axis=-1).reshape(-1, 2) + 10.0
    lon_lat_h = np.column_stack([grid.lon_lat(pixels), heights[10:110, 10:110].ravel()])
    error_px = np.abs(mapping.line_sample.reshape(-1, 2) - model.project(lon_lat_h)).max()
    assert a_hundredth_of_a_pixel < error_px < 1.02 * mapping.error_px


def test_a_part_of_a_map_is_made_as_in_the_whole() -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    whole, part = assembled(ramps(), ground, grid, window_px=64), Window(128, 192, 150, 100)
    count = np.zeros(grid.shape, dtype=np.int64)
    options = OrthoOptions(window_px=64)
    for one in orthorectify(ramps(), scene().model, ground, grid, options, part=part):
        at = one.window
        place = np.s_[at.line : at.line + at.lines, at.sample : at.sample + at.samples]
        count[place] += 1
        np.testing.assert_allclose(one.pixels, whole[:, *place], atol=a_hundredth_of_a_pixel)
    expected_count = np.zeros(grid.shape, dtype=np.int64)
    expected_count[128:278, 192:292] = 1
    np.testing.assert_array_equal(count, expected_count)


@dataclass(frozen=True)
class Wavy(FlatModel):
    """A plane whose lines move along the samples, by waves of 17 pixels."""

    wave_px: float = 0.0

    def project(self, lon_lat_h: Array) -> Array:
        plain = super().project(lon_lat_h)
        return plain + self.wave_px * np.sin(2.0 * np.pi * plain[:, 1:] / 17.0) * [1.0, 0.0]


def test_a_model_is_followed_by_nodes_at_every_second_pixel_and_no_closer() -> None:
    """Their middles miss 0.07 of a wave, those of nodes at every fourth pixel 0.26."""
    step = np.array([[0.0, 1.0], [-1.0, 0.0]]) * 0.5 * METRE_DEG
    grid = MapGrid("EPSG:4326", np.zeros(2), step, (130, 140))
    ground = Terrain(grid, ArrayImage(np.zeros(grid.shape, dtype=np.float32)))
    window = Window(0, 0, *grid.shape)
    mapping = map_into_image(Wavy(wave_px=1.0), ground, grid, window, the_tolerance_px)
    assert mapping is not None
    assert 0.05 < mapping.error_px < the_tolerance_px
    with pytest.raises(ComputationError, match=r"every second pixel leave an error of 0\.1"):
        map_into_image(Wavy(wave_px=2.0), ground, grid, window, the_tolerance_px)


def test_small_windows_and_divided_ones_give_the_same_image(monkeypatch: pytest.MonkeyPatch) -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    whole = assembled(ramps()[:1], ground, grid)
    np.testing.assert_allclose(
        assembled(ramps()[:1], ground, grid, window_px=100), whole, atol=2 * a_hundredth_of_a_pixel
    )
    monkeypatch.setattr(module, "MAX_READ_PIXELS", 10_000)
    np.testing.assert_allclose(
        assembled(ramps()[:1], ground, grid), whole, atol=2 * a_hundredth_of_a_pixel
    )


def test_a_coarser_map_shows_undisplaced_means() -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground, gsd_m=10.0)
    rendered, wanted = assembled(ramps(), ground, grid), expected(ground, grid)
    inside = np.isfinite(wanted).all(axis=0) & np.isfinite(rendered).all(axis=0)
    inside &= ((wanted > 15.0) & (wanted < np.array(SHAPE)[:, None, None] - 16.0)).all(axis=0)
    assert inside.sum() > 1000
    assert np.abs(rendered - wanted)[:, inside].max() < the_tolerance_px
    noise = ArrayImage(np.random.default_rng(1).normal(0.0, 100.0, SHAPE).astype(np.float32))
    smooth = assembled([noise], ground, grid)
    # Means over 10 m reduce the noise of pixels of 2 m to a fifth or less.
    assert np.nanstd(smooth) < 25.0


def void_share(position: np.ndarray, first: int, end: int) -> np.ndarray:
    """Bilinear weight of the pixels `first` to `end`, without it, at positions along an axis."""
    return np.clip(np.minimum(position - first + 1.0, end - position), 0.0, 1.0)


@pytest.mark.parametrize("kernel", ["bilinear", "cubic"])
def test_saturated_pixels_are_saturated_and_their_neighbours_are_kept(kernel: str) -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    line, sample = expected(ground, grid)
    pixels = np.full(SHAPE, 700.0, np.float32)
    pixels[200:220, 200:230] = np.inf
    pixels[100, 100] = np.inf
    rendered = assembled([ArrayImage(pixels)], ground, grid, kernel=kernel)[0]
    area = void_share(line, 200, 220) * void_share(sample, 200, 230) > 0.5
    alone = void_share(line, 100, 101) * void_share(sample, 100, 101) > 0.5
    assert alone.any()
    assert ((rendered == np.inf) != (area | alone)).sum() <= 3
    np.testing.assert_allclose(rendered[np.isfinite(rendered)], 700.0, atol=1e-3)


@pytest.mark.parametrize("gsd_m", [5.0, 9.0])
def test_a_coarse_map_does_not_depend_on_its_windows(gsd_m: float) -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground, gsd_m=gsd_m)
    noise = ArrayImage(np.random.default_rng(1).normal(500.0, 100.0, SHAPE).astype(np.float32))
    whole = assembled([noise], ground, grid)
    pieces = assembled([noise], ground, grid, window_px=23)
    both = np.isfinite(whole) & np.isfinite(pieces)
    assert both.sum() > 0.99 * np.isfinite(whole).sum()
    assert np.abs(whole - pieces)[both].max() < 1.0


def test_nodes_of_the_terrain_beside_a_void_have_their_heights() -> None:
    ground = terrain()
    heights = np.array(ground.heights.read(Window(0, 0, *DEM.shape)))
    heights[150:160, 160:170] = np.nan
    holed = replace(ground, heights=ArrayImage(heights))
    window = Window(100, 100, 120, 120)
    mapping = map_into_image(scene().model, holed, DEM, window, the_tolerance_px)
    assert mapping is not None
    nodes = heights[100:220, 100:220]
    np.testing.assert_array_equal(np.isfinite(mapping.height_m), np.isfinite(nodes))
    valid = np.isfinite(nodes)
    np.testing.assert_allclose(mapping.height_m[valid], nodes[valid], atol=0.01)


def test_voids_of_image_and_terrain_are_nodata() -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    heights = np.array(ground.heights.read(Window(0, 0, *DEM.shape)))
    heights[150:160, 160:170] = np.nan
    holed = replace(ground, heights=ArrayImage(heights))
    pixels = np.ones(SHAPE, np.float32)
    pixels[200:220, 200:230] = np.nan
    full = assembled([ArrayImage(np.ones(SHAPE, np.float32))], ground, grid)
    less = assembled([ArrayImage(pixels)], ground, grid)
    lost = np.isnan(less) & ~np.isnan(full)
    line, sample = expected(ground, grid)
    inside = void_share(line, 200, 220) * void_share(sample, 200, 230) > 0.5
    assert inside.sum() > 400
    # Positions on the edge of the void itself may fall on either side of it.
    assert (lost[0] != inside).sum() <= 3
    lost = np.isnan(assembled([ArrayImage(np.ones(SHAPE, np.float32))], holed, grid)) & ~np.isnan(full)
    # Ten nodes of some 8 by 11 m, in pixels of 2 m.
    assert 1800 < lost.sum() < 4500


@pytest.mark.parametrize("undulation_m", [-60.0, 80.0])
def test_the_same_ground_is_hidden_whatever_its_heights_refer_to(undulation_m: float) -> None:
    ground = terrain(300.0)
    heights = ground.heights.read(Window(0, 0, *DEM.shape))
    above_geoid = Terrain(
        DEM, ArrayImage(heights - np.float32(undulation_m)), lambda at: np.full(len(at), undulation_m)
    )
    grid, window = choose_grid(scene(), ground), Window(150, 150, 120, 120)
    hidden = []
    for one in (ground, above_geoid):
        mapping = map_into_image(scene().model, one, grid, window, the_tolerance_px)
        assert mapping is not None
        hidden.append(occluded_ground(scene().model, one, grid, window, mapping.height_m))
    assert 500 < hidden[0].sum() < 0.9 * hidden[0].size
    assert (hidden[0] != hidden[1]).sum() < 0.01 * hidden[0].sum()


def test_terrain_of_another_place_is_refused() -> None:
    far = replace(terrain(), grid=replace(DEM, origin_xy=np.array([50.0, 10.0])))
    with pytest.raises(CoverageError, match="does not cover"):
        choose_grid(scene(), far)


def test_a_map_without_a_pixel_of_the_scene_says_which_heights_do_not_fit() -> None:
    """A model that is valid for 2 m of height, and ground 50 m below."""
    of = scene()
    flat = replace(of.model, ground_offset=np.array([*of.model.ground_offset[:2], 900.0]))
    flat = replace(flat, ground_scale=np.array([*flat.ground_scale[:2], 1.0]))
    with pytest.raises(
        CoverageError, match=r"valid for heights of 899 to 901 m .* has 5\d\d to 8\d\d m"
    ):
        choose_grid(replace(of, model=flat), terrain())


def test_an_ortho_image_is_a_cloud_optimised_geotiff_with_overviews(tmp_path: Path) -> None:
    ground = terrain()
    grid = choose_grid(scene(), ground)
    windows = list(orthorectify(ramps(), scene().model, ground, grid))
    path = tmp_path / "ortho.tif"
    error_px = write_cog(path, grid, windows, BandForm(2, "uint16", 0.0))
    assert error_px == max(window.error_px for window in windows)
    assert [file.name for file in tmp_path.iterdir()] == ["ortho.tif"]
    with rasterio.open(path) as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.overviews(1)
        assert file.crs.to_epsg() == 32631
        assert file.nodata == 0.0
        stored = file.read()
        x, y = file.transform @ (0.5, 0.5)
    np.testing.assert_allclose([x, y], grid.origin_xy, atol=a_micropixel)
    wanted = assembled(ramps(), ground, grid)
    np.testing.assert_array_equal(stored == 0, np.isnan(wanted))
    seen = np.isfinite(wanted)
    np.testing.assert_allclose(stored[seen], np.maximum(np.rint(wanted[seen]), 1.0))


@pytest.mark.parametrize(
    ("dtype", "saturated", "written"),
    [("uint16", 4095, 4095), ("uint16", None, 65535), ("int16", 32767, 32767), ("float32", 4095, 4095)],
)
def test_saturated_pixels_are_written_as_the_saturated_value(
    tmp_path: Path, dtype: str, saturated: int | None, written: int
) -> None:
    grid = MapGrid("EPSG:32631", np.array([5e5, 4.8e6]), np.array([[0.0, 2.0], [-2.0, 0.0]]), (1, 6))
    row = np.array([[[np.nan, np.inf, 4095.0, 0.2, 700.0, 4094.0]]], dtype=np.float32)
    path = tmp_path / "a.tif"
    write_cog(
        path,
        grid,
        [OrthoWindow(Window(0, 0, 1, 6), row, 0.0)],
        BandForm(1, dtype, 0.0, saturated),
    )
    with rasterio.open(path) as file:
        stored = file.read(1)[0].tolist()
    nearly_white = 4094 if written == 4095 and dtype != "float32" else 4095
    least = 1 if dtype != "float32" else pytest.approx(0.2)
    assert stored == [0, written, nearly_white, least, 700, 4094]


@pytest.mark.parametrize("undulation_m", [-60.0, 80.0])
def test_positions_are_those_of_the_heights_above_the_ellipsoid(undulation_m: float) -> None:
    """Between the lowest and the highest of these a model is interpolated, and nowhere beyond."""
    grid = on_equator((80, 80))
    heights = np.linspace(-100.0, 100.0, 80 * 80, dtype=np.float32).reshape(80, 80)
    above_geoid = Terrain(
        grid,
        ArrayImage(heights - np.float32(undulation_m)),
        lambda at: np.full(len(at), undulation_m),
    )
    window, model = Window(0, 0, 80, 80), BentByHeight(moved_px=0.2)
    mapping = map_into_image(model, above_geoid, grid, window, the_tolerance_px)
    assert mapping is not None
    np.testing.assert_allclose(mapping.height_m, heights, atol=1e-3)
    pixels = np.moveaxis(np.indices((80, 80)), 0, -1).reshape(-1, 2).astype(np.float64)
    exact = model.project(np.column_stack([grid.lon_lat(pixels), heights.ravel()]))
    assert np.abs(mapping.line_sample.reshape(-1, 2) - exact).max() < the_tolerance_px


@pytest.mark.parametrize("gsd_m", [6.0, 10.0, 13.0])
def test_a_coarse_map_shows_the_image_as_blurred_as_its_pixels_are_large(gsd_m: float) -> None:
    """White noise under a Gaussian of 0.4 of the root of the squared ratio less one, and no more."""
    ground = terrain(0.0)
    noise = np.random.default_rng(4).standard_normal(SHAPE).astype(np.float32)
    rendered = assembled([ArrayImage(noise)], ground, choose_grid(scene(), ground, gsd_m=gsd_m))[0]
    area = rendered[np.isfinite(rendered)]
    sigma_px = 0.4 * np.sqrt((gsd_m / GSD_M) ** 2 - 1.0)
    expected_std = 1.0 / (2.0 * np.sqrt(np.pi) * sigma_px)
    assert area.std() == pytest.approx(expected_std, rel=0.25)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32631", "EPSG:3857", "EPSG:4807", "EPSG:27572"])
def test_pixels_of_a_map_are_as_long_as_wide_on_the_ground(crs: str) -> None:
    grid = choose_grid(scene(), terrain(), crs, gsd_m=3.0)
    corner, right, down = grid.lon_lat(np.array([[80.0, 80.0], [80.0, 81.0], [81.0, 80.0]]))
    metres = metres_per_degree_at(np.array([[*corner, 0.0]]))[0]
    for step in (right - corner, down - corner):
        assert np.hypot(*(step * metres)) == pytest.approx(3.0, rel=0.002)


def test_a_model_that_is_quadratic_in_the_height_is_followed_exactly() -> None:
    """However much it bends: it is interpolated between three heights."""
    grid = on_equator((90, 70))
    heights = np.linspace(-100.0, 300.0, 90 * 70, dtype=np.float32).reshape(90, 70)
    model = BentByHeight(moved_px=8.0, power=2)
    mapping = map_into_image(
        model, Terrain(grid, ArrayImage(heights)), grid, Window(0, 0, 90, 70), the_tolerance_px
    )
    assert mapping is not None
    assert mapping.error_px < 1e-6
    assert mapping.line_sample.shape == (90, 70, 2)
    assert mapping.height_m.dtype == np.float32
    pixels = np.moveaxis(np.indices((90, 70)), 0, -1).reshape(-1, 2).astype(np.float64)
    exact = model.project(np.column_stack([grid.lon_lat(pixels), heights.ravel()]))
    assert np.abs(mapping.line_sample.reshape(-1, 2) - exact).max() < 1e-3


def test_progress_is_the_share_of_the_lines_that_are_done() -> None:
    ground, told = terrain(), list[float]()
    grid = choose_grid(scene(), ground)

    def progress(fraction: float, message: str) -> None:
        told.append(fraction)
        assert message

    windows = orthorectify(
        ramps()[:1], scene().model, ground, grid, OrthoOptions(window_px=100), progress=progress
    )
    rows = sorted({one.window.line for one in windows})
    assert len(rows) > 3
    np.testing.assert_allclose(told, [*np.array(rows[1:]) / grid.shape[0], 1.0])


def plane(side_px: int) -> tuple[FlatModel, Terrain]:
    """A vertical view of a level plane of so many pixels of half a metre."""
    step = np.array([[0.0, 1.0], [-1.0, 0.0]]) * side_px * 0.5 * METRE_DEG
    nodes = MapGrid("EPSG:4326", -step @ np.full(2, 0.25), step, (4, 4))
    return FlatModel(), Terrain(nodes, ArrayImage(np.zeros((4, 4), dtype=np.float32)))


@pytest.mark.parametrize("ratio", [5.0, 20.0])
def test_a_much_coarser_map_shows_the_image_however_it_is_divided(ratio: float) -> None:
    """What a window reads beyond its border is all that its pixels consist of."""
    side = round(50 * ratio)
    model, ground = plane(side)
    step = np.array([[0.0, 1.0], [-1.0, 0.0]]) * 0.5 * ratio * METRE_DEG
    grid = MapGrid("EPSG:4326", step @ np.full(2, 0.5), step, (49, 49))
    noise = np.random.default_rng(5).normal(500.0, 200.0, (side, side)).astype(np.float32)
    whole, divided = (
        assembled([ArrayImage(noise)], ground, grid, model, window_px=px) for px in (512, 16)
    )
    assert np.isfinite(whole).all()
    np.testing.assert_allclose(divided, whole, atol=1e-3)
