"""The scenes of a mosaic from files, with the models that they are rectified with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.orthorectification import pixel_type
from amers.app.usecases.registered_scene import SceneModel, adjusted_model, read_registered_scene
from amers.services.errors import FormatError
from amers.services.formats.block.reader import read_document
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.ortho import BandForm
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.reopened import reopened_bands
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.formats.images.tiled_image import TiledImage
from amers.services.imagery.scene import Scene, scene_centre
from amers.services.mosaic.layout import MosaicScene
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.base import SensorModel
from amers.services.statements import Statements


@dataclass(frozen=True)
class MosaicFiles:
    """The files that a mosaic is made from.

    Attributes:
        images: raw scenes or ortho-images, all with the same bands. A scene that lies completely within
            earlier scenes of this list is not shown.
        registered: output folder of `amers scene register-many`, with the registrations of the images.
        block: folder of a block that was made from the images; the adjusted models of the block are
            used.
    """

    images: tuple[Path, ...]
    registered: Path | None = None
    block: Path | None = None


@dataclass(frozen=True)
class MosaicSource:
    """An image of a mosaic and where its model comes from: one of three, or the image itself.

    Attributes:
        image: raw, or on a map.
        registration: folder of the registration whose model is used.
        block: folder of the block whose adjusted model is used.
        model: file of the model that is used.
        crop_origin: line and sample of the image in the one that `model` is for; see `read_scene`.
        name: of the scene in results; by default that of its image.
    """

    image: Path
    registration: Path | None = None
    block: Path | None = None
    model: Path | None = None
    crop_origin: tuple[float, float] | None = None
    name: str | None = None


@dataclass(frozen=True)
class ReadScene:
    """A scene that was read; its file is closed.

    Attributes:
        path: of the image.
        scene: whose bands are opened when they are read.
        form: of its bands in a file.
        colours: names of its bands.
        statements: of its files.
    """

    path: Path
    scene: MosaicScene
    form: BandForm
    colours: tuple[str, ...]
    statements: Statements


def sources_of(files: MosaicFiles) -> list[MosaicSource]:
    """The images of some files, and where their models come from.

    Raises:
        InputError: two places are given.
    """
    if files.registered is not None and files.block is not None:
        raise InputError("one of --registered and --block is expected, not both")
    if files.registered is None:
        return [MosaicSource(image, block=files.block) for image in files.images]
    return [MosaicSource(image, files.registered / scene_name(image)) for image in files.images]


def read_mosaic_scenes(sources: Sequence[MosaicSource]) -> list[ReadScene]:
    """The scenes of some images, one after the other.

    Raises:
        InputError: a file cannot be used, or the images have different bands or types.
    """
    read = [_read(source) for source in sources]
    _check_same(read)
    return read


def _check_same(read: Sequence[ReadScene]) -> None:
    first = read[0]
    for one in read[1:]:
        for what, found, expected in (
            ("bands", one.form.bands, first.form.bands),
            ("pixel type", one.form.dtype, first.form.dtype),
            ("colours of the bands", ", ".join(one.colours), ", ".join(first.colours)),
        ):
            if found != expected:
                raise InputError(
                    f"{one.path}: {what}: {found} found, {expected} expected as in {first.path}; make "
                    "one mosaic of images with the same bands and pixel type"
                )


def _read(source: MosaicSource) -> ReadScene:
    scene, delivered, sigma_m = _with_model(source)
    if source.name is not None:
        scene = replace(scene, acquisition=replace(scene.acquisition, image_id=source.name))
    raster = scene.image
    assert isinstance(raster, RasterImage | TiledImage)
    try:
        dtype, nodata = pixel_type(raster)
        numbers = raster.validity.image_bands
        saturated = next(reversed(raster.saturated_values(numbers[0])), None)
        colours = tuple(raster.validity.colours[number - 1] for number in numbers)
        bands = reopened_bands(raster)
    finally:
        raster.close()
    form = BandForm(len(bands), dtype, nodata, saturated)
    one = MosaicScene(replace(scene, image=bands[0], statements=()), bands, delivered, sigma_m)
    return ReadScene(source.image, one, form, colours, scene.statements)


def _with_model(source: MosaicSource) -> tuple[Scene, SensorModel | None, float]:
    """A scene with the model used, its model before registration, and the accuracy of the first."""
    image = source.image
    if source.registration is not None:
        scene, accuracy = read_registered_scene(SceneModel(image, registration=source.registration))
        return scene, _delivered(image), _stated_m(scene, accuracy)
    if source.block is not None:
        model = adjusted_model(source.block, image)
        scene = read_scene(image, model, sigma_m=1.0, bands=one_band(1))
        return scene, _delivered(image), _stated_by_block_m(source.block)
    given = partial(read_scene, image, source.model, bands=one_band(1), crop_origin=source.crop_origin)
    try:
        scene = given()
    except FormatError:
        # An image on a map whose accuracy nobody states; any other error comes again.
        return given(sigma_m=1.0), None, math.nan
    return scene, None, scene.sigma_m


def _stated_by_block_m(block: Path) -> float:
    """Accuracy of the adjusted models of a block: of its frame, if known, and what its points share."""
    frame = read_document(block).metadata.frame
    covariance = np.nan_to_num(frame.covariance_m2[:2, :2]) + frame.shared_m2[:2, :2]
    sigma_m = float(np.sqrt(np.trace(covariance) / 2.0))
    return sigma_m if sigma_m > 0.0 else math.nan


def _delivered(image: Path) -> SensorModel:
    scene = read_scene(image, sigma_m=1.0, bands=one_band(1))
    scene.image.close()  # type: ignore[attr-defined]
    return scene.model


def _stated_m(scene: Scene, accuracy: CorrectionAccuracy | None) -> float:
    """Accuracy of a registered model in the middle of its image, on the Earth where that is known."""
    if accuracy is None:
        return math.nan
    ground = scene_centre(scene)[None, :]
    derivative = scene.model.project_derivative(ground)
    covariance = accuracy.relative_px2(scene.model.project(ground))[0]
    frame = accuracy.frame_px2(derivative)[0]
    if np.isfinite(frame).all():
        covariance = covariance + frame
    to_ground = np.linalg.inv(derivative[0, :, :2])
    return float(np.sqrt(np.trace(to_ground @ covariance @ to_ground.T) / 2.0))
