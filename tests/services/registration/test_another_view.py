"""The model of another view is named as such, in whichever search its points do not agree, or where
they do.
"""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NoConsensus
from amers.services.production.image_production import produce_points
from amers.services.registration.on_points import register_scene
from amers.services.simulation.view import plan_geometry, simulate_block, simulate_view
from amers.services.simulation.world import make_world
from amers.services.types import Array
from tests.services.registration.small_ground import points_at, scene, whole
from tests.services.simulated import BLOCK_SIGMA_M, GSD_M, OPTIONS, SHAPE, MemoryChips, plan

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
    assert "The model belongs to another view" in said


@pytest.mark.parametrize("seed", range(4))
def test_points_that_moved_each_by_itself_are_of_no_other_view(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = refused(rng.uniform(-15.0, 15.0, (64, 2)), rng.uniform(0.0, 100.0, 64))
    assert "another view" not in said
    assert "--sigma-m" in said


@pytest.mark.thorough
def test_chips_over_gentle_ground_imply_the_line_of_sight_of_their_scene() -> None:
    """Eight metres of relief, chips of four views; the scene is seen 11 degrees from the vertical."""
    gentle = make_world(np.random.default_rng(3), size_m=1000.0, posting_m=1.0, relief_m=8.0)
    views = simulate_block(
        gentle,
        np.random.default_rng(2),
        n_views=4,
        shape=SHAPE,
        gsd_m=GSD_M,
        error_m=BLOCK_SIGMA_M,
        largest_incidence_deg=20.0,
    )
    made = produce_points([view.as_scene(BLOCK_SIGMA_M) for view in views], OPTIONS)
    chips = MemoryChips(np.concatenate([made.chips(row) for row in range(len(made.points))]))
    seen = simulate_view(gentle, plan(), np.random.default_rng(11), (3.0, -2.0)).as_scene(10.0)
    for incidence_deg, met in ((11.0, True), (27.0, False), (33.0, False)):
        other = plan_geometry(gentle, plan(incidence_deg=incidence_deg), np.random.default_rng(1))
        result = register_scene(replace(seen, model=other.delivered), made.points, chips)
        told = [one for one in result.qualification.findings if one.name == "line_of_sight"]
        assert bool(told) != met
        assert (result.qualification.verdict == "good") == met
        if not met:
            # Hills of some metres, seen from beside: what they are off by is in the accuracy.
            assert result.qualification.predicted.overall_px > 1.0
