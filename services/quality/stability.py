"""How stable a correction is: repeated with fewer points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.errors import ComputationError
from services.quality.accuracy import Statistics, statistics
from services.sensors.base import SensorModel
from services.types import Array, BoolArray, Frame, Measures

PLACES = ("top left", "top right", "bottom right", "bottom left", "centre")


@dataclass(frozen=True)
class AdjustedScene:
    """A scene after its final adjustment.

    Attributes:
        model: of the scene, with the correction of the adjustment.
        measures: all n points that the scene could show, with their final residuals.
        adjustment: of all active points.
        shape: lines and samples of the image.
        gsd_m: ground sampling of the image; it converts pixels to metres.
        frame: of the control on the Earth.
        refit: repeats the adjustment on the measures of a mask (n,).
    """

    model: SensorModel
    measures: Measures
    adjustment: SceneAdjustment
    shape: tuple[int, int]
    gsd_m: float
    frame: Frame
    refit: Callable[[BoolArray], SceneAdjustment]


@dataclass(frozen=True)
class ImageResiduals:
    """Residuals of the active points in the image, pixels.

    Attributes:
        x: along samples.
        y: along lines.
        xy: length of the residual.
    """

    x: Statistics
    y: Statistics
    xy: Statistics


@dataclass(frozen=True)
class Displacement:
    """Displacement of one place of the image between the full solution and solutions with fewer points.

    Attributes:
        place: "top left", "top right", "bottom right", "bottom left" or "centre".
        median_px, max_px, median_m, max_m: length, over the draws.
        x_m, y_m: along samples and lines in the first draw: one repeated adjustment, as in the published
            tables.
    """

    place: str
    median_px: float
    max_px: float
    median_m: float
    max_m: float
    x_m: float
    y_m: float


@dataclass(frozen=True)
class Stability:
    """The adjustment repeated without a part of its points. It shows stability, not absolute accuracy.

    Attributes:
        kept_share: share of the active points in each draw.
        draws: number of adjustments that succeeded.
        failed_draws: number of adjustments that gave no solution.
        held_out_per_draw: number of points held out of each draw.
        displacements: of the four corners and the centre; empty when no draw succeeded.
        held_out_px: residuals of the points held out, all draws together; a point counts once in each
            draw that it was held out of.
        held_out_m: the same on the ground, by the ground sampling of the image.
        note: why there is no figure; "" otherwise.
    """

    kept_share: float
    draws: int
    failed_draws: int
    held_out_per_draw: int
    displacements: tuple[Displacement, ...]
    held_out_px: ImageResiduals
    held_out_m: ImageResiduals
    note: str


def residuals_in_image(residual: Array) -> ImageResiduals:
    """Statistics of residuals (n, 2), line and sample."""
    line, sample = residual[:, 0], residual[:, 1]
    return ImageResiduals(
        x=statistics(sample), y=statistics(line), xy=statistics(np.hypot(line, sample))
    )


def measure_stability(
    scene: AdjustedScene, draws: int, kept_share: float, rng: np.random.Generator
) -> Stability:
    """Displacements and residuals when the adjustment is repeated on random parts of the active points.

    Args:
        scene: after its final adjustment.
        draws: number of repetitions.
        kept_share: share of the active points in each draw.
        rng: draws the points that are held out.
    """
    measures, correction = scene.measures, scene.adjustment.correction
    active = np.flatnonzero(measures.active)
    held_count = len(active) - round(kept_share * len(active))
    places = image_places(scene.shape)
    displacements, held_out = [], []
    for _ in range(draws if held_count else 0):
        held = rng.permutation(active)[:held_count]
        used = measures.active.copy()
        used[held] = False
        try:
            repeated = scene.refit(used).correction
        except ComputationError:
            continue
        displacements.append(repeated.apply(places) - correction.apply(places))
        held_out.append(measures.line_sample[held] - repeated.apply(measures.predicted[held]))
    residual = np.concatenate(held_out) if held_out else np.empty((0, 2))
    return Stability(
        kept_share=kept_share,
        draws=len(displacements),
        failed_draws=(draws if held_count else 0) - len(displacements),
        held_out_per_draw=held_count,
        displacements=_displacements(np.array(displacements), scene.gsd_m) if displacements else (),
        held_out_px=residuals_in_image(residual),
        held_out_m=residuals_in_image(residual * scene.gsd_m),
        note="" if displacements else _why_no_stability(len(active), held_count),
    )


def image_places(shape: tuple[int, int]) -> Array:
    """Line and sample (5, 2) of the four corners and the centre, in the order of `PLACES`."""
    line, sample = shape[0] - 1.0, shape[1] - 1.0
    return np.array(
        [[0, 0], [0, sample], [line, sample], [line, 0], [line / 2, sample / 2]], dtype=float
    )


def _displacements(moved_px: Array, gsd_m: float) -> tuple[Displacement, ...]:
    """Lengths over the draws, and the first draw, of displacements (d, 5, 2) in line and sample."""
    length_px = np.linalg.norm(moved_px, axis=2)
    median, largest = np.median(length_px, axis=0), length_px.max(axis=0)
    return tuple(
        Displacement(
            place=place,
            median_px=float(median[k]),
            max_px=float(largest[k]),
            median_m=float(median[k] * gsd_m),
            max_m=float(largest[k] * gsd_m),
            x_m=float(moved_px[0, k, 1] * gsd_m),
            y_m=float(moved_px[0, k, 0] * gsd_m),
        )
        for k, place in enumerate(PLACES)
    )


def _why_no_stability(active: int, held_count: int) -> str:
    """The reason why no draw gave a solution."""
    if held_count == 0:
        return f"{active} active points leave none to hold out"
    return f"{active - held_count} of {active} active points gave no solution in any draw"
