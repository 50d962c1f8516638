"""Voids of a terrain, filled from the surrounding heights."""

from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.imagery.source import ImageSource, Window
from amers.services.types import FloatImage


@dataclass(frozen=True)
class FilledVoids:
    """Heights with filled voids; an `ImageSource`.

    Each void node gets the mean of the valid nodes within reach, weighted by the inverse square of
    their distance; a node without any stays void.

    Attributes:
        heights: with voids as NaN.
        reach: largest distance, nodes.
    """

    heights: ImageSource
    reach: int

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.heights.shape

    def read(self, window: Window) -> FloatImage:
        """Heights of a window; NaN outside the grid and in voids out of reach."""
        r = self.reach
        wider = Window(window.line - r, window.sample - r, window.lines + 2 * r, window.samples + 2 * r)
        pixels = self.heights.read(wider)
        void = np.isnan(pixels)
        inside = np.s_[r : r + window.lines, r : r + window.samples]
        if void[inside].any():
            square = (np.arange(-r, r + 1)[:, None] ** 2 + np.arange(-r, r + 1) ** 2).astype(np.float32)
            kernel = np.where((square > 0) & (square <= r * r), 1.0 / np.maximum(square, 1.0), 0.0)
            # OpenCV filters to doubles what is in doubles; from singles only where the kernel is large.
            valid = np.where(void, 0.0, 1.0)
            border = cv2.BORDER_CONSTANT
            level = np.float32(np.nanmean(pixels)) if not void.all() else np.float32(0.0)
            above = np.where(void, 0.0, pixels - level).astype(np.float64)
            total = cv2.filter2D(above, cv2.CV_64F, kernel, borderType=border)
            weight = cv2.filter2D(valid, cv2.CV_64F, kernel, borderType=border)
            with np.errstate(invalid="ignore", divide="ignore"):
                filled = np.where(weight > 1e-9, total / weight + level, np.nan)
            pixels = np.where(void, filled, pixels).astype(np.float32)
        out = np.array(pixels[inside])
        lines = np.arange(window.line, window.line + window.lines)
        samples = np.arange(window.sample, window.sample + window.samples)
        out[(lines < 0) | (lines >= self.shape[0])] = np.nan
        out[:, (samples < 0) | (samples >= self.shape[1])] = np.nan
        return out
