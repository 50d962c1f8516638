"""How much more likely ground that moved must make the measures, and which of two areas is the scene."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.types import Array, BoolArray
from tests.services.conftest import FlatModel
from tests.services.misfit.test_displacement_components import SHAPE, draw
from tests.services.misfit.test_moved_ground import landslide

pytestmark = pytest.mark.long

MIDDLE = np.zeros(2)
FEWEST_AREAS = 500
"""No search for an ellipse of any place, size and direction tries fewer."""


def half_square(observations: ControlObservations, area: BoolArray) -> float:
    """Half of the sum of squares that an affine correction leaves beside a shift of an area (n,)."""
    position = FlatModel().project(observations.lon_lat_h)
    sigma_px = observations.sigma_px[:, None]
    design = np.column_stack([np.ones(len(position)), position, area.astype(np.float64)]) / sigma_px
    moved = (observations.line_sample - position) / sigma_px
    residual = moved - design @ np.linalg.lstsq(design, moved, rcond=None)[0]
    return 0.5 * float((residual**2).sum())


def bands(observations: ControlObservations) -> list[BoolArray]:
    """Points (n,) between tenths of the lines and of the samples."""
    share = FlatModel().project(observations.lon_lat_h) / (np.array(SHAPE) - 1.0)
    tenths = list(combinations(np.linspace(0.0, 1.0, 11), 2))
    return [(axis >= first) & (axis < last) for axis in share.T for first, last in tenths]


def adjusted(
    share: float, moved: Array, seed: int, stated: float = 1.0
) -> tuple[ControlObservations, BoolArray, SceneAdjustment]:
    """A scene of which a round share moved, the points that lie on it, and its adjustment.

    The sigmas of its measures are stated too small by a factor.
    """
    ground = landslide(share, moved, MIDDLE, 1.0)
    observations, _ = draw(ground, np.random.default_rng(seed), wrong=0.0)
    observations = replace(observations, sigma_px=observations.sigma_px * stated)
    adjustment = adjust_scene(FlatModel(), SHAPE, observations, ground_may_move=True)
    return observations, ground.holds(FlatModel().project(observations.lon_lat_h)), adjustment


@pytest.mark.parametrize(("share", "size_px", "seed"), [(0.2, 1.5, 1), (0.3, 1.2, 1), (0.2, 1.2, 3)])
def test_one_of_many_areas_is_less_likely_by_the_number(share: float, size_px: float, seed: int) -> None:
    """It is compared with a band of lines or samples that moved, which has as many parameters."""
    diagonal = np.full(2, size_px / np.sqrt(2.0))
    observations, _, adjustment = adjusted(share, diagonal, seed)
    assert adjustment.moved is not None
    of_band = min(half_square(observations, band) for band in bands(observations))
    of_area = half_square(observations, adjustment.moved.measures)
    assert 0.0 < adjustment.moved.log_evidence < of_band - of_area - np.log(FEWEST_AREAS)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_the_larger_of_two_areas_is_the_scene(share: float) -> None:
    """An ellipse of 60 % of the image lies off by the correction; its surroundings are what moved."""
    moved = np.array([2.5, 3.5])
    _, on_it, adjustment = adjusted(share, moved, 0)
    assert adjustment.moved is not None
    others = ~on_it if share > 0.5 else on_it
    assert np.mean(adjustment.moved.measures == others) > 0.95
    left_px = np.median(adjustment.residual_px[others], axis=0)
    np.testing.assert_allclose(left_px, -moved if share > 0.5 else moved, atol=1.0)
    assert adjustment.active[~others].mean() > 0.9


@pytest.mark.parametrize(("share", "seed"), [(0.1, 0), (0.2, 4)])
def test_a_motion_that_chance_makes_nearly_as_likely_is_not_reported(share: float, seed: int) -> None:
    _, _, adjustment = adjusted(share, np.full(2, 1.2 / np.sqrt(2.0)), seed)
    assert adjustment.moved is None


def test_ground_that_moved_is_as_likely_whatever_sigmas_are_stated_too_small() -> None:
    evidence = []
    for stated in (0.7, 0.5):
        adjustment = adjusted(0.3, np.full(2, np.sqrt(2.0)), 0, stated)[2]
        assert adjustment.moved is not None
        evidence.append(adjustment.moved.log_evidence)
    assert evidence[0] == pytest.approx(evidence[1], rel=0.02)
