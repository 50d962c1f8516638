"""Lines and samples whose points do not agree: seen where a band is lost, not where some points fail."""

import numpy as np
import pytest
from scipy.stats import hypergeom

from amers.services.quality.lack_of_fit import missed_criterion
from amers.services.quality.missed_along import missed_along, missed_at_borders

LINES = 2000
AWAY_PX = np.array([2.0, -1.0])


def places(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(0.0, LINES, n)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("n", [30, 120])
def test_points_that_fail_at_random_accuse_no_lines(share: float, n: int) -> None:
    rng = np.random.default_rng([7, n, round(10 * share)])
    accused = 0
    for _ in range(500):
        line = places(rng, n)
        accused += missed_along(line, rng.random(n) < share, np.ones(n, dtype=bool)).any()
    assert accused <= 5  # one in a hundred


@pytest.mark.parametrize("first", [0.0, 700.0, 1600.0])
def test_a_band_of_lost_lines_is_found_with_its_borders(first: float) -> None:
    rng = np.random.default_rng(11)
    for _ in range(50):
        line = places(rng, 120)
        lost = (line >= first) & (line < first + 400.0)
        agrees = (rng.random(120) < 0.7) & ~lost
        missed = missed_along(line, agrees, np.ones(120, dtype=bool))
        assert missed[lost].all()
        # Points that fail on their own beside the band are taken with it, a few lines of them.
        assert (missed & ~lost).sum() <= 8


def test_an_image_turned_by_180_degrees_has_lost_the_same_lines() -> None:
    rng = np.random.default_rng(14)
    found = 0
    for number in range(300):
        line = places(rng, 60)
        first, lines = (0.0 if number % 2 else rng.uniform(0.0, LINES)), rng.uniform(200.0, 600.0)
        lost = (line >= first) & (line < first + lines) & (rng.random(60) < 0.95)
        agrees = (rng.random(60) < 0.7) & ~lost
        tried = np.ones(60, dtype=bool)
        missed = missed_along(line, agrees, tried)
        found += missed.any()
        np.testing.assert_array_equal(missed_along(LINES - line, agrees, tried), missed)
    assert 60 <= found <= 240, "bands that are clear and bands that chance may explain"


@pytest.mark.parametrize("agree", [True, False])
def test_where_all_points_agree_or_none_does_no_lines_are_told_from_others(agree: bool) -> None:
    line = places(np.random.default_rng(15), 60)
    assert not missed_along(line, np.full(60, agree), np.ones(60, dtype=bool)).any()


def rows_of_places(rng: np.random.Generator) -> np.ndarray:
    """Lines of 30 rows of 30 places, which a correction moved by little."""
    row = np.linspace(30.0, LINES - 30.0, 30)
    return np.repeat(row, 30) + rng.normal(0.0, 0.05, 900)


def test_a_part_of_the_rows_of_a_grid_is_no_band_of_lines() -> None:
    """Haze hides the right of six rows."""
    rng = np.random.default_rng(16)
    accused = 0
    for _ in range(100):
        line, right = rows_of_places(rng), np.tile(np.arange(30) >= 9, 30)
        hazy = (line > 300.0) & (line < 700.0)
        agrees = rng.random(900) < np.where(hazy & right, 0.02, 0.6)
        accused += missed_along(line, agrees, np.ones(900, dtype=bool)).any()
    assert accused <= 3


def test_rows_of_a_grid_that_are_lost_are_found_whole() -> None:
    rng = np.random.default_rng(17)
    for _ in range(50):
        line = rows_of_places(rng)
        lost = (line > 900.0) & (line < 1100.0)
        agrees = (rng.random(900) < 0.6) & ~(lost & (rng.random(900) < 0.98))
        missed = missed_along(line, agrees, np.ones(900, dtype=bool))
        assert not missed[~lost].any()
        assert missed.sum() % 30 == 0
        assert missed[lost].mean() > 0.4


def test_two_bands_are_both_found() -> None:
    rng = np.random.default_rng(12)
    line = places(rng, 200)
    lost = ((line > 300.0) & (line < 600.0)) | (line > 1700.0)
    missed = missed_along(line, ~lost & (rng.random(200) < 0.8), np.ones(200, dtype=bool))
    assert missed[lost].all()


def test_points_under_clouds_accuse_no_lines() -> None:
    rng = np.random.default_rng(13)
    line = places(rng, 120)
    clouded = line < 800.0
    reason = np.where(clouded, "cloud", "")
    criterion = missed_criterion("lines", line, ~clouded, reason, LINES)
    assert criterion.met
    assert criterion.value == 0.0


@pytest.mark.parametrize(("lines", "needed_for"), [(120.0, "good"), (500.0, "usable")])
def test_the_criterion_says_which_lines_and_how_many(lines: float, needed_for: str) -> None:
    line = np.linspace(0.0, LINES - 1.0, 240)
    lost = (line >= 900.0) & (line < 900.0 + lines)
    reason = np.where(lost, "low_score", "")
    criterion = missed_criterion("lines", line, ~lost, reason, LINES)
    assert not criterion.met
    assert criterion.needed_for == needed_for
    assert criterion.value == pytest.approx(100.0 * lines / LINES, abs=1.0)
    assert f"lines {line[lost][0]:.0f} and {line[lost][-1]:.0f}" in criterion.note


def test_a_detector_whose_points_do_not_agree_is_named_by_its_samples() -> None:
    sample = np.linspace(0.0, LINES - 1.0, 240)
    beside = (sample >= 500.0) & (sample < 1000.0)
    reason = np.where(beside, "deactivated", "")
    criterion = missed_criterion("samples", sample, ~beside, reason, LINES)
    assert (criterion.name, criterion.needed_for) == ("missed_along_samples", "usable")
    assert "samples 502 and 995" in criterion.note
    assert "a detector is out of place" in criterion.note


def test_a_side_of_the_image_whose_points_are_not_found_accuses_no_detector() -> None:
    sample = np.linspace(0.0, LINES - 1.0, 240)
    hazy = sample >= 1200.0
    criterion = missed_criterion("samples", sample, ~hazy, np.where(hazy, "low_score", ""), LINES)
    assert criterion.met


def test_lost_lines_reach_to_the_border_that_no_point_is_beyond() -> None:
    line = np.linspace(100.0, LINES - 101.0, 240)
    lost = line >= 1700.0
    criterion = missed_criterion("lines", line, ~lost, np.where(lost, "border_peak", ""), LINES)
    assert criterion.value == pytest.approx(15.0, abs=1.0)


def test_ground_that_moved_beside_others_is_not_taken_for_lost_lines() -> None:
    line = np.linspace(0.0, LINES - 1.0, 240)
    band = (line >= 900.0) & (line < 1400.0)
    agrees = ~band
    agrees[np.flatnonzero(band)[::6]] = True
    criterion = missed_criterion("lines", line, agrees, np.where(agrees, "", "low_score"), LINES)
    assert criterion.met
    assert criterion.value == 0.0


def test_chips_that_a_break_of_the_image_cuts_do_not_count() -> None:
    line = np.linspace(0.0, LINES - 1.0, 240)
    cut = np.abs(line - 1000.0) < 100.0
    reason = np.where(cut, "deactivated", "")
    assert not missed_criterion("lines", line, ~cut, reason, LINES).met
    assert missed_criterion("lines", line, ~cut, reason, LINES, counts=~cut).met


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_points_left_out_at_random_accuse_no_border(share: float) -> None:
    rng = np.random.default_rng([16, round(100 * share)])
    accused = 0
    for _ in range(4000):
        line = places(rng, 70)
        accused += missed_at_borders(
            line, rng.random(70) >= share, np.ones(70, dtype=bool), np.tile(AWAY_PX, (70, 1))
        ).any()
    assert accused <= 20, "half of one in a hundred: the other half is that of the samples"


def test_few_points_of_the_other_image_at_a_border_accuse_its_lines() -> None:
    rng = np.random.default_rng(17)
    for _ in range(50):
        line = np.concatenate([rng.uniform(0.0, 300.0, 5), rng.uniform(320.0, LINES, 130)])
        reason = np.full(135, "", dtype=object)
        reason[:5] = "deactivated"
        reason[5:70] = "low_score"  # hidden here and there: they say nothing of either part
        reason[rng.choice(np.arange(70, 135), 8, replace=False)] = "deactivated"
        active = reason == ""
        misfit_px = np.where(active[:, None], 0.0, AWAY_PX) + rng.normal(0.0, 0.3, (135, 2))
        criterion, turned = (
            missed_criterion("lines", at, active, reason.astype(str), LINES, misfit_px=misfit_px)
            for at in (line, LINES - line)
        )
        assert (criterion.met, criterion.needed_for) == (False, "usable")
        assert 12.0 <= criterion.value <= 25.0
        assert turned.value == pytest.approx(criterion.value)


def test_points_that_are_not_found_or_two_that_disagree_accuse_no_border() -> None:
    line = np.linspace(0.0, LINES - 1.0, 100)
    all_found, away = np.ones(100, dtype=bool), np.tile(AWAY_PX, (100, 1))
    agrees = np.arange(100) >= 6
    assert not missed_at_borders(line, agrees, agrees, away).any()
    assert not missed_at_borders(line, np.arange(100) >= 2, all_found, away).any()
    for others in (np.arange(100) >= 3, np.arange(100) < 97):
        np.testing.assert_array_equal(missed_at_borders(line, others, all_found, away), ~others)


@pytest.mark.parametrize("run", [3, 4, 6])
def test_a_border_is_accused_up_to_the_chance_of_drawing_its_points_without_return(run: int) -> None:
    """Of 80 points as many as chance allows are left out, besides those at the border far from it."""
    line = np.linspace(0.0, LINES - 1.0, 80)
    outcomes = []
    for left_out in range(run, 60):
        agrees = np.ones(80, dtype=bool)
        agrees[:run] = False
        agrees[10 : 10 + left_out - run] = False
        chance = 4.0 * hypergeom.pmf(run, 80, left_out, run)
        found = np.ones(80, dtype=bool)
        missed = missed_at_borders(line, agrees, found, np.tile(AWAY_PX, (80, 1)))
        assert missed[:run].all() == missed.any() == (chance <= 0.01)
        outcomes.append(missed.any())
    assert any(outcomes)
    assert not all(outcomes)


def test_points_that_are_left_out_where_they_are_expected_accuse_no_border() -> None:
    line = np.linspace(0.0, LINES - 1.0, 100)
    agrees = np.arange(100) >= 5
    assert not missed_at_borders(line, agrees, np.ones(100, dtype=bool), np.zeros((100, 2))).any()


def test_false_matches_at_a_border_accuse_it_less_than_points_that_are_displaced_alike() -> None:
    line = np.linspace(0.0, LINES - 1.0, 100)
    all_found, others = np.ones(100, dtype=bool), np.arange(100) >= 4
    rng = np.random.default_rng(18)
    accused = [
        missed_at_borders(line, others, all_found, rng.uniform(-8.0, 8.0, (100, 2))).any()
        for _ in range(400)
    ]
    assert np.mean(accused) < 0.1
