"""Structure of residuals that chance does not explain is named, and limits the verdict by its size."""

import numpy as np
import pytest

from services.adjustment.structure import Family, Structure
from services.quality.criteria import Criterion
from services.quality.lack_of_fit import structure_criteria

SIGHT = np.array([0.1, 0.0])
SHAPE = (4000, 3000)
PREDICTED_PX = 1.0


def judged(family: Family, largest_px: float, chance: float = 1e-9) -> Criterion:
    """The criterion on a structure whose largest displacement is this many times the predicted CE90."""
    size_px = np.full(2, largest_px / 2.0)
    structure = Structure(family, chance, "period", 800.0, size_px, largest_px, np.array([0.02, 0.0]))
    (criterion,) = structure_criteria([structure], SIGHT, SHAPE, PREDICTED_PX)
    return criterion


@pytest.mark.parametrize(
    ("family", "of_good", "of_usable"),
    [
        ("lines", None, 0.1),
        ("steps", None, 0.1),
        ("height", None, 0.5),
        ("samples", 0.5, 2.0),
        ("image", 0.5, 2.0),
        ("chips", 0.5, 2.0),
    ],
)
def test_the_size_of_a_structure_limits_the_verdict(
    family: Family, of_good: float | None, of_usable: float
) -> None:
    assert judged(family, 0.99 * (of_good or of_usable)).met
    too_large = judged(family, 1.01 * of_usable)
    assert not too_large.met
    assert too_large.needed_for == "usable"
    if of_good is not None:
        between = judged(family, 1.01 * of_good)
        assert not between.met
        assert between.needed_for == "good"


@pytest.mark.parametrize("family", ["lines", "steps", "samples", "image", "height", "chips"])
def test_what_chance_explains_is_not_named_however_large(family: Family) -> None:
    criterion = judged(family, 50.0, chance=1e-3)
    assert criterion.met
    assert criterion.value == 0.0


@pytest.mark.parametrize(
    ("family", "words"),
    [
        ("lines", "attitude jitter"),
        ("samples", "seams between detectors"),
        ("height", "model is that of another view"),
        ("chips", "too fast for positions of whole chips"),
    ],
)
def test_a_structure_says_what_it_looks_like(family: Family, words: str) -> None:
    assert words in judged(family, 5.0).note
