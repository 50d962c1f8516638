"""A simulated world: determined by its seed, continuous, with the stated properties."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from amers.services.geodesy import east_north_up
from amers.services.simulation.land import ESTATE_LOT_M, NO_ROOF
from amers.services.simulation.world import World, make_world

a_micrometre = 1e-6


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(np.random.default_rng(8), size_m=800.0, relief_m=50.0)


@pytest.mark.long
def test_the_same_seed_gives_the_same_world(world: World) -> None:
    again = make_world(np.random.default_rng(8), size_m=800.0, relief_m=50.0)
    other = make_world(np.random.default_rng(9), size_m=800.0, relief_m=50.0)
    np.testing.assert_array_equal(again.albedo, world.albedo)
    np.testing.assert_array_equal(again.roof_m, world.roof_m)
    np.testing.assert_array_equal(again.terrain_m, world.terrain_m)
    assert not np.array_equal(other.albedo, world.albedo)


def test_heights_are_those_of_the_nodes_and_bilinear_between(world: World) -> None:
    corners = np.array([[10.0, 20.0], [11.0, 20.0], [10.0, 21.0], [11.0, 21.0]])
    at_nodes = world.height_m(world.lon_lat(corners))
    np.testing.assert_allclose(at_nodes, world.terrain_m[20:22, 10:12].ravel(), atol=a_micrometre)
    middle = world.height_m(world.lon_lat(np.array([[10.5, 20.5]])))
    assert middle[0] == pytest.approx(at_nodes.mean(), abs=a_micrometre)


def test_the_relief_is_the_given_one(world: World) -> None:
    assert np.ptp(world.terrain_m) == pytest.approx(50.0, abs=0.001)
    assert world.height_range_m[0] == pytest.approx(150.0, abs=0.001)


def test_the_world_repeats_beyond_its_border(world: World) -> None:
    rows, columns = world.terrain_m.shape
    rng = np.random.default_rng(1)
    inside = rng.uniform(0.0, columns, (50, 2))
    beyond = inside + [columns, -rows]
    np.testing.assert_allclose(
        world.surface_m(world.lon_lat(beyond)), world.surface_m(world.lon_lat(inside)), atol=1e-4
    )
    seam = np.abs(world.terrain_m[:, 0] - world.terrain_m[:, -1]).max()
    assert seam < 2.0 * np.abs(np.diff(world.terrain_m, axis=1)).max()


def test_grid_positions_survive_a_round_trip_through_longitude_and_latitude(world: World) -> None:
    positions = np.random.default_rng(2).uniform(-100.0, 3000.0, (100, 2))
    back = world.column_row(world.lon_lat(positions))
    np.testing.assert_allclose(back, positions, atol=a_micrometre)


def test_the_posting_is_the_distance_of_nodes_on_the_ground() -> None:
    world = make_world(np.random.default_rng(1), 200.0, 0.5, centre_lon_lat=(-70.0, -33.0))
    centre = np.append(world.centre_lon_lat, 180.0)
    moved = np.append(world.centre_lon_lat + world.step_deg, 180.0)
    offset = east_north_up(moved[None, :], centre)[0]
    np.testing.assert_allclose(offset[:2], 0.5, rtol=1e-4)


def test_roofs_stand_above_their_ground_and_are_flat(world: World) -> None:
    built = world.roof_m > NO_ROOF
    assert 0.005 < built.mean() < 0.4
    assert (world.roof_m - world.terrain_m)[built].min() > 3.0
    both = built[:, 1:] & built[:, :-1]
    steps = np.abs(world.roof_m[:, 1:][both] - world.roof_m[:, :-1][both])
    assert np.mean(steps == 0.0) > 0.97


def test_the_texture_has_details_down_to_the_posting(world: World) -> None:
    spectrum = np.abs(np.fft.fft2(world.albedo - world.albedo.mean())) ** 2
    n = len(world.albedo)
    radius = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    bands = np.geomspace(0.01, 0.4, 8)
    power = [spectrum[(radius >= a) & (radius < b)].mean() for a, b in pairwise(bands)]
    slope = np.polyfit(np.log(np.sqrt(bands[1:] * bands[:-1])), np.log(power), 1)[0]
    assert -3.5 < slope < -1.5


def test_details_of_patterned_land_repeat_nearby() -> None:
    def best_double(patterned_share: float) -> float:
        """Median over small pieces of land of their correlation with the land one lot away."""
        world = make_world(
            np.random.default_rng(8), 1000.0, 1.0, relief_m=1.0, patterned_share=patterned_share
        )
        half, reach, lot = 15, 55, int(ESTATE_LOT_M / 2.0)
        scores = []
        for row, column in np.random.default_rng(1).integers(reach, 1000 - reach, (60, 2)):
            around = world.albedo[row - reach : row + reach + 1, column - reach : column + reach + 1]
            piece = around[reach - half : reach + half + 1, reach - half : reach + half + 1]
            score = cv2.matchTemplate(around, piece, cv2.TM_CCOEFF_NORMED)
            middle = reach - half
            score[
                middle - lot // 2 : middle + lot // 2 + 1, middle - lot // 2 : middle + lot // 2 + 1
            ] = -1
            scores.append(score.max())
        return float(np.median(scores))

    assert best_double(1.0) > best_double(0.0) + 0.1


def test_larger_hills_are_gentler() -> None:
    steep, gentle = (
        make_world(np.random.default_rng(8), 2000.0, 4.0, relief_m=300.0, smallest_hill_m=hill)
        for hill in (300.0, 1200.0)
    )
    assert gentle.steepest_slope < steep.steepest_slope
    assert np.ptp(gentle.terrain_m) == pytest.approx(300.0, abs=0.01)
