"""Mosaics of scenes whose truth is known: steps, levels, seams, and pixels that no tile changes."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import CoverageError, InputError
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid, xy_of_lon_lat
from amers.services.mosaic import layout as layouts
from amers.services.mosaic import levelling
from amers.services.mosaic.layout import MosaicMap, Rectifier, flat_terrain, lay_out
from amers.services.mosaic.levelling import level, overlap_of, unchanged
from amers.services.mosaic.mosaic import make_mosaic
from amers.services.mosaic.options import MosaicOptions
from amers.services.mosaic.steps import seam_places, seam_steps
from amers.services.mosaic.tiles import TileLabels, TileScenes, tile_task
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import FloatImage
from tests.services.mosaic.worlds import (
    GRID,
    GSD_M,
    PLACES,
    assembled,
    cut_out,
    layout_of,
    mosaic_of,
    scene,
    truth_on,
)

pytestmark = pytest.mark.long

a_twentieth_of_a_pixel_m = 0.05 * GSD_M
one_percent = 0.01
a_tenth_of_a_pixel = 0.1 * 80.0 * 2.0 * np.pi * GSD_M / 9.0
"""In grey values, of the finest of the `waves`."""


def test_a_mosaic_shows_every_pixel_of_the_ground() -> None:
    mosaic = mosaic_of([scene(k, *cut_out(k)) for k in range(3)])
    pixels, source = assembled(mosaic)
    truth = truth_on(mosaic.grid)
    assert set(np.unique(source[np.isfinite(truth[0])])) >= {1, 2, 3}
    seen = source > 0
    assert (np.isfinite(pixels).all(axis=0) == seen).all()
    np.testing.assert_allclose(pixels[:, seen], truth[:, seen], atol=0.1)
    assert seen[np.isfinite(truth[0])].mean() > 0.97  # the third scene is lower than the others
    assert mosaic.steps is not None
    assert mosaic.steps.used.found == mosaic.steps.places > 20
    assert mosaic.steps.used.p90_m < a_twentieth_of_a_pixel_m
    assert mosaic.steps.delivered is None


@pytest.mark.parametrize("off_px", [(3.0, -7.0), (0.4, 0.25), (-18.0, 12.0)])
def test_a_known_shift_of_a_scene_is_the_step_at_its_seams(off_px: tuple[float, float]) -> None:
    """The second scene has a model off by a shift, and the right one as that before registration."""
    first, second = scene(0, *cut_out(0)), scene(1, *cut_out(1, off_px=off_px))
    right = OrthoModel(cut_out(1)[1])
    mosaic = mosaic_of([replace(first, delivered=first.scene.model), replace(second, delivered=right)])
    steps = mosaic.steps
    assert steps is not None
    assert steps.delivered is not None
    assert steps.used.found > 0.8 * steps.places
    expected = np.array([off_px[1], -off_px[0]]) * GSD_M
    found = np.array([steps.used.east_m, steps.used.north_m])
    np.testing.assert_allclose(found, expected, atol=a_twentieth_of_a_pixel_m)
    assert steps.used.median_m == pytest.approx(np.hypot(*expected), abs=a_twentieth_of_a_pixel_m)
    assert steps.delivered.p90_m < a_twentieth_of_a_pixel_m
    assert mosaic.pair_steps[0].scenes == ("scene_0", "scene_1")


GAINS = ((1.0, 0.0), (1.3, -80.0), (0.7, 150.0))


@pytest.mark.parametrize("anchor", [None, "scene_1"])
def test_known_gains_are_levelled_to_a_percent(anchor: str | None) -> None:
    """A tenth of the second scene is a cloud, and each has its own noise."""
    rng = np.random.default_rng(1)
    scenes = []
    for number, (gain, offset) in enumerate(GAINS):
        pixels, grid = cut_out(number, gain=gain, offset=offset)
        pixels += rng.normal(scale=10.0, size=pixels.shape).astype(np.float32)
        if number == 1:
            pixels[:, 100:300, :130] = 1500.0
        scenes.append(scene(number, pixels, grid))
    mosaic = mosaic_of(scenes, level=True, anchor=anchor)
    to_truth = np.array([[1.0 / gain, -offset / gain] for gain, offset in GAINS])
    for band in range(2):
        gain, offset = mosaic.levels.gain[:, band], mosaic.levels.offset[:, band]
        together = gain / to_truth[:, 0]
        assert together == pytest.approx(np.full(3, together[0]), rel=one_percent)
        of_500 = gain * (500.0 * np.array([g for g, _ in GAINS]) + [o for _, o in GAINS]) + offset
        assert of_500 == pytest.approx(np.full(3, of_500[0]), rel=one_percent)
        if anchor is not None:
            assert gain[1] == 1.0
            assert offset[1] == 0.0
    # Without --level, grey values stay.
    assert (mosaic_of(scenes).levels.gain == 1.0).all()


def test_no_seam_crosses_a_cloud_or_what_has_moved() -> None:
    first, grid = cut_out(0)
    second, other = cut_out(1)
    first, second = first.copy(), second.copy()
    first[:, 250:330, 380:460] = 1400.0  # a cloud in the middle of the overlap
    second[:, 450:470, 30:90] = 150.0  # a lorry
    mosaic = mosaic_of([scene(0, first, grid), scene(1, second, other)])
    _, source = assembled(mosaic)
    line, sample = np.round(mosaic.grid.line_sample_of_xy(GRID.origin_xy[None, :])[0]).astype(int)
    for rows, columns in ((slice(250, 330), slice(380, 460)), (slice(450, 470), slice(380, 440))):
        shown = source[
            rows.start + line : rows.stop + line, columns.start + sample : columns.stop + sample
        ]
        assert len(np.unique(shown)) == 1
    assert {1, 2} <= set(np.unique(source))


@pytest.mark.parametrize("options", [{}, {"level": True, "feather_px": 10.0}])
def test_tiles_of_any_size_give_the_same_pixels(options: dict[str, object]) -> None:
    scenes = [scene(k, *cut_out(k, gain=1.0 + 0.1 * k, off_px=(0.3 * k, 0.0))) for k in range(3)]
    whole = assembled(mosaic_of(scenes, tile_px=2048, **options))
    small = assembled(mosaic_of(scenes, tile_px=512, **options))
    again = assembled(mosaic_of(scenes, tile_px=512, **options))
    for a, b, c in zip(whole, small, again, strict=True):
        assert a.tobytes() == b.tobytes() == c.tobytes()


def test_a_feathered_seam_has_no_step_of_grey_values() -> None:
    scenes = [scene(0, *cut_out(0)), scene(1, *cut_out(1, offset=200.0))]
    sharp, source = assembled(mosaic_of(scenes))
    soft, _ = assembled(mosaic_of(scenes, feather_px=20.0))
    truth = truth_on(mosaic_of(scenes).grid)
    excess = soft - truth
    inside = np.isfinite(excess[0]) & (source > 0)
    assert np.nanmin(excess[:, inside]) > -0.2
    assert np.nanmax(excess[:, inside]) < 200.2
    blended = (excess[0] > 5.0) & (excess[0] < 195.0)
    width = blended.sum(axis=1)[100:-100]
    assert 10 < np.median(width) < 30
    assert not ((sharp - truth)[0][inside] > 5.0)[((sharp - truth)[0][inside] < 195.0)].any()


def test_gaps_are_filled_from_other_scenes() -> None:
    pixels, grid = cut_out(0)
    pixels = pixels.copy()
    pixels[:, 300, 420] = np.nan
    pixels[:, 200:260, 100:130] = np.nan  # ground that the second scene does not show
    mosaic = mosaic_of([scene(0, pixels, grid), scene(1, *cut_out(1))])
    found, source = assembled(mosaic)
    truth = truth_on(mosaic.grid)
    line, sample = np.round(mosaic.grid.line_sample_of_xy(GRID.origin_xy[None, :])[0]).astype(int)
    assert source[300 + line, 420 + sample] == 2
    assert np.isfinite(found[:, 300 + line, 420 + sample]).all()
    hole = source[205 + line : 255 + line, 105 + sample : 125 + sample]
    assert (hole == 0).all()
    seen = source > 0
    np.testing.assert_allclose(found[:, seen], truth[:, seen], atol=0.5)


def test_a_scene_within_another_adds_no_seam() -> None:
    pixels, grid = cut_out(0)
    inner = replace(grid, origin_xy=grid.xy(np.array([[100.0, 100.0]]))[0], shape=(300, 300))
    both = scene(0, pixels, grid), scene(1, pixels[:, 100:400, 100:400], inner)
    for scenes, shown in ((both, 1), (both[::-1], 2)):
        mosaic = mosaic_of(scenes)
        assert mosaic.steps is None
        assert set(np.unique(assembled(mosaic)[1])) <= {0, shown}


def test_scenes_outside_the_box_are_left_out_by_name() -> None:
    scenes = [scene(k, *cut_out(k)) for k in range(3)]
    corners = np.array([[100.0, 20.0], [100.0, 200.0], [300.0, 200.0], [300.0, 20.0]])
    wanted = MosaicMap(GRID.crs, GSD_M, GRID.lon_lat(corners))
    layout = lay_out(scenes, flat_terrain(0.0), wanted)
    assert layout.left_out == ("scene_1", "scene_2")
    assert layout.grid.shape == pytest.approx((200, 180), abs=3)
    whole, _ = assembled(mosaic_of(scenes[:1]))
    part, _ = assembled(make_mosaic(layout, flat_terrain(0.0)))
    line, sample = np.round(
        layout_of(scenes[:1]).grid.line_sample_of_xy(layout.grid.origin_xy[None, :])[0]
    ).astype(int)
    lines, samples = layout.grid.shape
    np.testing.assert_allclose(part, whole[:, line : line + lines, sample : sample + samples], atol=0.05)
    far = MosaicMap(GRID.crs, GSD_M, GRID.lon_lat(corners + [0.0, 50_000.0]))
    with pytest.raises(CoverageError, match="check --bbox"):
        lay_out(scenes, flat_terrain(0.0), far)


def test_other_bands_and_unknown_anchors_are_refused() -> None:
    pixels, grid = cut_out(0)
    with pytest.raises(InputError, match="scene_1: 1 bands found, 2 expected as in scene_0"):
        mosaic_of([scene(0, pixels, grid), scene(1, pixels[:1], grid)])
    with pytest.raises(InputError, match="anchor: nobody found"):
        mosaic_of([scene(0, pixels, grid)], level=True, anchor="nobody")
    with pytest.raises(InputError, match="a multiple of 512"):
        MosaicOptions(tile_px=500)


def waves(grid: MapGrid) -> FloatImage:
    """Ground (1, lines, samples) known at every position, in the pixels of a grid."""
    at = np.stack(np.indices(grid.shape), axis=-1).reshape(-1, 2).astype(np.float64)
    x, y = (xy_of_lon_lat(GRID.crs, grid.lon_lat(at)) - GRID.origin_xy).T
    grey = 500.0 + sum(
        80.0 * np.sin(2.0 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / length_m + angle)
        for angle, length_m in ((0.3, 9.0), (1.2, 13.0), (2.0, 31.0), (2.9, 60.0))
    )
    return grey.reshape(1, *grid.shape).astype(np.float32)


def test_scenes_in_other_zones_lie_on_one_map() -> None:
    """The second image is on the map of the next zone, turned by four degrees against the first."""
    first = replace(GRID, shape=(300, 300))
    corner = xy_of_lon_lat("EPSG:32632", GRID.lon_lat(np.array([[0.0, 200.0]])))[0]
    second = replace(GRID, crs="EPSG:32632", origin_xy=corner, shape=(300, 300))
    scenes = [scene(k, waves(grid), grid) for k, grid in enumerate((first, second))]
    mosaic = mosaic_of(scenes)
    pixels, source = assembled(mosaic)
    assert {1, 2} <= set(np.unique(source))
    seen = source > 0
    error = np.abs(pixels - waves(mosaic.grid))[:, seen]
    # Positions are right to a tenth of a pixel, and the outermost half pixel is not interpolated.
    assert np.quantile(error, 0.998) < a_tenth_of_a_pixel
    assert mosaic.steps is not None
    assert mosaic.steps.used.p90_m < a_twentieth_of_a_pixel_m


def test_places_lie_on_seams_only() -> None:
    labels = np.zeros((40, 40), dtype=np.int16)
    labels[5:35, 5:20], labels[5:35, 20:35] = 1, 2
    places = seam_places(labels, 4)
    assert list(places) == [(0, 1)]
    assert (np.abs(places[0, 1][:, 1] - 80) <= 4).all()
    assert seam_places(labels * 0, 4) == {}


def test_scenes_on_both_sides_of_the_antimeridian_lie_on_one_map() -> None:
    """As on a map elsewhere, window by window: the map of the Pacific goes on beyond 180 degrees."""
    pacific = replace(GRID, crs="EPSG:3832", origin_xy=np.array([3_339_584.7 - 280.0, 0.0]))
    scenes = [scene(k, *cut_out(k)) for k in range(3)]
    moved = [
        scene(k, cut_out(k)[0], replace(cut_out(k)[1], crs=pacific.crs, origin_xy=pacific.xy(first)[0]))
        for k, first in enumerate(np.array([[PLACES[k][:2]] for k in range(3)], dtype=np.float64))
    ]
    lon = [one.scene.model.locate(np.zeros((1, 2)), np.zeros(1))[0, 0] for one in moved]
    assert np.ptp(lon) > 359.0
    found, expected = (
        lay_out(ones, flat_terrain(0.0), MosaicMap(crs, GSD_M))
        for ones, crs in ((moved, pacific.crs), (scenes, GRID.crs))
    )
    assert found.grid.shape == pytest.approx(expected.grid.shape, abs=4)
    for one, other in zip(found.windows, expected.windows, strict=True):
        assert (one.lines, one.samples) == pytest.approx((other.lines, other.samples), abs=4)
        assert (one.line, one.sample) == pytest.approx((other.line, other.sample), abs=4)
    zone = lay_out(moved, flat_terrain(0.0), MosaicMap(None, GSD_M)).grid
    assert zone.crs in ("EPSG:32601", "EPSG:32660", "EPSG:32701", "EPSG:32760")
    assert zone.shape == pytest.approx(expected.grid.shape, rel=0.05)


def test_a_gap_of_a_tile_is_filled_by_the_number_that_its_scene_has_among_all() -> None:
    """Scenes 1 and 2 reach the tile, all whose cells are of scene 1; the third has what that lacks."""
    pixels, grid = cut_out(1)
    pixels[:, 300:320, 400:420] = np.nan
    scenes = scene(1, pixels, grid), scene(2, *cut_out(2))
    layout = layout_of([scene(0, *cut_out(0)), *scenes])
    window = Window(256, 700, 100, 80)
    labels = TileLabels(np.full((40, 40), 2, dtype=np.int16), (60, 170), layout.cell_px, 0.0)
    found = TileScenes((1, 2), scenes, layout.windows[1:], unchanged(2, 2))
    rectifier = Rectifier(layout.grid, flat_terrain(0.0), MosaicOptions().ortho)
    made = tile_task(window, labels, found, rectifier)
    line, sample = (layout.grid.line_sample_of_xy(grid.xy(np.array([[310.0, 410.0]])))[0]).round()
    at = int(line) - window.line, int(sample) - window.sample
    assert made["source"][at] == 3
    assert made["source"][at[0] - 30, at[1] + 15] == 2
    assert np.isfinite(made["pixels"]).all()


def test_many_cells_are_compared_all_over_the_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ground whose first half is dark: of every third cell, the mean and the spread are those of all."""
    rng = np.random.default_rng(2)
    ground = np.concatenate([rng.normal(200.0, 20.0, (1, 3000)), rng.normal(700.0, 60.0, (1, 3000))], 1)
    values = np.stack([ground, 1.5 * ground + 40.0]).astype(np.float32)
    whole = overlap_of(0, 1, values)
    monkeypatch.setattr(levelling, "MOST_CELLS", 2500)
    part = overlap_of(0, 1, values)
    assert whole is not None
    assert part is not None
    assert part.count == 2000
    np.testing.assert_allclose(part.mean, whole.mean, rtol=0.02)
    np.testing.assert_allclose(part.spread, whole.spread, rtol=0.02)


def test_levels_keep_the_mean_gain_and_grey_value_of_scenes_that_are_joined() -> None:
    """The fourth scene has nothing in common with the others, and keeps its grey values."""
    rng = np.random.default_rng(3)
    ground = rng.normal(500.0, 90.0, (1, 400))
    gains, offsets = np.array([1.0, 1.4, 0.6]), np.array([0.0, -90.0, 130.0])
    seen = gains[:, None, None] * ground + offsets[:, None, None]
    overlaps = [overlap_of(a, b, seen[[a, b]].astype(np.float32)) for a, b in ((0, 1), (2, 1))]
    assert None not in overlaps
    means = np.append(seen.mean(axis=(1, 2)), 321.0)[:, None]
    levels = level([one for one in overlaps if one is not None], means)
    levelled = levels.gain[:3, :, None] * seen + levels.offset[:3, :, None]
    np.testing.assert_allclose(levelled, np.broadcast_to(levelled[:1], levelled.shape), rtol=1e-4)
    assert np.prod(levels.gain[:3]) == pytest.approx(1.0)
    assert levelled.mean() == pytest.approx(means[:3].mean())
    assert (levels.gain[3, 0], levels.offset[3, 0]) == pytest.approx((1.0, 0.0))


@pytest.mark.parametrize(("name", "most"), [("_MAP_CELLS", 5000), ("_SCENE_CELLS", 2000)])
def test_cells_are_as_large_as_their_number_allows_and_hold_every_pixel(
    name: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = [scene(k, *cut_out(k)) for k in range(3)]
    assert layout_of(scenes).cell_px == 4
    monkeypatch.setattr(layouts, name, most)
    layout = layout_of(scenes)
    cells = [layout.cell_window(number) for number in range(3)]
    counted = (
        [np.prod(layout.cells.shape)] if name == "_MAP_CELLS" else [w.lines * w.samples for w in cells]
    )
    assert 0.7 * most < max(counted) < 1.2 * most
    side = layout.cell_px
    for pixels, own in zip(layout.windows, cells, strict=True):
        for first, size, cell, count in (
            (pixels.line, pixels.lines, own.line, own.lines),
            (pixels.sample, pixels.samples, own.sample, own.samples),
        ):
            assert (first // side, (first + size - 1) // side) == (cell, cell + count - 1)


def test_steps_of_seams_are_told_by_their_median_and_what_nine_of_ten_are_below() -> None:
    """Of two seams, the second of which has a model before registration, too; some are not found."""
    east = np.arange(101.0)
    used = np.column_stack([east, np.zeros(101)])
    unknown = np.full((4, 2), np.nan)
    found = {
        (0, 1): {"used": np.concatenate([used, unknown])},
        (1, 2): {"used": -used[:1], "delivered": np.array([[3.0, -4.0]])},
    }
    together, (first, second) = seam_steps(("a", "b", "c"), found)
    assert (first.scenes, second.scenes) == (("a", "b"), ("b", "c"))
    assert (first.places, first.used.found, second.places) == (105, 101, 1)
    assert (first.used.median_m, first.used.p90_m, first.used.east_m) == pytest.approx(
        (50.0, 90.0, 50.0)
    )
    assert first.delivered is None
    assert second.delivered is not None
    assert (second.delivered.median_m, second.delivered.east_m, second.delivered.north_m) == (
        5.0,
        3.0,
        -4.0,
    )
    assert together is not None
    assert (together.places, together.used.found) == (106, 102)
    assert seam_steps(("a",), {}) == (None, ())
