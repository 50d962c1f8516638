"""Surfaces of simulated views with known truth: errors, sigmas, reasons, alignment, resumption."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from amers.services.errors import CoverageError
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.surface.match import Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pairs import candidate_pairs, choose_pairs
from amers.services.surface.rectify import rectify
from amers.services.surface.surface import make_surface, surface_tiles
from amers.services.tasks import Arrays, Work
from tests.services.surface.worlds import Compared, compared, compared_scenes, grid, scene

OPTIONS = SurfaceOptions()
UNFILLED = SurfaceOptions(fill_cells=0)
HEIGHTS_M = (140.0, 180.0)


@cache
def pair() -> Compared:
    return compared(("left", "right"), OPTIONS)


@cache
def triplet() -> Compared:
    return compared(("left", "right", "down"), OPTIONS)


@pytest.mark.parametrize("made", [pair, triplet])
def test_heights_are_true_and_so_are_their_sigmas(made: Callable[[], Compared]) -> None:
    found = made()
    known = np.isfinite(found.height_m)
    open_ground = known & ~found.near_wall
    error_m = found.error_m[open_ground]
    assert known.mean() > 0.97
    assert abs(np.median(error_m)) < 0.05
    assert 1.4826 * np.median(np.abs(error_m)) < 0.15
    assert np.quantile(np.abs(error_m), 0.99) < 1.0
    for cells in (open_ground, known):
        assert (np.abs(found.error_m) < 1.645 * found.sigma_m)[cells].mean() > 0.9
    assert (np.abs(found.error_m) > 5.0 * found.sigma_m)[known].mean() < 0.001
    assert np.median(found.sigma_m[open_ground]) < 0.4


def test_cells_without_a_height_say_why() -> None:
    found = compared(("left", "right"), UNFILLED)
    missing = ~np.isfinite(found.height_m)
    assert (found.reason[~missing] == Reason.FOUND).all()
    assert missing.any()
    assert (found.reason[missing] != Reason.FOUND).all()
    # Ground beside the walls is hidden from one of both.
    assert np.isin(found.reason[missing], (Reason.HIDDEN, Reason.ISOLATED)).mean() > 0.9
    filled = missing & np.isfinite(pair().height_m)
    assert (pair().views[filled] == 0).all()
    assert (found.views[~missing] == 2).all()


def test_models_that_disagree_are_aligned() -> None:
    shift_px = 0.6
    left = scene("left")
    correction = no_correction(left.image.shape)
    correction.parameters[1, 0] = shift_px
    off = replace(left, model=CorrectedModel(left.model, correction))
    found = compared_scenes([off, scene("right"), scene("down")], OPTIONS)
    before = {
        p: 0.5 * shift_px / pair.base_to_height
        for p, pair in enumerate(found.surface.pairs)
        if 0 in (pair.first, pair.second)
    }
    moved = found.surface.shift_m[:, 2]
    (still,) = set(range(3)) - set(before)
    for p, height_m in before.items():
        # A pair that the wrong model lifts is lowered by as much, against one without it.
        assert abs(abs(moved[p] - moved[still]) - height_m) < 0.12
    spread = np.abs(found.error_m - np.nanmedian(found.error_m))
    assert np.nanmedian(spread[~found.near_wall]) < 0.12


def test_rows_of_both_images_are_common() -> None:
    rectified = rectify(scene("left").model, scene("right").model, grid(), HEIGHTS_M, 1.0)
    assert rectified is not None
    assert rectified.residual_px < 0.01
    lowest, count = rectified.disparities
    assert lowest < rectified.nodes[:, 2].min() < rectified.nodes[:, 2].max() < lowest + count


def test_pairs_are_chosen_by_angle_and_spread_over_the_images() -> None:
    scenes = [scene(look) for look in ("left", "right", "down")]
    candidates = candidate_pairs(scenes, HEIGHTS_M, (0.1, 0.9))
    bases = sorted(round(pair.base_to_height, 2) for pair in candidates)
    assert bases == [0.25, 0.25, 0.5]
    best = choose_pairs(candidates, 3)[0]
    assert {best.first, best.second} == {0, 1}
    weak = [replace(candidates[0], fit=0.9), replace(candidates[1], fit=0.3)]
    assert choose_pairs(weak, 2, 0.5) == weak[:1]
    with pytest.raises(CoverageError, match=r"base over height of 0.6 to 0.9; .*left and right: 0.50"):
        candidate_pairs(scenes, HEIGHTS_M, (0.6, 0.9))


class Stops(dict[str, Arrays]):
    """Keeps results, and stops the work at one of them."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self.after = after

    def __setitem__(self, name: str, arrays: Arrays) -> None:
        super().__setitem__(name, arrays)
        if len(self) == self.after:
            self.after = -1
            raise KeyboardInterrupt


@pytest.mark.parametrize("after", [1, 2])
def test_interrupted_work_goes_on_to_the_same_bytes(after: int) -> None:
    kept = Stops(after)
    looks = ("left", "right")
    with pytest.raises(KeyboardInterrupt):
        compared(looks, UNFILLED, Work(kept=kept))
    same_bytes(compared(looks, UNFILLED, Work(kept=kept)), compared(looks, UNFILLED))


def test_the_number_of_threads_does_not_change_a_byte() -> None:
    with ThreadPoolExecutor(2) as executor:
        two = compared(("left", "right"), UNFILLED, Work(executor, ahead=4))
    same_bytes(two, compared(("left", "right"), UNFILLED))


def same_bytes(one: Compared, other: Compared) -> None:
    for name in ("height_m", "sigma_m", "views", "reason"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_heights_that_do_not_hold_the_ground_are_said() -> None:
    wrong: Any = replace(OPTIONS, heights_m=(9000.0, 9001.0))
    with pytest.raises(CoverageError, match="9000 to 9001 m are stated, the models"):
        compared(("left", "right"), wrong)


def test_ground_that_no_pair_shows_is_outside() -> None:
    away = grid()
    away = replace(away, shape=(60, 700))
    surface = make_surface([scene("left"), scene("right")], UNFILLED, grid=away)
    (tile,) = surface_tiles(surface)
    assert (tile.reason[:, 500:] == Reason.OUTSIDE).mean() > 0.99
    assert np.isnan(tile.height_m[:, 500:]).all()
