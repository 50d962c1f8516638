"""The rigorous model of an image: finding its metadata, and converting it to the pixels of the image."""

import re
from pathlib import Path
from typing import NamedTuple

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.formats.sensor_models.model_order import names_of_models
from amers.services.formats.sensor_models.place import stated_place
from amers.services.formats.sensor_models.rigorous_model import rigorous_model_in
from amers.services.formats.text_files import read_text
from amers.services.sensors.pushbroom import PushbroomModel


class DeliveredRigorousModel(NamedTuple):
    """The rigorous model delivered with an image, in the pixels of that image.

    Attributes:
        model: (0, 0) is the centre of the first pixel of the image.
        path: the file it was read from.
    """

    model: PushbroomModel
    path: FilePlace


def rigorous_model_of_image(
    image: SceneImage,
    model_path: Path | None = None,
    crop_origin: tuple[float, float] | None = None,
) -> DeliveredRigorousModel | None:
    """The rigorous model in the metadata of an image; None where none of its files has one.

    Looked at are `model_path` and the `DIM_` file of its product; else the XML files that have the name
    of a model of the image, as `names_of_models` lists them for all models: the documents of products
    first, then those of WorldView and of RPCs.

    Args:
        image: open.
        model_path: file of the model, when it is not to be found by its name.
        crop_origin: line and sample of the first pixel of the image in the image that the model is for;
            by default its position in the full scene, where the image file states one.

    Raises:
        FormatError: a value of the model is missing or impossible, or the image is a part of the one it
            is for and it is not stated which.
    """
    for path in _metadata_of(image, model_path):
        text = read_text(path)
        if not text.lstrip("\ufeff \t\r\n").startswith("<"):
            continue
        model = rigorous_model_in(text, path.name)
        if model is not None:
            return DeliveredRigorousModel(_in_pixels_of(image, model, path, crop_origin), path)
    return None


def _metadata_of(image: SceneImage, model_path: Path | None) -> list[FilePlace]:
    """The files that may have the rigorous model of an image."""
    if model_path is not None:
        product = model_path.with_name(re.sub("^RPC_", "DIM_", model_path.name, flags=re.IGNORECASE))
        return [path for path in dict.fromkeys([model_path, product]) if path.is_file()]
    names = names_of_models(image)
    kinds = ("rigorous", "airbus", "isd", "other dimap")
    return Siblings(image.path).named([name for kind in kinds for name in names[kind]])


def _in_pixels_of(
    image: SceneImage,
    model: PushbroomModel,
    path: FilePlace,
    crop_origin: tuple[float, float] | None,
) -> PushbroomModel:
    """The part of a model that an image shows."""
    origin = crop_origin
    if origin is None and not isinstance(image, TiledImage):
        place = stated_place(image, Siblings(image.path), path)
        if place is not None and place.step != (1.0, 1.0):
            raise FormatError(
                f"{image.path}: reduced, {place}: the rigorous model of {path.name} is for all pixels; "
                "register it without --rigorous"
            )
        origin = None if place is None else place.first
    if origin is None and re.search(r"_R1C1$", image.path.stem, re.IGNORECASE):
        origin = (0.0, 0.0)
    if origin is None:
        if image.shape == model.image_shape:
            return model
        raise FormatError(
            f"{image.path}: {image.shape[0]} x {image.shape[1]} pixels, and the rigorous model of "
            f"{path.name} is for {model.image_shape[0]} x {model.image_shape[1]}: the whole image "
            "expected, or a part that states its first pixel in the whole image"
        )
    ends = zip(origin, image.shape, model.image_shape, strict=True)
    if any(first < 0.0 or first + size > whole for first, size, whole in ends):
        lines, samples = model.image_shape
        raise FormatError(
            f"{image.path}: a part of {image.shape[0]} x {image.shape[1]} pixels from line "
            f"{origin[0]:g}, sample {origin[1]:g}, beyond the {lines} x {samples} pixels of the "
            f"rigorous model of {path.name}"
        )
    return model.cropped(origin, image.shape)
