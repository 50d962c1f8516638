"""An image that was mirrored or turned fits its model again when the model is turned as it is said."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.matching.control_points import MatchingOptions
from amers.services.registration.on_points import _how_it_is_turned
from amers.services.registration.options import CoarseOptions, RegistrationOptions
from amers.services.registration.turned import turned_scenes
from amers.services.types import Acquisition, FloatImage
from tests.factories import control_points
from tests.services.conftest import FlatModel
from tests.services.simulated import MemoryChips

LINES, SAMPLES = 7, 10
DELIVERED = np.arange(LINES * SAMPLES, dtype=np.float32).reshape(LINES, SAMPLES)
"""The image that belongs to the model: no two pixels are alike."""
AT = np.stack(np.meshgrid(np.arange(LINES), np.arange(SAMPLES), indexing="ij"), -1).reshape(-1, 2)
BLANK = Scene(ArrayImage(DELIVERED), FlatModel(), Acquisition("blank"), 1.0)
POINTS = control_points(3, np.random.default_rng(0)), MemoryChips(np.zeros((9, 101, 101)))
GROUND = FlatModel().locate(AT.astype(np.float64), np.zeros(len(AT)))


def pixels_by(words: str, image: FloatImage) -> FloatImage:
    """The pixels (n,) at which a model that is turned in this way expects the ground; NaN beyond."""
    scene = replace(BLANK, image=ArrayImage(image))
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
    named = [words for words, _ in turned_scenes(BLANK)]
    assert len(named) == len(WAYS)
    image = np.ascontiguousarray(WAYS[way](DELIVERED))
    fitting = [w for w in named if np.array_equal(pixels_by(w, image), DELIVERED.ravel())]
    assert len(fitting) == 1
    assert fitting[0].startswith(way)


@pytest.mark.parametrize(
    ("found", "agree", "is_turned", "points", "views"),
    [(12, 12, True, 60, 4), (24, 12, True, 60, 4), (11, 11, False, 10, 1), (25, 12, False, 60, 4)],
)
def test_an_image_is_turned_as_the_first_model_says_that_half_of_the_points_agree_on(
    found: int, agree: int, is_turned: bool, points: int, views: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dozen at least, of a quick search. A model that finds nothing, as the first, is left aside."""
    given: list[object] = []

    def search(*of: object) -> tuple[object, object, object]:
        given.append(of[-1])
        if len(given) == 1:
            raise NotEnoughPoints(0, 6, "")
        count = agree if len(given) == 3 else 2
        reason = np.where(np.arange(40) < found, "", "low_score")
        matches, active = SimpleNamespace(reason=reason), np.arange(40) < count
        return None, SimpleNamespace(matches=matches), SimpleNamespace(active=active)

    monkeypatch.setattr("amers.services.registration.on_points.search_scene", search)
    options = RegistrationOptions(
        coarse=CoarseOptions(points=points, min_score=0.45),
        matching=MatchingOptions(max_views=views, agreement_px=0.6),
        seed=3,
    )
    said = _how_it_is_turned(BLANK, *POINTS, options)
    assert said.startswith("turned by 180 degrees") == is_turned
    assert (f"by {agree} points that agree then" in said) == is_turned
    few = replace(
        options,
        max_points=60,
        fine_stages=1,
        coarse=replace(options.coarse, points=min(points, 24)),
        matching=replace(options.matching, max_views=min(views, 2)),
    )
    assert given == [few] * (3 if is_turned else len(WAYS))
