"""Two kilometres of flat ground without repetition, a scene of its middle, and points with chips."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, CachedImage, Window, render_chip
from amers.services.map_grid import MapGrid
from amers.services.matching.control_points import PointMatches
from amers.services.matching.multi_image import stored_chip
from amers.services.registration.context import PointContext, Prediction, RegistrationContext
from amers.services.registration.options import CoarseOptions, RegistrationOptions
from amers.services.registration.point_selection import initial_prediction
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import (
    Acquisition,
    Array,
    ControlPoints,
    FloatImage,
    ViewMeasures,
    no_progress,
)
from tests.services.simulated import MemoryChips, points_with, views_of_points
from tests.services.textures import as_pixels, texture

SIDE_PX, GSD_M = 1024, 2.0
GRID = MapGrid(
    "EPSG:32633",
    np.array([499_000.0, 5_601_000.0]),
    np.array([[0.0, GSD_M], [-GSD_M, 0.0]]),
    (SIDE_PX, SIDE_PX),
)
"""On the central meridian: map north is north."""
POINT_SIGMA_M = 0.3


@cache
def ground() -> FloatImage:
    """Grey values of all of it."""
    return as_pixels(texture(np.random.default_rng(3), SIDE_PX, 2.0))


def whole() -> Scene:
    """An image of all of it, where it lies."""
    return Scene(ArrayImage(ground()), OrthoModel(GRID), Acquisition("ground"), 1.0)


def scene(off_m: Array, sigma_m: float, lines: int = 400, samples: int = 400) -> Scene:
    """An image of the middle, with noise of its own, whose model is off east and north."""
    first = (SIDE_PX - lines) // 2, (SIDE_PX - samples) // 2
    pixels = whole().image.read(Window(*first, lines, samples))
    pixels = pixels + np.random.default_rng(8).normal(0.0, 30.0, pixels.shape).astype(np.float32)
    origin = GRID.origin_xy + GRID.step_xy @ np.array(first, dtype=np.float64) + off_m
    model = OrthoModel(replace(GRID, origin_xy=origin, shape=(lines, samples)))
    return Scene(ArrayImage(pixels), model, Acquisition("middle"), sigma_m)


def points_at(row_col: Array, gsd_m: float = GSD_M) -> tuple[ControlPoints, MemoryChips]:
    """Points at pixels (n, 2) of the ground, with one chip each."""
    lon_lat_h = whole().model.locate(row_col, np.zeros(len(row_col)))
    image = whole()
    chips = [stored_chip(render_chip(image.image, image.model, place, gsd_m)) for place in lon_lat_h]
    views = views_of_points(len(lon_lat_h), [gsd_m])
    points = points_with(lon_lat_h, views, POINT_SIGMA_M)
    return points, MemoryChips(np.array(chips))


@cache
def many_points() -> tuple[ControlPoints, MemoryChips]:
    """Points every 110 m, also far beside the scene."""
    axis = np.arange(55.0, SIDE_PX - 55.0, 55.0)
    return points_at(np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2))


def matches_at(line_sample: Array, displacement_m: Array, sigma_px: float) -> PointMatches:
    """Matches (n,) of points by a view each; NaN where they were not found."""
    n, nothing = len(line_sample), np.zeros(0, dtype=np.int64)
    found = np.isfinite(line_sample).all(axis=1)
    return PointMatches(
        line_sample=line_sample,
        displacement_m=displacement_m,
        sigma_px=np.where(found, sigma_px, np.nan),
        score=np.ones(n),
        views=np.ones(n, dtype=np.int64),
        reason=np.where(found, "", "low_score").astype("<U16"),
        by_gradient=np.zeros(n, dtype=bool),
        common_covariance_m2=np.zeros((2, 2)),
        view_measures=ViewMeasures(nothing, nothing, np.zeros(0), np.zeros(0, bool), np.zeros(0, str)),
    )


def context_of(of: Scene, **coarse: float) -> RegistrationContext:
    options = RegistrationOptions(coarse=CoarseOptions(**coarse))  # type: ignore[arg-type]
    return RegistrationContext(of, options, no_progress, [], None)


def point_context(
    of: Scene, points: ControlPoints, chips: MemoryChips, fine_gsd_m: float, **coarse: float
) -> PointContext:
    options = RegistrationOptions(coarse=CoarseOptions(**coarse))  # type: ignore[arg-type]
    image = CachedImage(of.image)
    return PointContext(of, options, no_progress, [], None, points, chips, image, fine_gsd_m)


def predicted(of: Scene, points: ControlPoints) -> Prediction:
    return initial_prediction(of, points)


def resampled(factor: float, sigma_m: float = 10.0, size: int = 700) -> Scene:
    """A scene whose pixels are finer by a factor than its model says."""
    of = scene(np.array([12.0, -9.0]), sigma_m, size, size)
    pixels = of.image.read(Window(0, 0, size, size))
    side = round(size * factor)
    way = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC
    return replace(of, image=ArrayImage(np.asarray(cv2.resize(pixels, (side, side), interpolation=way))))
