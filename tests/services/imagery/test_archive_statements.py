"""What archives state of their images: accuracy and offset by processing baseline, dates and seasons."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest
import shapely

from amers.services.imagery.archives import Archive, ArchiveImage, StatedAccuracy

ACCURACY = tuple(StatedAccuracy(3.0, own, since) for own, since in ((4.0, "02.00"), (1.0, "04.00")))
ARCHIVE = Archive(
    "made",
    ("made",),
    "red",
    accuracy=ACCURACY,
    offset=-1000.0,
    offset_since="04.00",
    offset_applied="done",
)


@pytest.mark.parametrize(
    ("baseline", "row"),
    [
        ("", 0),
        ("01.99", 0),
        ("02.00", 0),
        ("3.99", 0),
        ("N0400", 1),
        ("04.00", 1),
        ("5.9", 1),
        ("10.1", 1),
    ],
)
def test_the_statement_of_a_baseline_is_the_last_that_holds_and_else_the_first(
    baseline: str, row: int
) -> None:
    assert ARCHIVE.stated(baseline) is ACCURACY[row]
    assert ARCHIVE.offset_of(baseline, {}) == (-1000.0 if row else 0.0)
    assert ARCHIVE.offset_of(baseline, {"done": True}) == 0.0
    assert ARCHIVE.offset_of(baseline, {"done": False}) == ARCHIVE.offset_of(baseline, {})
    assert replace(ARCHIVE, offset_since="").offset_of(baseline, {}) == 0.0


def test_both_parts_of_an_accuracy_add_as_squares() -> None:
    assert [one.total_m for one in ACCURACY] == pytest.approx([5.0, 10.0**0.5])


@pytest.mark.parametrize(("month", "season"), [(12, 0), (1, 0), (2, 0), (3, 1), (8, 2), (9, 3), (11, 3)])
def test_a_season_has_three_months_and_a_pass_one_date(month: int, season: int) -> None:
    acquired = datetime(2024, month, 5, 10, 30, tzinfo=UTC)
    image = ArchiveImage(
        "a",
        acquired,
        "S2A",
        "22",
        "32TLP",
        "",
        shapely.Point(6, 43),
        0.0,
        0.0,
        (50.0, 150.0),
        0.0,
        ACCURACY[0],
    )
    assert image.season == season
    assert image.date == f"2024-{month:02d}-05 S2A 22"
    assert replace(image, tile="other").date == image.date
    assert replace(image, platform="", orbit="").date == f"2024-{month:02d}-05"
