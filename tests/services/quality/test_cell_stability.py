"""Hold-outs by cells show errors that neighbours share, which hold-outs at random cannot."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.quality.cell_stability import CELLS, cells_of, measure_cell_stability
from amers.services.quality.stability import PLACES, image_places, measure_stability
from tests.services.conftest import Make

SEEDS = range(12)


def both(registered, **made):
    """The stability at random and by cells of a registration without wrong measures."""
    scene = registered(lost=0, wrong=0, **made).adjusted()
    return measure_stability(scene, 10, 0.8, np.random.default_rng(1)), measure_cell_stability(scene)


def medians(registered, **made):
    """Medians over worlds of what hold-outs at random and by cells find over independent errors."""
    pairs = [both(registered, n=300, seed=seed, **made) for seed in SEEDS]
    at_random, by_cells = zip(*pairs, strict=True)
    return (
        np.median([one.group_means.over_independent for one in at_random]),
        np.median([one.group_means.over_independent for one in by_cells]),
        np.median([one.group_means.over_stated for one in by_cells]),
    )


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("points_px", [0.0, 2.0])
def test_with_independent_errors_both_find_what_is_predicted(registered, points_px):
    at_random, by_cells, over_stated = medians(registered, points_px=points_px)
    assert at_random == pytest.approx(1.0, abs=0.2)
    assert by_cells == pytest.approx(1.0, abs=0.1)
    assert over_stated == pytest.approx(1.0, abs=0.1)


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("shared_px", [0.4, 0.8])
def test_errors_that_neighbours_share_show_by_cells_only(registered, shared_px):
    at_random, by_cells, over_stated = medians(registered, shared_px=shared_px)
    assert at_random == pytest.approx(1.0, abs=0.25), "held out at random, they cannot be seen"
    assert by_cells > 2.0
    assert over_stated < 1.6, "the stated accuracy knows most of them"


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_a_model_that_bends_shows_by_cells_only(registered):
    at_random, by_cells, _ = medians(registered, bend_px=0.5)
    assert at_random == pytest.approx(1.0, abs=0.25)
    assert by_cells > 2.0


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_errors_that_neighbours_share_move_the_corners_more_by_cells(registered):
    ratios = []
    for seed in SEEDS:
        at_random, by_cells = both(registered, n=300, seed=seed, shared_px=0.8)
        moved = [max(one.max_px for one in held.displacements) for held in (by_cells, at_random)]
        ratios.append(moved[0] / moved[1])
    assert np.median(ratios) > 1.5


def test_every_active_point_is_held_out_once_with_its_whole_cell(registered):
    scene = registered(n=300)
    active, masks = scene.measures.active, []

    def refit(mask):
        masks.append(mask)
        return scene.refit(mask)

    stability = measure_cell_stability(scene.adjusted(refit))
    held = np.array([active & ~mask for mask in masks])
    assert stability.left_out == len(masks) == CELLS**2
    assert (held.sum(axis=0) == active).all()
    line_sample = scene.measures.line_sample
    low, high = line_sample[active].min(axis=0), line_sample[active].max(axis=0)
    for of_cell in held:
        extent = line_sample[of_cell].max(axis=0) - line_sample[of_cell].min(axis=0)
        assert (extent <= (high - low) / CELLS).all()
    assert stability.held_out_px.xy.n == active.sum()


def test_cells_divide_the_extent_of_the_points_wherever_in_the_image_it_lies(registered: Make) -> None:
    """Each cell is a quarter of the lines by a quarter of the samples that active points reach over."""
    measures = registered(n=300).measures
    here = cells_of(measures)
    stretch, start = np.array([3.0, 0.5]), np.array([5000.0, 40.0])
    moved = cells_of(replace(measures, line_sample=start + stretch * measures.line_sample))
    assert len(here) == len(moved) == CELLS**2
    for one, other in zip(here, moved, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.filterwarnings("error")
def test_cells_without_solution_are_counted_and_without_any_there_is_a_note(registered):
    def refit(mask):
        raise NotEnoughPoints(3, 4)

    scene = registered(n=300)
    stability = measure_cell_stability(scene.adjusted(refit))
    assert (stability.left_out, stability.failed, stability.displacements) == (0, CELLS**2, ())
    assert "no solution without any of 16 cells" in stability.note
    assert np.isnan(stability.group_means.over_independent)


def test_points_of_one_place_have_no_cells(registered):
    scene = registered()
    one = np.zeros(len(scene.measures.active), bool)
    one[np.flatnonzero(scene.measures.active)[0]] = True
    alone = replace(scene, measures=replace(scene.measures, active=one))
    assert (
        measure_cell_stability(alone.adjusted()).note
        == "1 active points in 1 cells leave none to hold out"
    )


def test_the_places_of_displacements_are_the_middles_of_the_corner_pixels_and_of_the_image() -> None:
    """Of 11 lines and 21 samples, around the image from the first pixel on, the middle at last."""
    places = dict(zip(PLACES, image_places((11, 21)).tolist(), strict=True))
    lines = {"top": 0.0, "bottom": 10.0}
    samples = {"left": 0.0, "right": 20.0}
    for name, place in places.items():
        if name != "centre":
            vertical, horizontal = name.split()
            assert place == [lines[vertical], samples[horizontal]]
    assert places["centre"] == [5.0, 10.0]
