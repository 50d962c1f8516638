"""Errors of a user's own points by the number of control points, the images and their base."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.marks_in_images import ImageMarks, MarkedImages, read_image_marks
from amers.services.adjustment.intersected_marks import intersect_marks
from amers.services.adjustment.parameters import AdjustableImage, image_parameters
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.production.image_production import ProductionOptions
from amers.services.quality.control_series import MarkedGroundPoints, SeriesRow, control_series
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.statements import Statements
from amers.services.types import Array, BoolArray, Progress, no_progress

COUNTS = (0, 1, 2, 3, 4, 6, 8, 10, 15, 20)
"""Numbers of control points that are tried by default, as far as the points allow."""


@dataclass(frozen=True)
class ExperimentOptions:
    """What is tried.

    Attributes:
        draws: number of random draws of control points; the errors of all draws are combined.
        seed: seed of the random draws; the same seed gives the same draws.
    """

    draws: int = 5
    seed: int = 0


@dataclass(frozen=True)
class ExperimentRow:
    """Errors of check points with some images on some control points.

    Attributes:
        images: their names.
        base_to_height: largest of two of them; 0 for one image.
        control_points: number of them; 0 for the models as delivered.
        errors: number of errors of check points, over all draws.
        rms_m: east, north, up; null for up with one image, whose heights are taken as known.
        residual_parallax_m: along lines and samples; null with one image.
        worst: point with the largest error.
        worst_m: that error.
        reason: why there is no result; "" where there is one.
    """

    images: list[str]
    base_to_height: float
    control_points: int
    errors: int
    rms_m: list[float]
    residual_parallax_m: list[float]
    worst: str
    worst_m: float
    reason: str


@dataclass(frozen=True)
class Experiment:
    """The series.

    Attributes:
        rows: by images, then by number of control points.
        points: of known ground that every image shows: control or check points of a draw.
        ties: points of unknown ground, which tie the images.
        notes: points that are left out, in words.
        statements: of all files.
    """

    rows: list[ExperimentRow]
    points: int
    ties: int
    notes: list[str]
    statements: Statements


def run_experiment(
    files: MarkedImages,
    point_sigma_m: tuple[float, float] | None,
    counts: Sequence[int] = COUNTS,
    options: ExperimentOptions = ExperimentOptions(),
    progress: Progress = no_progress,
) -> Experiment:
    """The errors of check points of some files of marks, in all configurations.

    Args:
        files: marks and images as delivered.
        point_sigma_m: horizontal and up, one sigma, of known ground whose file states none.
        counts: numbers of control points.
        options: draws.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used, or the accuracy of known ground is not stated.
        NotEnoughPoints: too few points of known ground are marked in every image.
    """
    read = read_image_marks(files)
    wrong = _wrong_points(read)
    points = _points(read, point_sigma_m, wrong)
    rng = np.random.default_rng(options.seed)
    rows = control_series(points, counts, options.draws, rng, progress)
    unknown = np.isnan(points.known[:, 0])
    notes = [
        f"point {read.names[p]}: left out, one of its marks disagrees with the others"
        for p in sorted(wrong)
    ]
    return Experiment(
        [_described(row, read) for row in rows],
        len(points.usable),
        int(unknown.sum()) - len(wrong),
        notes,
        read.statements,
    )


def _wrong_points(read: ImageMarks) -> set[int]:
    """Points with a mark that disagrees with the others, seen on all images together."""
    models = [scene.model for scene in read.scenes]
    found = intersect_marks(models, read.errors, read.marks, len(read.names))
    wrong = np.flatnonzero(found.disagree).tolist() + read.marks.point[found.rejected].tolist()
    return set(wrong)


def _points(
    read: ImageMarks, point_sigma_m: tuple[float, float] | None, wrong: set[int]
) -> MarkedGroundPoints:
    known = read.known.copy()
    left_out = np.isin(np.arange(len(known)), sorted(wrong))
    known[left_out] = np.nan
    sigma_m = with_stated_sigmas(read, np.asarray(np.isfinite(known).all(axis=1)), point_sigma_m)
    return MarkedGroundPoints(
        names=read.names,
        known=known,
        sigma_m=sigma_m,
        marks=read.marks.take(~left_out[read.marks.point]),
        images=tuple(adjustable(scene) for scene in read.scenes),
        models=tuple(scene.model for scene in read.scenes),
        gsd_m=np.array([scene_gsd_m(scene) for scene in read.scenes]),
    )


def with_stated_sigmas(
    read: ImageMarks, known: BoolArray, point_sigma_m: tuple[float, float] | None
) -> Array:
    """The sigmas (n, 3) of known ground, those that no file states from the caller.

    Raises:
        InputError: a point of known ground (n,) has none.
    """
    sigma_m = read.sigma_m
    if point_sigma_m is not None:
        horizontal_m, up_m = point_sigma_m
        sigma_m = np.where(np.isnan(sigma_m), [horizontal_m, horizontal_m, up_m], sigma_m)
    unstated = known & np.isnan(sigma_m).any(axis=1)
    if unstated.any():
        raise InputError(
            f"{int(unstated.sum())} points, such as {read.names[int(np.argmax(unstated))]}, have no "
            "sigma of their ground: state it (--point-sigma-m HORIZONTAL,UP)"
        )
    return sigma_m


def adjustable(scene: Scene, edge_sigma_m: float | None = None) -> AdjustableImage:
    """What may move in an image: its orbit and attitude, or a correction in the image.

    Args:
        scene: the image.
        edge_sigma_m: a priori sigma of drifts and skews at its edge; by default that of a production.
    """
    name = scene.acquisition.image_id
    if scene.parameter_set is not None and isinstance(scene.model, PushbroomModel):
        return rigorous_parameters(name, scene.model, scene.parameter_set, sigma_m=scene.sigma_m)
    gsd_m = scene_gsd_m(scene)
    slope_px = ProductionOptions().slope * max(scene.image.shape) / 2.0
    return image_parameters(
        name,
        scene.model,
        scene.image.shape,
        shift_px=scene.sigma_m / gsd_m,
        slope_px=slope_px if edge_sigma_m is None else edge_sigma_m / gsd_m,
    )


def _described(row: SeriesRow, read: ImageMarks) -> ExperimentRow:
    return ExperimentRow(
        images=[read.image_names[k] for k in row.images],
        base_to_height=row.base_to_height,
        control_points=row.control,
        errors=row.checked,
        rms_m=row.rms_m.tolist(),
        residual_parallax_m=row.parallax_m.tolist(),
        worst="" if row.worst < 0 else read.names[row.worst],
        worst_m=row.worst_m,
        reason=row.reason,
    )
