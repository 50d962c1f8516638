"""Parts of the service that need no database: drawings, boxes, ranges, words on values, limits."""

import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amers.app.api import connect
from amers.app.api.operations_page import _access, _values
from amers.app.api.pages import count_text, drawn
from amers.app.api.ranges import wanted_ranges
from amers.app.db import blocks, superseding, tokens
from amers.app.db.features.counts import Count
from amers.app.db.jobs import queue
from amers.app.usecases.features.items import FeaturePage
from amers.app.usecases.garbage_collection import Family

PARTS = [[[[5, 43], [6, 43], [6, 44], [5, 43]], [[5.5, 43.1], [5.6, 43.1], [5.5, 43.2], [5.5, 43.1]]]]
SIDES = st.tuples(st.floats(-5.0, 5.0), st.floats(0.001, 8.0))


def figures(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


@given(SIDES, SIDES)
def test_a_drawing_has_the_north_above_and_equal_margins_all_round(
    lon: tuple[float, float], lat: tuple[float, float]
):
    west, south = 10.0 + lon[0], 40.0 + lat[0]
    east, north = west + lon[1], south + lat[1]
    both = [{"type": "Point", "coordinates": [west, north, 7.0]}, {"type": "Point"}]
    both[1]["coordinates"] = [east, south, 9.0]
    drawing = drawn([None, *both])
    assert drawing is not None
    x, y, width, height = figures(drawing.box)
    margins = np.array([west - x, x + width - east, -north - y, y + height + south])
    longest = max(lon[1], lat[1])
    six_digits = 1e-4
    assert np.ptp(margins) < six_digits + 1e-3 * longest
    assert 0.03 * longest - six_digits < margins.mean() < 0.1 * longest + six_digits
    assert figures(drawing.dots)[:2] == pytest.approx([west, -north], abs=1e-6)
    assert figures(drawing.text.replace(" to ", " ")) == pytest.approx(
        [west, east, south, north], abs=1e-3
    )


def test_a_drawing_has_every_ring_of_every_outline_and_is_none_of_nothing():
    whole = {"type": "MultiPolygon", "coordinates": PARTS * 2}
    for geometry, rings in ((whole, 4), ({"type": "Polygon", "coordinates": PARTS[0]}, 2)):
        drawing = drawn([geometry])
        assert drawing is not None
        assert (drawing.lines.count("M"), drawing.lines.count("Z"), drawing.dots) == (rings, rings, "")
    alone = drawn([{"type": "Point", "coordinates": [5.0, 43.0]}])
    assert alone is not None
    assert min(figures(alone.box)[2:]) > 0.0, "one point is seen too"
    assert drawn([None]) is drawn([]) is None


@given(SIDES, SIDES)
def test_the_box_of_the_examples_is_the_middle_of_what_is_served(
    lon: tuple[float, float], lat: tuple[float, float]
):
    served = np.array([lon[0], 40.0 + lat[0], lon[0] + lon[1], 40.0 + lat[0] + lat[1]])
    box = np.array([float(side) for side in connect._box_within(tuple(served))])
    four_digits = 1.1e-4
    assert np.abs((box[:2] + box[2:]) - (served[:2] + served[2:])).max() < 2 * four_digits
    sides = np.minimum(served[2:] - served[:2], 0.05)
    assert np.abs(box[2:] - box[:2] - sides).max() < 2 * four_digits
    assert connect._box_within(None) == connect.EXAMPLE_BOX


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 12)), min_size=1), st.integers(1, 25))
def test_ranges_have_every_byte_that_was_asked_for_once(asked: list[tuple[int, int]], size: int):
    header = "bytes=" + ",".join(f"{start}-{start + more}" for start, more in asked)
    wanted = {byte for start, more in asked for byte in range(start, start + more + 1) if byte < size}
    found = wanted_ranges(header, size)
    assert found is not None
    assert sorted(byte for start, end in found for byte in range(start, end)) == sorted(wanted)
    assert all(one[1] < other[0] for one, other in pairwise(found)), "those that touch are one"


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        ({"type": "integer", "minimum": 0, "default": 0}, "integer; at least 0; default 0"),
        ({"type": "string", "maxLength": 9}, "string; at most 9 characters"),
        ({"type": "number", "exclusiveMinimum": 0, "exclusiveMaximum": 1}, "number; above 0; below 1"),
        ({"type": "string", "format": "uuid"}, "uuid"),
        ({"enum": ["a", 2], "type": "string"}, "a, 2"),
        (
            {"type": "array", "items": {"type": "number"}, "maxItems": 6},
            "list of number; at most 6 of them",
        ),
        ({"type": "array", "minItems": 4, "maxItems": 6}, "list; at least 4 of them; at most 6 of them"),
        ({}, "any"),
    ],
)
def test_the_values_of_a_parameter_are_told_in_words(schema: dict[str, Any], words: str):
    assert _values(schema) == words


def test_the_callers_of_an_operation_are_told_in_words():
    assert _access([]) == _access([{"bearer": ["read"]}, {}]) == "everybody"
    assert _access([{"bearer": []}, {"basic": []}]) == "any valid token"
    assert _access([{"bearer": ["read"]}, {"basic": ["admin"]}]) == "a token with scope admin, read"


def test_a_page_tells_how_many_features_it_has_of_how_many():
    page = FeaturePage(b"", 1000, Count(12345, exact=False), None)
    assert count_text(page) == "1,000 of about 12,345."
    assert count_text(FeaturePage(b"", 2, Count(2, exact=True), None)) == "2 of 2."


@pytest.mark.parametrize(("files", "most"), [(0, 100), (2000, 100), (2040, 102), (100_000, 5000)])
def test_a_sweep_removes_a_hundred_files_or_a_twentieth_of_very_many(files: int, most: int):
    assert Family("scenes", files, [], []).most_at_once == most


def test_no_two_advisory_locks_are_one():
    """Else claims of jobs would wait for who makes a token."""
    locks = [queue.SWEEP_LOCK, queue.CLAIM_LOCK, tokens.NAMES_LOCK, blocks.INGESTION_LOCK]
    assert len({*locks, superseding.PUBLICATION_LOCK}) == 5
