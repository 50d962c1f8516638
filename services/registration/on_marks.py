"""Registration of a scene on ground points that a person marked, without any search."""

from dataclasses import replace

import numpy as np

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.marked_scene import MarkedScene, MarkPriors, adjust_marks
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.criteria import at_most, verdict_of
from amers.services.quality.findings import with_findings
from amers.services.quality.held_area import HeldArea
from amers.services.quality.marks import marks_report
from amers.services.quality.qualification import Qualification, qualify
from amers.services.quality.stability import AdjustedScene
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.scene_marks import SceneMarks
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import BoolArray, Measures, ViewMeasures

SLOPE = 1e-4
"""A priori standard deviation of drift and skew, pixels per pixel: that of images of productions, and
1 px at the edge of a scene of 20000 pixels, as in registrations on many points. In short images there is
hardly any: a shift is enough for IKONOS up to 50 km (Grodecki and Dial, 2003, Block adjustment of
high-resolution satellite images described by rational polynomials, PE&RS 69)."""
_FEWEST_REPEATED = 3
"""Marks from which parts of them are held out; with two, the one held out is nothing but the other."""


def register_on_marks(
    scene: Scene, marks: SceneMarks, options: RegistrationOptions = RegistrationOptions()
) -> Registration:
    """Refine the model of a scene on known ground that a person marked in its image.

    One mark is enough; see `adjust_marks`. The verdict has the limits of every registration, with three
    differences: any number of marks may be usable, as each was named by a person; fewer than three are
    not repeated without some of them; and pixels of the control are the accuracy of the ground.

    Args:
        scene: as delivered.
        marks: one or more.
        options: of the qualification, and the a priori standard deviation of drift and skew.

    Raises:
        CoverageError: no mark lies where the model of the scene is valid.
    """
    shape, gsd_m = scene.image.shape, scene_gsd_m(scene)
    observations = ControlObservations(
        marks.lon_lat_h, marks.line_sample, marks.sigma_px, marks.covariance_m2
    )
    marked = adjust_marks(scene.model, shape, observations, mark_priors(scene, options))

    def refit(used: BoolArray) -> SceneAdjustment:
        part = replace(observations, usable=used)
        return adjust_marks(scene.model, shape, part, marked.priors, like=marked).adjustment

    adjustment = marked.adjustment
    model = CorrectedModel(scene.model, adjustment.correction)
    adjusted = AdjustedScene(
        model,
        _measures(scene, marks, marked),
        adjustment,
        shape,
        gsd_m,
        marks.frame,
        refit,
        control_gsd_m=float(np.median(marks.sigma_m[:, :2])),
    )
    adjusted = replace(with_findings(adjusted), held=HeldArea.whole(shape))
    qualification = _qualified(adjusted, marked, options)
    report = marks_report(adjusted, marked, marks.names, marks.sigma_m)
    return Registration(
        model,
        adjusted.adjustment,
        adjusted.measures,
        _NO_VIEWS,
        (),
        marks.frame,
        qualification,
        marks=report,
    )


_NO_VIEWS = ViewMeasures(
    np.zeros(0, dtype=np.int64),
    np.zeros(0, dtype=np.int64),
    np.zeros(0),
    np.zeros(0, dtype=np.bool_),
    np.zeros(0, dtype=np.str_),
)


def mark_priors(scene: Scene, options: RegistrationOptions = RegistrationOptions()) -> MarkPriors:
    """What is expected of the model of a scene before its marks are known.

    Args:
        scene: as delivered.
        options: the a priori standard deviation of drift and skew.
    """
    slope_px = min(options.adjustment.prior_slope_sigma_px, SLOPE * max(scene.image.shape) / 2.0)
    return MarkPriors(scene.sigma_m / scene_gsd_m(scene), slope_px)


def _measures(scene: Scene, marks: SceneMarks, marked: MarkedScene) -> Measures:
    """The marks as measures of points, without scores and views."""
    n, adjustment = len(marks), marked.adjustment
    model = CorrectedModel(scene.model, adjustment.correction)
    derivative = model.project_derivative(marks.lon_lat_h)
    seen = np.asarray(np.isfinite(adjustment.residual_px).all(axis=1))
    residual_m = np.full((n, 2), np.nan)
    residual_m[seen] = np.linalg.solve(
        derivative[seen][:, :, :2], adjustment.residual_px[seen][:, :, None]
    )[:, :, 0]
    reason = np.where(adjustment.active, "", np.where(seen, "deactivated", "outside"))
    return Measures(
        point_id=marks.numbers,
        lon_lat_h=marks.lon_lat_h,
        predicted=scene.model.project(marks.lon_lat_h),
        line_sample=marks.line_sample,
        sigma_px=marks.sigma_px,
        score=np.full(n, np.nan),
        views=np.zeros(n, dtype=np.int64),
        by_gradient=np.zeros(n, dtype=bool),
        residual_px=adjustment.residual_px,
        residual_m=residual_m,
        matched=seen,
        active=adjustment.active,
        reason=reason,
    )


def _qualified(scene: AdjustedScene, marked: MarkedScene, options: RegistrationOptions) -> Qualification:
    """The quality figures of a registration on marks; see `register_on_marks`."""
    limits = replace(options.qualification, usable_active_points=1)
    qualification = qualify(scene, limits, np.random.default_rng(options.seed))
    count = int(marked.adjustment.active.sum())
    beyond_few = {
        "displacement_px": count < _FEWEST_REPEATED,
        "residual_std_px": count < _FEWEST_REPEATED,
    }
    criteria = [one for one in qualification.criteria if not beyond_few.get(one.name, False)]
    in_doubt = count if marked.disagree else 0
    criteria.append(at_most("marks_in_doubt", in_doubt, 0, "usable"))
    kept = tuple(criteria)
    return replace(qualification, criteria=kept, verdict=verdict_of(kept))
