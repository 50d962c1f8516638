"""What a scene shows of the control points, before it is adjusted together with others."""

from dataclasses import dataclass

import numpy as np

from services.adjustment.control_observations import ControlObservations
from services.adjustment.image_correction import SceneAdjustment
from services.imagery.scene import Scene
from services.matching.control_points import PointMatches
from services.registration.context import SearchStage
from services.registration.search import Search, control_observations
from services.types import BoolArray, ControlPoints, ViewMeasures


@dataclass(frozen=True)
class MeasuredScene:
    """A scene and where it shows control points.

    Attributes:
        scene: as delivered.
        points: all control points that the scene may show.
        search: the last search of a part of them.
        alone: the adjustment of this scene on its own control points; None where they do not allow one.
        stages: summaries of the searches.
    """

    scene: Scene
    points: ControlPoints
    search: Search
    alone: SceneAdjustment | None
    stages: tuple[SearchStage, ...] = ()

    @property
    def name(self) -> str:
        """Of the image."""
        return self.scene.acquisition.image_id

    @property
    def usable(self) -> BoolArray:
        """Points (k,) of the search whose measures agree with each other."""
        matches = self.search.matches
        return np.asarray(
            self.search.inliers
            & np.isfinite(matches.line_sample).all(axis=1)
            & np.isfinite(matches.sigma_px)
        )

    def observations(self) -> ControlObservations:
        """What the scene shows of the points of its search."""
        return control_observations(self.scene, self.search, self.usable)


def nothing_found(scene: Scene, points: ControlPoints) -> MeasuredScene:
    """A scene in which no control point was searched yet."""
    none = np.zeros(0, dtype=np.int64)
    empty = np.zeros(0, dtype=np.bool_)
    matches = PointMatches(
        line_sample=np.empty((0, 2)),
        displacement_m=np.empty((0, 2)),
        sigma_px=np.empty(0),
        score=np.empty(0),
        views=none,
        reason=np.zeros(0, dtype="<U16"),
        by_gradient=empty,
        common_covariance_m2=np.zeros((2, 2)),
        view_measures=ViewMeasures(none, none, np.empty(0), empty, np.zeros(0, dtype="<U16")),
    )
    return MeasuredScene(scene, points, Search(points.take(none), none, matches, empty, 0.0), None)
