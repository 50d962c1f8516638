"""Straightened images: resampled without jitter, bends, lost lines and displaced detectors.

A registration follows the motion of lines and samples by a displacement on a grid. No RPC carries that,
and few programs read it. Resampled by the displacement alone, the image has the delivered model with an
affine correction, which an RPC carries. Heights do not matter: the displacement is one of the image.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from amers.services.imagery.source import ImageSource, Window
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.orthorectification.sampling import drop_outside, sampled
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array, BoolArray, Progress, no_progress

_WINDOW_PX = 512


def without_displacement(correction: ImageCorrection) -> ImageCorrection:
    """The affine part of a correction, which is that of the straightened image."""
    return replace(correction, displacement=None)


def shown_at(correction: ImageCorrection, line_sample: Array) -> Array:
    """Positions (n, 2) of the image that positions (n, 2) of the straightened one are taken from.

    NaN where the image has lost what belongs there: a part of a broken image ends at its break.
    """
    affine = without_displacement(correction)
    before = affine.invert(line_sample)
    if correction.displacement is None:
        return line_sample
    beside = correction.displacement.beside_breaks(before)
    shown = line_sample + correction.displacement.at(beside)
    shown[_beyond_breaks(correction, before, shown)] = np.nan
    return np.asarray(shown)


def _beyond_breaks(correction: ImageCorrection, before: Array, shown: Array) -> BoolArray:
    """Which positions (n,) lie on the other side of a break of the image than their ground.

    Args:
        correction: with a displacement.
        before: (n, 2) positions of the uncorrected model.
        shown: (n, 2) where the image would show them.
    """
    assert correction.displacement is not None
    beyond = np.zeros(len(before), dtype=bool)
    middle = float(correction.centre[1])
    for line in correction.displacement.breaks.tolist():
        sides = correction.displacement.beside_breaks(np.array([[line, middle], [line + 1e-6, middle]]))
        moved = correction.apply(sides) - sides
        in_image = line + float(moved[:, 0].mean())
        beyond |= (before[:, 0] > line) != (shown[:, 0] > in_image)
    return beyond


def straighten(
    images: Sequence[ImageSource],
    correction: ImageCorrection,
    *,
    progress: Progress = no_progress,
) -> Iterator[OrthoWindow]:
    """The windows of a straightened image, row by row; memory does not grow with the image.

    Args:
        images: bands of one image.
        correction: of its model, with a displacement.
        progress: receives the fraction of the rows done.

    Returns:
        Windows of an image of the same size; NaN where the image shows nothing.
    """
    lines, samples = images[0].shape
    for line in range(0, lines, _WINDOW_PX):
        for sample in range(0, samples, _WINDOW_PX):
            window = Window(
                line, sample, min(_WINDOW_PX, lines - line), min(_WINDOW_PX, samples - sample)
            )
            yield _straightened(images, correction, window)
        progress(min(line + _WINDOW_PX, lines) / lines, "straightening")


def _straightened(
    images: Sequence[ImageSource], correction: ImageCorrection, window: Window
) -> OrthoWindow:
    shape = (window.lines, window.samples)
    places = np.stack(
        np.meshgrid(
            window.line + np.arange(window.lines, dtype=np.float64),
            window.sample + np.arange(window.samples, dtype=np.float64),
            indexing="ij",
        ),
        axis=-1,
    )
    line_sample = shown_at(correction, places.reshape(-1, 2)).reshape(places.shape)
    low, high = drop_outside(line_sample, *images[0].shape)
    if not (high >= low).all():
        return OrthoWindow(window, np.full((len(images), *shape), np.nan, dtype=np.float32), 0.0)
    first = np.floor(low).astype(np.int64)
    size = np.ceil(high).astype(np.int64) - first + 1
    pixels = np.stack([sampled(image, line_sample, first, size) for image in images])
    return OrthoWindow(window, pixels, 0.0)
