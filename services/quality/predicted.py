"""Predicted accuracy over the whole image, from the covariances of the correction and the frame."""

from dataclasses import dataclass

import numpy as np

from amers.services.quality.frames import frame_in_image
from amers.services.quality.normal_law import normal_ce90, overall_ce90
from amers.services.quality.stability import AdjustedScene
from amers.services.types import Array


@dataclass(frozen=True)
class PredictedAccuracy:
    """Accuracy all over the image, by the normal law.

    Relative to the control points it is the covariance of the correction. On the Earth it includes the
    frame of the control points, an error that all of them share. Metres are on the ground, at its true
    height.

    Places that no point holds have predictions, too, but are not counted: see `HeldArea`.

    Attributes:
        std_line_px, std_sample_px: (g, g) on a regular grid from corner to corner, relative to the
            control points.
        ce90_px: (g, g) relative to the control points.
        worst_px: the largest of all places that points support; NaN where they hold none.
        overall_px: CE90 of all these places alike, the radius that holds 90 % of their errors: what CE90
            of check points all over them estimates.
        worst_m, overall_m: the same on the ground, relative to the control points.
        on_the_earth_worst_m, on_the_earth_overall_m: the same with the frame; NaN when unknown.
    """

    std_line_px: Array
    std_sample_px: Array
    ce90_px: Array
    worst_px: float
    overall_px: float
    worst_m: float
    overall_m: float
    on_the_earth_worst_m: float
    on_the_earth_overall_m: float


def predict_accuracy(scene: AdjustedScene, grid: int) -> PredictedAccuracy:
    """The covariance of the correction, propagated to a grid over the image.

    Args:
        scene: after its final adjustment.
        grid: nodes along each side.
    """
    line, sample = np.meshgrid(
        *(np.linspace(0.0, size - 1.0, grid) for size in scene.shape), indexing="ij"
    )
    nodes = np.column_stack([line.ravel(), sample.ravel()])
    covariance = scene.adjustment.covariance_at(nodes)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).reshape(grid, grid, 2)
    held = nodes if scene.held is None else scene.held.places
    ce90_px = normal_ce90(covariance).reshape(grid, grid)
    figures = _over(scene, held) if len(held) else [float("nan")] * 6
    return PredictedAccuracy(std[..., 0], std[..., 1], ce90_px, *figures)


def _over(scene: AdjustedScene, places: Array) -> list[float]:
    """Worst and overall CE90 at places (n, 2): pixels, on the ground, on the Earth."""
    covariance = scene.adjustment.covariance_at(places)
    derivative = _derivative(scene, places)
    to_ground = np.linalg.inv(derivative[:, :, :2])
    of_frame = frame_in_image(scene.frame, derivative, scene.adjustment.apart_px)
    on_ground = (
        to_ground @ part @ to_ground.transpose(0, 2, 1) for part in (covariance, covariance + of_frame)
    )
    parts = (covariance, *on_ground)
    return [figure for part in parts for figure in (float(normal_ce90(part).max()), overall_ce90(part))]


def _derivative(scene: AdjustedScene, line_sample: Array) -> Array:
    """Derivatives (n, 2, 3) of the model at image positions (n, 2), at the middle height of the points.

    A scene that shows none, which others hold, has the middle height of its model. Where the model
    reaches no ground, those of its middle stand in.
    """
    points = scene.measures.lon_lat_h
    middle_m = np.median(points[:, 2]) if len(points) else np.mean(scene.model.height_range_m)
    height_m = np.full(len(line_sample), middle_m)
    derivative = scene.model.project_derivative(scene.model.locate(line_sample, height_m))
    beyond = np.asarray(~np.isfinite(derivative).all(axis=(1, 2)))
    if beyond.any():
        middle = scene.model.project_derivative(points).mean(axis=0)
        derivative = np.where(beyond[:, None, None], middle, derivative)
    return np.asarray(derivative)
