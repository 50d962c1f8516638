"""Planimetry of a block at sites with ortho-images: the errors put in are found."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.matching.reference_image import Reference
from amers.services.production.ortho_production import (
    GroundHeights,
    OrthoPointOptions,
    produce_ortho_points,
)
from amers.services.quality.planimetry import planimetric_quality
from amers.services.quality.site_errors import Site, expected_reach_m, point_errors
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array, ControlPoints, Frame
from tests.services.simulated import MemoryChips
from tests.services.textures import as_pixels, moved, texture

GSD_M = 2.0
SIDE = 2400
CORNER_XY = (400_000.0, 5_800_000.0)
POINT_SIGMA_M = 0.8
MATCH_SIGMA_M = 0.1
a_tenth_of_a_metre = 0.1
a_centimetre = 0.01


@cache
def land() -> Array:
    return texture(np.random.default_rng(4), SIDE, 1.5)


def map_of(first: tuple[int, int], shape: tuple[int, int]) -> OrthoModel:
    """The map of a part of the land, by its first pixel and its shape."""
    line, sample = first
    origin_xy = np.array(CORNER_XY) + [sample * GSD_M, (SIDE - line) * GSD_M]
    return OrthoModel(MapGrid("EPSG:32633", origin_xy, np.array([[0.0, GSD_M], [-GSD_M, 0.0]]), shape))


@cache
def block() -> tuple[ControlPoints, MemoryChips]:
    """Points of the land where they truly are, with chips of 2 and 8 m."""
    taken = Acquisition("land", incidence_deg=0.0, azimuth_deg=0.0)
    scene = Scene(ArrayImage(as_pixels(land())), map_of((0, 0), (SIDE, SIDE)), taken, 2.0)
    made = produce_ortho_points(
        [scene], GroundHeights(None, 120.0, 2.0), OrthoPointOptions(points=400, fine_gsd_m=2.0)
    )
    chips = np.concatenate([made.chips(row) for row in range(len(made.points))])
    sigma_m2 = np.diag([POINT_SIGMA_M**2, POINT_SIGMA_M**2, 4.0])
    covariance = np.tile(sigma_m2, (len(made.points), 1, 1))
    frame = Frame.from_sigmas(3.0, 3.0)
    return replace(made.points, covariance_m2=covariance, frames=(frame,)), MemoryChips(chips)


def misplaced(points: ControlPoints, error_m: Array) -> ControlPoints:
    """Points that state a place off the detail that their chips show."""
    step = np.column_stack([np.broadcast_to(error_m, (len(points), 2)), np.zeros(len(points))])
    return replace(points, lon_lat_h=move_metres(points.lon_lat_h, step))


def site(
    name: str,
    first: tuple[int, int],
    shape: tuple[int, int],
    *,
    is_control: bool = False,
    displaced_px: tuple[float, float] = (0.0, 0.0),
) -> Site:
    """An ortho-image of a part of the land; displaced, it shows the land that far down and right."""
    pixels = moved(land(), *displaced_px) if any(displaced_px) else land()
    part = pixels[first[0] : first[0] + shape[0], first[1] : first[1] + shape[1]]
    noise = np.random.default_rng(8).normal(0.0, 0.05, part.shape)
    image = ArrayImage(as_pixels(part + noise))
    local_m = MATCH_SIGMA_M
    return Site(
        name,
        is_control,
        Reference(image, map_of(first, shape), None, local_m, 0.0, Frame.from_sigmas(0.5, 0.5)),
    )


WEST, EAST = ((0, 0), (SIDE, 1100)), ((0, 1300), (SIDE, 1100))


@pytest.mark.long
def test_the_errors_of_the_points_are_found_at_a_site() -> None:
    points, chips = block()
    rng = np.random.default_rng(5)
    error_m = rng.normal(0.0, POINT_SIGMA_M, (len(points), 2)) + [2.0, -1.5]
    wrong = misplaced(points, error_m)
    errors = point_errors(wrong, chips, site("west", *WEST))
    assert errors.tried > 100
    assert len(errors.error_m) > 0.9 * errors.tried
    # Points are found again by where they say they are.
    row = [
        int(np.argmin(np.abs(wrong.lon_lat_h[:, :2] - place).sum(axis=1))) for place in errors.lon_lat
    ]
    assert np.abs(errors.error_m - error_m[row]).max() < a_tenth_of_a_metre
    quality = planimetric_quality([errors], "points", points.frames[0])
    (together,) = quality.groups
    true = np.quantile(np.hypot(*(rng.normal(0.0, POINT_SIGMA_M, (2, 500_000)) + [[2.0], [-1.5]])), 0.9)
    assert together.accuracy.ce90_m.lower < true < together.accuracy.ce90_m.upper
    assert_allclose(together.accuracy.bias_m, [2.0, -1.5], atol=2 * a_tenth_of_a_metre)
    assert quality.normalised.lower < quality.normalised.mean_square < quality.normalised.upper
    assert_allclose(quality.typical_ratio, 1.0, atol=0.1)
    # The shift of 2.5 m is what a frame of 3 m and an ortho-image of 0.5 m let expect.
    expected = (2.0**2 + 1.5**2) / (3.0**2 + 0.5**2) / 2.0
    assert_allclose(quality.normalised_frame.mean_square, expected, rtol=0.2)


@pytest.mark.long
def test_check_only_sites_are_told_apart_from_control_sites() -> None:
    points, chips = block()
    sites = [site("west", *WEST, is_control=True), site("east", *EAST, displaced_px=(-3.0, 2.0))]
    errors = [point_errors(points, chips, one) for one in sites]
    quality = planimetric_quality(errors, "points", points.frames[0])
    together, check_only, control = quality.groups
    assert [g.name for g in quality.groups] == ["all sites", "check-only sites", "control sites"]
    assert (together.sites, check_only.sites, control.sites) == (2, 1, 1)
    # The eastern ortho-image shows everything 3 lines farther up and 2 samples farther right.
    pixels_per_metre = map_of((0, 0), (SIDE, SIDE)).project_derivative(points.lon_lat_h[:1])[0, :, :2]
    expected_m = np.linalg.solve(pixels_per_metre, [3.0, -2.0])
    assert_allclose(check_only.accuracy.bias_m, expected_m, atol=a_centimetre)
    assert_allclose(control.accuracy.bias_m, [0.0, 0.0], atol=a_centimetre)
    assert_allclose(check_only.accuracy.ce90_m.value, np.hypot(4.0, 6.0), atol=a_centimetre)
    assert np.isnan(together.accuracy.ce90_m.upper)  # two sites bound nothing
    assert "share errors" in together.accuracy.ce90_m.note


@pytest.mark.long
def test_what_an_ortho_image_states_of_its_details_is_in_the_errors_found_on_it() -> None:
    points, chips = block()
    sharp = site("corner", (0, 0), (700, 700))
    blunt = replace(sharp, reference=replace(sharp.reference, sigma_m=0.6))
    first, second = (point_errors(points, chips, one) for one in (sharp, blunt))
    assert len(first.error_m) > 5
    added_m2 = (0.6**2 - MATCH_SIGMA_M**2) * np.eye(2)
    assert_allclose(second.covariance_m2, first.covariance_m2 + added_m2, atol=1e-9)


@pytest.mark.long
def test_what_a_measure_states_is_in_metres_and_covers_its_scatter() -> None:
    """Exact points on an exact ortho-image: the measures alone err, of pixels of 2 m."""
    points, chips = block()
    exact = replace(points, covariance_m2=np.zeros_like(points.covariance_m2))
    here = site("west", *WEST)
    sharp = replace(here, reference=replace(here.reference, sigma_m=0.0))
    errors = point_errors(exact, chips, sharp)
    square = np.mean(errors.error_m**2 / np.diagonal(errors.covariance_m2, 0, 1, 2))
    assert 0.06 < square < 0.3


@pytest.mark.long
def test_a_shift_beyond_the_near_search_is_found_when_the_frame_lets_expect_it() -> None:
    points, chips = block()
    far = Frame.from_sigmas(40.0, 40.0)
    shifted = replace(misplaced(points, np.array([70.0, -55.0])), frames=(far,))
    here = site("west", *WEST)
    assert expected_reach_m(shifted, here) > 120.0
    errors = point_errors(shifted, chips, here)
    assert len(errors.error_m) > 0.9 * errors.tried
    assert_allclose(np.median(errors.error_m, axis=0), [70.0, -55.0], atol=a_tenth_of_a_metre)


@pytest.mark.long
def test_other_ground_gives_no_error_but_the_reasons() -> None:
    points, chips = block()
    here = site("west", *WEST)
    other = ArrayImage(as_pixels(texture(np.random.default_rng(99), SIDE, 1.5)[:, :1100]))
    wrong = replace(here, reference=replace(here.reference, image=other))
    errors = point_errors(points, chips, wrong)
    assert len(errors.error_m) < 0.03 * errors.tried
    assert sum(count for _, count in errors.reasons) + len(errors.error_m) == errors.tried
    quality = planimetric_quality(
        [
            replace(
                errors,
                error_m=errors.error_m[:0],
                lon_lat=errors.lon_lat[:0],
                covariance_m2=errors.covariance_m2[:0],
            )
        ],
        "points",
        points.frames[0],
    )
    assert np.isnan(quality.groups[0].accuracy.ce90_m.value)
    elsewhere = replace(here.reference, model=map_of((90_000, 0), (SIDE, 1100)))
    assert point_errors(points, chips, replace(here, reference=elsewhere)).tried == 0
