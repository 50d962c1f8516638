"""The record of what files state: repetition, words, and what a terminal shows."""

import pytest

from amers.services.statements import Statement, Subject, Use, gathered, worth_saying

UNIT = Statement("a.tif", Subject.UNIT, Use.USED, "foot", "band 1")


def test_a_statement_is_one_sentence():
    stated = Statement("a.csv", Subject.UNIT, Use.NOT_USED, "furlong", "column h", "metres expected")
    assert str(stated) == "a.csv, column h: unit: furlong: not used (metres expected)"
    assert str(UNIT) == "a.tif, band 1: unit: foot: used"


def test_what_many_files_state_alike_is_one_statement_with_their_number():
    others = [Statement(f"{k}.tif", UNIT.subject, UNIT.use, UNIT.value, UNIT.where) for k in range(3)]
    alone = Statement("b.tif", Subject.EPOCH, Use.NOT_USED, "2010.0")
    found = gathered([UNIT, alone, *others, UNIT])
    assert [str(one) for one in found] == [
        "a.tif and 3 more, band 1: unit: foot: used",
        "b.tif: epoch: 2010.0: not used",
    ]


@pytest.mark.parametrize(
    ("use", "is_usual", "is_said"),
    [
        (Use.USED, False, False),
        (Use.ASSUMED, False, True),
        (Use.NOT_USED, False, True),
        (Use.NOT_USED, True, False),
        ("not used", False, True),
        ("used", False, False),
    ],
)
def test_a_terminal_shows_what_was_assumed_or_not_used_unless_it_is_usual(use, is_usual, is_said):
    """Words in place of the enumeration are what a JSON document has."""
    stated = Statement("a.tif", Subject.EPOCH, use, "2010.0", is_usual=is_usual)
    assert bool(worth_saying([stated])) is is_said
