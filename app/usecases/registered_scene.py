"""A scene with its registered model and the errors of that model, from the files of a registration."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

from amers.app.errors import InputError
from amers.app.usecases.model_choice import parse_crop_origin
from amers.services.formats.block.reader import block_member, read_document
from amers.services.formats.images.bands import BandMix
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.correction_json import (
    is_of_rigorous,
    parse_correction_accuracy,
)
from amers.services.formats.sensor_models.refined_model import CORRECTION_JSON
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.formats.text_files import read_text
from amers.services.imagery.scene import Scene
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.parameter_sets import SRP, ParameterSet

REFINED_NAME = "refined_RPC.TXT"
"""Name of the refined model among the outputs of a registration."""


@dataclass(frozen=True)
class SceneModel:
    """A scene and its model.

    Attributes:
        image: raw image: GeoTIFF, JPEG 2000 or NITF.
        model: file of the delivered model; by default it is found by its name.
        registration: folder of the registration of the scene, the output of `amers scene register`.
        sigma_m: accuracy of a model that is not registered, one sigma, metres; by default unknown.
        crop_origin: position LINE,SAMPLE of the first pixel of the image in the full image of the sensor
            model; by default the position that ICHIPB, .TIL, DIMAP or the geotransform states.
    """

    image: Path
    model: Path | None = None
    registration: Path | None = None
    sigma_m: float | None = None
    crop_origin: str | None = None


def read_registered_scene(files: SceneModel) -> tuple[Scene, CorrectionAccuracy | None]:
    """As `registered_scene`, of the files that the options of a command name.

    Raises:
        InputError: the scene or its registration cannot be used.
    """
    origin = None if files.crop_origin is None else parse_crop_origin(files.crop_origin)
    return registered_scene(ImageFiles(files.image, files.model, origin), files.registration)


def registered_scene(
    source: ImageFiles, folder: Path | None, bands: BandMix | None = None
) -> tuple[Scene, CorrectionAccuracy | None]:
    """A scene with its registered model, and the errors of that model; None when it is not registered.

    With a registration, the model is its refined RPC. Where it made none, where no RPC carries its
    correction exactly, or a model is given, it is the delivered model with the correction.

    Args:
        source: files of the scene.
        folder: of its registration, if it has one.
        bands: to use; by default those of `read_scene`.

    Raises:
        InputError: the scene or its registration cannot be used.
    """
    if folder is None:
        return _scene(source, bands), None
    accuracy = _read_accuracy(folder)
    refined = folder / REFINED_NAME
    if source.model is None and refined.is_file() and not _is_better_corrected(folder, accuracy):
        scene = _scene(ImageFiles(source.image, refined, (0.0, 0.0)), bands)
        _check_size(folder, scene)
        return scene, accuracy
    # Which of the published sets does not matter: only what is kept of the metadata does.
    scene = _scene(source, bands, SRP if _is_of_rigorous(folder) else None)
    _check_size(folder, scene)
    return replace(scene, model=CorrectedModel(scene.model, accuracy.correction)), accuracy


def delivered_and_correction(
    source: ImageFiles, folder: Path, bands: BandMix | None = None
) -> tuple[Scene, ImageCorrection]:
    """A scene with its delivered model, and the correction of its registration.

    Args:
        source: files of the scene.
        folder: of its registration.
        bands: to use; by default those of `read_scene`.

    Raises:
        InputError: the scene or its registration cannot be used, or the correction is that of a rigorous
            model, whose parameters are not in its files.
    """
    accuracy = _read_accuracy(folder)
    if _is_of_rigorous(folder):
        raise InputError(
            f"{folder / CORRECTION_JSON}: corrects a rigorous model, a correction of the delivered RPC "
            "expected: register the scene without --rigorous"
        )
    scene = _scene(source, bands)
    _check_size(folder, scene)
    return scene, accuracy.correction


def read_raw_scene(files: SceneModel) -> tuple[Scene, CorrectionAccuracy | None]:
    """See `read_registered_scene`; an ortho-image is refused.

    Raises:
        InputError: the scene or its registration cannot be used, or the scene is an ortho-image.
    """
    scene, accuracy = read_registered_scene(files)
    model = scene.model.base if isinstance(scene.model, CorrectedModel) else scene.model
    if isinstance(model, OrthoModel):
        raise InputError(
            f"{files.image}: has a map grid, a raw image with a sensor model is expected; vectors drawn "
            "on an ortho-image are on the map already"
        )
    return scene, accuracy


def adjusted_model(block: Path, image: Path) -> Path:
    """The file of the adjusted model of an image of a block.

    Raises:
        InputError: the block has no such image, or no model of it.
    """
    document = read_document(block)
    for one, model in zip(document.images, document.models, strict=True):
        if one.image_id in (image.stem, image.name) and model is not None:
            return block_member(block, model)
    known = ", ".join(one.image_id for one in document.images[:5])
    raise InputError(f"{image}: no image of {block} with an adjusted model; its images: {known}")


def _read_accuracy(folder: Path) -> CorrectionAccuracy:
    path = folder / CORRECTION_JSON
    if not path.is_file():
        raise InputError(
            f"{folder}: no {CORRECTION_JSON} found, the folder of a registration expected, as "
            "`amers scene register -o` writes it"
        )
    return parse_correction_accuracy(read_text(path), str(path))


def _scene(
    source: ImageFiles, bands: BandMix | None, parameter_set: ParameterSet | None = None
) -> Scene:
    return read_scene(
        source.image,
        source.model,
        sigma_m=1.0,
        bands=bands,
        crop_origin=source.crop_origin,
        parameter_set=parameter_set,
    )


def _is_better_corrected(folder: Path, accuracy: CorrectionAccuracy) -> bool:
    """Whether the delivered model with the correction is closer than the refined RPC of a registration.

    No RPC carries a displacement of lines and samples.
    """
    return accuracy.correction.displacement is not None and not _is_of_rigorous(folder)


def _is_of_rigorous(folder: Path) -> bool:
    path = folder / CORRECTION_JSON
    return is_of_rigorous(read_text(path), str(path))


def _check_size(folder: Path, scene: Scene) -> None:
    """Refuse the registration of an image of another size."""
    report = folder / "report.json"
    if not report.is_file():
        return
    try:
        of_report = json.loads(read_text(report))["scene"]
        shape = of_report["lines"], of_report["samples"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{report}: the report of a registration expected: {error}") from error
    if shape != tuple(scene.image.shape):
        raise InputError(
            f"{folder}: registers an image of {shape[0]} x {shape[1]} pixels, the scene has "
            f"{scene.image.shape[0]} x {scene.image.shape[1]}; give the registration of this scene"
        )
