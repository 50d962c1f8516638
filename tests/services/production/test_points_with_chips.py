"""Chips of other bases, resampled to the chips of a block: their matches state their errors honestly."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, image_gsd_m, low_pass, render_chip
from amers.services.map_grid import MapGrid, lon_lat_of_xy, xy_of_lon_lat
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.production.points_production import MISSING, NO_HEIGHT, NOT_SALIENT, SAME_PLACE
from amers.services.production.points_with_chips import (
    NO_CHIP,
    NOT_SHOWN,
    OwnChips,
    produce_points_with_chips,
)
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array, Frame, GroundPoints
from tests.services.chip_bases import CORNER_XY, UTM, image, north_up
from tests.services.textures import as_pixels, texture

NEXT_ZONE = "EPSG:32632"
RADIUS_PX = 6
NOISE = 0.3
SIGMA_M = (3.0, 3.0, 5.0)
FRAME = Frame.from_sigmas(1.0, 2.0)


def shows(grid: MapGrid, pixels: Array) -> Scene:
    return Scene(ArrayImage(as_pixels(pixels)), OrthoModel(grid), Acquisition("chip"), np.nan)


def noise(rng: np.random.Generator, side: int, smoothness_px: float) -> Array:
    if smoothness_px == 0.0:
        return NOISE * rng.standard_normal((side, side))
    return NOISE * texture(rng, 2 * (side // 2 + 1), smoothness_px)[:side, :side]


def chip_at(
    xy: Array, gsd_m: float, side: int, rng: np.random.Generator, smooth_m: float = 0.0
) -> Scene:
    """A noisy chip on the map of a base, around a place up to half a pixel off its middle."""
    corner = xy + np.array([-1.0, 1.0]) * side * gsd_m / 2.0 + gsd_m * rng.uniform(-0.5, 0.5, 2)
    grid = north_up(UTM, corner, gsd_m, side)
    return shows(grid, image(grid) + noise(rng, side, smooth_m / gsd_m))


def scene_at(
    place: Array, gsd_m: float, reach_m: float, rng: np.random.Generator, smooth_m: float
) -> Scene:
    """A noisy image on the map of the next zone, turned by nearly 5 degrees against that of the base."""
    side = int(2.0 * reach_m / gsd_m)
    middle = xy_of_lon_lat(NEXT_ZONE, place[None, :2])[0]
    corner = middle + np.array([-1.0, 1.0]) * side * gsd_m / 2.0 + gsd_m * rng.uniform(-0.5, 0.5, 2)
    grid = north_up(NEXT_ZONE, corner, gsd_m, side)
    return shows(grid, image(grid) + noise(rng, side, smooth_m / gsd_m))


def in_a_block(chips: list[Scene], places: Array) -> tuple[Array, float]:
    """The chips (n, 101, 101) of a block that is made of chips, and their ground sampling."""
    names = np.array([f"P{number}" for number in range(len(chips))])
    ground = GroundPoints(names, places, np.tile(SIGMA_M, (len(chips), 1)))
    made = produce_points_with_chips(ground, own(names, chips), FRAME)
    assert made.left_out == {}
    return np.concatenate([made.chips(row) for row in range(len(chips))]), made.gsds_m[0]


def own(names: Array, chips: list[Scene | str]) -> OwnChips:
    image_of = np.zeros(len(chips), dtype=np.int64)
    return OwnChips(names, image_of, (Acquisition("chip"),), chips.__getitem__)


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize(
    ("chip_m", "side", "scene_m", "smooth_m"),
    [
        (10.0, 57, 10.0, 0.0),
        pytest.param(10.0, 57, 10.0, 15.0, marks=pytest.mark.endurance),
        pytest.param(10.0, 57, 5.0, 0.0, marks=pytest.mark.endurance),
        (10.0, 57, 5.0, 15.0),
        pytest.param(30.0, 64, 10.0, 0.0, marks=pytest.mark.endurance),
        (15.0, 64, 30.0, 0.0),
    ],
)
def test_matches_of_resampled_chips_state_honest_sigmas(
    chip_m: float, side: int, scene_m: float, smooth_m: float
) -> None:
    rng = np.random.default_rng(3)
    xy = np.array(CORNER_XY) + rng.uniform(1500.0, 6000.0, (60, 2)) * [1.0, -1.0]
    places = np.column_stack([lon_lat_of_xy(UTM, xy), np.zeros(len(xy))])
    chips, gsd_m = in_a_block([chip_at(at, chip_m, side, rng, smooth_m) for at in xy], places)
    assert gsd_m * 101 == pytest.approx(side * chip_m, rel=0.08)
    error_m, sigma_m = [], []
    for place, stored in zip(places, chips, strict=True):
        shift_px = rng.uniform(-3.0, 3.0, 2)
        off_m = np.array([[-shift_px[1] * gsd_m, shift_px[0] * gsd_m, 0.0]])
        seen = scene_at(place, scene_m, 0.65 * side * chip_m + 10.0 * scene_m, rng, smooth_m)
        middle = move_metres(place[None, :], off_m)[0]
        patch = render_chip(seen.image, seen.model, middle, gsd_m, 101 + 2 * RADIUS_PX)
        chip = np.where(stored > 0, stored, np.nan).astype(np.float32)
        chip = low_pass(chip, image_gsd_m(seen.model, place) / gsd_m)
        peak = find_chip(patch, chip, CorrelationOptions(min_score=0.6))
        assert peak.reason == FOUND
        error_m.append((peak.row_col - shift_px) * gsd_m)
        sigma_m.append(peak.sigma_px * gsd_m)
    normalised = np.array(error_m) / np.array(sigma_m)[:, None]
    print(f"{gsd_m} m: normalised errors {np.sqrt((normalised**2).mean()):.2f}")
    assert 0.7 < (normalised**2).mean() < 1.5
    standard_error = normalised.std(axis=0) / np.sqrt(len(normalised))
    assert (np.abs(normalised.mean(axis=0)) < 4.0 * standard_error).all()


def base(count: int = 9) -> tuple[GroundPoints, list[Scene | str]]:
    rng = np.random.default_rng(7)
    xy = np.array(CORNER_XY) + rng.uniform(1500.0, 6000.0, (count, 2)) * [1.0, -1.0]
    places = np.column_stack([lon_lat_of_xy(UTM, xy), np.full(count, 90.0)])
    names = np.array([f"P{number}" for number in range(count)])
    chips: list[Scene | str] = [chip_at(at, 10.0, 57, rng) for at in xy]
    return GroundPoints(names, places, np.tile(SIGMA_M, (count, 1))), chips


def test_points_have_the_place_and_the_sigmas_of_their_base() -> None:
    ground, chips = base()
    made = produce_points_with_chips(ground, own(ground.id, chips), FRAME)
    assert made.source_id.tolist() == ground.id.tolist()
    np.testing.assert_array_equal(made.points.lon_lat_h, ground.lon_lat_h)
    np.testing.assert_allclose(made.points.covariance_m2, np.tile(np.diag([9.0, 9.0, 25.0]), (9, 1, 1)))
    assert made.points.frames == (FRAME,)


def test_every_point_that_is_left_out_is_counted_by_its_reason() -> None:
    ground, chips = base(15)
    places = ground.lon_lat_h.copy()
    flat, torn = chips[9], chips[10]
    assert isinstance(flat, Scene)
    assert isinstance(torn, Scene)
    chips[8] = "its chip is not in the folder"
    chips[9] = replace(flat, image=ArrayImage(np.full((57, 57), 5.0, np.float32)))
    half = np.array(torn.image.pixels)  # type: ignore[attr-defined]
    half[:, :20] = np.nan
    chips[10] = replace(torn, image=ArrayImage(half))
    places[11, 0] += 0.1
    places[12] = places[3]
    places[13, 2] = np.nan
    names = ground.id.copy()
    names[14] = "Q14"
    made = produce_points_with_chips(replace(ground, lon_lat_h=places), own(names, chips), FRAME)
    assert made.left_out == dict.fromkeys(
        [
            "its chip is not in the folder",
            NOT_SALIENT,
            MISSING,
            NOT_SHOWN,
            SAME_PLACE,
            NO_HEIGHT,
            NO_CHIP,
        ],
        1,
    )
    assert made.source_id.tolist() == [f"P{number}" for number in range(8)]


def test_a_point_keeps_the_chips_that_can_be_used() -> None:
    ground, chips = base()
    again: list[Scene | str] = ["its chip cannot be read" if k < 4 else chips[k] for k in range(9)]
    both = OwnChips(
        np.concatenate([ground.id, ground.id]),
        np.repeat([0, 1], 9),
        (Acquisition("first"), Acquisition("second")),
        [*chips, *again].__getitem__,
    )
    made = produce_points_with_chips(ground, both, FRAME)
    assert np.diff(made.points.views.start).tolist() == [1] * 4 + [2] * 5
    assert made.left_out == {}
    assert made.chips(8).shape == (2, 101, 101)
    assert made.points.views.image[-2:].tolist() == [0, 1]


def test_too_few_chips_are_refused_with_the_reasons() -> None:
    ground, _ = base()
    with pytest.raises(NotEnoughPoints, match="of 9 points: 9 gone"):
        produce_points_with_chips(ground, own(ground.id, ["gone"] * 9), FRAME)


def test_nine_of_ten_chips_fill_the_square_of_a_chip() -> None:
    """Twenty bases of chips of 42 to 80 pixels: the two smallest leave a border, the others none."""
    ground, _ = base(20)
    rng, sides = np.random.default_rng(8), np.random.default_rng(9).permutation(np.arange(42, 82, 2))
    xy = xy_of_lon_lat(UTM, ground.lon_lat_h[:, :2])
    chips: list[Scene | str] = [
        chip_at(at, 10.0, int(side), rng) for at, side in zip(xy, sides, strict=True)
    ]
    made = produce_points_with_chips(ground, own(ground.id, chips), FRAME)
    whole = [bool((made.chips(row) > 0).all()) for row in range(len(made.points))]
    rows = [ground.id.tolist().index(name) for name in made.source_id]
    filled = {int(sides[row]) for row, one in zip(rows, whole, strict=True) if one}
    assert filled >= set(range(46, 82, 2))
    assert 42 not in filled
