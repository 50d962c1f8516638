"""How far images of one place disagree, against what they state, and which points they confirm."""

from dataclasses import replace

import numpy as np
import pytest

from services.imagery.scene import Scene
from services.imagery.source import ArrayImage
from services.production.view_agreement import AgreedViews
from services.types import Acquisition, Array, Observations
from tests.services.conftest import FlatModel

BLANK = ArrayImage(np.zeros((10, 10), dtype=np.float32))


def agreed(sigmas_m: tuple[float, ...], shift_m: Array) -> AgreedViews:
    """Images that state these sigmas and lie off by these shifts; of five points they show some."""
    scenes = [Scene(BLANK, FlatModel(), Acquisition("image"), sigma_m) for sigma_m in sigmas_m]
    point, image = np.array([0, 0, 0, 1, 1, 2, 4]), np.array([0, 1, 2, 0, 1, 1, 2])
    views = Observations(point, image, np.zeros((7, 2)), np.full(7, np.nan))
    tied = np.ones(len(scenes), dtype=bool)
    reference, shown_by = np.array([0, 0, 1, -1, 2]), np.array([3, 3, 3, 0, 1])
    return AgreedViews(scenes, views, reference, shown_by, shift_m, tied, np.nan)


def test_images_that_are_off_as_they_state_disagree_as_stated() -> None:
    """The first image is off as well: shifts are those of both. Drawn a hundred times as large."""
    rng, sigmas_m = np.random.default_rng(3), (2.0, 6.0)
    off_m = rng.normal(size=(4000, 2, 2)) * np.array(sigmas_m)[:, None]
    shifts_m = 100.0 * (off_m[:, 1] - off_m[:, 0])
    ratios = [agreed(sigmas_m, np.stack([np.zeros(2), one])).disagreement for one in shifts_m]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(100.0, rel=0.03)


def test_the_image_that_disagrees_most_counts_and_agreement_makes_nothing_better() -> None:
    shift_m = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, -40.0]])
    assert agreed((2.0, 2.0, 2.0), shift_m).disagreement == pytest.approx(10.0)
    assert agreed((2.0, 2.0, 2.0), shift_m / 100.0).disagreement == 1.0


def test_points_are_confirmed_by_enough_images_or_by_all_that_show_them() -> None:
    views = agreed((2.0, 2.0, 2.0), np.zeros((3, 2)))
    np.testing.assert_array_equal(views.confirmed(3), [True, False, False, False, True])
    np.testing.assert_array_equal(views.confirmed(2), [True, True, False, False, True])
    taken = views.take(np.array([1, 4]))
    np.testing.assert_array_equal(taken.point, [0, 0, 1])
    np.testing.assert_array_equal(taken.image, [0, 1, 2])
    assert replace(views, reference=np.full(5, -1)).confirmed(1).sum() == 0
