"""Models for rotated or mirrored images, a common reason why a scene is not found."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.sensors.correction import CorrectedModel, no_correction

_TURNS = {
    "mirrored: its samples run the other way": (1, -1, False),
    "upside down: its lines run the other way": (-1, 1, False),
    "turned by 180 degrees: its lines and samples run the other way": (-1, -1, False),
    "swapped: its lines are the samples of its model": (1, 1, True),
    "turned by 90 degrees: its lines are the samples of its model, which run the other way": (
        1,
        -1,
        True,
    ),
    "turned by 90 degrees: its samples are the lines of its model, which run the other way": (
        -1,
        1,
        True,
    ),
    "swapped and turned by 180 degrees": (-1, -1, True),
}
"""What is said of an image; signs of lines and samples, and whether they are swapped first."""


def turned_scenes(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield a scene with its model turned in every way, and what is then true of its image."""
    frame = no_correction(scene.image.shape)
    for words, (line_sign, sample_sign, swapped) in _TURNS.items():
        turn = np.diag([line_sign, sample_sign]) @ (np.eye(2)[::-1] if swapped else np.eye(2))
        # Where they are swapped, the model is that of an image with as many lines as this has samples.
        middle = frame.centre[::-1] if swapped else frame.centre
        shift = frame.centre - turn @ middle + (turn - np.eye(2)) @ frame.centre
        slopes = (turn - np.eye(2)) * frame.half_size
        correction = replace(frame, parameters=np.column_stack([shift, slopes]))
        yield words, replace(scene, model=CorrectedModel(scene.model, correction))
