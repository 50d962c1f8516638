"""Pixels of ground with several power spectra, and what goes wrong with them."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from amers.services.imagery.source import ArrayImage, Window
from amers.services.types import FloatImage

SHAPE = (640, 560)
TEXTURES = ("fractal", "rough", "blurred", "fields", "town", "speckle")


def texture(name: str, seed: int, shape: tuple[int, int] = SHAPE) -> FloatImage:
    """Ground of a kind, grey values of about 100 to 1,000 with the noise of a sensor.

    Fractal and rough: power that falls with the third and the first power of the frequency; blurred:
    smoothed noise; fields: patches with outlines in all directions; town: the same along the axes, with
    texture; speckle: a radar image of four looks.
    """
    rng = np.random.default_rng(seed)
    if name in ("fractal", "rough"):
        pixels = _power_law(rng, shape, 3.0 if name == "fractal" else 1.0)
    elif name == "blurred":
        pixels = _smooth(rng.normal(size=shape), 1.2) + 3.0 * _smooth(rng.normal(size=shape), 6.0)
    elif name == "speckle":
        ground = _power_law(rng, shape, 3.0)
        mean = np.exp(0.5 * ground / ground.std())
        pixels = mean * _smooth(rng.gamma(4.0, 0.25, size=shape), 0.6)
    else:
        pixels = _patches(rng, shape, turned=name == "fields")
    pixels = (pixels - pixels.mean()) / pixels.std()
    noisy = np.clip(400.0 + 100.0 * pixels + 3.0 * rng.normal(size=shape), 1.0, 4000.0)
    return noisy.astype(np.float32)


def _smooth(pixels: FloatImage, sigma_px: float) -> FloatImage:
    """Smoothed without an edge at the border: as if the ground went on around."""
    padded = np.pad(pixels.astype(np.float32), 40, mode="wrap")
    return np.asarray(cv2.GaussianBlur(padded, (0, 0), sigma_px)[40:-40, 40:-40])


def _power_law(rng: np.random.Generator, shape: tuple[int, int], power: float) -> FloatImage:
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=shape)) * frequency ** (-power / 2.0)
    return _smooth(np.fft.irfft2(spectrum, s=shape), 0.6)


def _patches(rng: np.random.Generator, shape: tuple[int, int], *, turned: bool) -> FloatImage:
    pixels = np.zeros(shape, dtype=np.float32)
    for _ in range(400):
        centre = (float(rng.uniform(0, shape[1])), float(rng.uniform(0, shape[0])))
        size = (float(rng.uniform(8, 90)), float(rng.uniform(8, 90)))
        angle = float(rng.uniform(0, 180)) if turned else 0.0
        corners = cv2.boxPoints((centre, size, angle))
        cv2.fillPoly(pixels, [np.rint(corners).astype(np.int32)], float(rng.normal()))
    rough = _power_law(rng, shape, 2.0)
    return _smooth(pixels + 0.4 * rough / rough.std(), 0.6)


def moved(pixels: FloatImage, line: float, sample: float) -> FloatImage:
    """The image displaced, in so far as it shows the ground."""
    matrix = np.array([[1.0, 0.0, sample], [0.0, 1.0, line]])
    return np.asarray(
        cv2.warpAffine(
            pixels, matrix, pixels.shape[::-1], flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT
        )
    )


def repeated(pixels: FloatImage, first: int, count: int) -> FloatImage:
    """Lines before `first` repeated from there on; as many are lost at the end."""
    return np.concatenate([pixels[:first], pixels[first - count : first], pixels[first:]])[: len(pixels)]


def lost(pixels: FloatImage, first: int, count: int) -> FloatImage:
    return np.concatenate([pixels[:first], pixels[first + count :]])


def pasted(pixels: FloatImage, corner: tuple[int, int], side: int, apart: int) -> FloatImage:
    """A square that shows the ground some pixels away along both axes."""
    out = pixels.copy()
    place = np.s_[corner[0] : corner[0] + side, corner[1] : corner[1] + side]
    out[place] = moved(pixels, apart, apart)[place]
    return out


def interlaced(pixels: FloatImage, apart: float) -> FloatImage:
    out = pixels.copy()
    out[1::2] = moved(pixels, 0.0, apart)[1::2]
    return out


def seen_twice(pixels: FloatImage, line: int, sample: int, share: float = 0.5) -> FloatImage:
    return np.asarray((pixels + share * moved(pixels, line, sample)) / (1.0 + share))


def changed(pixels: FloatImage, line: int, lines: int) -> FloatImage:
    """Other texture, with soft edges, over lines around one."""
    other = _smooth(np.random.default_rng(9).normal(size=pixels.shape), 3.0)
    away = np.abs(np.arange(len(pixels)) - line)
    weight = np.clip((lines / 2 + 15 - away) / 30.0, 0.0, 1.0)[:, None]
    return np.asarray(
        (1.0 - weight) * pixels + weight * (pixels.mean() + other / other.std() * pixels.std()),
        np.float32,
    )


def hazy(pixels: FloatImage, line: int, share: float) -> FloatImage:
    """A veil that is strongest at a line."""
    veil = share * np.exp(-(((np.arange(len(pixels)) - line) / (0.3 * len(pixels))) ** 2))[:, None]
    return np.asarray(pixels * (1.0 - veil) + veil * np.percentile(pixels, 95), np.float32)


def rounded(pixels: FloatImage, dtype: str) -> FloatImage:
    """The pixels as a file of a type has them; those of 8 bits are stretched, and some are saturated."""
    if dtype == "float32":
        return pixels / np.float32(5000.0)
    if dtype == "uint16":
        return np.rint(pixels)
    low, high = np.percentile(pixels, [1.0, 99.0])
    return np.asarray(np.rint(np.clip((pixels - low) / (high - low) * 255.0, 0.0, 255.0)), np.float32)


def compressed(pixels: FloatImage, quality: int) -> FloatImage:
    """Through JPEG and back."""
    coded = cv2.imencode(
        ".jpg", rounded(pixels, "uint8").astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    return np.asarray(cv2.imdecode(coded[1], cv2.IMREAD_GRAYSCALE), np.float32)


@dataclass(frozen=True)
class Watched(ArrayImage):
    """An image that remembers the windows that are read."""

    windows: list[Window] = field(default_factory=list)

    def read(self, window: Window) -> FloatImage:
        self.windows.append(window)
        return super().read(window)
