"""Steps at the seams of a mosaic: displacement between both scenes of a seam, in metres."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.imagery.source import Window
from amers.services.matching.correlate import FOUND, CorrelationOptions, correlation_map, find_chip
from amers.services.mosaic.layout import MosaicScene, Rectifier
from amers.services.mosaic.seams import Labels
from amers.services.sensors.base import SensorModel
from amers.services.tasks import Arrays
from amers.services.types import Array, FloatImage, IntArray

CHIP_PX = 41
"""Side of the window that is correlated across a seam, as for reference images."""
SEARCH_M = 15.0
"""Steps that are looked for: three times the CE90 of delivered models of 0.5 m images (5 to 10 m)."""
_SEARCH_PX = (8, 64)
_SPACING_PX = 32
"""Distance of the places along a seam: their windows overlap by no more than a quarter."""
_AROUND_PX = 24
"""Distance from the seam within which the chip with the most detail is taken."""
_LOCAL_PX = 10
"""Distance from the common step of a pair within which that of a place is looked for."""
_MUTUAL_PX = 1.0
"""What is found is looked for in the first scene, too, and has to lie where it came from: of three dates
of a town this left none of the places that rows of cars put 2.5 m off (benchmarks/mosaic.py)."""
_NOWHERE = np.zeros(2, dtype=np.int64)
_MOST_PLACES = 60
"""Places of one pair of scenes; the median of so many is known to a sixth of their spread."""
_PLACES_IN_ALL = 6000
_PEAK = CorrelationOptions(min_score=0.6, max_sigma_px=0.5)
"""Of three dates of a town, scores of 0.5 to 0.7 gave the same median; places known to half a pixel only
were wrong by metres as often as not (benchmarks/mosaic.py)."""


@dataclass(frozen=True)
class StepFigures:
    """Steps at the places of a seam where both scenes were found to show the same ground.

    Attributes:
        found: number of such places.
        median_m, p90_m: length of the steps; NaN without any.
        east_m, north_m: median of the steps, of the second scene against the first.
    """

    found: int
    median_m: float
    p90_m: float
    east_m: float
    north_m: float


@dataclass(frozen=True)
class SeamSteps:
    """The steps at the seams of one pair of scenes, or of all.

    Attributes:
        scenes: names; empty for all.
        places: where steps were looked for.
        used: with the models that the mosaic uses.
        delivered: at the same places with the models before registration; None where there are none.
    """

    scenes: tuple[str, ...]
    places: int
    used: StepFigures
    delivered: StepFigures | None = None


def seam_places(labels: Labels, cell_px: int) -> dict[tuple[int, int], IntArray]:
    """Pixels (n, 2) of the map along the seams, by the numbers of both scenes, the lower first."""
    found = []
    for axis in range(2):
        one, other = (labels[:-1], labels[1:]) if axis == 0 else (labels[:, :-1], labels[:, 1:])
        at = np.argwhere((one != other) & (one > 0) & (other > 0))
        numbers = np.sort(np.column_stack([one[tuple(at.T)], other[tuple(at.T)]]), axis=1) - 1
        pixel = at * cell_px + cell_px // 2
        pixel[:, axis] += cell_px // 2
        found.append(np.column_stack([numbers, pixel // _SPACING_PX, pixel]))
    rows = np.concatenate(found).astype(np.int64)
    if not len(rows):
        return {}
    rows = rows[np.lexsort(rows.T[::-1])]
    rows = rows[np.unique(rows[:, :4], axis=0, return_index=True)[1]]
    pairs, start = np.unique(rows[:, :2], axis=0, return_index=True)
    most = max(10, min(_MOST_PLACES, _PLACES_IN_ALL // len(pairs)))
    places = {}
    for (first, second), of_pair in zip(pairs.tolist(), np.split(rows[:, 4:], start[1:]), strict=True):
        chosen = np.unique(np.linspace(0, len(of_pair) - 1, min(most, len(of_pair))).round().astype(int))
        places[first, second] = of_pair[chosen]
    return places


def steps_task(
    scenes: tuple[MosaicScene, MosaicScene], places: IntArray, rectifier: Rectifier
) -> Arrays:
    """Steps (n, 2) east and north in metres around places, with the models used and those delivered.

    NaN where the scenes do not correlate, or not within the search. Of places that take the same chip,
    one is kept.
    """
    metre = rectifier.grid.gsd_m
    low, high = _SEARCH_PX
    radius = min(max(math.ceil(SEARCH_M / metre), low), high)
    chips = np.unique([_place_of_chip(scenes, place, rectifier) for place in places], axis=0)
    out = {"used": _steps(scenes, (None, None), chips, radius, rectifier)}
    delivered = [one.delivered for one in scenes]
    if any(model is not None for model in delivered):
        out["delivered"] = _steps(scenes, delivered, chips, radius, rectifier)
    return {name: steps * metre for name, steps in out.items()}


def _place_of_chip(scenes: Sequence[MosaicScene], place: IntArray, rectifier: Rectifier) -> IntArray:
    """Middle (2,) of the chip with the most detail near a place, where both scenes have data."""
    reach = CHIP_PX // 2 + _AROUND_PX
    first, second = (_seen(one, None, place, reach, rectifier) for one in scenes)
    return place + _distinct(np.where(np.isfinite(second), first, np.float32(np.nan)))


def _steps(
    scenes: Sequence[MosaicScene],
    models: Sequence[SensorModel | None],
    places: IntArray,
    radius: int,
    rectifier: Rectifier,
) -> Array:
    """Steps (n, 2) east and north in pixels at places (n, 2), NaN where none is found."""
    half, near = CHIP_PX // 2, min(_LOCAL_PX, radius)
    first = [_seen(scenes[0], models[0], place, half + near, rectifier) for place in places]
    second = [_seen(scenes[1], models[1], place, half + radius, rectifier) for place in places]
    maps = [
        correlation_map(patch, _middle(around, CHIP_PX))
        for patch, around in zip(second, first, strict=True)
    ]
    known = [one for one in maps if one is not None]
    if not known:
        return np.full((len(places), 2), np.nan)
    # What all places have in common stands out where one place alone is ambiguous.
    total = np.sum(known, axis=0)
    peak = np.array(np.unravel_index(int(total.argmax()), total.shape))
    common = np.clip(peak, near, 2 * radius - near) - radius
    row_col = np.array(
        [_step(around, patch, common) for around, patch in zip(first, second, strict=True)]
    )
    return row_col[:, ::-1] * [1.0, -1.0]


def _step(first: FloatImage, second: FloatImage, common: IntArray) -> Array:
    """Rows and columns (2,) from the middle of one image to where another shows the same, or NaN.

    Args:
        first: around the chip that is looked for.
        second: around the same place, more.
        common: where it is looked for.
    """
    lost = np.full(2, np.nan)
    peak = find_chip(_middle(second, len(first), common), _middle(first, CHIP_PX), _PEAK)
    if peak.reason != FOUND:
        return lost
    whole = np.round(peak.row_col).astype(np.int64)
    back = find_chip(first, _middle(second, CHIP_PX, common + whole), _PEAK)
    if back.reason != FOUND or np.hypot(*(back.row_col + peak.row_col - whole)) > _MUTUAL_PX:
        return lost
    return np.asarray(common + peak.row_col)


def _middle(image: FloatImage, size: int, off: IntArray = _NOWHERE) -> FloatImage:
    """The part (size, size) of an image around its middle, or off it."""
    top, left = ((len(image) - size) // 2 + off).tolist()
    return np.ascontiguousarray(image[top : top + size, left : left + size])


def _seen(
    one: MosaicScene,
    model: SensorModel | None,
    place: IntArray,
    reach: int,
    rectifier: Rectifier,
) -> FloatImage:
    """Mean of the bands (n, n) of a scene around a pixel of the map."""
    window = Window(int(place[0]) - reach, int(place[1]) - reach, 2 * reach + 1, 2 * reach + 1)
    return np.ascontiguousarray(rectifier.pixels(one, window, model).mean(axis=0))


def _distinct(image: FloatImage) -> IntArray:
    """Lines and samples (2,) from the middle of an image to the chip in it with the most detail.

    Seams go where there is little: the nearest detail tells more of a step. The detail of a chip is the
    lower eigenvalue of the sums of its squared slopes (Shi and Tomasi 1994).
    """
    known = np.isfinite(image)
    filled = np.where(known, image, np.float32(0.0))
    detail = cv2.cornerMinEigenVal(filled, blockSize=CHIP_PX, ksize=3)
    detail[cv2.erode(known.astype(np.uint8), np.ones((CHIP_PX + 2, CHIP_PX + 2))) == 0] = 0.0
    half = CHIP_PX // 2
    near = detail[half:-half, half:-half]
    best = np.unravel_index(int(near.argmax()), near.shape) if near.any() else (_AROUND_PX, _AROUND_PX)
    return np.array(best, dtype=np.int64) - _AROUND_PX


def seam_steps(
    names: Sequence[str], found: Mapping[tuple[int, int], Arrays]
) -> tuple[SeamSteps | None, tuple[SeamSteps, ...]]:
    """The steps of all seams together, None without a seam, and those of each pair.

    Args:
        names: of the scenes.
        found: what `steps_task` returned, by the numbers of the scenes.
    """
    pairs = tuple(
        _of_pair((names[first], names[second]), arrays) for (first, second), arrays in found.items()
    )
    if not pairs:
        return None, ()
    kinds = {kind for arrays in found.values() for kind in arrays}
    together = {
        kind: np.concatenate([arrays[kind] for arrays in found.values() if kind in arrays])
        for kind in kinds
    }
    return _of_pair((), together), pairs


def _of_pair(names: tuple[str, ...], arrays: Arrays) -> SeamSteps:
    delivered = _figures(arrays["delivered"]) if "delivered" in arrays else None
    return SeamSteps(names, len(arrays["used"]), _figures(arrays["used"]), delivered)


def _figures(steps: Array) -> StepFigures:
    known = steps[np.isfinite(steps).all(axis=1)]
    if not len(known):
        return StepFigures(0, math.nan, math.nan, math.nan, math.nan)
    length = np.hypot(*known.T)
    east, north = np.median(known, axis=0).tolist()
    return StepFigures(
        len(known), float(np.median(length)), float(np.quantile(length, 0.9)), east, north
    )
