"""CQL2 text is read by its BNF (OGC 21-065r2) in linear time; other texts are refused by their place."""

import random
import re
import time
from contextlib import suppress
from typing import Any

import pytest

from amers.app.db.features import cql2_text
from amers.app.db.features.cql2 import translate
from amers.app.db.features.cql2_text import LONGEST_TEXT, parse_text
from amers.app.db.features.crs import CRS84
from amers.app.db.points import POINTS
from amers.app.errors import InvalidParameter
from tests.app.filter_attacks import NAMED
from tests.app.filter_grammar import Grammar
from tests.app.filter_pairs import Pairs, flattened, operation

SEED = 20_261_128
A, B = {"property": "a"}, {"property": "b"}


def point(x: float, y: float) -> dict[str, Any]:
    return {"type": "Point", "coordinates": [x, y]}


def test_a_filter_means_the_same_in_text_and_in_json() -> None:
    """The texts and the documents are made side by side, without the parser."""
    pairs, long = Pairs(random.Random(SEED)), 0
    for _ in range(2_000):
        text, document = pairs.expression(3)
        if len(text) > LONGEST_TEXT:
            long += 1
            continue
        assert flattened(parse_text(text)) == document, text
    assert long < 200


@pytest.mark.parametrize(
    ("text", "document"),
    [
        # What the library that parsed filters before read otherwise, or refused: by the BNF.
        ("a = .5", operation("=", A, 0.5)),
        ("a\x0b=\x851", operation("=", A, 1.0)),
        (r"a = 'it\'s'", operation("=", A, "it's")),
        ("not -a = 1", operation("not", operation("=", operation("*", -1.0, A), 1.0))),
        ("not\n+2 < a", operation("not", operation("<", 2.0, A))),
        ("-+2 = a", operation("=", -2.0, A)),
        ("Höhe = 1", operation("=", {"property": "Höhe"}, 1.0)),
        ("((((((((((((((((a = 1))))))))))))))))", operation("=", A, 1.0)),
        ("s_within(a, POINT(1+2))", operation("s_within", A, point(1.0, 2.0))),
        ("s_within(a, POINT(1e1 2))", operation("s_within", A, point(10.0, 2.0))),
        ("a = 1 is null", operation("isNull", operation("=", A, 1.0))),
        ("a is null is not null", operation("not", operation("isNull", operation("isNull", A)))),
        # How closely operators bind.
        ("a or b and not a", operation("or", A, operation("and", B, operation("not", A)))),
        ("a - b - 1 < 2", operation("<", operation("-", operation("-", A, B), 1.0), 2.0)),
        ("a = 8 / 2 * 4", operation("=", A, operation("*", operation("/", 8.0, 2.0), 4.0))),
        ("a = -2 ^ 2", operation("=", A, operation("^", -2.0, 2.0))),
        ("a = -b ^ 2", operation("=", A, operation("^", operation("*", -1.0, B), 2.0))),
        ("a between 1 and 2 and b", operation("and", operation("between", A, 1.0, 2.0), B)),
        ("not a is null", operation("not", operation("isNull", A))),
        # Wider than the BNF, with one meaning.
        ("a != 1", operation("!=", A, 1.0)),
        ("not not a", operation("not", operation("not", A))),
        ("a = -(b + 1)", operation("=", A, operation("*", -1.0, operation("+", B, 1.0)))),
        ('"view:off-nadir" = 1', operation("=", {"property": "view:off-nadir"}, 1.0)),
    ],
)  # fmt: skip
def test_a_filter_is_read_by_the_bnf(text: str, document: Any) -> None:
    assert parse_text(text) == document


@pytest.mark.parametrize(
    ("text", "position", "expected"),
    [
        ("", 1, "a value"),
        ("a = ", 5, "a value"),
        ("a = and b", 5, "a value"),
        ("a = null", 5, "a value"),
        ("a 1", 3, "an operator"),
        ("a = 1 = 1", 7, "`and`, `or` or parentheses"),
        ("a = 2 ^ 3 ^ 2", 11, "`and`, `or` or parentheses"),
        ("not a = 1 = 1", 11, "`and`, `or` or parentheses"),
        ("1 + not a = 1", 5, "a value"),
        ("a not = 1", 7, "`like`, `in` or `between`"),
        ("a is not 1", 10, "`null`"),
        ("a in 1", 6, "`(`"),
        ("a in ()", 7, "a value"),
        ("a in (1, 2", 11, "`)`"),
        ("in (a, 1)", 1, "a value"),
        ("between(a, 1, 2)", 1, "a value"),
        ("a between 1 or 2", 13, "`and`"),
        ("(a = 1", 7, "`)`"),
        ("a = 1)", 6, "an operator"),
        ("a = +b", 6, "a number"),
        ("a = 1e400", 5, "a number below 1.8e308"),
        ("a = 1.2.3", 5, "a number and a space"),
        ("a = 1or b", 5, "a number and a space"),
        ("a = 'b", 5, "a second '"),
        (r"a = 'b\'", 5, "a second '"),
        ('"" = 1', 1, 'a second "'),
        ("a = 1; drop", 6, "a character of CQL2"),
        ("a\x1c= 1", 2, "a character of CQL2"),
        ("s_within(a, POINT(1))", 20, "a number"),
        ("s_within(a, POINT(1 2 3 4))", 25, "`)`"),
        ("s_within(a, POINT(1 2, 3 4))", 22, "`)`"),
        ("s_within(a, POINT(b 2))", 19, "a number"),
        ("s_within(a, LINESTRING((1 2), (3 4)))", 24, "a number"),
        ("s_within(a, GEOMETRYCOLLECTION(GEOMETRYCOLLECTION(POINT(1 2))))", 32, "no collection"),
        ("s_within(a, BBOX(1, 2, b, 4))", 24, "a number"),
        ("(" * 17 + "a" + ")" * 17, 17, "16 levels of parentheses"),
        ("a = " + "1 + " * 33 + "1", 135, "after 32 operators"),
        ("-" * 3_900 + "1 = a", 33, "after 32 operators"),
        ("not " * 900 + "a", 129, "after 32 operators"),
    ],
)
def test_what_is_no_cql2_is_refused_by_its_place(text: str, position: int, expected: str) -> None:
    with pytest.raises(InvalidParameter) as refusal:
        parse_text(text)
    assert f"at character {position}, " in str(refusal.value)
    assert expected in str(refusal.value)


@pytest.mark.parametrize(
    "text", ["-" * 3_900 + "1 = saliency", "not " * 5_000 + "saliency = 1", "saliency > 0.5"]
)
def test_a_filter_is_answered_in_less_than_a_millisecond(text: str) -> None:
    def answer_s() -> float:
        begin = time.perf_counter()
        try:
            translate(parse_text(text), POINTS, CRS84)
        except InvalidParameter:
            assert text != "saliency > 0.5"
        return time.perf_counter() - begin

    assert min(answer_s() for _ in range(20)) < 1e-3


@pytest.mark.security
def test_each_token_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """So the time is linear in the length: no filter makes the parser go back."""
    tokens: list[int] = []

    class Counting:
        def match(self, text: str, position: int) -> re.Match[str] | None:
            tokens.append(position)
            return cql2_text_token.match(text, position)

    cql2_text_token = cql2_text.TOKEN
    monkeypatch.setattr(cql2_text, "TOKEN", Counting())
    grammar = Grammar(random.Random(SEED))
    for text in (*NAMED.values(), *(grammar.text() for _ in range(500))):
        tokens.clear()
        with suppress(InvalidParameter):
            parse_text(text)
        assert tokens == sorted(set(tokens)), text
