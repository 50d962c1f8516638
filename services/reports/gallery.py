"""Chips next to the scene before and after its registration, as images inside a page."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.reports.figure_data import ChipComparison
from amers.services.types import ChipArray

COMPARED_PER_GROUP = 4


@dataclass(frozen=True)
class GalleryGroup:
    """Comparisons that are shown together.

    Attributes:
        title: of the group.
        comparisons: in order of falling score.
    """

    title: str
    comparisons: tuple[ChipComparison, ...]


def choose_comparisons(gallery: tuple[ChipComparison, ...]) -> tuple[GalleryGroup, ...]:
    """The comparisons of the best, middle and worst scores of a gallery, none twice.

    Args:
        gallery: any order; comparisons without a score are the worst.
    """
    count = COMPARED_PER_GROUP
    ordered = sorted(gallery, key=lambda one: -np.nan_to_num(one.score, nan=-2.0))
    if len(ordered) <= 3 * count:
        return (GalleryGroup("All points, best score first", tuple(ordered)),) if ordered else ()
    middle = (len(ordered) - count) // 2
    return (
        GalleryGroup("Best scores", tuple(ordered[:count])),
        GalleryGroup("Middle scores", tuple(ordered[middle : middle + count])),
        GalleryGroup("Worst scores", tuple(ordered[-count:])),
    )


def chip_uri(chip: ChipArray) -> str:
    """A chip as an image inside the page, stretched from its 1st to its 99th percentile.

    Nodata is black and saturated pixels are white.
    """
    values = chip.astype(np.float32)
    valid = np.isfinite(values) & (values != 0.0)
    grey = np.where(np.isposinf(values), 255, 0).astype(np.uint8)
    if valid.any():
        low, high = np.percentile(values[valid], [1.0, 99.0])
        stretched = (values[valid] - low) / max(float(high - low), 1e-6) * 255.0
        grey[valid] = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    _, encoded = cv2.imencode(".png", grey)
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
