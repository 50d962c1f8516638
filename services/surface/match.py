"""Dense matching of rectified images: the interface of matchers, and the default matcher."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.surface.semi_global import (
    best_disparities,
    census,
    costs_of_second,
    differences,
    disparity_sums,
    matching_costs,
)
from amers.services.types import BoolArray, FloatImage

Reasons = npt.NDArray[np.uint8]


class Reason(IntEnum):
    """Why a pixel or a cell has no height; the larger one is said where several hold."""

    FOUND = 0
    OUTSIDE = 1
    NO_DATA = 2
    SATURATED = 3
    WATER = 4
    NO_TEXTURE = 5
    ISOLATED = 6
    HIDDEN = 7


REASON_LABELS = {
    Reason.FOUND: "has a height",
    Reason.OUTSIDE: "no pair of images shows it, or nothing around it was matched",
    Reason.NO_DATA: "an image has no data there",
    Reason.SATURATED: "an image is saturated there",
    Reason.WATER: "stated as water",
    Reason.NO_TEXTURE: "no texture",
    Reason.ISOLATED: "a small patch that does not fit its surroundings",
    Reason.HIDDEN: "hidden in one image, or changed between both",
}


@dataclass(frozen=True)
class RectifiedPair:
    """Two images on common rows.

    Attributes:
        first, second: (rows, columns) grey values, without gaps.
        first_valid, second_valid: (rows, columns) which of them are seen by the sensor.
        lowest: the first disparity to look for; see `Rectification`.
        count: number of disparities.
    """

    first: FloatImage
    second: FloatImage
    first_valid: BoolArray
    second_valid: BoolArray
    lowest: int
    count: int


@dataclass(frozen=True)
class Disparities:
    """The result of a dense matching.

    Attributes:
        first: (rows, columns) float32, by the pixels of the first image; NaN where there is none.
        second: the same by those of the second one, that was found in the other direction.
        reason: (rows, columns) uint8, a `Reason`, by the pixels of the first image.
    """

    first: FloatImage
    second: FloatImage
    reason: Reasons


class DenseMatcher(Protocol):
    """Finds the disparities of the pixels of both images of a pair."""

    def match(self, pair: RectifiedPair) -> Disparities:
        """The disparities of a pair, and why pixels have none."""
        ...

    def bytes_per_disparity(self) -> int:
        """Memory for each pixel and disparity."""
        ...


@dataclass(frozen=True)
class SemiGlobal:
    """Semi-global matching on census costs of 5 x 5 pixels, in both directions.

    Attributes:
        small_penalty: cost of a disparity that differs by one from its neighbour, in comparisons of a
            census that differ, of which there are 24.
        large_penalty: cost of a larger difference, between pixels of the same grey value.
        halving_step: grey step that halves the large penalty, in standard deviations of the image:
            heights jump where the grey value does.
        max_difference_px: largest difference of the disparities that both directions have of one detail.
        smallest_patch_px: patches of fewer pixels that differ from their surroundings are left out.
        least_contrast: standard deviation around a pixel, as a share of that of the image, below which
            there is no texture.
    """

    small_penalty: int = 14
    large_penalty: int = 80
    halving_step: float = 0.5
    max_difference_px: float = 0.75
    smallest_patch_px: int = 100
    least_contrast: float = 0.01

    def match(self, pair: RectifiedPair) -> Disparities:
        """As the interface says; see the attributes."""
        penalties = (self.small_penalty, self.large_penalty, self.halving_step)
        valid = (pair.first_valid, pair.second_valid)
        words = census(pair.first), census(pair.second)
        costs = matching_costs(*words, valid, pair.lowest, pair.count)
        sums = disparity_sums(costs, _in_contrasts(pair.first, pair.first_valid), penalties)
        first = best_disparities(sums, pair.lowest)
        del sums
        costs = costs_of_second(costs, pair.lowest)
        sums = disparity_sums(costs, _in_contrasts(pair.second, pair.second_valid), penalties)
        second = best_disparities(sums, pair.lowest)
        del costs, sums
        reason = self._reason(first, second, (pair.first, *valid), pair.lowest)
        # Seen from the second image, disparities have the other sign.
        back = self._reason(-second, -first, (pair.second, *valid[::-1]), 1 - pair.lowest - pair.count)
        return Disparities(
            np.where(reason == Reason.FOUND, first, np.nan).astype(np.float32),
            np.where(back == Reason.FOUND, second, np.nan).astype(np.float32),
            reason,
        )

    def _reason(
        self,
        own: FloatImage,
        other: FloatImage,
        seen: tuple[FloatImage, BoolArray, BoolArray],
        lowest: int,
    ) -> Reasons:
        """Why pixels have no disparity: by those of both directions, pixels, valid ones of both."""
        pixels, valid, other_valid = seen
        reason = np.full(own.shape, Reason.FOUND, dtype=np.uint8)
        reason[~(differences(own, other) <= self.max_difference_px)] = Reason.HIDDEN
        # Across gaps of the other image the penalties carry disparities that nothing shows.
        reason[~seen_at(other_valid, own)] = Reason.HIDDEN
        reason[_flat(pixels, valid, self.least_contrast)] = Reason.NO_TEXTURE
        reason[~valid] = Reason.OUTSIDE
        found = np.where(reason == Reason.FOUND, own, np.nan).astype(np.float32)
        reason[_small_patches(found, lowest, self.smallest_patch_px)] = Reason.ISOLATED
        return reason

    def bytes_per_disparity(self) -> int:
        """Costs of one byte, and sums of two."""
        return 3


def seen_at(valid: BoolArray, disparity: FloatImage) -> BoolArray:
    """Whether the pixels that lie at disparities (rows, columns) in the other image are valid there."""
    columns = np.arange(disparity.shape[1], dtype=np.int32)
    at = columns - np.rint(np.nan_to_num(disparity)).astype(np.int32)
    inside = (at >= 0) & (at < valid.shape[1])
    return inside & np.take_along_axis(valid, np.clip(at, 0, valid.shape[1] - 1), axis=1)


_STEPS_PER_PX = 16
"""Steps of disparity in which OpenCV compares neighbours."""
_WINDOW_PX = 7


def _in_contrasts(pixels: FloatImage, valid: BoolArray) -> FloatImage:
    """Grey values in units of the standard deviation of the valid ones."""
    spread = float(pixels[valid].std()) if valid.any() else 0.0
    return np.asarray(pixels / np.float32(spread if spread > 0.0 else 1.0))


def _flat(pixels: FloatImage, valid: BoolArray, share: float) -> BoolArray:
    """Pixels whose neighbourhood varies by less than a share of the whole image."""
    scaled = _in_contrasts(pixels - np.float32(pixels[valid].mean() if valid.any() else 0.0), valid)
    window = (_WINDOW_PX, _WINDOW_PX)
    mean = cv2.blur(scaled, window)
    variance = cv2.blur(scaled * scaled, window) - mean * mean
    return np.asarray(variance < share * share)


def _small_patches(disparity: FloatImage, lowest: int, smallest: int) -> BoolArray:
    """Pixels of patches that are too small; neighbours in a patch differ by a pixel at most."""
    known = np.isfinite(disparity)
    steps = np.where(known, (disparity - lowest) * _STEPS_PER_PX, -_STEPS_PER_PX * 2.0)
    patches = np.rint(steps).astype(np.int16)
    unknown = -2 * _STEPS_PER_PX
    cv2.filterSpeckles(patches, unknown, smallest, _STEPS_PER_PX)
    return np.asarray(known & (patches == unknown))
