"""Features in the geometry of the ground: found again in views that are turned, coarser, or damaged."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ArrayImage
from amers.services.matching.ground_features import FeatureOptions, Features, find_features
from amers.services.matching.tie_points import match_features
from amers.services.registration.turned import turned_scenes
from amers.services.simulation.view import SimulatedView, ViewPlan, simulate_view
from tests.services.simulated import BLOCK_SIGMA_M, block_views, world

COARSE_GSD_M = 1.6
OTHER_ORBIT_DEG = 130.0
a_pixel = 1.0


@cache
def coarse_view() -> SimulatedView:
    """A view of the same ground from another orbit, with larger pixels."""
    lon, lat = (float(value) for value in world().centre_lon_lat)
    plan = ViewPlan(
        "coarse", (lon, lat), (420, 420), COARSE_GSD_M, incidence_deg=8.0, azimuth_deg=OTHER_ORBIT_DEG
    )
    return simulate_view(world(), plan, np.random.default_rng(9), (1.0, -2.0))


def turned(scene: Scene) -> Scene:
    """The same image turned by a quarter: its lines are the samples, from the last to the first."""
    pixels = scene.image.pixels  # type: ignore[attr-defined]
    image = ArrayImage(np.ascontiguousarray(np.rot90(pixels)))
    ways = dict(turned_scenes(replace(scene, image=image)))
    (words,) = (one for one in ways if one.startswith("turned by 90 degrees: its samples"))
    return ways[words]


def matched_errors_px(one: Scene, other: Scene, truth: tuple, gsd_m: float) -> np.ndarray:
    """Distance (k,) across all matches between the true position in the other image and the match.

    `truth` are the true models of both; the height of a detail is that at which its rays come closest,
    so that only the distance across the epipolar line counts.
    """
    features, others = (find_features(scene, gsd_m) for scene in (one, other))
    found = match_features(one, other, features, others, gsd_m=gsd_m)
    mine = features.line_sample[found.rows[:, 0]]
    theirs = others.line_sample[found.rows[:, 1]]
    low = truth[1].project(truth[0].locate(mine, np.full(len(mine), 0.0)))
    high = truth[1].project(truth[0].locate(mine, np.full(len(mine), 400.0)))
    along = (high - low) / np.linalg.norm(high - low, axis=1, keepdims=True)
    offset = theirs - low
    return np.asarray(offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0])


@pytest.mark.long
def test_a_turned_image_has_the_same_features() -> None:
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    gsd_m = scene_gsd_m(scene)
    plain, quarter = find_features(scene, gsd_m), find_features(turned(scene), gsd_m)
    line, sample = quarter.line_sample.T
    back = np.column_stack([sample, scene.image.shape[1] - 1.0 - line])
    distance = np.linalg.norm(plain.line_sample[:, None] - back[None], axis=2)
    nearest = distance.argmin(axis=1)
    same = distance.min(axis=1) < 0.05
    assert same.mean() > 0.95
    alike = (plain.directions() * quarter.directions()[nearest]).sum(axis=1)
    assert np.median(alike[same]) > 0.99


@pytest.mark.long
def test_views_of_other_orbits_and_pixel_sizes_share_details() -> None:
    one, other = block_views()[0], coarse_view()
    truth = one.geometry.true_model, other.geometry.true_model
    error_px = matched_errors_px(
        one.as_scene(BLOCK_SIGMA_M), other.as_scene(BLOCK_SIGMA_M), truth, COARSE_GSD_M
    )
    assert len(error_px) > 100
    assert np.mean(np.abs(error_px) < a_pixel) > 0.9


@pytest.mark.thorough
def test_memory_is_that_of_a_part_and_parts_leave_no_gap() -> None:
    """Parts of a third of the image find as many features everywhere as one part that holds it all."""
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    gsd_m = scene_gsd_m(scene)
    options = FeatureOptions(per_image=50_000, per_megapixel=50_000)
    whole = find_features(scene, gsd_m, options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("amers.services.matching.ground_features._LARGEST_PX", 260)
        parts = find_features(scene, gsd_m, options)
    cells = np.arange(0, 701, 70)
    count, of_parts = (
        np.histogram2d(*found.line_sample.T, bins=(cells, cells))[0] for found in (whole, parts)
    )
    # Each part stretches its own contrast and has its own pixels, so that weak features differ.
    full = count > 40
    assert full.mean() > 0.8
    assert 0.6 < (of_parts[full] / count[full]).min() <= (of_parts[full] / count[full]).max() < 1.6
    assert len(np.unique(np.round(parts.line_sample, 1), axis=0)) > 0.99 * len(parts)


def test_no_feature_touches_what_is_lost() -> None:
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    pixels = np.array(scene.image.pixels)  # type: ignore[attr-defined]
    pixels[200:330, 150:400] = np.nan
    pixels[500:520, 500:520] = np.inf
    found: Features = find_features(replace(scene, image=ArrayImage(pixels)), scene_gsd_m(scene))
    line, sample = found.line_sample.T
    assert len(found) > 500
    assert not ((line > 198) & (line < 331) & (sample > 148) & (sample < 401)).any()
    assert not ((line > 498) & (line < 521) & (sample > 498) & (sample < 521)).any()


def test_an_image_without_pixels_has_no_features() -> None:
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    empty = replace(scene, image=ArrayImage(np.full(scene.image.shape, np.nan, dtype=np.float32)))
    assert len(find_features(empty, scene_gsd_m(scene))) == 0


@pytest.mark.parametrize("lost", [np.nan, np.inf])
@pytest.mark.long
def test_no_feature_lies_within_four_pixels_of_an_area_without_data(lost: float) -> None:
    """The edge of such an area is a strong detail that no other image shows."""
    view = block_views()[0].as_scene(BLOCK_SIGMA_M)
    pixels = view.image.pixels.copy()  # type: ignore[attr-defined]
    centre, radius = np.array([330.0, 350.0]), 120.0
    away = np.hypot(*(np.indices(pixels.shape).transpose(1, 2, 0) - centre).transpose(2, 0, 1)) - radius
    pixels[away < 0.0] = lost
    holed = find_features(replace(view, image=ArrayImage(pixels)), scene_gsd_m(view))
    distance = np.hypot(*(holed.line_sample - centre).T) - radius
    assert (distance < 30.0).sum() > 20
    assert distance.min() > 3.0


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_a_small_image_gives_no_more_features_than_its_pixels_allow(ratio: float) -> None:
    """So many for a million pixels of the image, at whatever sampling they are found; most are found."""
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    allowed = 2_000 * np.prod(scene.image.shape) / 1e6
    options = FeatureOptions(per_megapixel=2_000, largest_px=50.0)
    found = find_features(scene, ratio * scene_gsd_m(scene), options)
    assert 0.6 * allowed < len(found) < 1.2 * allowed
