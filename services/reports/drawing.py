"""Common parts of the figures of a report: palette, mark sizes, and the scene as background."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.conventions import STATUS_COLOURS
from amers.services.reports.figure_data import Quicklook
from amers.services.reports.plot import SMALL_TEXT, WIDTH, Figure, Panel
from amers.services.reports.report import RegistrationReport
from amers.services.types import Array, BoolArray, FloatImage

ACTIVE, DEACTIVATED, NOT_MATCHED = STATUS_COLOURS.values()
MATCHED = "#8db7ea"
ARROW = "#ffb000"
_DARK_ROOM, _CONTRAST_LIMIT, _PARTS = 8.0, 3.0, 4
"""How much more room dark values get than bright ones; limit of contrast, and parts across the image."""
_UNCROWDED = 300
_LABEL_LENGTH = 34
_TALLEST = 540.0
"""Largest height of an image in a figure, points."""
_IMAGE_PX = 720
"""Largest side of an image in a figure, pixels of the page."""


def image_panel(report: RegistrationReport, darkness: float, above: float, below: float) -> Panel:
    """A panel in pixels of the image, over its quicklook; its vertical axis points down.

    Args:
        report: of the scene.
        darkness: brightness of the quicklook, so that marks on it stand out.
        above, below: room in the figure above and below the image, points.
    """
    lines, samples = report.scene.shape
    scale = min((WIDTH - 2.0) / samples, _TALLEST / lines)
    width, height = samples * scale, lines * scale
    figure = Figure(above + height + below)
    panel = Panel(
        figure,
        (WIDTH - width) / 2.0,
        above,
        width,
        height,
        (-0.5, samples - 0.5),
        (lines - 0.5, -0.5),
    )
    if report.figure_data.quicklook is not None:
        _draw_quicklook(panel, report.figure_data.quicklook, darkness)
    panel.frame()
    return panel


def _draw_quicklook(panel: Panel, quicklook: Quicklook, darkness: float) -> None:
    """Draw the reduced scene, stretched and darkened; nothing where there is no data.

    Saturated pixels are as bright as the brightest one.
    """
    opaque = ~np.isnan(quicklook.pixels) & (quicklook.pixels != 0.0)
    if not opaque.any():
        return
    brightest = np.max(quicklook.pixels, initial=0.0, where=np.isfinite(quicklook.pixels))
    pixels = np.minimum(np.where(opaque, quicklook.pixels, np.float32(0.0)), np.float32(brightest))
    largest = max(pixels.shape)
    if largest > _IMAGE_PX:
        size = [max(1, round(side * _IMAGE_PX / largest)) for side in pixels.shape[::-1]]
        share = cv2.resize(opaque.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-3)
        opaque = share > 0.5
    panel.image(darkness * _stretched(pixels, opaque), opaque)


def _stretched(pixels: FloatImage, opaque: BoolArray) -> Array:
    """Grey values, 0 to 255, in which ground has its contrast also beside clouds and beside water.

    A stretch between percentiles gives most greys to clouds. The inverse hyperbolic sine makes room for
    dark values (Lupton, Gunn and Szalay, A modified magnitude system, 1999), the equalisation of parts
    of the image with limited contrast uses it for the ground that is there (Zuiderveld, Contrast limited
    adaptive histogram equalization, 1994).
    """
    low, high = np.percentile(pixels[opaque], [1.0, 99.0]) if opaque.any() else (0.0, 1.0)
    share = (np.clip(pixels, low, high) - low) / max(float(high - low), 1e-6)
    grey = np.arcsinh(_DARK_ROOM * share) * (255.0 / np.arcsinh(_DARK_ROOM))
    equalise = cv2.createCLAHE(_CONTRAST_LIMIT, (_PARTS, _PARTS))
    return np.asarray(equalise.apply(grey.astype(np.uint8)), dtype=np.float64)


def crowding(n: int) -> float:
    """Factor, at most 1, by which the size of n marks is reduced so that they do not overlap much."""
    return float(np.sqrt(min(1.0, _UNCROWDED / max(n, 1))))


def rgb_values(colours: Sequence[str]) -> npt.NDArray[np.uint8]:
    """Red, green and blue (n, 3) of colours such as "#7fb2e5"."""
    return np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colours], dtype=np.uint8)


def legend(figure: Figure, top: float, entries: Sequence[tuple[str, str]]) -> None:
    """Write names beside boxes of their colours, in rows of three from a height of the figure down."""
    for k, (name, colour) in enumerate(entries):
        x, y = 52.0 + (k % 3) * (WIDTH - 60.0) / 3.0, top + 12.0 * (k // 3)
        figure.box((x, y - 7.0), (9.0, 8.0), colour)
        figure.text(x + 13.0, y, name, size=SMALL_TEXT)


def round_number(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten; 1 for values that are not positive."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda step: abs(step - value / power)))


def shortened(text: str) -> str:
    """Text that fits a label."""
    return text if len(text) <= _LABEL_LENGTH else text[: _LABEL_LENGTH - 1] + "…"
