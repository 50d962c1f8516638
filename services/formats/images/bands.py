"""Selection of bands, their weights in one mixed band, and special codes of their pixels."""

import math
import re
from dataclasses import dataclass

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace

_ITEM = re.compile(r"\s*(\d{1,4})\s*(?::\s*(\d+(?:\.\d*)?|\.\d+)\s*)?")
VISIBLE = ("red", "green", "blue")
_BRIGHTNESS = ("Y", "lightness")
_NO_BRIGHTNESS = ("cyan", "magenta", "yellow", "black", "hue", "saturation")


@dataclass(frozen=True)
class BandMix:
    """A weighted mean of bands.

    Attributes:
        bands: numbers of the bands, counted from 1.
        weights: positive weight of each band; their sum is 1.
        reason: why these bands, one sentence.
    """

    bands: tuple[int, ...]
    weights: tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class PixelCodes:
    """Pixel values that stand for something else than a brightness; None where nothing is stated.

    Attributes:
        nodata: nothing was imaged there.
        saturated: brighter than the sensor can tell.
    """

    nodata: int | None = None
    saturated: int | None = None


def one_band(band: int, reason: str = "as requested") -> BandMix:
    """A mix of a single band."""
    return BandMix((band,), (1.0,), reason)


def parse_bands(text: str) -> BandMix:
    """The mix of a text: "2" for one band, "1,2,3" for a mean, "3:0.3,2:0.6,1:0.1" for a weighted mean.

    Raises:
        FormatError: the text has another form, or names a band twice.
    """
    matches = [_ITEM.fullmatch(item) for item in text.split(",")]
    weighted = [(int(match[1]), float(match[2] or 1.0)) for match in matches if match is not None]
    bands = tuple(band for band, _ in weighted)
    total = math.fsum(weight for _, weight in weighted)
    wrong = len(weighted) < len(matches) or 0 in bands or len(set(bands)) < len(bands)
    if wrong or not all(0.0 < weight < math.inf for _, weight in weighted):
        raise FormatError(
            f"bands: expected band numbers like 1 or 1,2,3 or 3:0.3,2:0.6,1:0.1, found {text[:60]!r}"
        )
    return BandMix(bands, tuple(weight / total for _, weight in weighted), "as requested")


def default_mix(colours: tuple[str, ...], path: FilePlace | str = "image") -> BandMix:
    """The first band of an image with one or two bands, else the mean of its visible bands.

    Chips are panchromatic, and a panchromatic band covers the visible spectrum and little more. Where
    the file does not name its red, green and blue bands, the first three are taken as visible. A band of
    brightness alone (Y, lightness) is one; alpha bands do not count.

    Args:
        colours: colour interpretation of each band, by GDAL's names.
        path: of the image, for messages.

    Raises:
        FormatError: the bands are inks, which are dark where the ground is bright.
    """
    bands = {band: colour for band, colour in enumerate(colours, start=1) if colour != "alpha"}
    visible = tuple(band for name in VISIBLE for band, colour in bands.items() if colour == name)
    if len(bands) >= 3 and len(visible) == 3:
        return BandMix(visible, (1 / 3,) * 3, "mean of the red, green and blue bands")
    bright = [band for band, colour in bands.items() if colour in _BRIGHTNESS]
    if bright:
        return one_band(bright[0], "the band of brightness")
    inks = [band for band, colour in bands.items() if colour in _NO_BRIGHTNESS]
    if inks:
        raise FormatError(
            f"{path}: band {inks[0]} is {bands[inks[0]]}, an image in grey or in red, green and blue "
            "expected; convert it, or name the band to use (--bands)"
        )
    first = tuple(bands)[:3] or (1,)
    if len(bands) < 3:
        return one_band(first[0], "the first band")
    return BandMix(first, (1 / 3,) * 3, "mean of the first three bands, taken as visible")
