"""Faults of pixels in real scenes, and where the faulty image shows what the right one showed."""

from dataclasses import dataclass

import numpy as np

from amers.services.types import Array, FloatImage
from benchmarks.pixel_checks import distorted

KINDS = {
    "repeated": (2, 5, 12, 25, 60),
    "lost": (2, 5, 12, 40, 100),
    "pasted": (3, 8, 16, 40),
    "interlace": (1, 3, 10),
    "ghost": (5, 12, 30),
    "changed": (12, 25, 40),
    "haze": (12, 40, 70),
}
"""Amounts of each kind: lines, pixels, or percent."""
AT = (0.02, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
"""Fraction of the lines (and samples) at which a fault begins."""
HARMLESS = ("", "changed", "haze")
"""Kinds that leave the geometry as it is."""


@dataclass(frozen=True)
class Fault:
    """What is done to the pixels of a scene.

    Attributes:
        kind: one of `KINDS`; "" for none.
        amount: see there.
        at: fraction of the image where it begins.
    """

    kind: str = ""
    amount: int = 0
    at: float = 0.0

    def pixels(self, pixels: FloatImage) -> FloatImage:
        """The faulty image."""
        return distorted(pixels, self.kind, self.amount, self.at) if self.kind else pixels

    def shown(self, line_sample: Array, shape: tuple[int, int]) -> Array:
        """Where (n, 2) the faulty image shows places of the right one; NaN where twice or never."""
        line, amount, first = line_sample[:, 0], float(self.amount), int(self.at * shape[0])
        out = line_sample.copy()
        if self.kind == "repeated":
            out[line >= first, 0] += amount
            out[(line >= first - amount - 1.0) & (line < first)] = np.nan
        elif self.kind == "lost":
            out[line >= first + amount, 0] -= amount
            out[(line > first - 1.0) & (line < first + amount)] = np.nan
        elif self.kind == "interlace":
            out[np.rint(line) % 2 == 1, 1] += amount
        elif self.kind == "pasted":
            out = self._pasted(line_sample, shape)
        return out

    def _pasted(self, line_sample: Array, shape: tuple[int, int]) -> Array:
        corner = np.floor(self.at * np.array(shape))
        side = np.floor(0.35 * min(shape))

        def inside(places: Array) -> Array:
            return np.asarray(((places >= corner) & (places < corner + side)).all(axis=1))

        there = line_sample + float(self.amount)
        within, moved = inside(line_sample), inside(there)
        out = np.where((within & moved)[:, None], there, line_sample)
        out[within ^ moved] = np.nan
        return out


def drawn_fault(rng: np.random.Generator, kind: str) -> Fault:
    """A fault of a kind."""
    return Fault(kind, int(rng.choice(KINDS[kind])), float(rng.choice(AT)))
