"""What an elevation model tells of points, and how well, on ground whose slope is known."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.production.height_control import ControlHeights, known_heights, ortho_heights
from amers.services.sensors.ortho import OrthoModel
from amers.services.terrain import Terrain
from amers.services.types import Acquisition, Array, Frame, Observations, SurfaceHeights

POSTING_M, SIDE = 10.0, 400
DEM_SIGMA_M, SURFACE_SIGMA_M = 0.5, 0.3
DEM_FRAME_M, PLACE_M = (3.0, 1.0), 4.0
OFF_M = 5.0
"""Of the places of points and model together: 4 m and 3 m."""
ABOVE_M = 2.5
a_millimetre = 1e-3
a_percent = 0.01

GRID = MapGrid(
    "EPSG:32631", np.array([7e5, 4.8e6]), np.array([[0.0, POSTING_M], [-POSTING_M, 0.0]]), (SIDE, SIDE)
)


def ground(west: float, east: float) -> ControlHeights:
    """Ground that rises eastwards by some metres a metre, in its western and its eastern half."""
    along_m = (np.arange(SIDE) - SIDE / 2.0) * POSTING_M
    heights = 500.0 + np.where(along_m < 0.0, west, east) * along_m
    pixels = np.tile(heights, (SIDE, 1)).astype(np.float32)
    frame = Frame.from_sigmas(*DEM_FRAME_M)
    return ControlHeights("dem", Terrain(GRID, ArrayImage(pixels), sigmas=DEM_SIGMA_M), frame)


def places() -> Array:
    """Forty places in each half of the ground, away from its borders and from the edge between both."""
    sample = np.concatenate([np.linspace(40.0, 160.0, 40), np.linspace(240.0, 360.0, 40)])
    line = np.tile(np.linspace(60.0, 340.0, 40), 2)
    return np.column_stack([GRID.lon_lat(np.column_stack([line, sample])), np.zeros(80)])


def surfaces(count: int) -> SurfaceHeights:
    return SurfaceHeights(np.full(count, ABOVE_M), np.full(count, SURFACE_SIGMA_M))


def test_a_point_lies_as_far_below_the_model_as_the_surface_lies_above_the_point() -> None:
    heights = ground(0.0, 0.1)
    known = known_heights(places(), surfaces(80), PLACE_M, heights)
    expected = heights.terrain.height_m(known.lon_lat_h[:, :2]) - ABOVE_M
    np.testing.assert_allclose(known.lon_lat_h[:, 2], expected, atol=0.05)
    assert not known.known[:, :2].any()
    assert known.known[:, 2].all()


@pytest.mark.parametrize(
    ("west", "east", "shared", "own"),
    [(0.0, 0.0, 0.0, 0.0), (0.2, 0.2, 0.2, 0.0), (0.2, -0.2, 0.0, 0.2), (0.3, 0.1, 0.2, 0.1)],
)
def test_the_mean_slope_errs_together_and_what_differs_from_it_apart(
    west: float, east: float, shared: float, own: float
) -> None:
    """A model that lies off moves all heights of a slope alike, and those of two slopes apart."""
    known = known_heights(places(), surfaces(80), PLACE_M, ground(west, east))
    own_m2 = DEM_SIGMA_M**2 + SURFACE_SIGMA_M**2 + (own * OFF_M) ** 2
    np.testing.assert_allclose(known.covariance_m2[:, 2, 2], own_m2, rtol=5 * a_percent)
    frame_m2 = known.frames[0].covariance_m2[2, 2]
    assert frame_m2 == pytest.approx(DEM_FRAME_M[1] ** 2 + (shared * OFF_M) ** 2, rel=5 * a_percent)


def test_steep_ground_gives_no_heights() -> None:
    known = known_heights(places(), surfaces(80), PLACE_M, ground(0.1, 0.6))
    np.testing.assert_array_equal(known.point, np.arange(40))
    with pytest.raises(NotEnoughPoints, match="0 of them on ground that is not steep"):
        known_heights(places(), surfaces(80), PLACE_M, ground(0.6, 0.6))


def test_three_points_on_smooth_ground_are_enough_and_two_are_not() -> None:
    three = known_heights(places()[:3], surfaces(3), PLACE_M, ground(0.0, 0.0))
    assert len(three) == 3
    with pytest.raises(NotEnoughPoints):
        known_heights(places()[:2], surfaces(2), PLACE_M, ground(0.0, 0.0))


def test_heights_of_ortho_images_err_with_the_slope_where_image_and_model_lie_off() -> None:
    blank = ArrayImage(np.zeros((SIDE, SIDE), dtype=np.float32))
    scene = Scene(blank, OrthoModel(GRID), Acquisition("ortho"), PLACE_M)
    line_sample = GRID.line_sample(places()[:, :2])
    count = len(line_sample)
    seen = Observations(
        np.repeat(np.arange(count), 2),
        np.tile([0, 1], count),
        np.repeat(line_sample, 2, axis=0),
        np.full(2 * count, 0.3),
    )
    known = ortho_heights([scene, replace(scene, sigma_m=50.0)], seen, ground(0.0, 0.3))
    expected_m2 = DEM_SIGMA_M**2 + np.repeat([0.0, 0.3 * OFF_M], 40) ** 2
    np.testing.assert_allclose(known.covariance_m2[:, 2, 2], expected_m2, rtol=5 * a_percent)
    np.testing.assert_allclose(
        known.lon_lat_h[:, 2], ground(0.0, 0.3).terrain.height_m(places()), atol=a_millimetre
    )


def test_ground_that_is_no_plane_is_as_uncertain_as_it_deviates_from_one() -> None:
    """Waves of 60 m, seen over the square within which a point may lie: two sigmas to each side."""
    posting_m, amplitude_m, length_m = 2.5, 0.9, 60.0
    grid = replace(GRID, step_xy=np.array([[0.0, posting_m], [-posting_m, 0.0]]))
    along_m = np.arange(SIDE) * posting_m
    wave_m = 500.0 + amplitude_m * np.sin(2.0 * np.pi * along_m / length_m)
    pixels = np.tile(wave_m, (SIDE, 1)).astype(np.float32)
    terrain = Terrain(grid, ArrayImage(pixels), sigmas=DEM_SIGMA_M)
    heights = ControlHeights("dem", terrain, Frame.from_sigmas(*DEM_FRAME_M))
    sample = np.linspace(100.0, 300.0, 57)
    lon_lat = grid.lon_lat(np.column_stack([np.full(57, 200.0), sample]))
    points = np.column_stack([lon_lat, np.zeros(57)])
    known = known_heights(points, surfaces(57), PLACE_M, heights)
    assert len(known.point) == 57
    x_m = np.random.default_rng(3).uniform(-2.0 * OFF_M, 2.0 * OFF_M, (57, 2000))
    at_m = sample[:, None] * posting_m + x_m
    deviation_m, slope = np.empty(57), np.empty(57)
    for row in range(57):
        wave = amplitude_m * np.sin(2.0 * np.pi * at_m[row] / length_m)
        line = np.polyfit(x_m[row], wave, 1)
        deviation_m[row], slope[row] = (wave - np.polyval(line, x_m[row])).std(), line[0]
    known_m2 = DEM_SIGMA_M**2 + SURFACE_SIGMA_M**2 + ((slope - slope.mean()) * OFF_M) ** 2
    rough_m2 = known.covariance_m2[:, 2, 2] - known_m2
    crests = np.abs(slope) < 0.02
    assert crests.sum() > 5
    ratio = np.sqrt(np.median(rough_m2[crests]) / np.median(deviation_m[crests] ** 2))
    # The border of the square counts more than its middle.
    assert 0.8 < ratio < 1.6


def test_the_most_precise_of_many_heights_take_part() -> None:
    """Four hundred of 480: those whose surfaces the images show best."""
    points = np.tile(places(), (6, 1))
    sigma_m = np.random.default_rng(9).permutation(np.linspace(0.1, 2.0, len(points)))
    above = SurfaceHeights(np.full(len(points), ABOVE_M), sigma_m)
    known = known_heights(points, above, PLACE_M, ground(0.0, 0.0))
    np.testing.assert_array_equal(known.point, np.flatnonzero(sigma_m <= np.sort(sigma_m)[399]))


def test_the_roughness_of_noisy_ground_is_that_of_its_noise() -> None:
    """The square around a point has a node at each of its 49 places; three of them make the plane."""
    noise_m, count = 0.8, 400
    posting_m = 2.0 * OFF_M / 3.0
    grid = replace(
        GRID,
        origin_xy=np.array([499_500.0, 100_000.0]),
        step_xy=np.array([[0.0, posting_m], [-posting_m, 0.0]]),
    )
    pixels = np.random.default_rng(4).normal(500.0, noise_m, (SIDE, SIDE)).astype(np.float32)
    sigma_m = 3.0
    terrain = Terrain(grid, ArrayImage(pixels), sigmas=sigma_m)
    axis = np.linspace(10, SIDE - 11, 20).round()
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid.lon_lat(nodes), np.zeros(count)])
    taken = ControlHeights("dem", terrain, Frame.from_sigmas(*DEM_FRAME_M))
    above = SurfaceHeights(np.full(count, ABOVE_M), np.linspace(0.1, 0.101, count))
    known = known_heights(points, above, PLACE_M, taken)
    own_m2 = known.covariance_m2[:, 2, 2] - sigma_m**2 - above.sigma_m[known.point] ** 2
    # The slopes of 49 heights have a variance of 1 / (196 postings^2) of theirs on both axes.
    of_slopes = 2.0 * OFF_M**2 / (196.0 * posting_m**2)
    assert own_m2.mean() == pytest.approx(noise_m**2 * (1.0 + of_slopes), rel=0.03)
