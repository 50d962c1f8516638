"""Conditions that degrade an image: haze, clouds, season, inverted contrast, noise."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.errors import InputError
from amers.services.simulation.grid import bilinear_values
from amers.services.simulation.render import Radiometry
from amers.services.simulation.world import natural_noise
from amers.services.types import Array, FloatImage

HAZE_LIGHT = 0.35
"""Light of haze that hides all contrast, relative to white ground in the sun."""

INVERSION_LIGHT = 0.6
"""Light that becomes black by an inversion of contrast; brighter light does too."""

CLOUD_LIGHT = 0.65
CLOUD_RELIEF = 0.08
"""Light of a thick cloud, and amplitude of its variation."""

SHADOW_LIGHT = 0.45
"""Share of the light that reaches the ground below a thick cloud."""

_CLOUD_NODES = 256
_CLOUD_EDGE = 0.25
_SHADOW_SHIFT = (0.05, 0.03)


@dataclass(frozen=True)
class Conditions:
    """The conditions of an acquisition.

    Attributes:
        haze: 0 to 1, share of the contrast of the ground that is lost.
        cloud_cover: 0 to 1, share of the image under clouds, without their shadows.
        inverted: whether the contrast is inverted, as between some pairs of bands.
        season: 0 to 1, distance from another season; see `light.day_of`.
        noise: standard deviation in the dark, in 12 bits; that of the sensor when it is larger.
    """

    haze: float = 0.0
    cloud_cover: float = 0.0
    inverted: bool = False
    season: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Refuse shares outside 0 to 1."""
        for name in ("haze", "cloud_cover", "season"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{name}: {getattr(self, name)} given, 0 to 1 expected")


CLEAR = Conditions()


@dataclass(frozen=True)
class Clouds:
    """The clouds of an image; those of a pixel do not depend on the window that is read.

    Attributes:
        thickness: (n, n) noise of unit standard deviation, stretched over the image.
        threshold: smallest thickness of a cloud.
        per_px: (2,) nodes per line and per sample.
    """

    thickness: FloatImage
    threshold: float
    per_px: Array

    def opacity(self, line: Array, sample: Array, shift: tuple[float, float] = (0.0, 0.0)) -> FloatImage:
        """Share (lines, samples) of the ground that is hidden, 0 to 1.

        Args:
            line, sample: (lines,) and (samples,) pixels.
            shift: shift of the clouds along lines and samples, relative to the size of the image.
        """
        size = len(self.thickness)
        y = (line[:, None] + 0.5) * self.per_px[0] + shift[0] * size
        x = (sample[None, :] + 0.5) * self.per_px[1] + shift[1] * size
        grid = np.column_stack([np.broadcast_to(v, (len(line), len(sample))).ravel() for v in (x, y)])
        thickness = bilinear_values(self.thickness, grid).reshape(len(line), len(sample))
        t = np.clip((thickness - self.threshold) / _CLOUD_EDGE + 0.5, 0.0, 1.0)
        return np.asarray(t * t * (3.0 - 2.0 * t), dtype=np.float32)


def clouds_over(shape: tuple[int, int], cover: float, rng: np.random.Generator) -> Clouds | None:
    """Random clouds over a share of an image; None when the share is zero.

    Args:
        shape: lines and samples.
        cover: share of the image under clouds, 0 to 1.
        rng: source of randomness.
    """
    if cover == 0.0:
        return None
    thickness = natural_noise(rng, _CLOUD_NODES, 1.8, 0.01)
    threshold = float(np.quantile(thickness, 1.0 - cover))
    return Clouds(thickness, threshold, _CLOUD_NODES / np.array(shape, dtype=np.float64))


def under_clouds(light: FloatImage, clouds: Clouds, line: Array, sample: Array) -> FloatImage:
    """Light (lines, samples) of the ground with clouds and their shadows added."""
    shadow = clouds.opacity(line, sample, _SHADOW_SHIFT)
    cloud = clouds.opacity(line, sample)
    top = CLOUD_LIGHT + CLOUD_RELIEF * (2.0 * shadow - 1.0)
    ground = light * (1.0 - (1.0 - SHADOW_LIGHT) * shadow)
    return np.asarray(ground + cloud * (top - ground), dtype=np.float32)


def inverted(light: FloatImage) -> FloatImage:
    """Light with inverted contrast."""
    return np.maximum(np.float32(INVERSION_LIGHT) - light, np.float32(0.0))


def seen_through(conditions: Conditions, radiometry: Radiometry) -> Radiometry:
    """The radiometry through haze, with the noise of the conditions."""
    return replace(
        radiometry,
        gain=radiometry.gain * (1.0 - conditions.haze),
        haze=radiometry.haze + radiometry.gain * HAZE_LIGHT * conditions.haze,
        noise_floor=max(radiometry.noise_floor, conditions.noise),
    )
