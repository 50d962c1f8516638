"""Independent check points: errors of a registered model at ground that it was not fitted to."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.errors import CoverageError
from amers.services.geodesy import metres_per_degree_at
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.accuracy import Accuracy, NormalisedError, accuracy, normalised_error
from amers.services.quality.criteria import at_most, verdict_of
from amers.services.quality.qualification import Qualification
from amers.services.quality.stability import ImageResiduals, residuals_in_image
from amers.services.sensors.base import SensorModel
from amers.services.statements import Statements
from amers.services.types import Array, Frame

MARKING_SIGMA_PX = 0.5
"""Precision with which a person marks a detail in an image, one standard deviation a coordinate, where
the marks come without one."""


@dataclass(frozen=True)
class CheckPoints:
    """n points of known ground, held out of the adjustment.

    Attributes:
        lon_lat_h: (n, 3).
        line_sample: (n, 2) where the image shows them.
        sigma_m: (n, 3) of east, north, up, one standard deviation; NaN where unknown: 0 is used.
        sigma_px: (n,) of the marks, a coordinate; NaN where unknown: 0.5 px is used.
        statements: of their file.
    """

    lon_lat_h: Array
    line_sample: Array
    sigma_m: Array
    sigma_px: Array
    statements: Statements = ()


@dataclass(frozen=True)
class CheckResult:
    """Errors of a registered model at check points.

    Attributes:
        residual_px: marks minus the positions that the model computes; x along samples, y along lines.
        accuracy: of the ground that the model gives for the marks, at the heights of the points; a
            single scene gives no heights, so there is no LE90.
        normalised: the residuals in units of the stated precision of model, marks and points; their mean
            square is 1 when these are honest.
    """

    residual_px: ImageResiduals
    accuracy: Accuracy
    normalised: NormalisedError


def check_model(
    model: SensorModel, adjustment: SceneAdjustment, points: CheckPoints, frame: Frame
) -> CheckResult:
    """The errors of a registered model at check points.

    Args:
        model: registered.
        adjustment: the one that registered it.
        points: held out of it.
        frame: of the control on the Earth; 0 is used where it is unknown.

    Raises:
        CoverageError: the model has no image position for any of the points.
    """
    expected = model.project(points.lon_lat_h)
    residual = points.line_sample - expected
    if not np.isfinite(residual).all(axis=1).any():
        raise CoverageError(
            f"none of the {len(expected)} check points lies where the model of the scene is valid: "
            "check that their coordinates are longitude, latitude and height, and belong to this scene"
        )
    ground_m2 = np.nan_to_num(points.sigma_m)[:, None, :] ** 2 * np.eye(3)
    ground_m2 = ground_m2 + np.nan_to_num(frame.covariance_m2)
    derivative = model.project_derivative(points.lon_lat_h)
    of_ground = derivative @ ground_m2 @ derivative.transpose(0, 2, 1)
    marking_px = np.nan_to_num(points.sigma_px, nan=MARKING_SIGMA_PX)
    of_marks = marking_px[:, None, None] ** 2 * np.eye(2)
    located = model.locate(points.line_sample, points.lon_lat_h[:, 2])
    error_deg = located[:, :2] - points.lon_lat_h[:, :2]
    error_deg[:, 0] = (error_deg[:, 0] + 180.0) % 360.0 - 180.0
    return CheckResult(
        residuals_in_image(residual),
        accuracy(error_deg * metres_per_degree_at(points.lon_lat_h)),
        normalised_error(residual, adjustment.covariance_at(expected) + of_ground + of_marks),
    )


def with_check_points(qualification: Qualification, check: CheckResult, limit: float) -> Qualification:
    """The qualification with a criterion on check points: contradicted, it is not "good" any more.

    Args:
        qualification: without check points.
        check: the errors of the model at check points.
        limit: largest ratio of the residuals to the stated precision of model, marks and points.
    """
    ratio = float(np.sqrt(check.normalised.mean_square))
    criteria = (*qualification.criteria, at_most("check_points", ratio, limit, "good"))
    return replace(qualification, criteria=criteria, verdict=verdict_of(criteria))
