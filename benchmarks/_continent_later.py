"""Later images of a continent registered on a block: errors against the truth, and points that last."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import move_metres
from amers.services.matching.predict import in_image
from amers.services.registration.options import RegistrationOptions
from amers.services.simulation.archive import ArchiveView
from amers.services.simulation.conditions import clouds_over
from amers.services.simulation.detectors import PERFECT
from amers.services.simulation.distortion import Distortion
from amers.services.types import Array, BoolArray, ChipSource, ControlPoints
from benchmarks._campaign import Outcome, registered
from benchmarks._continent import Continent
from benchmarks._point_errors import BlockErrors
from benchmarks._scenes import Prepared

CORRECT_M = 3.0
"""Largest horizontal error of a measure that shows its point."""
_CLEAR_OPACITY = 0.2
_CHIP_REACH_M = 100.0
OPTIONS = RegistrationOptions(max_points=0)


@dataclass(frozen=True)
class LaterScene:
    """A later image registered on a block of n points.

    Attributes:
        name: of the image.
        outcome: of the registration, against the truth.
        shown: (n,) whether the image shows the point, whole and without clouds.
        found: (n,) whether it was matched where it truly is.
    """

    name: str
    outcome: Outcome
    shown: BoolArray
    found: BoolArray


def register_later(
    continent: Continent,
    points: ControlPoints,
    chips: ChipSource,
    true_lon_lat_h: Array,
    frame_error_m: Array,
    *,
    say: Callable[[str], object] = lambda words: None,
) -> list[LaterScene]:
    """The later images of a continent, each registered on a block.

    Args:
        continent: with its later images.
        points, chips: of the block.
        true_lon_lat_h: (n, 3) of the points; where NaN, the error of the frame stands in.
        frame_error_m: (3,) east, north, up, of the block.
        say: receives every outcome.
    """
    true = np.where(
        np.isfinite(true_lon_lat_h),
        true_lon_lat_h,
        move_metres(points.lon_lat_h, np.tile(-frame_error_m, (len(points), 1))),
    )
    results = []
    for name, view in continent.later.items():
        scene = read_scene(continent.folder / "later" / f"{name}.tif")
        prepared = Prepared(
            scene,
            points,
            continent.world_of(view),
            continent.geometry(view),
            PERFECT,
            _only_frame(frame_error_m),
            Distortion(scene.image.shape),
        )
        outcome, registration = registered(prepared, chips, OPTIONS)
        line_sample = prepared.geometry.true_model.project(true)
        found = np.zeros(len(points), dtype=bool)
        if registration is not None:
            measures = registration.measures
            rows = np.searchsorted(points.id, measures.point_id)
            off_px = np.linalg.norm(measures.line_sample - line_sample[rows], axis=1)
            found[rows] = measures.matched & (off_px * view.plan.gsd_m < CORRECT_M)
        results.append(LaterScene(name, outcome, _shown(view, line_sample), found))
        say(f"{name}: {outcome.verdict} {outcome.reason}")
    return results


def never_found(scenes: list[LaterScene]) -> float:
    """Share of the points that no image matches, of those that one image shows or more."""
    shown = np.any([scene.shown for scene in scenes], axis=0)
    found = np.any([scene.found for scene in scenes], axis=0)
    return float((shown & ~found).sum() / max(1, shown.sum()))


def _shown(view: ArchiveView, line_sample: Array) -> BoolArray:
    """Which points (n,) an image shows whole and without clouds."""
    reach_px = _CHIP_REACH_M / view.plan.gsd_m
    inside = in_image(line_sample, view.plan.shape, -reach_px - max(view.border_px))
    rng = np.random.default_rng([view.seed, 0])
    clouds = clouds_over(view.plan.shape, view.conditions.cloud_cover, rng)
    if clouds is None:
        return np.asarray(inside)
    clear = inside.copy()
    for row in np.flatnonzero(inside):
        around = np.linspace(-reach_px, reach_px, 9)
        line, sample = line_sample[row]
        clear[row] = clouds.opacity(line + around, sample + around).max() < _CLEAR_OPACITY
    return np.asarray(clear)


def _only_frame(frame_error_m: Array) -> BlockErrors:
    """A block that is off by its frame and not distorted."""
    return BlockErrors(frame_error_m[None, :], np.zeros((2, 3)), np.array([1.0, 0.0]), np.zeros(2), 1.0)
