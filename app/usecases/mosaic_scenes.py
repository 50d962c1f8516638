"""The scenes of a mosaic from files, with the models that they are rectified with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.orthorectification import pixel_type
from amers.app.usecases.registered_scene import SceneModel, adjusted_model, read_registered_scene
from amers.services.errors import FormatError
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
        images: raw scenes or ortho-images, all with the same bands. What lies whole within those given
            before is not shown.
        registered: folder with the registrations of the images, one folder each, as `amers scene
            register-many -o` writes it.
        block: folder of a block that was made from the images, whose adjusted models are used.
    """

    images: tuple[Path, ...]
    registered: Path | None = None
    block: Path | None = None


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


def read_mosaic_scenes(files: MosaicFiles) -> list[ReadScene]:
    """The scenes of some files, one after the other.

    Raises:
        InputError: a file cannot be used, or the images have different bands or types.
    """
    if files.registered is not None and files.block is not None:
        raise InputError("one of --registered and --block is expected, not both")
    read = [_read(image, files) for image in files.images]
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


def _read(image: Path, files: MosaicFiles) -> ReadScene:
    scene, delivered, sigma_m = _with_model(image, files)
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
    return ReadScene(image, one, form, colours, scene.statements)


def _with_model(image: Path, files: MosaicFiles) -> tuple[Scene, SensorModel | None, float]:
    """A scene with the model used, its model before registration, and the accuracy of the first."""
    if files.registered is not None:
        folder = files.registered / scene_name(image)
        scene, accuracy = read_registered_scene(SceneModel(image, registration=folder))
        return scene, _delivered(image), _stated_m(scene, accuracy)
    if files.block is not None:
        scene = read_scene(image, adjusted_model(files.block, image), sigma_m=1.0, bands=one_band(1))
        return scene, _delivered(image), math.nan
    try:
        scene = read_scene(image, bands=one_band(1))
    except FormatError:
        # An image on a map whose accuracy nobody states; any other error comes again.
        return read_scene(image, sigma_m=1.0, bands=one_band(1)), None, math.nan
    return scene, None, scene.sigma_m


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
