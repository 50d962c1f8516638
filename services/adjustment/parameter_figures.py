"""Parameters of adjusted images in their units, and the parameters that stay undetermined."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from amers.services.adjustment.bundle import BlockAdjustment
from amers.services.adjustment.parameters import AdjustableImage

HARDLY = 0.1
"""Share of a parameter that observations tell below which they do not determine it."""


@dataclass(frozen=True)
class ParameterFigure:
    """One parameter of an image.

    Attributes:
        image: name of it.
        name, unit: of the parameter.
        value: what the adjustment found.
        sigma: standard deviation of the value.
        a_priori_sigma: what was expected of it.
        determined: share that observations tell, 0 to 1.
    """

    image: str
    name: str
    unit: str
    value: float
    sigma: float
    a_priori_sigma: float
    determined: float

    @property
    def is_held(self) -> bool:
        """Whether the parameter stays what was expected of it, because observations do not tell it."""
        return self.determined < HARDLY


def parameter_figures(
    images: Sequence[AdjustableImage], block: BlockAdjustment
) -> tuple[ParameterFigure, ...]:
    """All parameters of all images of a block, in their own units."""
    sigma = np.sqrt(np.maximum(block.accuracy.variance(), 0.0))
    sigma = sigma.reshape(-1, block.values.shape[1])
    return tuple(
        ParameterFigure(
            image.name,
            parameter.name,
            parameter.unit,
            float(block.values[i, k]) * parameter.per_px,
            float(sigma[i, k]) * parameter.per_px,
            float(image.sigma[k]) * parameter.per_px,
            float(block.determined[i, k]),
        )
        for i, image in enumerate(images)
        for k, parameter in enumerate(image.parameters)
    )


def held_parameters(figures: Sequence[ParameterFigure]) -> tuple[str, ...]:
    """A sentence for every image with parameters that its observations do not determine."""
    held = [figure for figure in figures if figure.is_held]
    sentences = []
    for name, of_image in groupby(held, key=lambda figure: figure.image):
        named = [
            f"{figure.name} ({figure.value:+.3g} {figure.unit}, {figure.a_priori_sigma:.3g} a priori)"
            for figure in of_image
        ]
        sentences.append(
            f"{name}: the observations do not determine {', '.join(named)}; the a priori accuracy "
            "limits them. Add control points, farther apart"
        )
    return tuple(sentences)
