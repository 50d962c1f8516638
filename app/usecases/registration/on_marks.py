"""Refine the model of a scene on known ground that a person marked in its image."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amers.app.usecases.registration.check_points import ground_positions, marks_of_scene
from amers.services.errors import InputError
from amers.services.formats.sensor_models.refined_model import write_refined
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.imagery.scene import Scene
from amers.services.misfit.affine_fit import FREE, Order
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.marked_scene import adjust_marks
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.check_points import MARKING_SIGMA_PX, CheckPoints
from amers.services.registration.on_marks import mark_priors
from amers.services.sensors.correction import CorrectedModel
from amers.services.statements import Statements, gathered


@dataclass(frozen=True, repr=False)
class Refinement:
    """A model refined on marks.

    Attributes:
        model: of the scene, with its correction.
        adjustment: the correction, its covariance, and the residuals of the marks.
        files: with the refined model; none where no folder was given.
        statements: of the files of the scene and of the marks.
    """

    model: CorrectedModel
    adjustment: SceneAdjustment
    files: tuple[Path, ...] = ()
    statements: Statements = ()

    def __repr__(self) -> str:
        adjustment = self.adjustment
        active = adjustment.active
        rms_px = np.sqrt(np.mean(adjustment.residual_px[active] ** 2, axis=0))
        return (
            f"Refinement: {adjustment.order} on {active.sum()} of {len(active)} marks\n"
            f"  residuals (rms) {rms_px[0]:.2f} px along lines, {rms_px[1]:.2f} px along samples\n"
            f"  standard deviation of unit weight {adjustment.sigma0:.2f}"
        )


def read_marks(path: Path, heights: str | None, image: Path, scene: Scene) -> CheckPoints:
    """The marks of a scene that its file neither switches off nor holds out as check points.

    Args:
        path: of the file, in any format that `read_control_points` reads.
        heights: vertical datum of its heights, where it states none; see `read_control_points`.
        image: of the scene; marks in other images are not used.
        scene: needs no heights if it is an ortho-image.

    Raises:
        InputError: the file cannot be used, or has no such mark of this scene.
    """
    marks = marks_of_scene(path, heights, image, scene)
    used = marks.take(marks.active & ~marks.check)
    if len(used) == 0:
        raise InputError(
            f"{path.name}: all {len(marks)} marks are check points or switched off; switch some on"
        )
    ground = ground_positions(used, path, scene)
    return CheckPoints(ground, used.line_sample, used.sigma_m, used.sigma_px, used.statements)


def refine_on_marks(scene: Scene, marks: CheckPoints, order: Order | None = None) -> Refinement:
    """The model of a scene, corrected so that it fits the marks.

    Args:
        scene: as delivered.
        marks: known ground and where the image shows it. A mark without a sigma counts as 0.5 px, a
            ground point without one as exact.
        order: of a correction by least squares alone, without an expectation of the model: "shift" needs
            two marks, "drift" three, "affine" four, one more than determine it. None weighs the marks
            against the accuracy of the model, as `register_on_marks`: one mark is enough, and wrong ones
            are rejected.

    Raises:
        InputError: the order is none of these.
        NotEnoughPoints: fewer marks have a position in the image than the order needs.
        CoverageError: no mark lies where the model of the scene is valid.
        UndeterminedCorrection: the marks lie on a line, which does not determine the order given.
    """
    if order is not None and order not in FREE:
        raise InputError(f"order: {order} found, one of {', '.join(FREE)} expected")
    observations = ControlObservations(
        marks.lon_lat_h,
        marks.line_sample,
        np.nan_to_num(marks.sigma_px, nan=MARKING_SIGMA_PX),
        np.nan_to_num(marks.sigma_m)[:, None, :] ** 2 * np.eye(3),
    )
    shape = scene.image.shape
    if order is None:
        adjustment = adjust_marks(scene.model, shape, observations, mark_priors(scene)).adjustment
    else:
        fewest = int(FREE[order].sum()) // 2 + 1
        options = AdjustmentOptions(order=order, min_points=fewest)
        adjustment = adjust_scene(scene.model, shape, observations, options)
    statements = gathered(scene.statements + marks.statements)
    model = CorrectedModel(scene.model, adjustment.correction)
    return Refinement(model, adjustment, statements=statements)


def written(
    refinement: Refinement, image: Path, model: Path | None, scene: Scene, folder: Path
) -> Refinement:
    """The refinement, after its model was written into a folder; see `write_refined`.

    Args:
        refinement: of the scene.
        image, model: files of the scene.
        scene: as read from them.
        folder: created when missing.

    Raises:
        FormatError: a delivered file would be overwritten.
    """
    refined = write_refined(
        ImageFiles(image, model),
        refinement.model,
        refinement.adjustment,
        shape=scene.image.shape,
        folder=folder,
    )
    return replace(refinement, files=refined.files)
