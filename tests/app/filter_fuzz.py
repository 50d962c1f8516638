"""A process that takes random filters their whole way: `python -m tests.app.filter_fuzz COUNT SEED`.

It prints one line of JSON with its figures. Its death, or another error than the refusal of a filter, is
what `test_filter_fuzz` looks for.
"""

import json
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

from sqlalchemy import select

from amers.app.db.features import cql2_process
from amers.app.db.features.collection import Collection
from amers.app.db.features.cql2 import translate
from amers.app.db.features.cql2_bounds import parse_json, parse_text
from amers.app.db.features.cql2_tokens import TOKEN
from amers.app.db.features.crs import CRS84
from amers.app.db.history import HISTORY
from amers.app.db.points import POINTS
from amers.app.db.statements import hot
from amers.app.errors import InvalidParameter
from tests.app.filter_grammar import Grammar

JSON_SHARE = 0.2
TEMPORAL_WORDS = ("date", "timestamp", "interval")


def main(count: int, seed: int) -> None:
    """Try filters and print how many were accepted and refused, the slowest, and the lost processes."""
    rng = random.Random(seed)
    grammar = Grammar(rng)
    outcomes: Counter[str] = Counter()
    slowest_s, slowest, pids = 0.0, "", parser_pids()
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
        "parsers_lost": len(pids - parser_pids()),
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
        if not is_json:
            assert read_alike(text, document), document
        condition = translate(document, collection, CRS84)
    except InvalidParameter:
        return "refused"
    assert condition.non_bbox_predicate is not None
    hot(select(collection.key.expression).where(condition.non_bbox_predicate))
    return "accepted"


def read_alike(text: str, document: Any) -> bool:
    """Whether the bounds and the parser find the same texts in a filter; times are written anew."""
    tokens = [token.group() for token in TOKEN.finditer(text)]
    if any(token.lower() in TEMPORAL_WORDS for token in tokens):
        return True
    texts = [token[1:-1].replace("''", "'") for token in tokens if token.startswith("'")]
    return Counter(texts) == Counter(literals(document))


def literals(node: Any) -> Iterator[str]:
    """The texts of a filter in CQL2 JSON."""
    if isinstance(node, str):
        yield node
    elif isinstance(node, list):
        for part in node:
            yield from literals(part)
    elif isinstance(node, dict):
        for name, part in node.items():
            if name not in ("op", "property", "type"):
                yield from literals(part)


def parser_pids() -> set[int]:
    """The processes that parse for this one, after each has parsed a filter."""
    for entry in cql2_process._processes:
        entry.parse("text", "true")
    return {entry.process.pid for entry in cql2_process._processes if entry.process}


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
