"""Detectors at other positions than in the sensor model, and blur of the image."""

from dataclasses import dataclass

import numpy as np

from amers.services.simulation.render import NODE_SPACING
from amers.services.types import Array


@dataclass(frozen=True)
class Detectors:
    """Equal parts of a row of detectors, each a little out of place, and their common blur.

    Parts begin at multiples of `NODE_SPACING` samples, between the tiles of an image.

    Attributes:
        step_px: (k, 2) lines and samples: a pixel of part k shows what the sensor model sees this far
            from it.
        blur_px: sigma of the blur along lines (motion) and samples (optics); zero for none.
    """

    step_px: Array
    blur_px: tuple[float, float] = (0.0, 0.0)

    @property
    def are_perfect(self) -> bool:
        """Whether they see what the sensor model says, as sharply as their pixels allow."""
        return not self.step_px.any() and not any(self.blur_px)

    def step_of(self, column: int, samples: int) -> Array:
        """Displacement (2,) of the tile `column` of `NODE_SPACING` samples in an image so wide."""
        tiles = -(-samples // NODE_SPACING)
        return np.asarray(self.step_px[min(max(column, 0), tiles - 1) * len(self.step_px) // tiles])

    def seen(self, line_sample: Array, samples: int) -> Array:
        """Positions (n, 2) of the sensor model that pixels (n, 2) of an image show."""
        column = np.floor((line_sample[:, 1] + 0.5) / NODE_SPACING).astype(int)
        steps = np.array([self.step_of(c, samples) for c in column.tolist()]).reshape(-1, 2)
        return np.asarray(line_sample + steps)


PERFECT = Detectors(np.zeros((1, 2)))
