"""Structure of residuals that chance does not explain is named, and limits the verdict by its size."""

import numpy as np
import pytest

from amers.services.misfit.structure import Family, Structure, unfollowed_variance_px2
from amers.services.quality.criteria import Criterion
from amers.services.quality.lack_of_fit import breaks_criterion, structure_criteria

SIGHT = np.array([0.1, 0.0])
SHAPE = (4000, 3000)
PREDICTED_PX = 1.0


def judged(family: Family, largest_px: float, chance: float = 1e-9, shape: str = "period") -> Criterion:
    """The criterion on a structure whose largest displacement is this many times the predicted CE90."""
    size_px = np.full(2, largest_px / 2.0)
    structure = Structure(family, chance, shape, 800.0, size_px, largest_px, np.array([0.02, 0.0]))
    (criterion,) = structure_criteria([structure], SIGHT, SHAPE, PREDICTED_PX)
    return criterion


@pytest.mark.parametrize(
    ("family", "of_good", "of_usable"),
    [
        ("lines", None, 0.1),
        ("steps", None, 0.1),
        ("seams", 0.5, 2.0),
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


@pytest.mark.parametrize("family", ["lines", "steps", "samples", "seams", "image", "height", "chips"])
def test_a_structure_is_given_in_pixels_to_the_hundredth(family: Family) -> None:
    """Measures tell no more than a hundredth of a pixel, and limits are tenths of it."""
    criterion = judged(family, 5.0)
    assert (criterion.unit, criterion.decimals) == ("px", 2)
    assert "px" in criterion.note


@pytest.mark.parametrize("family", ["lines", "steps", "samples", "seams", "image", "height", "chips"])
def test_what_chance_explains_is_not_named_however_large(family: Family) -> None:
    criterion = judged(family, 50.0, chance=1e-3)
    assert criterion.met
    assert criterion.value == 0.0


@pytest.mark.parametrize(
    ("family", "words"),
    [
        ("lines", "attitude jitter"),
        ("samples", "seams between detectors"),
        ("height", "model belongs to another view"),
        ("chips", "attitude jitter that is shorter than a chip"),
    ],
)
def test_a_structure_says_what_it_looks_like(family: Family, words: str) -> None:
    assert words in judged(family, 5.0).note


@pytest.mark.parametrize(
    ("family", "words"),
    [
        ("steps", "at line 800. Possible cause: lines that were lost"),
        ("seams", "at sample 800. Possible cause: a seam between detectors"),
    ],
)
def test_a_step_says_where_it_is_and_what_it_looks_like(family: Family, words: str) -> None:
    assert words in judged(family, 5.0, shape="step").note


@pytest.mark.parametrize(("period", "cause"), [(3900.0, "attitude jitter"), (4100.0, "a bow")])
def test_an_oscillation_longer_than_the_lines_of_an_image_is_a_bow(period: float, cause: str) -> None:
    """However many samples it has."""
    oscillation = Structure("lines", 1e-9, "period", period, np.full(2, 2.0), 4.0, np.full(2, np.nan))
    for samples in (500, 30_000):
        (criterion,) = structure_criteria([oscillation], SIGHT, (SHAPE[0], samples), PREDICTED_PX)
        assert cause in criterion.note


LINES = 2000
BREAKS = np.array([500, 1500])


def behind_breaks(line: list[float], followed: bool = True) -> Criterion:
    return breaks_criterion(BREAKS, np.array(line), followed, LINES)


def test_an_oscillation_is_told_by_its_largest_displacement() -> None:
    """A wave of 1 px reaches 1 px at its crests, and 0.71 px in the root mean square."""
    phase = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    size_px = np.array([np.sin(phase).std(), 3.0 * np.sin(phase).std()])
    structure = Structure("samples", 1e-9, "period", 800.0, size_px, 9.0, np.full(2, np.nan))
    (criterion,) = structure_criteria([structure], SIGHT, SHAPE, PREDICTED_PX)
    assert "1.00 px in line and 3.00 px in sample" in criterion.note


def test_parts_of_a_broken_image_that_points_hold_are_good() -> None:
    held = behind_breaks([10, 200, 400, 600, 900, 1400, 1600, 1700, 1900])
    assert held.met
    assert held.value == 0.0


def test_a_scene_is_not_usable_where_no_three_points_hold_a_quarter_of_its_lines() -> None:
    without = behind_breaks([10, 200, 400, 600, 900, 1400, 1600, 1700])
    assert (without.met, without.needed_for, without.value) == (False, "usable", 25.0)
    assert "line 500, 1500" in without.note
    assert "1 of the 3 parts" in without.note


def test_a_short_part_that_nothing_holds_is_enough() -> None:
    criterion = breaks_criterion(np.array([1900]), np.arange(0.0, 1800.0, 100.0), True, LINES)
    assert (criterion.met, criterion.needed_for, criterion.value) == (False, "usable", 5.0)
    assert "cut the image there" in criterion.note


def test_a_correction_that_follows_no_break_holds_one_part_alone() -> None:
    unfollowed = behind_breaks([10, 200, 400, 600, 900, 1200, 1400, 1600, 1700, 1900], followed=False)
    assert (unfollowed.met, unfollowed.needed_for, unfollowed.value) == (False, "usable", 50.0)
    assert "does not follow" in unfollowed.note


def left(family: Family, line_px: float, sample_px: float, chance: float = 1e-12) -> Structure:
    """A structure that nothing follows."""
    size_px = np.array([line_px, sample_px])
    return Structure(family, chance, "wave", np.nan, size_px, 3.0 * line_px, np.full(2, np.nan))


def test_families_are_words_for_one_misfit_of_which_the_largest_counts() -> None:
    found = [left("lines", 0.4, 0.1), left("samples", 0.3, 0.2), left("steps", 0.2, 0.0)]
    expected = np.array([0.4, 0.2]) ** 2
    np.testing.assert_allclose(unfollowed_variance_px2(found, np.full(2, 0.5)), expected, rtol=1e-6)
    np.testing.assert_allclose(
        unfollowed_variance_px2(found[::-1], np.full(2, 0.5)), expected, rtol=1e-6
    )


def test_neighbours_that_err_together_may_be_points_and_lines_that_do_are_not() -> None:
    """Of the variance of measures a quarter is the image's in lines, and all of it in samples."""
    of_image = np.array([0.25, 1.0])
    together = unfollowed_variance_px2([left("image", 0.4, 0.4)], of_image)
    np.testing.assert_allclose(together, 0.16 * of_image, rtol=1e-6)
    along_lines = unfollowed_variance_px2([left("lines", 0.4, 0.4)], of_image)
    np.testing.assert_allclose(along_lines, [0.16, 0.16], rtol=1e-6)
    by_height = unfollowed_variance_px2([left("height", 0.4, 0.4)], of_image)
    np.testing.assert_array_equal(by_height, np.zeros(2))


def test_what_chance_explains_adds_nothing_to_the_variance() -> None:
    unclear = [left("lines", 0.4, 0.4, chance) for chance in (0.0, 1e-4, 0.01, 0.1, 0.5)]
    variance = [unfollowed_variance_px2([one], np.ones(2))[0] for one in unclear]
    assert variance[0] == pytest.approx(0.16)
    assert variance[-1] == 0.0
    assert (np.diff(variance) < 0.0).all()
