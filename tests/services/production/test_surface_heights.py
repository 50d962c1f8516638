"""Heights of the surface at produced points are as far from the truth as their sigmas state."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from scipy.ndimage import map_coordinates

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window, render_chip
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.production.point_surfaces import NOT_ASKED, surfaces_at
from amers.services.production.tie_points import find_tie_points
from amers.services.simulation.view import SimulatedView, ViewPlan, simulate_view
from amers.services.simulation.world import World, make_world
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.tasks import Work
from amers.services.types import Array, no_progress
from tests.services.simulated import (
    BLOCK_SIGMA_M,
    OPTIONS,
    block_views,
    production,
    truth_of,
    views_of,
    world,
)

pytestmark = [pytest.mark.long, pytest.mark.thorough]

honest = (0.7, 1.5)
"""Mean square of errors over their sigmas."""
cautious = 0.3
"""The same where sigmas are those of real images, and simulated ones are less noisy."""
five_sigma = 5.0
interval90 = 1.6449
chips_m = (0.5, 2.0)
TRIPLET = ProductionOptions(fine_gsd_m=chips_m[0], coarse_gsd_m=chips_m[1])
dsm_sigma_m = 0.3
"""Of the noise of the elevation model. Its roughness over 2.5 m is 0.1 m; the scatter of tie points
against it, without their own noise, is 0.5 m at most."""


@dataclass(frozen=True)
class Surfaces:
    """Heights of the surface as produced, and what they should be, above the points."""

    stated_m: Array
    sigma_m: Array
    true_m: Array
    sigma_up_m: Array

    def mean_square(self) -> float:
        return float(np.mean(((self.stated_m - self.true_m) / self.sigma_m) ** 2))


def nmad(values: Array) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def simulated_surfaces(ground: World, views: Sequence[SimulatedView], made: Production) -> Surfaces:
    """The true surface at the true places of the details that the adjusted models project points to.

    The block differs from the truth by a translation.
    """
    points, true = made.points, truth_of(made, views).lon_lat_h
    above = ground.surface_m(true[:, :2]) - true[:, 2]
    assert points.surface is not None
    stated = points.surface.height_m - points.lon_lat_h[:, 2]
    known = np.isfinite(stated) & np.isfinite(above)
    return Surfaces(
        stated[known],
        points.surface.sigma_m[known],
        above[known],
        np.sqrt(points.covariance_m2[known, 2, 2]),
    )


def surfaces_of(seed: int, views: int) -> Surfaces:
    """Many points of a world that no other test uses."""
    ground = world(seed)
    seen = views_of(ground, np.random.default_rng(seed + 1), views)
    made = produce_points(
        [view.as_scene(BLOCK_SIGMA_M) for view in seen], replace(OPTIONS, points=150, surface_pairs=10)
    )
    return simulated_surfaces(ground, seen, made)


def test_simulated_surfaces_are_true_and_so_are_their_sigmas() -> None:
    for found in (surfaces_of(61, 3), surfaces_of(51, 3), surfaces_of(31, 2)):
        error_m = found.stated_m - found.true_m
        held = float((np.abs(error_m) < interval90 * found.sigma_m).mean())
        print(
            f"{len(error_m)} points: heights of chips {nmad(found.true_m):.2f} m from the surface, "
            f"stated surface {nmad(error_m):.2f} m, 90 % intervals hold {held:.2f}, largest "
            f"{np.abs(error_m / found.sigma_m).max():.1f}"
        )
        assert len(error_m) > 60
        assert nmad(error_m) < 0.15 * nmad(found.true_m)
        assert abs(np.median(error_m)) < 0.15
        # What a whole chip shows is no statement of the surface at its centre.
        assert np.mean((found.true_m / found.sigma_up_m) ** 2) > 2.0 * honest[1]
        assert held > 0.85
        assert np.abs(error_m / found.sigma_m).max() < five_sigma


@pytest.mark.endurance
@pytest.mark.monte_carlo
def test_surfaces_of_bent_blocks_are_as_far_from_the_truth_as_stated() -> None:
    """Images of 2.5 m with drifts of 0.6 px at the edges and jitter; without the block's translation."""
    squares = []
    for seed in range(1, 5):
        ground, views = bent_pair(seed)
        options = ProductionOptions(fine_gsd_m=2.5, coarse_gsd_m=10.0, points=150)
        made = produce_points([view.as_scene(5.0) for view in views], options)
        points, surface = made.points, made.points.surface
        assert surface is not None
        true = truth_of(made, views).lon_lat_h
        shift = (points.lon_lat_h - true).mean(axis=0)
        error_m = surface.height_m - ground.surface_m((points.lon_lat_h - shift)[:, :2]) - shift[2]
        known = np.isfinite(error_m)
        assert known.sum() > 60
        squares.append(float(np.mean((error_m[known] / surface.sigma_m[known]) ** 2)))
        print(f"block {seed}: mean square {squares[-1]:.2f}")
    print(f"all: {np.mean(squares):.2f}")
    assert cautious < np.mean(squares) < honest[1]


def bent_pair(seed: int) -> tuple[World, list[SimulatedView]]:
    """Two images of 2.2 km from two sides, each with drifts and jitter of its own."""
    rng = np.random.default_rng(seed)
    ground = make_world(np.random.default_rng(seed + 100), size_m=3000.0, posting_m=2.0)
    lon, lat = (float(value) for value in ground.centre_lon_lat)
    turn_deg, views = rng.uniform(0.0, 360.0), []
    for k in range(2):
        incidence_deg = float(25.0 * rng.uniform(0.3, 1.0))
        azimuth_deg = float((turn_deg + 180.0 * (k + rng.uniform(-0.2, 0.2))) % 360.0)
        side = (900, 900)
        plan = ViewPlan(f"view_{k}", (lon, lat), side, 2.5, incidence_deg, azimuth_deg, jitter_px=0.2)
        drift_px = np.column_stack([np.zeros(2), rng.normal(0.0, 0.6, (2, 2))])
        views.append(simulate_view(ground, plan, rng, (2.0, -2.0), drift_px))
    return ground, views


def test_no_surface_is_stated_without_a_pair_or_where_none_is_asked_for() -> None:
    places = production().points.lon_lat_h[:3]
    scenes = [view.as_scene(BLOCK_SIGMA_M) for view in block_views()]
    for shown, pairs in ((scenes[:1], 10), (scenes, 0)):
        found, why = surfaces_at(shown, places, pairs, work=Work(), progress=no_progress)
        assert np.isnan(found.height_m).all()
        assert np.isnan(found.sigma_m).all()
        reason = NOT_ASKED if pairs == 0 else REASON_LABELS[Reason.OUTSIDE]
        assert why == {reason: len(places)}


def test_points_far_apart_have_the_same_surface_as_those_of_a_whole() -> None:
    """Between them nothing is matched; towers would reach beyond the heights of the models."""
    made = production()
    delivered = [view.as_scene(BLOCK_SIGMA_M) for view in block_views()]
    pairs = zip(delivered, made.adjustment.models, strict=True)
    scenes = [replace(scene, model=model) for scene, model in pairs]
    places = made.points.lon_lat_h
    assert made.points.surface is not None
    known = np.flatnonzero(np.isfinite(made.points.surface.height_m))
    assert len(known) > 0.9 * len(places)
    rows = known[[places[known, axis].argmin() for axis in (0, 1)] + [places[known, 0].argmax()]]
    alone, _ = surfaces_at(scenes, places[rows], 10, work=Work(), progress=no_progress)
    off_m = alone.height_m - made.points.surface.height_m[rows]
    assert (np.abs(off_m) < np.maximum(1.0, 2.0 * alone.sigma_m)).all()
    of_models_m2, common = np.array([1.0, 4.0, 9.0]), {"work": Work(), "progress": no_progress}
    with_models, _ = surfaces_at(scenes, places[rows], 10, of_models_m2=of_models_m2, **common)
    np.testing.assert_allclose(with_models.sigma_m**2, alone.sigma_m**2 + of_models_m2)


def read_triplet(folder: Path, names: Sequence[str]) -> list[Scene]:
    scenes = []
    for name in names:
        scene = read_scene(folder / f"{name}.tif")
        pixels = scene.image.read(Window(0, 0, *scene.image.shape))
        scene.image.close()  # type: ignore[attr-defined]
        scenes.append(replace(scene, image=ArrayImage(pixels)))
    return scenes


@pytest.fixture(scope="module")
def triplet(real_data: Path) -> tuple[list[Scene], Production, Work]:
    scenes = read_triplet(real_data / "phr_calanques_triplet", ("img_01", "img_02", "img_03"))
    work = Work()
    return scenes, produce_points(scenes, TRIPLET, work=work), work


@dataclass(frozen=True)
class ElevationModel:
    """Heights of a raster on a map, bilinear; NaN beside missing ones."""

    heights: Array
    transform: rasterio.Affine
    to_map: Transformer

    def at(self, lon_lat_h: Array, east: float = 0.0, north: float = 0.0) -> Array:
        shift = np.tile([east, north, 0.0], (len(lon_lat_h), 1))
        moved = move_metres(lon_lat_h, shift)
        x, y = self.to_map.transform(moved[:, 0], moved[:, 1])
        inverse = ~self.transform
        column = inverse.a * x + inverse.b * y + inverse.c
        row = inverse.d * x + inverse.e * y + inverse.f
        return map_coordinates(
            self.heights, [row - 0.5, column - 0.5], order=1, mode="constant", cval=np.nan
        )

    def translation(self, lon_lat_h: Array, height_m: Array) -> Array:
        """East, north, up (3,) from points to the raster: its frame is another one. Robust."""
        shift = np.zeros(3)
        for _ in range(6):
            slope = [
                (self.at(lon_lat_h, *(shift[:2] + step)) - self.at(lon_lat_h, *(shift[:2] - step))) / 2.0
                for step in np.eye(2)
            ]
            above = height_m - self.at(lon_lat_h, shift[0], shift[1])
            equations = np.column_stack([*slope, np.ones(len(above))])
            usable = np.isfinite(above + equations.sum(axis=1)) & (np.hypot(*slope) < 1.5)
            equations, above = equations[usable], above[usable]
            weight = np.ones(len(above))
            for _ in range(20):
                solved = np.linalg.lstsq(equations * weight[:, None], above * weight)[0]
                residual = above - equations @ solved
                weight = 1.0 / np.sqrt(1.0 + (residual / (2.0 * nmad(residual))) ** 2)
            shift = np.array([shift[0] + solved[0], shift[1] + solved[1], solved[2]])
        return shift


@pytest.mark.endurance
@pytest.mark.real_data
def test_real_surfaces_agree_with_an_elevation_model_as_stated(triplet, real_data: Path) -> None:
    with rasterio.open(real_data / "phr_calanques_triplet" / "expected_output" / "dsm.tif") as raster:
        model = ElevationModel(
            raster.read(1, masked=True).astype(np.float64).filled(np.nan),
            raster.transform,
            Transformer.from_crs(4326, 32631, always_xy=True),
        )
    scenes, made, work = triplet
    points = made.points
    assert points.surface is not None
    stated, sigma_m = points.surface.height_m, points.surface.sigma_m
    # Some thirty heights tell where the raster lies to a metre; thousands of ties, to a decimetre.
    ties = find_tie_points(scenes, [], FeatureOptions(), work, no_progress)
    tied = intersect(made.adjustment.models, ties, int(ties.point[-1]) + 1).lon_lat_h
    tied = tied[np.isfinite(tied[:, 0])]
    east, north, up = model.translation(tied, tied[:, 2])
    reference = model.at(points.lon_lat_h, east, north) + up
    slope = np.hypot(
        (model.at(points.lon_lat_h, east + 2.0, north) - model.at(points.lon_lat_h, east - 2.0, north)),
        (model.at(points.lon_lat_h, east, north + 2.0) - model.at(points.lon_lat_h, east, north - 2.0)),
    )
    slope_deg = np.degrees(np.arctan(slope / 4.0))
    known = np.isfinite(stated + reference)
    normalised = (stated - reference) / np.hypot(sigma_m, dsm_sigma_m)
    chips = points.lon_lat_h[:, 2] - reference
    for low, high in ((0.0, 15.0), (15.0, 30.0), (30.0, 90.0)):
        rows = known & (slope_deg >= low) & (slope_deg < high)
        print(
            f"slope {low:g}-{high:g} deg: {rows.sum()} points, chips {nmad(chips[rows]):.2f} m, surface "
            f"{nmad((stated - reference)[rows]):.2f} m, sigma {np.median(sigma_m[rows]):.2f} m, "
            f"mean square {np.mean(normalised[rows] ** 2):.2f}, robust {nmad(normalised[rows]) ** 2:.2f}"
        )
    mean_square = float(np.mean(normalised[known] ** 2))
    print(
        f"{known.sum()} points, raster {east:.2f} east, {north:.2f} north: chips "
        f"{nmad(chips[known]):.2f} m, surface {nmad((stated - reference)[known]):.2f} m, mean square "
        f"{mean_square:.2f}, robust {nmad(normalised[known]) ** 2:.2f}"
    )
    assert known.sum() > 60
    assert nmad((stated - reference)[known]) < 0.5 * nmad(chips[known])
    # S2P matched the same images: it shares errors of theirs with the points.
    assert mean_square < honest[1]


TOWN_DATES = ("001", "003", "016", "018", "019")


@pytest.mark.real_data
def test_surfaces_of_points_in_a_town_agree_with_lidar_as_stated(real_data: Path) -> None:
    """The horizontal place of the lidar is found to a cell, its vertical datum is not known."""
    folder = real_data / "wv3_jacksonville"
    scenes = [replace(read_scene(folder / f"jax_{date}.tif"), sigma_m=5.0) for date in TOWN_DATES]
    points = produce_points(scenes, TRIPLET).points
    with rasterio.open(folder / "lidar_west.tif") as raster:
        lidar = ElevationModel(
            raster.read(1, masked=True).astype(np.float64).filled(np.nan),
            raster.transform,
            Transformer.from_crs(4326, raster.crs, always_xy=True),
        )
    assert points.surface is not None
    stated, sigma_m = points.surface.height_m, points.surface.sigma_m

    def errors(height_m: Array, east: float, north: float) -> Array:
        above = height_m - lidar.at(points.lon_lat_h, east, north)
        return above - np.nanmedian(above)

    shifts = [(e, n) for e in np.arange(-3.0, 3.1, 0.5) for n in np.arange(-3.0, 3.1, 0.5)]
    shift = min(shifts, key=lambda at: np.nanmean(np.minimum(np.abs(errors(stated, *at)), 2.0)))
    error_m, chips_off_m = errors(stated, *shift), errors(points.lon_lat_h[:, 2], *shift)
    seen = np.isfinite(lidar.at(points.lon_lat_h, *shift))
    known = np.isfinite(error_m)
    held = float((np.abs(error_m) < interval90 * sigma_m)[known].mean())
    certain = known & (sigma_m <= np.quantile(sigma_m[known], 0.85))
    within = float((np.abs(error_m[known]) < 1.0).mean())
    le90_m = float(np.quantile(np.abs(error_m[certain]), 0.9))
    print(
        f"{known.sum()} of {seen.sum()} points, lidar {shift[0]}, {shift[1]} m off: chips "
        f"{nmad(chips_off_m[known]):.2f} m, surface {nmad(error_m[known]):.2f} m, {within:.2f} within "
        f"1 m, 90 % intervals hold {held:.2f}; 85 % that are certain: {nmad(error_m[certain]):.2f} m, "
        f"LE90 {le90_m:.2f} m"
    )
    assert seen.sum() > 60
    assert known.sum() > 0.95 * seen.sum()
    assert nmad(chips_off_m[known]) > 2.0
    assert nmad(error_m[known]) < 0.6
    assert within > 0.7
    assert held > 0.75


@pytest.mark.real_data
def test_points_of_two_views_are_where_a_third_view_shows_their_chips(triplet) -> None:
    scenes, all_three, work = triplet
    features = {name: work.kept[name] for name in work.kept if name.startswith("features/")}
    without = replace(TRIPLET, surface_pairs=0)
    pair = produce_points(scenes[:2], without, work=Work(kept=features))
    third, model = scenes[2], all_three.adjustment.models[2]
    points, gsd_m = pair.points, chips_m[0]
    rows, displacement_m, covariance_m2 = [], [], []
    for row, ground in enumerate(points.lon_lat_h):
        patch = render_chip(third.image, model, ground, gsd_m, 125)
        chip = render_chip(scenes[1].image, pair.adjustment.models[1], ground, gsd_m)
        peak = find_chip(patch, chip, CorrelationOptions(min_score=0.6))
        if peak.reason != FOUND:
            continue
        derivative = model.project_derivative(ground[None, :])[0]
        on_ground = np.linalg.inv(derivative[:, :2]) @ derivative
        rows.append(row)
        displacement_m.append([peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m])
        measure_m2 = (peak.sigma_px * gsd_m) ** 2 * np.eye(2)
        covariance_m2.append(on_ground @ points.covariance_m2[row] @ on_ground.T + measure_m2)
    # The frames of both blocks differ by a smooth function of the place.
    place = points.lon_lat_h[rows] - points.lon_lat_h[rows].mean(axis=0)
    equations = np.column_stack([np.ones(len(place)), place / np.abs(place).max(axis=0)])
    solved = np.linalg.lstsq(equations, np.array(displacement_m))[0]
    residual = np.array(displacement_m) - equations @ solved
    normalised = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance_m2), residual) / 2.0
    print(f"{len(rows)} points in the third view: mean square {normalised.mean():.2f}")
    assert len(rows) > 80
    assert normalised.mean() < honest[1]
