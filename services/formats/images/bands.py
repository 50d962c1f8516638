"""Which bands of an image are looked at, and with which weights they are mixed into one."""

import math
import re
from dataclasses import dataclass

from services.errors import FormatError

_ITEM = re.compile(r"\s*(\d{1,4})\s*(?::\s*(\d+(?:\.\d*)?|\.\d+)\s*)?")
VISIBLE = ("red", "green", "blue")


@dataclass(frozen=True)
class BandMix:
    """A weighted mean of bands.

    Attributes:
        bands: counted from one.
        weights: positive, of each band; their sum is one.
        reason: why these, one sentence.
    """

    bands: tuple[int, ...]
    weights: tuple[float, ...]
    reason: str


def one_band(band: int, reason: str = "as asked for") -> BandMix:
    """A single band."""
    return BandMix((band,), (1.0,), reason)


def parse_bands(text: str) -> BandMix:
    """What a user says: "2", "1,2,3" for their mean, "3:0.3,2:0.6,1:0.1" for a weighted one.

    Raises:
        FormatError: when it is none of that, or names a band twice.
    """
    items = [_ITEM.fullmatch(item) for item in text.split(",")]
    found = [(int(item[1]), float(item[2] or 1.0)) for item in items if item is not None]
    bands = tuple(band for band, _ in found)
    total = math.fsum(weight for _, weight in found)
    wrong = len(found) < len(items) or 0 in bands or len(set(bands)) < len(bands)
    if wrong or not all(0.0 < weight < math.inf for _, weight in found):
        raise FormatError(
            f"bands: expected numbers of bands like 1 or 1,2,3 or 3:0.3,2:0.6,1:0.1, found {text[:60]!r}"
        )
    return BandMix(bands, tuple(weight / total for _, weight in found), "as asked for")


def default_mix(colours: tuple[str, ...]) -> BandMix:
    """The panchromatic band, or the mean of the visible ones.

    Chips are panchromatic, and a panchromatic band sees the visible and little beyond. Where the file
    does not say which bands are red, green and blue, the first three are taken for them, in any order.

    Args:
        colours: what each band shows, by the names GDAL has for it.
    """
    if len(colours) < 3:
        return one_band(1, "the first band")
    visible = tuple(colours.index(colour) + 1 for colour in VISIBLE if colour in colours)
    if len(visible) == 3:
        return BandMix(visible, (1 / 3,) * 3, "mean of the red, green and blue bands")
    return BandMix((1, 2, 3), (1 / 3,) * 3, "mean of the first three bands, taken for the visible")
