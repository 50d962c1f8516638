"""Test whether a refused first search shows a model of another view."""

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.matching.height_consensus import view_consensus
from amers.services.registration.context import SearchStage
from amers.services.registration.search import FIRST_TOLERANCE_PX, next_step, sees_nothing
from amers.services.types import Array

_MAX_FALSE_ALARMS = 1e-4
_MORE = 1.25
"""Points that agree on another view, over those that agree on one displacement, at least."""


def another_view(
    scene: Scene, stage: SearchStage, lon_lat_h: Array, predicted: Array, measured: Array
) -> str:
    """What to say and do where a search agrees on the model of another view, or finds nothing.

    Args:
        scene: that was searched.
        stage: summary of the search.
        lon_lat_h: (n, 3) the points.
        predicted, measured: (n, 2) where they are expected and found, pixels; NaN where not found.

    Returns:
        A sentence for the refusal; "" if no other view is found.
    """
    if sees_nothing(stage):
        return next_step(stage, scene.sigma_m)
    derivative = scene.model.project_derivative(lon_lat_h.mean(axis=0)[None, :])[0, :, :2]
    px_per_m = float(np.sqrt(abs(np.linalg.det(derivative))))
    agrees, false_alarms = view_consensus(
        predicted,
        measured - predicted,
        lon_lat_h[:, 2],
        FIRST_TOLERANCE_PX * stage.chip_gsd_m * px_per_m,
        stage.search_radius_m * px_per_m,
    )
    if false_alarms > _MAX_FALSE_ALARMS or agrees.sum() < _MORE * stage.inliers:
        return ""
    return (
        f"{int(agrees.sum())} of them agree if displacements may change along the image and with their "
        f"heights ({false_alarms:.1g} such groups expected by chance). The model belongs to another "
        "view: give the model that was delivered with this image"
    )
