"""Every input of a process, and every parameter of an endpoint, goes where it went, as the same value.

`tests/golden/wiring_of_jobs.json` has where. After a change that is meant, write it anew (`python -m
tests.app.wiring_of_jobs`) and read what differs.
"""

import json
from collections.abc import Callable

import pytest

from tests.app.wiring_of_jobs import GOLDEN, NO_INPUTS, Found, interfaces

EXPECTED = json.loads(GOLDEN.read_text())
INTERFACES = dict(interfaces())
OF_MANY_OPTIONS = {"register-scene", "register-scenes"}
NOWHERE = 21
"""Inputs, of 370, whose way is not seen so: their call ends before, or hands them to no function of
another module. The number may not grow."""


@pytest.mark.parametrize(
    ("name", "find"),
    [
        pytest.param(*one, id=one[0], marks=[pytest.mark.thorough] if one[0] in OF_MANY_OPTIONS else [])
        for one in INTERFACES.items()
    ],
)
def test_inputs_arrive_where_they_did(name: str, find: Callable[[], Found]) -> None:
    assert find() == EXPECTED[name]


def test_all_interfaces_are_known() -> None:
    assert list(EXPECTED) == list(INTERFACES)


def test_nearly_all_inputs_are_seen_to_arrive() -> None:
    nowhere = [
        f"{name} {of}"
        for name, inputs in EXPECTED.items()
        for of, places in inputs.items()
        if of not in NO_INPUTS and not [place for place in places if not place.startswith("ends with")]
    ]
    assert len(nowhere) <= NOWHERE, nowhere
