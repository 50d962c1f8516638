"""Random filters in both languages of CQL2, written side by side by the rules of the BNF."""

import random
from collections.abc import Callable
from typing import Any

Pair = tuple[str, Any]
"""A part of a filter in text, and the same in JSON."""

SPACES = (" ", "  ", "\n", "\t", "\r\n", "\u00a0", "\u2003", "\x0b")


class Pairs:
    """Draws filters; a rule of the BNF is a method.

    Args:
        rng: the source of randomness.
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng

    def expression(self, depth: int) -> Pair:
        """Conditions whose parts stand at most `depth` deep in each other."""
        return self._junction("or", lambda: self._junction("and", lambda: self._factor(depth)))

    def _word(self, word: str) -> str:
        return "".join(self.rng.choice((letter.lower(), letter.upper())) for letter in word)

    def _joined(self, *parts: str) -> str:
        """Parts with spaces between them."""
        return "".join(part + self.rng.choice(SPACES) for part in parts)

    def _junction(self, op: str, part: Callable[[], Pair]) -> Pair:
        text, document = part()
        for _ in range(self.rng.choice((0, 0, 1, 2))):
            right_text, right = part()
            text = self._joined(text, self._word(op), right_text)
            document = operation(op, document, right)
        return text, document

    def _factor(self, depth: int) -> Pair:
        text, document = self._primary(depth)
        if self.rng.random() < 0.3:
            return self._joined(self._word("not"), text), operation("not", document)
        return text, document

    def _primary(self, depth: int) -> Pair:
        rng = self.rng
        if depth > 0 and rng.random() < 0.4:
            text, document = self.expression(depth - 1)
            return f"({text})", document
        rules = (
            self._comparison,
            self._like,
            self._between,
            self._in,
            self._is_null,
            self._relation,
            self._literal,
        )
        return rng.choice(rules)(depth)

    def _literal(self, depth: int) -> Pair:
        value = self.rng.random() < 0.5
        return self._word(str(value)), value

    def _comparison(self, depth: int) -> Pair:
        sign = self.rng.choice(("=", "<>", "<", "<=", ">", ">="))
        (left_text, left), (right_text, right) = self._sum(depth), self._scalar(depth)
        return f"{left_text}{sign}{right_text}", operation(sign, left, right)

    def _negatable(self, left_text: str, op: str, document: Any) -> Pair:
        if self.rng.random() < 0.5:
            return self._joined(left_text, self._word("not"), self._word(op)), operation("not", document)
        return self._joined(left_text, self._word(op)), document

    def _like(self, depth: int) -> Pair:
        (left_text, left), (pattern_text, pattern) = self._characters(depth), self._text()
        head, document = self._negatable(left_text, "like", operation("like", left, pattern))
        return head + pattern_text, document

    def _between(self, depth: int) -> Pair:
        (text, value), (low_text, low), (high_text, high) = (self._sum(depth) for _ in range(3))
        head, document = self._negatable(text, "between", operation("between", value, low, high))
        return head + self._joined(low_text, self._word("and"), high_text), document

    def _in(self, depth: int) -> Pair:
        text, value = self._scalar(depth)
        values = [self._scalar(depth) for _ in range(self.rng.randint(1, 3))]
        listed = operation("in", value, [part for _, part in values])
        head, document = self._negatable(text, "in", listed)
        return f"{head}({','.join(part for part, _ in values)})", document

    def _is_null(self, depth: int) -> Pair:
        text, value = self._sum(depth)
        if self.rng.random() < 0.5:
            words = self._joined(text, self._word("is"), self._word("not"), self._word("null"))
            return words, operation("not", operation("isNull", value))
        return self._joined(text, self._word("is"), self._word("null")), operation("isNull", value)

    def _relation(self, depth: int) -> Pair:
        name, part = self.rng.choice((("s_within", self._geometry), ("t_during", self._time)))
        (left_text, left), (right_text, right) = part(), part()
        return f"{self._word(name)}({left_text}, {right_text} )", operation(name, left, right)

    def _scalar(self, depth: int) -> Pair:
        return self.rng.choice((self._sum, self._characters, self._literal))(depth)

    def _sum(self, depth: int) -> Pair:
        return self._chain(("+", "-"), lambda: self._product(depth))

    def _product(self, depth: int) -> Pair:
        return self._chain(("*", "/", "%", "div"), lambda: self._power(depth))

    def _chain(self, ops: tuple[str, ...], part: Callable[[], Pair]) -> Pair:
        """Operators that are evaluated from the left."""
        text, document = part()
        for _ in range(self.rng.choice((0, 0, 0, 1, 2))):
            op, (right_text, right) = self.rng.choice(ops), part()
            text, document = (
                self._joined(text, self._word(op), right_text),
                operation(op, document, right),
            )
        return text, document

    def _power(self, depth: int) -> Pair:
        text, document = self._term(depth)
        if self.rng.random() < 0.2:
            right_text, right = self._term(depth)
            return f"{text}^{right_text}", operation("^", document, right)
        return text, document

    def _term(self, depth: int) -> Pair:
        rng = self.rng
        if depth > 0 and rng.random() < 0.3:
            text, document = self._sum(depth - 1)
            return f"({text})", document
        if rng.random() < 0.5:
            number = rng.choice(("7", "1.", ".5", "0.25", "2e3", "1.5E-2", ".5e+1"))
            sign = rng.choice(("", "-", "+", "- ", "--", "-+"))
            value = float(number)
            return sign + number, -value if sign.strip() in ("-", "-+") else value
        text, document = self._property()
        if rng.random() < 0.3:
            return f"-{text}", operation("*", -1.0, document)
        return text, document

    def _property(self) -> Pair:
        name = self.rng.choice(("a", "order.by:x", "notes", "_e1", "Höhe", "point", "date", "interval"))
        return self.rng.choice((name, f'"{name}"')), {"property": name}

    def _characters(self, depth: int) -> Pair:
        if depth > 0 and self.rng.random() < 0.3:
            text, document = self._characters(depth - 1)
            return f"{self._word('casei')}({text})", operation("casei", document)
        return self.rng.choice((self._property, self._text))()

    def _text(self) -> Pair:
        pieces = (
            ("a", "a"),
            ("''", "'"),
            ("\\'", "'"),
            ("\\%", "\\%"),
            ('"', '"'),
            (") or (", ") or ("),
        )
        drawn = [self.rng.choice(pieces) for _ in range(self.rng.randint(0, 4))]
        return f"'{''.join(text for text, _ in drawn)}'", "".join(value for _, value in drawn)

    def _time(self) -> Pair:
        day, instant = "2020-01-31", "2020-01-31T23:59:59.5Z"
        return self.rng.choice(
            (
                (f"{self._word('date')}('{day}')", {"date": day}),
                (f"{self._word('timestamp')} ('{instant}')", {"timestamp": instant}),
                (f"{self._word('interval')}('{day}', '..')", {"interval": [day, ".."]}),
                (f"interval(a,'{instant}')", {"interval": [{"property": "a"}, instant]}),
                self._property(),
            )
        )

    def _geometry(self) -> Pair:
        name = self.rng.choice((*WKT, "BBOX", "GeometryCollection", "property"))
        if name == "property":
            return self._property()
        if name == "BBOX":
            return f"{self._word(name)}(-1, 2.5, 3, 4 )", {"bbox": [-1.0, 2.5, 3.0, 4.0]}
        if name == "GeometryCollection":
            members = [("Point", WKT["Point"][0]), ("LineString", WKT["LineString"][0])]
            text = ",".join(f"{self._word(member)}{written}" for member, (written, _) in members)
            geometries = [{"type": member, "coordinates": value} for member, (_, value) in members]
            return f"{self._word(name)}({text})", {"type": name, "geometries": geometries}
        text, value = self.rng.choice(WKT[name])
        return self._word(name) + text, {"type": name, "coordinates": value}


WKT: dict[str, list[tuple[str, Any]]] = {
    "Point": [("(1 -2)", [1.0, -2.0]), (" z (1 2\n3)", [1.0, 2.0, 3.0]), ("(.5 +1e1)", [0.5, 10.0])],
    "LineString": [("(0 0,1 1)", [[0.0, 0.0], [1.0, 1.0]]), (" EMPTY", [])],
    "Polygon": [("((0 0, 1 0, 1 1, 0 0))", [[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]])],
    "MultiPoint": [
        ("((1 2), (3 4))", [[1.0, 2.0], [3.0, 4.0]]),
        (" (1 2, 3 4)", [[1.0, 2.0], [3.0, 4.0]]),
    ],
    "MultiLineString": [("((0 0,1 1))", [[[0.0, 0.0], [1.0, 1.0]]])],
    "MultiPolygon": [
        ("Z (((0 0 9, 1 0 9, 0 1 9, 0 0 9)))", [[[[0.0, 0, 9], [1.0, 0, 9], [0.0, 1, 9], [0.0, 0, 9]]]])
    ],
}
"""Coordinates as text and as lists."""


def operation(op: str, *args: Any) -> dict[str, Any]:
    """An operation; `and` and `or` take up what is the same within them."""
    parts: list[Any] = []
    for arg in args:
        is_same = op in ("and", "or") and isinstance(arg, dict) and arg.get("op") == op
        parts += arg["args"] if is_same else [arg]
    return {"op": op, "args": parts}


def flattened(node: Any) -> Any:
    """A filter in JSON in which no `and` stands directly in an `and`, and no `or` in an `or`."""
    if isinstance(node, list):
        return [flattened(part) for part in node]
    if not isinstance(node, dict):
        return node
    if "op" in node:
        return operation(node["op"], *flattened(node["args"]))
    return {name: flattened(part) for name, part in node.items()}
