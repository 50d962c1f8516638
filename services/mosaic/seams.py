"""Seams of a mosaic: the scene of every cell of the map, cut where scenes are most similar."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.imagery.source import Window
from amers.services.mosaic.layout import Layout, common_window, inside
from amers.services.mosaic.levelling import Levels
from amers.services.types import BoolArray, FloatImage

Labels = npt.NDArray[np.int16]
"""Number of the scene of each cell, counted from 1; 0 for none."""

_COST_AT_MOST = 50.0
"""Cost of a cell in units of the median difference: a cloud and a shadow are both passed by."""
_MARGIN_CELLS = 12
"""Cells around an overlap that take part in the cut; OpenCV looks 10 beyond."""
_EDGE_CELLS = 8
"""Cells from the end of a scene within which a seam costs more, by up to half a median difference: it
shall not run along the end, where images have most defects."""
_HARD, _GAP_PENALTY = 10_000.0, 1_000.0
"""Costs of a cut through what one scene alone shows, and along cells that one lacks: both of OpenCV."""


class CellImages:
    """Levelled grey values of scenes in the cells of the map."""

    def __init__(self, layout: Layout, images: Sequence[FloatImage], levels: Levels) -> None:
        """Take over the cells.

        Args:
            layout: of the scenes.
            images: (bands, lines, samples) of the cells of each scene; read when needed.
            levels: of the scenes.
        """
        self.layout = layout
        self._images = images
        self._levels = levels

    def read(self, number: int, window: Window) -> FloatImage:
        """Levelled values (bands, lines, samples) of a scene in a window of the cells; NaN beyond it."""
        own = self.layout.cell_window(number)
        image = self._images[number]
        out = np.full((image.shape[0], window.lines, window.samples), np.nan, dtype=np.float32)
        common = common_window(own, window)
        if common is not None:
            values = np.asarray(image[:, *inside(common, own)])
            out[:, *inside(common, window)] = self._levels.apply(values, number)
        return out


def choose_seams(cells: CellImages) -> Labels:
    """Numbers of the scenes of all cells.

    One scene after the other is added to those before: over the ground that both show, the minimum cut
    (Boykov and Kolmogorov 2004, as OpenCV has it) gives the line along which the sum of differences is
    smallest, so that the number of seams and what they cross stays small. What lies whole within others
    adds nothing.
    """
    layout = cells.layout
    labels = np.zeros(layout.cells.shape, dtype=np.int16)
    whole = Window(0, 0, *labels.shape)
    for number in range(len(layout.scenes)):
        own, margin = layout.cell_window(number), _MARGIN_CELLS
        # Beyond its end, a scene has to see what the others alone show.
        around = Window(
            own.line - margin, own.sample - margin, own.lines + 2 * margin, own.samples + 2 * margin
        )
        window = common_window(around, whole)
        assert window is not None
        part = labels[inside(window, whole)]
        valid = _certain(cells.read(number, window))
        taken = _cut(cells, number, window, part, valid)
        part[taken] = number + 1
    return labels


def _certain(image: FloatImage) -> BoolArray:
    """Cells with data in all bands, whose neighbours have data too."""
    valid = np.asarray(~np.isnan(image).any(axis=0), dtype=np.uint8)
    return np.asarray(cv2.erode(valid, np.ones((3, 3)), borderType=cv2.BORDER_REPLICATE) > 0)


def _cut(cells: CellImages, number: int, window: Window, labels: Labels, valid: BoolArray) -> BoolArray:
    """Cells of a window that a scene takes from those before."""
    before = labels > 0
    taken = valid & ~before
    both = valid & before
    if not both.any():
        return taken
    rows, columns = _around(both)
    old, new = before[rows, columns], valid[rows, columns]
    if not (new & ~old).any() or min(old.shape) < 2:
        return taken
    if not (old & ~new).any():
        return valid
    part = Window(window.line + rows.start, window.sample + columns.start, *old.shape)
    cost = _cost(_composite(cells, labels[rows, columns], part), cells.read(number, part), old & new)
    # OpenCV sums the squared distances of two images at both sides of a cut.
    images = np.zeros((2, *cost.shape, 3), dtype=np.float32)
    images[0, :, :, 0] = np.sqrt(cost)
    masks = [np.where(mask, 255, 0).astype(np.uint8) for mask in (old, new)]
    finder: Any = cv2.detail.GraphCutSeamFinder("COST_COLOR", _HARD, _GAP_PENALTY)
    cut = finder.find([images[0], images[1]], [(0, 0), (0, 0)], masks)
    taken[rows, columns] = np.asarray(cut[1].get() if hasattr(cut[1], "get") else cut[1]) > 0
    return taken


def _around(both: BoolArray) -> tuple[slice, slice]:
    """The box around some cells, with a margin."""
    box = []
    for axis in range(2):
        at = np.flatnonzero(both.any(axis=1 - axis))
        low = max(int(at[0]) - _MARGIN_CELLS, 0)
        box.append(slice(low, min(int(at[-1]) + 1 + _MARGIN_CELLS, both.shape[axis])))
    return box[0], box[1]


def _composite(cells: CellImages, labels: Labels, window: Window) -> FloatImage:
    """What the scenes before show in a window."""
    numbers = [int(label) - 1 for label in np.unique(labels) if label > 0]
    out = np.full_like(cells.read(numbers[0], window), np.nan)
    for number in numbers:
        shown = labels == number + 1
        out[:, shown] = cells.read(number, window)[:, shown]
    return out


def _cost(first: FloatImage, second: FloatImage, both: BoolArray) -> FloatImage:
    """Differences (lines, samples) of grey values and of their slopes, each in units of its median."""
    grey = np.abs(first - second)
    slopes = [np.abs(np.gradient(first, axis=axis) - np.gradient(second, axis=axis)) for axis in (1, 2)]
    cost = np.zeros(both.shape, dtype=np.float32)
    for difference in (grey, slopes[0] + slopes[1]):
        for band in difference:
            known = band[both & np.isfinite(band)]
            middle = float(np.median(known)) if len(known) else 0.0
            if middle > 0.0:
                cost += band / (middle * len(difference))
    cost = np.clip(np.nan_to_num(cost, nan=_COST_AT_MOST), 0.0, _COST_AT_MOST)
    inwards = cv2.distanceTransform(both.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(cost + np.clip(1.0 - inwards / _EDGE_CELLS, 0.0, 1.0), dtype=np.float32)
