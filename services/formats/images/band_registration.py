"""Displacement between the bands of an image, measured before they are mixed to one value.

Bands of one product that lie apart give a mean that is blurred and lies between them, without a trace in
the residuals of a registration.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.images.bands import default_mix, one_band
from amers.services.formats.images.masks import MaskedImage
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.imagery.source import ImageSource, Window
from amers.services.matching.least_squares import covariance_from_influence, fit_chip
from amers.services.statements import Statement, Subject, Use
from amers.services.types import Array, FloatImage

LARGEST_APART_PX = 0.3
"""Largest distance between two bands of a mix, pixels: what is required of the bands of Sentinel-2.

Source: Gascon et al. (2017), Copernicus Sentinel-2A calibration and products validation status,
multi-spectral registration, at 3 sigma.
"""
_WINDOWS, _FEWEST = 5, 5
"""Windows along each side of an image, and of those in which bands are compared at least."""
_SIDE_PX, _SEARCH_PX, _MARGIN_PX = 64, 4, 4
"""Of a window; largest distance that is searched; border for the interpolation."""
_LEAST_SCORE, _LARGEST_SIGMA_PX = 0.7, 0.15
"""Correlation between bands in a window that counts, and standard deviation of a distance."""
_FEWEST_OF_PART = 4
"""Windows of a half of the image that have a median of their own."""


@dataclass(frozen=True)
class _Apart:
    """Where the bands of a mix lie.

    Attributes:
        px: largest distance between two of them, as medians over the image and its halves; NaN where
            too few windows show it.
        windows: number of windows in which they were compared.
    """

    px: float
    windows: int


def with_registered_bands(
    image: SceneImage, *, is_requested: bool
) -> tuple[SceneImage, Statement | None]:
    """An image whose mix is of bands that lie on each other, else its middle band alone.

    Args:
        image: opened; where it has one band, nothing is measured.
        is_requested: whether a caller names its bands: they are used, and what was measured is stated.

    Returns:
        The image, and what is said of its bands; None for an image of a single band.
    """
    bands, names = image.mix.bands, _names(image)
    others = [band for band in _image_bands(image) if band not in bands]
    left_out = f"{_listed('band', others)} not used; --bands chooses" if others else ""
    if len(bands) == 1:
        if not others:
            return image, None
        use = Use.USED if is_requested else Use.ASSUMED
        return image, _statement(image, use, f"{names[0]} alone, {image.mix.reason}", left_out)
    apart, mix = _measure(image), image.mix
    listed = ", ".join(names)
    if apart.px <= LARGEST_APART_PX:
        value = f"mean of {listed}, which lie within {apart.px:.2f} px of each other"
        is_known = is_requested or "taken as" not in mix.reason
        note = left_out if is_known else "; ".join(part for part in (mix.reason, left_out) if part)
        return image, _statement(image, Use.USED if is_known else Use.ASSUMED, value, note)
    found = f"lie up to {apart.px:.2f} px apart, at most {LARGEST_APART_PX} px accepted for a mean"
    if np.isnan(apart.px):
        found = (
            f"look alike in {apart.windows} of {_WINDOWS**2} windows only: how far they lie apart is "
        )
        found += "unknown"
    if is_requested:
        note = f"{listed} {found}; give one band, such as --bands {_middle(bands)}"
        return image, _statement(image, Use.ASSUMED, f"mean of {listed}, as requested", note)
    alone = one_band(_middle(bands), f"{listed} {found}")
    note = f"{listed} {found}; --bands chooses another one"
    name = names[bands.index(alone.bands[0])]
    return image.with_mix(alone), _statement(image, Use.ASSUMED, f"{name} alone", note)


def visible_bands(image: ImageSource) -> tuple[SceneImage, ...]:
    """The visible bands of an image each by itself; none where it has one, or is not that of files."""
    opened = image.image if isinstance(image, MaskedImage) else image
    if not isinstance(opened, RasterImage | TiledImage):
        return ()
    try:
        bands = default_mix(opened.validity.colours, opened.path).bands
    except FormatError:
        return ()
    return tuple(opened.with_mix(one_band(band)) for band in bands) if len(bands) > 1 else ()


def _statement(image: SceneImage, use: Use, value: str, note: str) -> Statement:
    return Statement(image.path.name, Subject.BANDS, use, value, note=note)


def _image_bands(image: SceneImage) -> tuple[int, ...]:
    return image.validity.image_bands


def _names(image: SceneImage) -> list[str]:
    """Names of the bands of a mix: their colours, else their numbers."""
    colours = [image.validity.colours[band - 1] for band in image.mix.bands]
    return [
        f"band {band}" if colour in ("undefined", "gray", "palette") else colour
        for band, colour in zip(image.mix.bands, colours, strict=True)
    ]


def _listed(noun: str, numbers: list[int]) -> str:
    """Such as "band 4" or "bands 4, 5"."""
    return f"{noun}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


def _middle(bands: tuple[int, ...]) -> int:
    """The band between the others: of red, green and blue it is green, and nearest to both."""
    return bands[len(bands) // 2]


def _measure(image: SceneImage) -> _Apart:
    """Distances between the bands of a mix in windows over the image."""
    bands, reach = image.mix.bands, _SIDE_PX + 2 * (_SEARCH_PX + _MARGIN_PX)
    middle = image.with_mix(one_band(_middle(bands)))
    rest = [image.with_mix(one_band(band)) for band in bands if band != _middle(bands)]
    if min(image.shape) < reach:
        return _Apart(np.nan, 0)
    places, found = [], []
    for line in np.linspace(0, image.shape[0] - reach, _WINDOWS).astype(int).tolist():
        for sample in np.linspace(0, image.shape[1] - reach, _WINDOWS).astype(int).tolist():
            window = Window(line, sample, reach, reach)
            apart = _window_apart(middle.read(window), [one.read(window) for one in rest])
            if apart is not None:
                places.append((line, sample))
                found.append(apart)
    if len(found) < _FEWEST:
        return _Apart(np.nan, len(found))
    return _Apart(_largest(np.array(places, dtype=np.float64), np.array(found)), len(found))


def _window_apart(middle: FloatImage, rest: list[FloatImage]) -> Array | None:
    """Displacements (k, 2) of other bands from the middle one; None where one is unseen."""
    if not all(np.isfinite(pixels).all() for pixels in (middle, *rest)):
        return None
    border = _SEARCH_PX + _MARGIN_PX
    chip = np.ascontiguousarray(middle[border:-border, border:-border])
    if chip.std() == 0.0:
        return None
    found = []
    for pixels in rest:
        inner = np.ascontiguousarray(pixels[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX])
        scores = cv2.matchTemplate(inner, chip, cv2.TM_CCOEFF_NORMED)
        start = np.array(np.unravel_index(int(scores.argmax()), scores.shape), dtype=np.float64)
        fit = fit_chip(pixels, chip, start + _MARGIN_PX)
        if fit is None or fit.score < _LEAST_SCORE:
            return None
        if np.sqrt(np.trace(covariance_from_influence(fit.influence)) / 2.0) > _LARGEST_SIGMA_PX:
            return None
        found.append(fit.row_col - border)
    return np.array(found)


def _largest(places: Array, found: Array) -> float:
    """The largest distance between two bands, of medians over the image and over its halves.

    Args:
        places: (n, 2) of windows.
        found: (n, k, 2) displacements of other bands from the middle one.
    """
    centre = (places.min(axis=0) + places.max(axis=0)) / 2.0
    parts = [np.ones(len(places), dtype=bool)]
    parts += [places[:, axis] < centre[axis] for axis in range(2)]
    parts += [places[:, axis] > centre[axis] for axis in range(2)]
    largest = 0.0
    for part in parts:
        if part.sum() < _FEWEST_OF_PART:
            continue
        at = np.vstack([np.zeros((1, 2)), np.median(found[part], axis=0)])
        largest = max(largest, float(np.linalg.norm(at[:, None] - at[None, :], axis=2).max()))
    return largest
