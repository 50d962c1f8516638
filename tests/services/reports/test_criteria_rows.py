"""What a page lists of criteria, residuals and points: the worst and the commonest first."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.quality.criteria import Criterion, at_least, at_most
from amers.services.reports.criteria_rows import NOT_USABLE, criterion_rows, unmet_criteria
from amers.services.reports.reasons import count_reasons
from amers.services.reports.scene_words import centre_words
from tests.services.conftest import Make

CE90 = "predicted_ce90_px"
UNIT_WEIGHT, POINTS = "unit_weight", "active_points"


def of_two_levels(value_px: float) -> list[Criterion]:
    """A figure that is good up to 1 px and usable up to 3 px; the level that is asked first varies."""
    return [at_most(CE90, value_px, 1.0, "good"), at_most(CE90, value_px, 3.0, "usable")]


@pytest.mark.parametrize(
    ("value_px", "level", "margin"),
    [(0.5, "good", "+50 %"), (2.0, "usable", "-100 %"), (4.0, NOT_USABLE, "-300 %")],
)
@pytest.mark.parametrize("order", [1, -1])
def test_a_figure_stands_once_with_the_level_that_it_reaches(
    value_px: float, level: str, margin: str, order: int
) -> None:
    (row,) = criterion_rows(of_two_levels(value_px)[::order])
    assert (row.level, row.is_met, row.margin) == (level, level == "good", margin)
    assert (row.good, row.usable) == ("at most 1.00 px", "at most 3.00 px")
    assert row.value == f"{value_px:.2f} px"


def test_what_costs_most_stands_first() -> None:
    fine, costly = at_most(UNIT_WEIGHT, 1.0, 3.0, "good"), at_least(POINTS, 3, 6, "usable")
    rows = criterion_rows([fine, *of_two_levels(2.0), costly])
    assert [row.level for row in rows] == [NOT_USABLE, "usable", "good"]
    assert [row.label for row in rows] == [costly.label, of_two_levels(2.0)[0].label, fine.label]


def test_an_unmet_figure_is_listed_at_the_lowest_level_that_it_misses_and_the_lowest_first() -> None:
    missed = at_least(POINTS, 3, 20, "good"), at_least(POINTS, 3, 6, "usable")
    unmet = unmet_criteria([*of_two_levels(2.0), *missed, at_most(UNIT_WEIGHT, 1.0, 3.0, "good")])
    assert [(one.name, one.needed_for) for one in unmet] == [(POINTS, "usable"), (CE90, "good")]


def test_of_points_not_matched_and_of_others_the_commonest_reason_stands_first(registered: Make) -> None:
    measures = registered(n=60, lost=20, wrong=6).measures
    codes = np.array(["cloud"] * 3 + ["low_score"] * 12 + ["nodata"] * 5, dtype="<U32")
    reason = measures.reason.copy()
    reason[~measures.matched] = codes
    deactivated = np.flatnonzero(measures.matched & ~measures.active)
    reason[deactivated] = "deactivated"
    counts = count_reasons(replace(measures, reason=reason))
    assert [(one.stage, one.reason, one.count) for one in counts] == [
        ("not matched", "low_score", 12),
        ("not matched", "nodata", 5),
        ("not matched", "cloud", 3),
        ("deactivated", "deactivated", len(deactivated)),
    ]


@pytest.mark.parametrize(
    ("lon", "lat", "words"),
    [
        (5.0, 43.0, "43.0000° N, 5.0000° E"),
        (-5.5, -43.25, "43.2500° S, 5.5000° W"),
        (179.95, 1.0, "1.0000° N, 179.9500° E"),
        (180.25, -1.0, "1.0000° S, 179.7500° W"),
    ],
)
def test_the_middle_of_a_scene_is_on_its_side_of_the_earth(lon: float, lat: float, words: str) -> None:
    around = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    assert centre_words(np.array([lon, lat]) + around) == words
