"""Points marked in several images, with their models and the errors of these, from files."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.marked_files import images_of_marks
from amers.app.usecases.model_choice import ModelChoice, metres_by_image
from amers.app.usecases.registered_scene import SceneModel, adjusted_model, read_registered_scene
from amers.services.adjustment.intersected_marks import EXACT_MODEL, ModelErrors
from amers.services.formats.block.reader import read_document
from amers.services.formats.gcp.marked_points import MarkedPoints
from amers.services.formats.gcp.reader import StatedByCaller, read_marked_ground
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.imagery.scene import Scene
from amers.services.quality.check_points import MARKING_SIGMA_PX
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.quality.frames import weighted_frame
from amers.services.sensors.parameter_sets import parameter_set_named
from amers.services.statements import Statements, gathered
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations

OF_CONTROL, OF_BLOCK, OF_MODELS = "the control points", "the block", "the models"
"""What positions are relative to: with registered scenes, with images of a block, with others."""


@dataclass(frozen=True)
class MarkedImages:
    """Marks in files, and the images that they are in.

    Attributes:
        marks: files of points marked in images: CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI, PCI. Several
            files may mark the same points, which have the same names. A CSV needs no ground coordinates.
        images: image that is named in the marks; give at least two.
        registered: output folder of `amers scene register-many`, with the registrations of the images.
        block: folder of a block that was made from the images; the adjusted models of the block are
            used.
        rigorous: use the rigorous models of images whose metadata contain one, instead of their RPC. The
            value is the set of parameters that an adjustment estimates: srp, toutin or spot-hrv.
        sigma_m: accuracy of a model that is not registered, one sigma, metres; for one of several images
            write IMAGE=M, and repeat the option. By default the accuracy that the producer states, or
            that of the sensor.
        mark_sigma_px: sigma of marks if their file states none, pixels; by default 0.5.
        models: of the images whose names and tags do not give them.
        stated: what the files of the marks do not state.
    """

    marks: tuple[Path, ...]
    images: tuple[Path, ...]
    registered: Path | None = None
    block: Path | None = None
    rigorous: str | None = None
    sigma_m: tuple[str, ...] = ()
    mark_sigma_px: float | None = None
    models: ModelChoice = field(default_factory=ModelChoice)
    stated: StatedByCaller = field(default_factory=StatedByCaller)


@dataclass(frozen=True)
class ImageMarks:
    """n points with m marks in k images.

    Attributes:
        names: of the points.
        known: (n, 3) where the files state their ground; NaN elsewhere.
        sigma_m: (n, 3) of the known ground; NaN when unknown.
        check: (n,) points that the files flag as check points.
        file: (n,) number of the first file that states its ground; -1 without.
        marks: in the images.
        scenes: the images.
        errors: of their models.
        frame: error on the Earth that all points share.
        reference: what the positions are relative to, one of the constants above.
        statements: of all files.
    """

    names: tuple[str, ...]
    known: Array
    sigma_m: Array
    check: BoolArray
    file: IntArray
    marks: Observations
    scenes: tuple[Scene, ...]
    errors: tuple[ModelErrors, ...]
    frame: Frame
    reference: str
    statements: Statements

    @property
    def is_registered(self) -> bool:
        """Whether the errors of the models are those relative to control points."""
        return self.reference == OF_CONTROL

    @property
    def shared_m2(self) -> Array:
        """Covariance (3, 3) of what the models of a block are off by together, beyond its frame."""
        return self.frame.shared_m2 if self.reference == OF_BLOCK else np.zeros((3, 3))

    @property
    def image_names(self) -> list[str]:
        """Names of the images."""
        return [scene.acquisition.image_id for scene in self.scenes]


def read_image_marks(files: MarkedImages) -> ImageMarks:
    """The marks of some files and the models of their images.

    Raises:
        InputError: a file cannot be used, a mark is in none of the images, or a point is marked twice in
            an image.
    """
    _check(files)
    with ExitStack() as stack:
        scenes, accuracies = [], []
        for image, (model, origin) in files.models.of(files.images).items():
            scene, accuracy = _scene(files, image, model, origin)
            stack.callback(scene.image.close)  # type: ignore[attr-defined]
            scenes.append(scene)
            accuracies.append(accuracy)
    points = _points(files, scenes)
    return _with_models(files, points, scenes, [one for one in accuracies if one is not None])


def _check(files: MarkedImages) -> None:
    if len(files.images) < 2:
        raise InputError(
            f"--images: {len(files.images)} found, two at least expected: a position needs two views"
        )
    if files.registered is not None and files.block is not None:
        raise InputError(
            "--registered and --block: both given, but one of them is expected; leave one out"
        )
    placed = files.registered or files.block
    if placed is not None and (files.sigma_m or files.rigorous or files.models != ModelChoice()):
        raise InputError(
            "--sigma-m, --model, --crop-origin and --rigorous describe delivered models, but the "
            f"adjusted models of {placed} are used; leave these options out"
        )


def _scene(
    files: MarkedImages, image: Path, model: Path | None, origin: tuple[float, float] | None
) -> tuple[Scene, CorrectionAccuracy | None]:
    """An image with its model, and the errors of a registered one."""
    if files.registered is not None:
        folder = files.registered / scene_name(image)
        return read_registered_scene(SceneModel(image, registration=folder))
    if files.block is not None:
        return read_scene(image, adjusted_model(files.block, image), sigma_m=1.0), None
    rigorous = None if files.rigorous is None else parameter_set_named(files.rigorous)
    sigma_m = metres_by_image("--sigma-m", files.sigma_m, files.images).get(image)
    scene = read_scene(image, model, sigma_m=sigma_m, crop_origin=origin, parameter_set=rigorous)
    return scene, None


@dataclass(frozen=True)
class _Points:
    names: tuple[str, ...]
    known: Array
    sigma_m: Array
    check: BoolArray
    file: IntArray
    marks: Observations
    statements: Statements


_SAME_PLACE = np.array([1e-8, 1e-8, 1e-3])
"""Positions of one point in several files agree to this: degrees, degrees, metres."""


def _points(files: MarkedImages, scenes: Sequence[Scene]) -> _Points:
    """The points of all files by their names."""
    stated = replace(files.stated, csv=replace(files.stated.csv, may_lack_ground=True))
    read = [read_marked_ground(path, stated) for path in files.marks]
    images = [
        images_of_marks(one.take(one.is_marked), path, scenes, files.images)
        for one, path in zip(read, files.marks, strict=True)
    ]
    names, point = np.unique(np.concatenate([one.id for one in read]), return_inverse=True)
    point = point.astype(np.int64)
    known, sigma_m = np.full((len(names), 3), np.nan), np.full((len(names), 3), np.nan)
    check, file = np.zeros(len(names), dtype=np.bool_), np.full(len(names), -1)
    rows = 0
    for number, (one, path) in enumerate(zip(read, files.marks, strict=True)):
        own = point[rows : rows + len(one)]
        rows += len(one)
        _set_ground(known, sigma_m, own, one, path)
        check[own[one.check]] = True
        new = own[np.isfinite(one.lon_lat_h[:, 0])]
        file[new[file[new] < 0]] = number
    marked = np.concatenate([one.is_marked for one in read])
    line_sample, sigma_px = (
        np.concatenate([getattr(one, name) for one in read])[marked]
        for name in ("line_sample", "sigma_px")
    )
    of_point, image = point[marked], np.concatenate(images)
    order = np.lexsort((image, of_point))
    sigma_px = np.nan_to_num(sigma_px, nan=files.mark_sigma_px or MARKING_SIGMA_PX)
    marks = Observations(of_point, image, line_sample, sigma_px).take(order)
    same = (np.diff(marks.point) == 0) & (np.diff(marks.image) == 0)
    if same.any():
        row = int(np.flatnonzero(same)[0])
        raise InputError(
            f"point {names[marks.point[row]]}: marked twice in "
            f"{scenes[marks.image[row]].acquisition.image_id}, once expected; give points other names"
        )
    statements = tuple(chain(*(one.statements for one in read)))
    return _Points(tuple(names.tolist()), known, sigma_m, check, file, marks, statements)


def _set_ground(known: Array, sigma_m: Array, point: IntArray, marks: MarkedPoints, path: Path) -> None:
    """Enter the ground of a file; refuse another position of the same point."""
    for row in np.flatnonzero(np.isfinite(marks.lon_lat_h[:, 0])).tolist():
        at, ground = int(point[row]), marks.lon_lat_h[row]
        if (np.abs(known[at] - ground) > _SAME_PLACE).any():
            raise InputError(
                f"{path.name}, point {marks.id[row]}: {ground.tolist()} found, {known[at].tolist()} "
                "expected as in another file: give points different names, or correct one of them"
            )
        known[at] = np.where(np.isnan(known[at]), ground, known[at])
        sigma_m[at] = np.where(np.isnan(sigma_m[at]), marks.sigma_m[row], sigma_m[at])


def _with_models(
    files: MarkedImages,
    points: _Points,
    scenes: Sequence[Scene],
    accuracies: Sequence[CorrectionAccuracy],
) -> ImageMarks:
    """The points with the errors of the models of their images."""
    places = [points.marks.line_sample[points.marks.image == k] for k in range(len(scenes))]
    if files.registered is not None:
        errors = [_of_registration(one, at) for one, at in zip(accuracies, places, strict=True)]
        frame = weighted_frame([one.frame for one in accuracies], np.ones(len(accuracies)))
        reference = OF_CONTROL
    elif files.block is not None:
        errors, frame = [EXACT_MODEL] * len(scenes), read_document(files.block).metadata.frame
        reference = OF_BLOCK
    else:
        errors = [_of_delivery(scene, at) for scene, at in zip(scenes, places, strict=True)]
        frame, reference = Frame.from_sigmas(0.0, 0.0), OF_MODELS
    statements = gathered(chain(*(scene.statements for scene in scenes), points.statements))
    return ImageMarks(
        points.names,
        points.known,
        points.sigma_m,
        points.check,
        points.file,
        points.marks,
        tuple(scenes),
        tuple(errors),
        frame,
        reference,
        statements,
    )


def _of_registration(accuracy: CorrectionAccuracy, line_sample: Array) -> ModelErrors:
    """Errors of a registered model where its marks are; NaN where its registration states none."""
    if not len(line_sample):
        return EXACT_MODEL
    shared = (
        replace(accuracy, local_sigma_px=np.zeros(2), held=None).relative_px2(line_sample).mean(axis=0)
    )
    return ModelErrors(shared, np.nan_to_num(accuracy.local_sigma_px))


def _of_delivery(scene: Scene, line_sample: Array) -> ModelErrors:
    """Errors of a delivered model: its horizontal accuracy, seen in the image."""
    if not len(line_sample):
        return EXACT_MODEL
    height_m = np.array([sum(scene.model.height_range_m) / 2.0])
    ground = scene.model.locate(line_sample.mean(axis=0)[None, :], height_m)
    horizontal = scene.model.project_derivative(ground)[0, :, :2]
    return ModelErrors(scene.sigma_m**2 * horizontal @ horizontal.T, np.zeros(2))
