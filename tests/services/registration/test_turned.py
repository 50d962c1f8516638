"""An image that was mirrored or turned fits its model again when the model is turned as it is said."""

from collections.abc import Callable

import numpy as np
import pytest

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.registration.turned import turned_scenes
from amers.services.types import Acquisition, FloatImage
from tests.services.conftest import FlatModel

LINES, SAMPLES = 7, 10
DELIVERED = np.arange(LINES * SAMPLES, dtype=np.float32).reshape(LINES, SAMPLES)
"""The image that belongs to the model: no two pixels are alike."""
AT = np.stack(np.meshgrid(np.arange(LINES), np.arange(SAMPLES), indexing="ij"), -1).reshape(-1, 2)
GROUND = FlatModel().locate(AT.astype(np.float64), np.zeros(len(AT)))


def pixels_by(words: str, image: FloatImage) -> FloatImage:
    """The pixels (n,) at which a model that is turned in this way expects the ground; NaN beyond."""
    scene = Scene(ArrayImage(image), FlatModel(), Acquisition("turned"), 1.0)
    (turned,) = (one for said, one in turned_scenes(scene) if said == words)
    at = turned.model.project(GROUND)
    np.testing.assert_allclose(at, np.rint(at), atol=1e-6)
    row, column = np.rint(at).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < image.shape[0]) & (column < image.shape[1])
    seen = image[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside, seen, np.float32(np.nan))


WAYS: dict[str, Callable[[FloatImage], FloatImage]] = {
    "mirrored": np.fliplr,
    "upside down": np.flipud,
    "turned by 180": lambda image: np.rot90(image, 2),
    "swapped: ": np.transpose,
    "turned by 90 degrees: its lines": lambda image: np.rot90(image, -1),
    "turned by 90 degrees: its samples": lambda image: np.rot90(image, 1),
    "swapped and turned": lambda image: np.rot90(image.T, 2),
}


@pytest.mark.parametrize("way", WAYS)
def test_each_way_of_turning_is_undone_by_the_model_that_is_named_after_it(way: str) -> None:
    blank = Scene(ArrayImage(DELIVERED), FlatModel(), Acquisition("blank"), 1.0)
    named = [words for words, _ in turned_scenes(blank)]
    assert len(named) == len(WAYS)
    image = np.ascontiguousarray(WAYS[way](DELIVERED))
    fitting = [w for w in named if np.array_equal(pixels_by(w, image), DELIVERED.ravel())]
    assert len(fitting) == 1
    assert fitting[0].startswith(way)
