"""Every option of a command goes where it went, as the same value; every result is shown as it was.

`tests/golden/wiring.json` has where, and what is shown of results that have another value in every
field. After a change that is meant, write it anew (`python -m tests.app.wiring`) and read what differs.
"""

import json
from pathlib import Path

import pytest

from tests.app.wiring import GOLDEN, NO_OPTIONS, commands, wiring

EXPECTED = json.loads(GOLDEN.read_text())
NOWHERE = 28
"""Options, of 439, whose way is not seen so: they need others in a way of their own, or what they are
given to is a result, for which nothing stands in. The number may not grow."""


@pytest.mark.parametrize("words", list(commands()), ids=" ".join)
def test_options_arrive_where_they_did(words: tuple[str, ...], tmp_path: Path) -> None:
    assert wiring(words, tmp_path) == EXPECTED[" ".join(words)]


def test_nearly_all_options_are_seen_to_arrive() -> None:
    nowhere = [
        f"{command} {option}"
        for command, options in EXPECTED.items()
        for option, places in options.items()
        if not option.startswith(NO_OPTIONS) and all(place.startswith("exit status") for place in places)
    ]
    assert len(nowhere) <= NOWHERE, nowhere
