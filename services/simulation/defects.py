"""Pixel defects as in archives: quantised, missing and saturated pixels."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from amers.services.errors import InputError
from amers.services.imagery.source import ImageSource, Window
from amers.services.simulation.render import BRIGHTEST
from amers.services.types import Array, FloatImage

_SAMPLED_WINDOWS = 5
_SAMPLED_PX = 64


@dataclass(frozen=True)
class Damage:
    """What an image has lost.

    Attributes:
        bits: of a pixel, 8 to 16; the largest value means saturated.
        share: of the pixels that are damaged, 0 to 1.
        missing: share of the damaged squares that are missing; the others are saturated.
        patch_px: side of the squares that are damaged as a whole; 1 for single pixels.
        brightest: whether the brightest pixels are saturated, instead of squares anywhere.
    """

    bits: int = 12
    share: float = 0.0
    missing: float = 0.0
    patch_px: int = 1
    brightest: bool = False

    def __post_init__(self) -> None:
        """Refuse shares outside 0 to 1, and pixels of other sizes than sensors have."""
        for name in ("share", "missing"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{name}: {getattr(self, name)} given, 0 to 1 expected")
        if not 8 <= self.bits <= 16 or self.patch_px < 1:
            raise InputError(
                f"{self.bits} bits and squares of {self.patch_px} px given, 8 to 16 bits and squares of "
                "1 px or more expected"
            )


class DamagedImage:
    """A 12-bit image, quantised anew, with missing (NaN) and saturated (+inf) pixels.

    The damage of a pixel follows from its position and the seed, not from the windows that are read.
    """

    def __init__(self, image: ImageSource, damage: Damage, seed: int) -> None:
        """Prepare an image.

        Args:
            image: pixels from 1 to 4095.
            damage: what happens to it; without any share no pixel is marked, whatever its value.
            seed: of the places.
        """
        self._image, self._damage, self._seed = image, damage, seed
        self._limit = np.float32(np.inf)
        if damage.share > 0.0:
            self._limit = np.float32(self._brightest() if damage.brightest else BRIGHTEST)

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self._image.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, float32; NaN where missing and outside the image, +inf where saturated."""
        pixels = self._image.read(window)
        top = 2.0**self._damage.bits - 1.0
        out = np.clip(np.rint(pixels * np.float32(top / BRIGHTEST)), 1.0, top).astype(np.float32)
        out[pixels >= self._limit] = np.inf
        if self._damage.share > 0.0 and not self._damage.brightest:
            line = np.arange(window.line, window.line + window.lines) // self._damage.patch_px
            sample = np.arange(window.sample, window.sample + window.samples) // self._damage.patch_px
            hit = _uniform(self._seed, line, sample) < self._damage.share
            lost = _uniform(self._seed + 1, line, sample) < self._damage.missing
            out[hit & ~lost & ~np.isnan(pixels)] = np.inf
            out[hit & lost] = np.nan
        return out

    def _brightest(self) -> float:
        """The value that a share of the pixels exceed, from windows all over the image."""
        corner = [
            np.linspace(0, max(size - _SAMPLED_PX, 0), _SAMPLED_WINDOWS).astype(int)
            for size in self.shape
        ]
        windows = [
            Window(int(i), int(j), _SAMPLED_PX, _SAMPLED_PX) for i in corner[0] for j in corner[1]
        ]
        values = np.concatenate([self._image.read(window).ravel() for window in windows])
        return float(np.nanquantile(values, 1.0 - self._damage.share))


def _uniform(seed: int, line: npt.NDArray[np.int64], sample: npt.NDArray[np.int64]) -> Array:
    """Numbers (lines, samples) between 0 and 1 that follow from the position, by SplitMix64."""
    key = (line[:, None].astype(np.uint64) << np.uint64(32)) + sample[None, :].astype(np.uint64)
    with np.errstate(over="ignore"):
        z = key + np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53)
