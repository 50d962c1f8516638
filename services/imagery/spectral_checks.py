"""Phase correlation between parts of an image, second images by the cepstrum, and blur.

All are measured in windows evenly over the image. A displacement that all windows share is estimated
from the sum of their cross-spectra: what differs between the parts averages out, phases do not.
Source: Kuglin and Hines (1975), The phase correlation image alignment method; Bogert, Healy and Tukey
(1963), The quefrency alanysis of time series for echoes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter

from amers.services.imagery.gaps import filled
from amers.services.imagery.source import ImageSource, Window
from amers.services.types import Array, FloatImage

FIELDS_LIMIT_PX = (0.5, 0.05)
"""Displacement of odd lines against even ones, in line and in sample, pixels. Source:
`benchmarks/pixel_checks.py`."""
BANDS_LIMIT_PX = 0.3
"""Largest distance between bands, pixels: what is required of the bands of Sentinel-2. Source: Gascon et
al. (2017), Copernicus Sentinel-2A calibration and products validation status."""
LEAST_SHIFT_SCORE = 10.0
"""Score of a displacement below which two images do not show the same, see `Shift`: the peak of noise of
256 x 256 pixels is 4.5 standard deviations high, and exceeds 6 once in 15,000 times."""
ECHO_LIMIT = 10.0
"""Score of a second image, see `Echo`. Source: `benchmarks/pixel_checks.py`."""
_SIDE_PX, _SMALLEST_PX = 256, 64
"""Side of a window where the image is large enough; least side."""
_PER_SIDE = 4
"""Windows along each side of an image, at most."""
_MOST_GAPS = 0.02
"""Share of pixels without data in a window, above which it is left aside."""
_LOW = 0.25
"""Frequencies along each axis that displacements are estimated from, cycles per pixel: higher ones are
aliased where every other line is left out."""
_STEPS = 4
_PHASE = 1.5
"""Steps of the estimate below a pixel; phases beyond which a frequency is not used, radians."""
_LEAST_LAG_PX, _FARTHEST = 4, 0.4
"""Lags below which the blur of an image hides a second one; largest lag, in sides of a window."""
_BOUND, _AROUND_PX, _CANDIDATES = 0.05, 15, 20
"""Bound of the cepstrum where its spread is computed, over so many lags; peaks that are looked at."""
_BLUR_FREQUENCIES = (0.04, 0.25)
"""Cycles per pixel: below are few frequencies, above is noise."""
_FLOOR = 1e-6
"""Of the power at a frequency over the mean one."""
_ECHO = 0.3
"""Cepstrum at twice a lag over that at the lag, at most: that of a second image is negative there, while
what is periodic on the ground goes on."""


@dataclass(frozen=True)
class Shift:
    """The displacement of a second image against a first one that shows the same.

    Attributes:
        line_sample: (2,) pixels; NaN where unknown.
        score: peak of the phase correlation over its standard deviation; that of images that show
            different things is below 6.
    """

    line_sample: Array
    score: float


@dataclass(frozen=True)
class Echo:
    """The clearest sign of a second image.

    Attributes:
        score: cepstrum at the lag over its robust standard deviation at the lags around.
        share: strength of the second image over that of the first, 0 to 1.
        line, sample: its displacement, pixels; line is not negative.
    """

    score: float
    share: float
    line: int
    sample: int


def windows_of(image: ImageSource) -> dict[Window, FloatImage]:
    """Square windows of an image with texture and few gaps, which are filled; all have the same size."""
    side = min(_SIDE_PX, *image.shape)
    side -= side % 4
    if side < _SMALLEST_PX:
        return {}
    found = {}
    for place in _window_places(image.shape, side):
        pixels = image.read(place)
        gaps = ~np.isfinite(pixels)
        if gaps.mean() <= _MOST_GAPS:
            pixels = filled(pixels) if gaps.any() else pixels
            if pixels.std() > 0.0:
                found[place] = pixels
    return found


def _window_places(shape: tuple[int, int], side: int) -> list[Window]:
    """Windows of a side evenly over an image; all begin at even lines and samples."""
    axes = [
        np.unique(
            2
            * np.linspace(0, (size - side) // 2, min(_PER_SIDE, max(1, round(size / side)))).astype(int)
        )
        for size in shape
    ]
    return [Window(line, sample, side, side) for line in axes[0].tolist() for sample in axes[1].tolist()]


def fields_shift(windows: Sequence[FloatImage]) -> Shift:
    """How far odd lines lie from where even lines expect them: (0, 0) in an image without fault.

    Args:
        windows: begin at even lines.
    """
    shift = displacement([one[0::2] for one in windows], [one[1::2] for one in windows])
    # A line of these images is two of the original. What odd lines show begins one line further down.
    line, sample = shift.line_sample
    return Shift(np.array([2.0 * line + 1.0, sample]), shift.score)


def displacement(first: Sequence[FloatImage], second: Sequence[FloatImage]) -> Shift:
    """The displacement of second windows against first ones, from all of them together."""
    unknown = Shift(np.full(2, np.nan), 0.0)
    if not first:
        return unknown
    lines, samples = first[0].shape
    taper = np.outer(np.hanning(lines), np.hanning(samples)).astype(np.float32)
    cross = np.zeros((lines, samples // 2 + 1), dtype=np.complex64)
    power = np.zeros((2, lines, samples // 2 + 1), dtype=np.float32)
    for one, other in zip(first, second, strict=True):
        spectra = [fft.rfft2((pixels - pixels.mean()) * taper) for pixels in (one, other)]
        energy = [float((np.abs(spectrum) ** 2).sum()) for spectrum in spectra]
        if min(energy) <= 0.0:
            continue
        spectra = [spectrum / np.sqrt(part) for spectrum, part in zip(spectra, energy, strict=True)]
        cross += spectra[0] * np.conj(spectra[1])
        power += np.abs(np.stack(spectra)) ** 2
    size = np.abs(cross)
    if not size.any():
        return unknown
    correlation = fft.irfft2(cross / np.maximum(size, 1e-20), s=(lines, samples))
    # Where one image is bright, another band may be dark.
    at = int(np.abs(correlation).argmax())
    cross = cross * np.sign(correlation.flat[at])
    peak = np.array(np.unravel_index(at, correlation.shape), dtype=np.float64)
    peak = np.where(peak > np.array([lines, samples]) / 2, peak - [lines, samples], peak)
    frequencies = fft.fftfreq(lines)[:, None], fft.rfftfreq(samples)[None, :]
    coherence = size**2 / np.maximum(power[0] * power[1], 1e-30)
    shift = _refined(cross, coherence, frequencies, -peak)
    return Shift(shift, float(np.abs(correlation).max() / correlation.std()))


def _refined(cross: Array, coherence: Array, frequencies: tuple[Array, Array], start: Array) -> Array:
    """The displacement that phases at low frequencies agree on, near a start in whole pixels."""
    line, sample = np.broadcast_arrays(*frequencies)
    used = (np.abs(line) < _LOW) & (np.abs(sample) < _LOW) & ((line != 0.0) | (sample != 0.0))
    design = -2.0 * np.pi * np.column_stack([line[used], sample[used]])
    angle, shared = np.angle(cross[used]), np.minimum(coherence[used], 0.999)
    shift = start.astype(np.float64)
    for _ in range(_STEPS):
        rest = np.angle(np.exp(1j * (angle + design @ shift)))
        weight = np.where(np.abs(rest) < _PHASE, shared / (1.0 - shared), 0.0)
        normal = design.T @ (design * weight[:, None])
        if np.linalg.cond(normal) > 1e8:
            return np.full(2, np.nan)
        shift = shift - np.linalg.solve(normal, design.T @ (weight * rest))
    return shift


def log_spectra(windows: Sequence[FloatImage]) -> FloatImage:
    """Logarithm (k, side, side // 2 + 1) of the power of windows, one at least."""
    side = windows[0].shape[0]
    taper = np.outer(np.hanning(side), np.hanning(side)).astype(np.float32)
    found = []
    for pixels in windows:
        power = np.abs(fft.rfft2((pixels - pixels.mean()) * taper)) ** 2
        found.append(np.log(power + _FLOOR * power.mean()))
    return np.array(found)


def clearest_echo(spectra: FloatImage) -> Echo:
    """The second image that the spectra of all windows, see `log_spectra`, show."""
    side = spectra.shape[1]
    half, reach = side // 2, int(_FARTHEST * side)
    cepstra = [fft.fftshift(fft.irfft2(one, s=(side, side))) for one in spectra]
    cepstrum = np.median(cepstra, axis=0)
    lag = np.abs(np.arange(side) - half)
    far = np.maximum(lag[:, None], lag[None, :])
    spread = np.sqrt(uniform_filter(np.clip(cepstrum, -_BOUND, _BOUND) ** 2, _AROUND_PX))
    searched = (far >= _LEAST_LAG_PX) & (far <= reach)
    searched[:half] = False
    score = np.where(searched, cepstrum / np.maximum(spread, 1e-9), 0.0)
    best = Echo(0.0, 0.0, 0, 0)
    for at in np.argpartition(score, -_CANDIDATES, axis=None)[-_CANDIDATES:].tolist():
        line, sample = at // side - half, at % side - half
        again = cepstrum[
            half + 2 * line - 1 : half + 2 * line + 2, half + 2 * sample - 1 : half + 2 * sample + 2
        ]
        value = float(cepstrum.flat[at])
        if float(again.max(initial=0.0)) <= _ECHO * value and score.flat[at] > best.score:
            best = Echo(float(score.flat[at]), value, line, sample)
    return best


def blur_px(spectra: FloatImage) -> float:
    """Blur of an image, pixels: one standard deviation of the Gaussian that its spectra fit.

    The power of the ground is taken to fall with the square of the frequency. Source: Field (1987),
    Relations between the statistics of natural images and the response properties of cortical cells.
    """
    mean = spectra.mean(axis=0)
    side = mean.shape[0]
    frequency = np.hypot(fft.fftfreq(side)[:, None], fft.rfftfreq(side)[None, :])
    used = (frequency > _BLUR_FREQUENCIES[0]) & (frequency < _BLUR_FREQUENCIES[1])
    design = np.column_stack([np.ones(used.sum()), -((2.0 * np.pi * frequency[used]) ** 2)])
    weight = 1.0 / frequency[used]
    fitted = np.linalg.lstsq(
        design * weight[:, None], (mean[used] + 2.0 * np.log(frequency[used])) * weight, rcond=None
    )[0]
    return float(np.sqrt(max(fitted[1], 0.0)))
