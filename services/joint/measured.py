"""Control points measured in one scene, before the joint adjustment."""

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amers.services.errors import ComputationError
from amers.services.imagery.scene import Scene
from amers.services.matching.control_points import PointMatches
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.points_elsewhere import Elsewhere
from amers.services.registration.context import SearchStage
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.scene_marks import SceneMarks, searched_with_marks, with_marks
from amers.services.registration.search import Search, adjust_search, control_observations
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.moving_pushbroom import moving_model
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.types import Array, BoolArray, ControlPoints, ViewMeasures


@dataclass(frozen=True)
class MeasuredScene:
    """A scene and where it shows control points.

    Attributes:
        scene: as delivered.
        points: all control points that the scene may show.
        search: the last search of a part of them.
        alone: the adjustment of this scene on its own control points; None where they do not allow one.
        stages: summaries of the searches.
        elsewhere: points that agree on another place; None without any.
        marks: of a person in it, which are the last points; None without any in all scenes.
    """

    scene: Scene
    points: ControlPoints
    search: Search
    alone: SceneAdjustment | None
    stages: tuple[SearchStage, ...] = ()
    elsewhere: Elsewhere | None = None
    marks: SceneMarks | None = None

    @property
    def name(self) -> str:
        """Of the image."""
        return self.scene.acquisition.image_id

    @property
    def usable(self) -> BoolArray:
        """Points (k,) of the search whose measures agree with each other, or with what moves lines."""
        matches, alone = self.search.matches, self.alone
        usable = self.search.inliers & np.isfinite(matches.line_sample).all(axis=1)
        usable &= np.isfinite(matches.sigma_px)
        if alone and alone.components and self.motion:
            usable |= alone.active
            if any(one.kind == "break" for one in alone.components):
                # Breaks cut chips, and leave parts that too few points support.
                usable = alone.active
        if alone and alone.moved:
            usable &= ~alone.moved.measures
        return np.asarray(usable)

    @cached_property
    def motion(self) -> ImageCorrection | None:
        """The correction whose displacement moves lines and samples, as the scene alone shows it.

        Its variance is without the covariance with the parameters, which the block estimates again.
        None where nothing moves, and where no motion of a satellite explains it.
        """
        correction, model = self.alone.correction if self.alone else None, self.scene.model
        if correction is None or correction.displacement is None:
            return None
        if (
            self.scene.parameter_set is not None
            and isinstance(model, PushbroomModel)
            and moving_model(model, correction) is None
        ):
            return None
        grid = correction.displacement
        grid = replace(grid, variance_px2=np.maximum(grid.variance_px2, 0.0))
        return replace(correction, displacement=grid)

    @property
    def displacement(self) -> DisplacementGrid | None:
        """What moves lines and samples beyond an affine correction; None for nothing."""
        return self.motion.displacement if self.motion else None

    def observations(self) -> ControlObservations:
        """What the scene shows of the points of its search."""
        return control_observations(self.scene, self.search, self.usable)

    def line_sample(self) -> Array:
        """Where the scene shows the points (k, 2) of its search.

        Chips average a displacement over their pixels, which is taken back.
        """
        seen, displacement = self.observations(), self.displacement
        if displacement is None:
            return seen.line_sample
        place = self.scene.model.project(seen.lon_lat_h)
        shown = displacement.averaged(place, seen.chip_side_px)
        return np.asarray(seen.line_sample + displacement.at(place) - shown)


def with_own_marks(
    measured: MeasuredScene, marks: SceneMarks, options: RegistrationOptions
) -> MeasuredScene:
    """A measured scene with marks of a person in it, which may be none: all scenes need their frame."""
    points = with_marks(measured.points, marks)
    search = searched_with_marks(measured.search, len(measured.points), marks)
    alone = measured.alone
    if len(marks):
        adjustment = options_in_block(options).adjustment
        with suppress(ComputationError):
            alone = adjust_search(measured.scene, search, adjustment, ground_may_move=True)
    return replace(measured, points=points, search=search, alone=alone, marks=marks)


def without_own_marks(measured: MeasuredScene) -> MeasuredScene:
    """The scene with the points of the base alone, which can be searched."""
    points = measured.points.take(np.flatnonzero(measured.points.id >= 0))
    return replace(measured, points=replace(points, frames=points.frames[:-1]), marks=None)


def options_in_block(options: RegistrationOptions) -> RegistrationOptions:
    """The options of a scene that is adjusted with others.

    Bends that the points of a scene leave open are left to the tie points.
    """
    return replace(options, adjustment=replace(options.adjustment, bends=False))


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
