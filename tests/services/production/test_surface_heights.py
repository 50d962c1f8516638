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
from amers.services.matching.surface_heights import surface_height
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.production.tie_points import find_tie_points
from amers.services.simulation.view import SimulatedView, simulate_block
from amers.services.simulation.world import World
from amers.services.tasks import Work
from amers.services.types import Array, Observations, no_progress
from tests.services.simulated import (
    BLOCK_SIGMA_M,
    GSD_M,
    OPTIONS,
    SHAPE,
    block_views,
    production,
    world,
)

pytestmark = [pytest.mark.long, pytest.mark.thorough]

honest = (0.7, 1.5)
"""Mean square of errors over their sigmas."""
five_sigma = 5.0
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


def simulated_surfaces(
    ground: World, views: Sequence[SimulatedView], made: Production, gsd_m: float
) -> Surfaces:
    """The true surface is where the true line of sight of the steepest view meets it.

    True heights of points are those of the details that the adjusted models project them to: the
    block differs from the truth by a translation.
    """
    points = made.points
    n, count = len(points), len(views)
    seen = np.stack([model.project(points.lon_lat_h) for model in made.adjustment.models], axis=1)
    observations = Observations(
        np.repeat(np.arange(n), count),
        np.tile(np.arange(count), n),
        seen.reshape(-1, 2),
        np.full(n * count, 0.1),
    )
    true_h = intersect([v.geometry.true_model for v in views], observations, n).lon_lat_h[:, 2]
    low, high = ground.height_range_m
    heights = np.arange(high + 1.0, low - 1.0, -0.05)
    above = np.full(n, np.nan)
    for row in range(n):
        mine = np.arange(*points.views.start[row : row + 2])
        mine = mine[points.views.gsd_m[mine] == gsd_m]
        if len(mine) == 0:
            continue
        image = points.views.image[mine[np.argmin(points.views.incidence_deg[mine])]]
        ray = views[image].geometry.true_model.locate(
            np.tile(seen[row, image], (len(heights), 1)), heights
        )
        above[row] = heights[np.argmax(ground.surface_m(ray[:, :2]) >= heights)] - true_h[row]
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
    seen = simulate_block(
        ground,
        np.random.default_rng(seed + 1),
        n_views=views,
        shape=SHAPE,
        gsd_m=GSD_M,
        error_m=BLOCK_SIGMA_M,
        largest_incidence_deg=20.0,
    )
    made = produce_points([view.as_scene(BLOCK_SIGMA_M) for view in seen], replace(OPTIONS, points=150))
    return simulated_surfaces(ground, seen, made, OPTIONS.fine_gsd_m)


def test_errors_of_simulated_surfaces_are_as_large_as_stated() -> None:
    # World 61 has an edge of a roof that parts of 11 px on both of its sides follow.
    cases = [surfaces_of(61, 3), surfaces_of(51, 3), surfaces_of(31, 2)]
    for found in cases:
        error_m = found.stated_m - found.true_m
        print(
            f"{len(error_m)} points: heights of chips {nmad(found.true_m):.2f} m from the surface, "
            f"stated surface {nmad(error_m):.2f} m, mean square {found.mean_square():.2f}, largest "
            f"{np.abs(error_m / found.sigma_m).max():.1f}"
        )
        assert len(error_m) > 30
        assert nmad(error_m) < 0.5 * nmad(found.true_m)
        # What a whole chip shows is no statement of the surface at its centre.
        assert np.mean((found.true_m / found.sigma_up_m) ** 2) > 2.0 * honest[1]
        assert np.abs(error_m / found.sigma_m).max() < five_sigma
    weights = [len(found.stated_m) for found in cases]
    together = np.average([found.mean_square() for found in cases], weights=weights)
    assert honest[0] < together < honest[1]


def test_one_view_does_not_state_a_surface() -> None:
    scene = block_views()[0].as_scene(BLOCK_SIGMA_M)
    assert np.isnan(surface_height([scene], production().points.lon_lat_h[0], GSD_M)).all()


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
    assert known.sum() > 30
    assert nmad((stated - reference)[known]) < 0.5 * nmad(chips[known])
    assert honest[0] < mean_square < honest[1]


@pytest.mark.real_data
def test_points_of_two_views_are_where_a_third_view_shows_their_chips(triplet) -> None:
    scenes, all_three, work = triplet
    features = {name: work.kept[name] for name in work.kept if name.startswith("features/")}
    pair = produce_points(scenes[:2], TRIPLET, work=Work(kept=features))
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
