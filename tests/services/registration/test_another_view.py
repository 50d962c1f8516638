"""The model of another view is named as such, in whichever search its points do not agree."""

from dataclasses import replace

import numpy as np
import pytest

from services.errors import NoConsensus
from services.registration.on_points import register_scene
from services.types import Array
from tests.services.registration.small_ground import points_at, scene, whole

SIGMA_M = 12.0


def refused(displacement_px: Array, height_m: Array) -> str:
    """Why points (64,) are refused that a model places aside of where their scene shows them."""
    axis = 312.0 + np.linspace(40.0, 360.0, 8)
    shown = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    points, chips = points_at(shown)
    aside = replace(points, lon_lat_h=whole().model.locate(shown + displacement_px, height_m))
    with pytest.raises(NoConsensus) as error:
        register_scene(scene(np.zeros(2), SIGMA_M), aside, chips)
    assert "but only" in str(error.value)
    return str(error.value)


def test_a_search_that_begins_with_the_finest_chips_names_the_model_of_another_view() -> None:
    height_m = np.random.default_rng(5).uniform(0.0, 100.0, 64)
    said = refused(height_m[:, None] * [0.0, 0.3], height_m)
    assert "the model is that of another view" in said


@pytest.mark.parametrize("seed", range(4))
def test_points_that_moved_each_by_itself_are_of_no_other_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = refused(rng.uniform(-15.0, 15.0, (64, 2)), rng.uniform(0.0, 100.0, 64))
    assert "another view" not in said
    assert "--sigma-m" in said
