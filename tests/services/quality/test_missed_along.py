"""Lines and samples whose points do not agree: seen where a band is lost, not where some points fail."""

import numpy as np
import pytest

from amers.services.quality.missed_along import missed_along

LINES = 2000


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
