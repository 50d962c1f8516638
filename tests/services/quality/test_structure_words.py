"""What structures of residuals look like in words, and what they add to the stated accuracy."""

import numpy as np
import pytest

from amers.services.misfit.structure import Family, Structure, unfollowed_variance_px2
from amers.services.quality.structure_words import structure_words

SHAPE = (4000, 3000)


@pytest.mark.parametrize(
    ("family", "shape", "words"),
    [
        ("lines", "period", "attitude jitter"),
        ("samples", "period", "seams between detectors"),
        ("image", "period", "errors of the terrain"),
        ("steps", "step", "at line 800. Possible cause: lines that were lost"),
        ("seams", "step", "at sample 800. Possible cause: a seam between detectors"),
    ],
)
def test_a_structure_says_where_and_what_it_is_like(family: Family, shape: str, words: str) -> None:
    structure = Structure(family, 1e-9, shape, 800.0, np.full(2, 2.5), 5.0, np.full(2, np.nan))
    assert words in structure_words(structure, SHAPE)


@pytest.mark.parametrize(("period", "cause"), [(3900.0, "attitude jitter"), (4100.0, "a bow")])
def test_an_oscillation_longer_than_the_lines_of_an_image_is_a_bow(period: float, cause: str) -> None:
    """However many samples it has."""
    oscillation = Structure("lines", 1e-9, "period", period, np.full(2, 2.0), 4.0, np.full(2, np.nan))
    for samples in (500, 30_000):
        assert cause in structure_words(oscillation, (SHAPE[0], samples))


def test_an_oscillation_is_told_by_its_largest_displacement() -> None:
    """A wave of 1 px reaches 1 px at its crests, and 0.71 px in the root mean square."""
    phase = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    size_px = np.array([np.sin(phase).std(), 3.0 * np.sin(phase).std()])
    structure = Structure("samples", 1e-9, "period", 800.0, size_px, 9.0, np.full(2, np.nan))
    assert "1.00 px in line and 3.00 px in sample" in structure_words(structure, SHAPE)


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
