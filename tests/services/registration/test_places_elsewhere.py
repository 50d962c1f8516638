"""Points of a few lines that agree on another place than the scene are named, from five on."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, CachedImage, Window
from amers.services.matching.control_points import ChipSearch, match_points
from amers.services.misfit.scene_adjustment import AdjustmentOptions
from amers.services.quality.points_elsewhere import Elsewhere
from amers.services.registration.context import PointContext
from amers.services.registration.elsewhere import adjust_with_places
from amers.services.registration.missed_points import search_missed_points
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.search import Search, adjust_search, predict, select_inliers
from amers.services.types import (
    Acquisition,
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    no_progress,
)
from tests.factories import control_points
from tests.services.conftest import GSD_M, SHAPE, FlatModel
from tests.services.registration.small_ground import GSD_M as GRID_M
from tests.services.registration.small_ground import matches_at, point_context, points_at, scene, whole
from tests.services.simulated import MemoryChips

NOISE_PX = 0.2
EVENLY = np.sqrt(3.0)
"""Even errors have this as the largest, standard deviations: none is taken for wrong."""
BEYOND_PX = np.array([6.0, 2.0])


def elsewhere_of(context: PointContext, search: Search) -> Elsewhere | None:
    """The points of a search that agree on another place of the scene."""
    options = context.options.adjustment
    adjustment = adjust_search(context.scene, search, options, ground_may_move=True)
    return adjust_with_places(context, search, adjustment)[2]


def named(off_px: Array, place: Array, height_m: Array | None = None) -> Elsewhere | None:
    """What is named of points (n, 2) that lie off by displacements (n, 2); NaN where not found."""
    n, rng = len(place), np.random.default_rng(4)
    heights = rng.normal(80.0, 20.0, n) if height_m is None else height_m
    points = replace(
        control_points(n, rng, gsds_m=(GSD_M,)),
        lon_lat_h=FlatModel().locate(place, heights),
        covariance_m2=np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        chip_files=("chips",),
    )
    line_sample = place + off_px + NOISE_PX * rng.uniform(-EVENLY, EVENLY, (n, 2))
    found = np.isfinite(off_px).all(axis=1)
    displacement_m = (line_sample - place)[:, ::-1] * [GSD_M, -GSD_M]
    matches = matches_at(line_sample, displacement_m, NOISE_PX)
    blank = ArrayImage(np.broadcast_to(np.float32(0.0), SHAPE))
    scene = Scene(blank, FlatModel(), Acquisition("flat"), 10.0)
    options = RegistrationOptions(adjustment=AdjustmentOptions(order="drift", min_points=6))
    chips = MemoryChips(np.zeros((n * 3, 101, 101), dtype=np.uint16))
    context = PointContext(
        scene, options, no_progress, [], None, points, chips, CachedImage(blank), GSD_M
    )
    inliers = found & (np.hypot(*(off_px - np.nanmedian(off_px, axis=0)).T) < 3.0)
    search = Search(points, np.arange(n), matches, inliers, 50.0)
    return elsewhere_of(context, search)


def places(beside: int) -> tuple[Array, BoolArray]:
    """Sixty points of all lines but 1500 to 2000, and some of these; and which they are."""
    rng = np.random.default_rng(6)
    line = np.concatenate([np.linspace(100.0, 1450.0, 24), np.linspace(2050.0, 3900.0, 36)])
    line = np.concatenate([line, np.linspace(1550.0, 1950.0, beside)])
    place = np.column_stack([line, rng.uniform(100.0, 4900.0, len(line))])
    return place, np.arange(len(line)) >= 60


@pytest.mark.parametrize("beside", [4, 5, 6])
def test_five_points_of_lines_beside_the_scene_are_named(beside: int) -> None:
    place, away = places(beside)
    elsewhere = named(np.where(away[:, None], BEYOND_PX, 0.0), place)
    if beside < 5:
        assert elsewhere is None
        return
    assert elsewhere is not None
    np.testing.assert_array_equal(elsewhere.rows, np.flatnonzero(away))
    np.testing.assert_allclose(elsewhere.displacement_px, BEYOND_PX, atol=1.5 * NOISE_PX)
    assert elsewhere.displacement_m == pytest.approx(GSD_M * np.hypot(*BEYOND_PX), abs=NOISE_PX)
    assert elsewhere.slope_px is None


def test_points_that_agree_with_the_scene_or_with_nothing_are_not_named() -> None:
    place, away = places(8)
    assert named(np.zeros_like(place), place) is None
    scattered = np.random.default_rng(9).uniform(-40.0, 40.0, place.shape)
    assert named(np.where(away[:, None], scattered, 0.0), place) is None


SLOPE_PX = np.array([0.08, -0.05])
"""By how much a metre of height displaces points, line and sample."""


def on_slopes(tall: int, relief_m: float) -> tuple[Array, Array, Array]:
    """Points of ground that rises along the lines, their heights above it, and its heights.

    Some are tall; the others differ by a relief. Three are not found.
    """
    place, _ = places(0)
    ground_m = 50.0 + 0.03 * place[:, 0] + 0.01 * place[:, 1]
    above_m = np.random.default_rng(11).normal(0.0, relief_m, len(place))
    above_m[5 :: 55 // tall][:tall] = np.linspace(110.0, 160.0, tall)
    return place, above_m, ground_m


def displaced(above_m: Array, moves: BoolArray) -> Array:
    """Displacements of points in proportion to their heights, of those that move; three are lost."""
    off_px = np.where(moves[:, None], above_m[:, None] * SLOPE_PX, 0.0)
    off_px[[2, 30, 58]] = np.nan
    return off_px


@pytest.mark.parametrize(("tall", "relief_m"), [(8, 0.0), (8, 6.0), (4, 6.0)])
def test_points_that_are_displaced_as_they_rise_above_the_ground_are_named(
    tall: int, relief_m: float
) -> None:
    place, above_m, ground_m = on_slopes(tall, relief_m)
    everywhere = np.ones(len(place), dtype=bool)
    elsewhere = named(displaced(above_m, everywhere), place, ground_m + above_m)
    assert elsewhere is not None
    np.testing.assert_array_equal(elsewhere.rows, np.flatnonzero(above_m > 100.0))
    assert elsewhere.slope_px is not None
    np.testing.assert_allclose(elsewhere.slope_px, SLOPE_PX, atol=0.01)
    farthest_px = 160.0 * np.hypot(*SLOPE_PX)
    assert elsewhere.farthest_px == pytest.approx(farthest_px, abs=4.0 * NOISE_PX)
    np.testing.assert_allclose(elsewhere.displacement_px, 135.0 * SLOPE_PX, atol=1.0)
    assert elsewhere.displacement_m == pytest.approx(135.0 * GSD_M * np.hypot(*SLOPE_PX), abs=0.5)


def test_few_tall_points_are_not_believed_where_the_others_do_not_move_with_their_heights() -> None:
    place, above_m, ground_m = on_slopes(4, 6.0)
    assert named(displaced(above_m, above_m > 100.0), place, ground_m + above_m) is None


def narrow_search(
    of: Scene, points: ControlPoints, chips: MemoryChips, radius_px: int = 6
) -> tuple[PointContext, Search]:
    """A search of points within some pixels of their chips."""
    context = point_context(of, points, chips, GRID_M)
    narrow = ChipSearch(of.image, of.model, of.acquisition, GRID_M, radius_px)
    matches = match_points(narrow, points, chips, context.options.matching)
    inliers, _ = select_inliers(of.model, points, matches)
    return context, Search(points, np.arange(len(points.id)), matches, inliers, CHIP_SIZE * GRID_M)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_points_that_moved_each_by_itself_are_no_place_of_their_own(seed: int) -> None:
    """Little beyond the narrow search, where some are near one another: twenty of sixty-four."""
    rng = np.random.default_rng(seed)
    axis = 312.0 + np.linspace(60.0, 340.0, 8)
    places_px = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    points, chips = points_at(places_px)
    off_px = np.zeros((64, 2))
    moved = rng.choice(64, 20, replace=False)
    angle = rng.uniform(0.0, 2.0 * np.pi, 20)
    off_px[moved] = rng.uniform(8.0, 14.0, 20)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    lon_lat_h = whole().model.locate(places_px + off_px, np.arange(64.0) % 7)
    context, search = narrow_search(scene(np.zeros(2), 5.0), replace(points, lon_lat_h=lon_lat_h), chips)
    assert (search.matches.reason[moved] != "").sum() >= 15
    assert elsewhere_of(context, search) is None


@pytest.mark.parametrize("all_move", [True, False])
def test_two_tall_points_are_believed_where_the_ground_moves_with_its_relief(all_move: bool) -> None:
    """Two tall points, a low one, and one that moved by itself, of a model that leans otherwise."""
    place, above_m, ground_m = on_slopes(4, 2.5)
    tall = np.flatnonzero(above_m > 100.0)
    above_m[tall] = 16.0, 26.0, 55.0, 74.0
    off_px = displaced(above_m, np.full(len(place), all_move) | (above_m >= 16.0))
    off_px[tall[1]] = -9.0, 1.0
    elsewhere = named(off_px, place, ground_m + above_m)
    assert (elsewhere is not None) == all_move
    if elsewhere is not None:
        assert elsewhere.slope_px is not None
        np.testing.assert_allclose(elsewhere.slope_px, SLOPE_PX, atol=0.01)


@dataclass(frozen=True)
class ChipsRead(MemoryChips):
    """Chips that say which of them were read."""

    rows: set[int] = field(default_factory=set)

    def read(self, file: str, row: int, count: int) -> ChipArray:
        self.rows.update(range(row, row + count))
        return super().read(file, row, count)


def test_only_points_that_were_not_found_are_searched_in_a_wide_window() -> None:
    """Not those that were found and do not agree: their place is known."""
    axis = 312.0 + np.linspace(60.0, 340.0, 8)
    places_px = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    points, memory = points_at(places_px)
    off_px = np.zeros((64, 2))
    off_px[[5, 17, 30, 44, 60, 61], 0] = 4.0, -4.0, 4.0, -4.0, 4.0, -4.0
    lost = np.array([0, 9, 26, 38, 47, 55])
    lon_lat_h = whole().model.locate(places_px + off_px, np.arange(64.0) % 7)
    chips = MemoryChips(memory.chips.copy())
    chips.chips[lost] = chips.chips[np.roll(lost, 1)]
    context, search = narrow_search(scene(np.zeros(2), 5.0), replace(points, lon_lat_h=lon_lat_h), chips)
    np.testing.assert_array_equal(np.flatnonzero(search.matches.reason != ""), lost)
    assert (~search.inliers).sum() == 12
    read = ChipsRead(chips.chips)
    assert elsewhere_of(replace(context, chips=read), search) is None
    assert read.rows == set(lost.tolist())


def with_lines_aside(aside_px: int, a_side: int) -> tuple[Scene, ControlPoints, MemoryChips]:
    """A scene of which the last lines show the ground some pixels aside, and points all over it."""
    axis = 312.0 + np.linspace(60.0, 340.0, a_side)
    points, chips = points_at(np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2))
    relief = [[0.0, 0.0, k % 7] for k in range(len(points))]
    of = scene(np.zeros(2), 5.0)
    wide = scene(np.zeros(2), 5.0, 400, 520).image.read(Window(0, 0, 400, 520))
    pixels = of.image.read(Window(0, 0, 400, 400))
    pixels[260:] = wide[260:, 60 + aside_px : 460 + aside_px]
    broken = replace(of, image=ArrayImage(pixels))
    return broken, replace(points, lon_lat_h=points.lon_lat_h + relief), chips


@pytest.mark.parametrize(("aside_px", "radius_px"), [(40, 6), (5, 3)])
def test_lines_that_lie_far_from_the_others_are_found_in_a_wide_window(
    aside_px: int, radius_px: int
) -> None:
    """Where a narrow search does not see them, and no nearer than points scatter."""
    broken, points, chips = with_lines_aside(aside_px, 8)
    context, search = narrow_search(broken, points, chips, radius_px)
    elsewhere = elsewhere_of(context, search)
    assert elsewhere is not None
    beside = points.lon_lat_h[elsewhere.rows]
    line = broken.model.project(beside)[:, 0]
    assert len(line) >= 8
    assert line.min() > 260.0
    np.testing.assert_allclose(elsewhere.displacement_px, [0.0, -aside_px], atol=0.5)
    assert elsewhere.displacement_m == pytest.approx(aside_px * GRID_M, rel=0.02)
    assert elsewhere.false_alarms < 1e-5
    assert elsewhere.slope_px is None


def test_missed_points_are_searched_farther_out_on_all_their_lines() -> None:
    """Of 48 points in four rows no more than 40, as many of each row."""
    broken, points, chips = with_lines_aside(40, 12)
    context, search = narrow_search(broken, points, chips)
    adjustment = adjust_search(broken, search, context.options.adjustment)
    prediction = predict(broken, points, adjustment)
    farther, again = search_missed_points(context, prediction, search, adjustment)
    before, after = (one.matches.reason == "" for one in (search, farther))
    row = np.arange(len(points)) // 12
    added = np.bincount(row[after & ~before], minlength=12)
    # Chips of the first of these rows show both places.
    assert added[:9].sum() == 0
    assert added[9:].min() >= 5
    assert np.ptp(added[9:]) <= 1
    assert len(again.active) == len(points)
    moved_px = farther.matches.line_sample - prediction.model.project(points.lon_lat_h)
    np.testing.assert_allclose(np.median(moved_px[after & ~before], axis=0), [0.0, -40.0], atol=1.0)
