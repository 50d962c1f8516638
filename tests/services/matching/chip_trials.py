"""Chips that are searched in patches which show them displaced: their errors and stated sigmas."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.types import Array, FloatImage
from tests.services.textures import as_pixels

RADIUS_PX, SIDE, PERIOD = 6, 101, 128
"""Of a search, a chip, and the texture that both are cut from, pixels."""
CHIPS = 100


@dataclass(frozen=True)
class Trials:
    """Errors and sigmas of the chips that were found, and the number of the others."""

    error_px: Array
    sigma_px: Array
    lost: int

    @property
    def normalised_square(self) -> float:
        """Mean square of the errors divided by their stated sigmas: 1 for honest sigmas."""
        return float(((self.error_px / self.sigma_px[:, None]) ** 2).mean())

    @property
    def rms_px(self) -> float:
        return float(np.sqrt((self.error_px**2).mean()))


def chip_of(ground: Array, side: int = SIDE) -> FloatImage:
    heart = slice(RADIUS_PX, RADIUS_PX + side)
    return as_pixels(ground[heart, heart])


def patch_of(ground: Array, side: int = SIDE) -> FloatImage:
    side += 2 * RADIUS_PX
    return as_pixels(ground[:side, :side])


def searched(pairs: Iterable[tuple[FloatImage, FloatImage, Array]]) -> Trials:
    """Of patches, chips, and how far the patch shows the chip from its middle."""
    error, sigma, lost = [], [], 0
    for patch, chip, shift in pairs:
        peak = find_chip(patch, chip, CorrelationOptions())
        if peak.reason == FOUND:
            error.append(peak.row_col - shift)
            sigma.append(peak.sigma_px)
        else:
            lost += 1
    return Trials(np.array(error), np.array(sigma), lost)
