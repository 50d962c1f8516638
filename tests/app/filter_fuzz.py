"""A process that takes random filters their whole way: `python -m tests.app.filter_fuzz COUNT SEED`.

It prints one line of JSON with its figures. Its death, or another error than the refusal of a filter, is
what `test_filter_fuzz` looks for.
"""

import json
import random
import sys
import time
from collections import Counter

from sqlalchemy import select

from amers.app.db.features.collection import Collection
from amers.app.db.features.cql2 import translate
from amers.app.db.features.cql2_bounds import parse_json
from amers.app.db.features.cql2_text import parse_text
from amers.app.db.features.crs import CRS84
from amers.app.db.history import HISTORY
from amers.app.db.points import POINTS
from amers.app.db.statements import hot
from amers.app.errors import InvalidParameter
from tests.app.filter_grammar import Grammar

JSON_SHARE = 0.2


def main(count: int, seed: int) -> None:
    """Try filters and print how many were accepted and refused, and the slowest."""
    rng = random.Random(seed)
    grammar = Grammar(rng)
    outcomes: Counter[str] = Counter()
    slowest_s, slowest = 0.0, ""
    begin = time.perf_counter()
    for _ in range(count):
        is_json = rng.random() < JSON_SHARE
        text = drawn_document(grammar) if is_json else grammar.text()
        start = time.perf_counter()
        try:
            outcome = outcome_of(text, is_json, rng.choice((POINTS, POINTS, POINTS, HISTORY)))
        except BaseException:
            print(f"seed {seed}: {text!r}", file=sys.stderr)
            raise
        if (taken_s := time.perf_counter() - start) > slowest_s:
            slowest_s, slowest = taken_s, text
        outcomes[f"{outcome} {'json' if is_json else 'text'}"] += 1
    figures = {
        "outcomes": outcomes,
        "seconds": time.perf_counter() - begin,
        "slowest_s": slowest_s,
        "slowest": slowest[:200],
    }
    print(json.dumps(figures))


def drawn_document(grammar: Grammar) -> str:
    """A filter in JSON: nodes at random, or what a filter of the grammar is in JSON, broken or not."""
    if grammar.rng.random() < 0.3:
        return grammar.document()
    grammar.oddness = 0.0
    try:
        text = json.dumps(parse_text(grammar.condition(grammar.rng.randrange(3))))
    except InvalidParameter:
        return grammar.document()
    return grammar.broken(text) if grammar.rng.random() < 0.3 else text


def outcome_of(text: str, is_json: bool, collection: Collection) -> str:
    """What becomes of a filter on its way to a statement: `accepted` or `refused`."""
    try:
        document = parse_json(text) if is_json else parse_text(text)
        condition = translate(document, collection, CRS84)
    except InvalidParameter:
        return "refused"
    assert condition.non_bbox_predicate is not None
    hot(select(collection.key.expression).where(condition.non_bbox_predicate))
    return "accepted"


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
