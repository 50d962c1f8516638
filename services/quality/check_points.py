"""Independent check points: how far a registered model is from ground that had no part in it."""

from dataclasses import dataclass, replace

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.errors import CoverageError
from services.geodesy import metres_per_degree_at
from services.quality.accuracy import Accuracy, NormalisedError, accuracy, normalised_error
from services.quality.qualification import Criterion, Qualification, verdict_of
from services.quality.stability import ImageResiduals, residuals_in_image
from services.sensors.correction import CorrectedModel
from services.types import Array

MARKING_SIGMA_PX = 0.5
"""How well a person marks a detail in an image, one standard deviation a coordinate, where unsaid."""


@dataclass(frozen=True)
class CheckPoints:
    """n points of known ground, held out of the adjustment.

    Attributes:
        lon_lat_h: (n, 3).
        line_sample: (n, 2) where the image shows them.
        sigma_m: (n, 3) of east, north, up, one standard deviation; NaN where unknown, taken for 0.
        sigma_px: (n,) of the marks, a coordinate; NaN where unknown, taken for 0.5.
    """

    lon_lat_h: Array
    line_sample: Array
    sigma_m: Array
    sigma_px: Array


@dataclass(frozen=True)
class Checked:
    """A registered model against check points.

    Attributes:
        residual_px: marks minus where the model expects the points; x along samples, y along lines.
        accuracy: of the ground that the model gives for the marks, at the heights of the points; a
            single scene gives no heights, so there is no LE90.
        normalised: these residuals in units of what model, marks and points state; its mean square is 1
            when all of them are honest.
    """

    residual_px: ImageResiduals
    accuracy: Accuracy
    normalised: NormalisedError


def check_model(
    model: CorrectedModel, adjustment: SceneAdjustment, points: CheckPoints, frame_sigma_m: float
) -> Checked:
    """Hold a registered model against check points.

    Args:
        model: registered.
        adjustment: that registered it.
        points: held out of it.
        frame_sigma_m: how well the frame of the control points is known on the Earth, one standard
            deviation a coordinate; NaN when unknown, taken for 0.

    Raises:
        CoverageError: the model has no place for any of the points.
    """
    expected = model.project(points.lon_lat_h)
    residual = points.line_sample - expected
    if not np.isfinite(residual).all(axis=1).any():
        raise CoverageError(f"none of the {len(expected)} check points lies where the scene was taken")
    variance_m2 = np.nan_to_num(points.sigma_m) ** 2 + np.nan_to_num(frame_sigma_m) ** 2
    derivative = model.project_derivative(points.lon_lat_h)
    of_ground = (derivative * variance_m2[:, None, :]) @ derivative.transpose(0, 2, 1)
    marking_px = np.nan_to_num(points.sigma_px, nan=MARKING_SIGMA_PX)
    of_marks = marking_px[:, None, None] ** 2 * np.eye(2)
    located = model.locate(points.line_sample, points.lon_lat_h[:, 2])
    off_deg = located[:, :2] - points.lon_lat_h[:, :2]
    off_deg[:, 0] = (off_deg[:, 0] + 180.0) % 360.0 - 180.0
    return Checked(
        residuals_in_image(residual),
        accuracy(off_deg * metres_per_degree_at(points.lon_lat_h)),
        normalised_error(residual, adjustment.covariance_at(expected) + of_ground + of_marks),
    )


def qualified_by(qualification: Qualification, checked: Checked, limit: float) -> Qualification:
    """A qualification that is not "good" when check points contradict it.

    Args:
        qualification: without them.
        checked: the model against them.
        limit: largest ratio of their residuals to what model, marks and points state.
    """
    ratio = float(np.sqrt(checked.normalised.mean_square))
    criterion = Criterion("check_points", ratio, "at most", limit, "good", bool(ratio <= limit))
    criteria = (*qualification.criteria, criterion)
    return replace(qualification, criteria=criteria, verdict=verdict_of(criteria))
