"""Every option of a command goes where it went, as the same value; every result is shown as it was.

`tests/golden/wiring.json` has where, and what is shown of results that have another value in every
field. After a change that is meant, write it anew (`python -m tests.app.wiring`) and read what differs.
"""

import json
import math
from pathlib import Path

import pytest

from tests.app.wiring import GOLDEN, NO_OPTIONS, commands, limits, refusals, wiring

EXPECTED = json.loads(GOLDEN.read_text())
UNITS = {1.0, 0.01, 1000.0}
"""By what options are multiplied: none, per cent, and kilometres in metres."""
OF_USE_ALONE = {
    "base make --geoid",
    "points intersect --geoid",
    "points experiment --geoid",
    "points reach --vertical",
    "points reach --geoid",
    "production points --vertical",
    "production points --geoid",
    "scene register --reference",
    "production run --control-ortho",
    "production run --control-dem",
    # What a use case is given, it checks.
    "reference add --vertical",
    "reference add --geoid",
    # A variable of the environment gives it to all commands.
    "points query --token",
    "scene register --token",
}
"""Options that need no other one, or not always."""
NOWHERE = 10
"""Options, of 439, whose way is not seen so: they need others in a way of their own, or what they are
given to is a result, for which nothing stands in. The number may not grow."""


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_options_arrive_where_they_did(words: tuple[str, ...], tmp_path: Path) -> None:
    assert wiring(words, tmp_path) == EXPECTED[" ".join(words)]


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_an_option_at_its_limit_arrives_where_one_between_its_limits_does(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    """Zero is no option that was not given, and the largest is not cut; units are as for the others."""
    for option, between, limit, notes in limits(words, tmp_path):
        for line in EXPECTED[" ".join(words)][option]:
            path, _, text = line.partition(" = ")
            if (share := number(text) / between) in UNITS:
                found = [
                    number(note.removeprefix(f"{path} = "))
                    for note in notes
                    if note.startswith(f"{path} = ")
                ]
                assert found == [pytest.approx(share * limit)], (option, limit)


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_an_option_that_belongs_to_another_one_is_refused_without_it(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    for option, others, reason in refusals(words, tmp_path):
        if f"{' '.join(words)} {option}" not in OF_USE_ALONE:
            sentences = [f"{option}: given without {one}, to which it belongs" for one in others]
            assert reason.startswith(tuple(sentences)), (option, reason)


def number(text: str) -> float:
    """The number that a text is."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def test_nearly_all_options_are_seen_to_arrive() -> None:
    nowhere = [
        f"{command} {option}"
        for command, options in EXPECTED.items()
        for option, places in options.items()
        if not option.startswith(NO_OPTIONS) and all(place.startswith("exit status") for place in places)
    ]
    assert len(nowhere) <= NOWHERE, nowhere
