"""Which model each of several images has, as the options of a command or the inputs of a job name it."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from amers.app.errors import InputError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.text_files import NUMBER_PATTERN

CropOrigin = tuple[float, float]
Place = TypeVar("Place", Path, FilePlace)


@dataclass(frozen=True)
class ModelChoice:
    """The models of images, where they are not those that their names and tags give.

    Attributes:
        model: file of the sensor model; for one of several images write IMAGE=FILE, and repeat the
            option. By default the first that exists of STEM.RPB, STEM.XML (WorldView), STEM_RPC.TXT,
            RPC_NAME.XML (DIMAP), STEM.rpc, tags of the image, IMAGE.aux.xml, STEM_RPC.XML, STEM.geom,
            DIM_NAME.XML, METADATA.DIM, PHRDIMAP_NAME.XML, as in GDAL. For JPEG 2000, IMAGE.aux.xml comes
            first; for NITF, IMAGE.aux.xml, STEM_RPC.TXT and RPC00B come first.
        crop_origin: position LINE,SAMPLE of the first pixel of the image in the full image of the sensor
            model; 0,0 if the image is the full image. For one of several images write IMAGE=LINE,SAMPLE,
            and repeat the option. By default the position that ICHIPB, .TIL, DIMAP or the geotransform
            states.
    """

    model: tuple[str, ...] = ()
    crop_origin: tuple[str, ...] = ()

    def of(self, images: Sequence[Path]) -> dict[Path, tuple[Path | None, CropOrigin | None]]:
        """The model file and the crop origin of each image; None where they are not given.

        Raises:
            InputError: a file does not exist, a value has another form, or it is of no image.
        """
        files = by_image("--model", self.model, images)
        origins = by_image("--crop-origin", self.crop_origin, images)
        for text in files.values():
            if not Path(text).is_file():
                raise InputError(f"--model: {text}: no such file; the file of a model expected")
        return {
            image: (
                Path(files[image]) if image in files else None,
                parse_crop_origin(origins[image]) if image in origins else None,
            )
            for image in images
        }


def parse_crop_origin(text: str, source: str = "--crop-origin") -> CropOrigin:
    """Line and sample of a text.

    Raises:
        InputError: it has another form.
    """
    found = re.fullmatch(rf"\s*({NUMBER_PATTERN})\s*,\s*({NUMBER_PATTERN})\s*", text)
    if found is None:
        raise InputError(f"{source}: {text[:60]!r} found, LINE,SAMPLE expected, such as 8192,0")
    return float(found[1]), float(found[2])


def by_image(option: str, values: Iterable[str], images: Sequence[Place]) -> dict[Place, str]:
    """The values of an option by their images: FILE of the only image, IMAGE=FILE of one of several."""
    found: dict[Place, str] = {}
    for value in values:
        name, sign, text = value.partition("=")
        named = [image for image in images if sign and name in (str(image), image.name, image.stem)]
        if not named and len(images) == 1:
            named, text = list(images), value
        if len(named) != 1:
            raise InputError(
                f"{option}: {value[:200]!r} belongs to {len(named)} of {len(images)} images: name the "
                f"image by its path or its file, such as {option} {images[0].name}=…"
            )
        if named[0] in found:
            raise InputError(f"{option}: given twice for {named[0].name}, once expected")
        found[named[0]] = text
    return found


def metres_by_image(option: str, values: Sequence[str], images: Sequence[Place]) -> dict[Place, float]:
    """Lengths that are stated of images: of one each, IMAGE=M, and one value alone of all others.

    Raises:
        InputError: as `stated_metres`.
    """
    of_all, own = stated_metres(option, values, images)
    return own if of_all is None else dict.fromkeys(images, of_all) | own


def stated_metres(
    option: str, values: Sequence[str], images: Sequence[Place]
) -> tuple[float | None, dict[Place, float]]:
    """The length that is stated of all images, None without any, and those of single ones, IMAGE=M.

    Raises:
        InputError: a value is no length above 0, or of no image; or two are of all images.
    """
    alone = [value for value in values if "=" not in value]
    if len(alone) > 1:
        raise InputError(f"{option}: {alone[0]} and {alone[1]} found, one value of all images expected")
    stated = by_image(option, [value for value in values if "=" in value], images)
    own = {image: _metres(option, text) for image, text in stated.items()}
    return (_metres(option, alone[0]) if alone else None), own


def _metres(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 < value < 1e6:
        raise InputError(f"{option}: {text[:60]!r} found, metres above 0 expected, such as 5")
    return value
