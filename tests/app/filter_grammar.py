"""Random filters in CQL2: of its grammar, broken, deep, long and odd."""

import json
import math
import random
from collections.abc import Callable
from typing import Any

from tests.app.filter_attacks import NAMED

NUMBERS = ("0", "1", "-1", "+2", "1.", "1.5e3", "0.25", "100")
ODD_NUMBERS = (
    "1e400",
    "-1E-400",
    "9" * 30,
    "1e",
    ".5",
    "1.2.3",
    "0x1",
    "1_0",
    "1/0",
    "null",
    "typology",
)
NUMERIC = ("saliency", "n_views", "sigma_up_m", '"block_number"')
TEXTS = ("a", "it''s", "%", "_b", "\\%", "é", "\U0001f6f0", "--", "((", '"', "\u2028")
ODD_TEXTS = ("\\", "\\'", "'", "\x00", "\ud800")
TIMES = ("2020-01-01", "2020-01-01T00:00:00Z")
ODD_TIMES = ("2020-13-45", "99999-01-01", "", "..", "now")
ODD_NAMES = ("colour", "SALIENCY", '"a""b"', "geometry", "not", "in", "null", "x" * 300, "é")
SPATIAL = ("intersects", "equals", "disjoint", "touches", "within", "overlaps", "crosses", "contains")
TEMPORAL = ("after", "before", "during", "equals", "intersects", "meets", "overlappedBy", "STARTS")
SPACES = (" ", "  ", "\n", "\t", "\r\n", "\u00a0", "\u2003")
ODD_SPACES = ("", "\x0b", "/**/", ";", "\ufeff")
PIECES = (
    *(
        "(",
        ")",
        ",",
        "'",
        '"',
        "\\'",
        "-",
        "+",
        "not ",
        " and ",
        " or ",
        " in ",
        " between ",
        " like ",
        "=",
    ),
    *(
        " is null",
        " div ",
        "^",
        "casei(",
        "POINT(",
        "POLYGON((",
        "interval(",
        "date(",
        "\x00",
        "\ud800",
        "é",
    ),
)


class Grammar:
    """Filters drawn from the grammar of CQL2.

    Args:
        rng: the source of randomness.
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.oddness = 0.0

    def text(self) -> str:
        """A filter in text: of the grammar, or changed until nobody knows what it is."""
        rng = self.rng
        self.oddness = rng.choice((0.0, 0.0, 0.02, 0.2))
        text = self.condition(rng.choice((0, 1, 2, 3, 4, 6)))
        change = rng.choice(
            (None, None, None, self._mutated, self._deep, self._long, self._repeated, self._attack)
        )
        return text if change is None else change(text)

    def document(self) -> str:
        """A filter in JSON of nodes that seldom fit together, half of them broken."""
        rng = self.rng
        text = json.dumps(self._node(rng.choice((0, 1, 2, 3, 5, 12))))
        return self.broken(text) if rng.random() < 0.5 else text

    def broken(self, text: str) -> str:
        """A document nested, mutated or with a value that JSON does not have."""
        rng = self.rng
        kind = rng.randrange(3)
        if kind == 0:
            depth = rng.choice((5, 15, 40, 1000))
            return '{"op": "not", "args": [' * depth + text + "]}" * depth
        if kind == 1:
            return self._mutated(text)
        return text.replace("1", rng.choice(("NaN", "1e400", "-Infinity", "null", "1" * 5000)), 1)

    def condition(self, depth: int) -> str:
        """A condition whose parts stand at most `depth` deep in each other."""
        rng = self.rng
        kinds: tuple[Callable[[int], str], ...] = (
            self._comparison,
            self._list,
            self._range,
            self._null,
            self._like,
            self._spatial,
            self._temporal,
        )
        kind = rng.randrange(5) if depth > 0 else 4
        if kind == 0:
            return f"not{self._space()}{self.condition(depth - 1)}"
        if kind == 1:
            return f"({self.condition(depth - 1)})"
        if kind < 4:
            word = rng.choice(("and", "or", "AND", "Or"))
            parts = [self.condition(depth - 1) for _ in range(rng.randint(2, 4))]
            return f"{self._space()}{word}{self._space()}".join(parts)
        return rng.choice(kinds)(depth)

    def _pick(self, sound: tuple[str, ...], odd: tuple[str, ...]) -> str:
        return self.rng.choice(odd if self.rng.random() < self.oddness else sound)

    def _space(self) -> str:
        return self._pick(SPACES, ODD_SPACES)

    def _comparison(self, depth: int) -> str:
        rng = self.rng
        sign = self._pick(("=", "<>", "<", "<=", ">", ">="), ("!=", "==", "~", "<>="))
        side = rng.choice((self._number, self._number, self._words, self._instant))
        return f"{side(depth)}{rng.choice(('', self._space()))}{sign}{self._space()}{side(depth)}"

    def _list(self, depth: int) -> str:
        side = self.rng.choice((self._number, self._words))
        values = ",".join(side(depth - 1) for _ in range(self.rng.choice((1, 1, 3, 30))))
        values = self._pick((values,), ("", ",", values + ","))
        return f"{side(depth)} {self.rng.choice(('', 'not '))}in{self._space()}({values})"

    def _range(self, depth: int) -> str:
        word = self.rng.choice((" between ", " not BETWEEN "))
        return f"{self._number(depth)}{word}{self._number(depth - 1)} and {self._number(depth - 1)}"

    def _null(self, depth: int) -> str:
        word = self._pick(
            (" is null", " IS NOT NULL"), (" isnull", " is not not null", " is null is null")
        )
        return self._pick((*NUMERIC, "typology", "first_view", "geometry"), ODD_NAMES) + word

    def _like(self, depth: int) -> str:
        return f"{self._words(depth)}{self.rng.choice(('', ' not'))} like {self._quoted()}"

    def _spatial(self, depth: int) -> str:
        return f"s_{self.rng.choice(SPATIAL)}({self._geometry()},{self._space()}{self._geometry()})"

    def _temporal(self, depth: int) -> str:
        return f"T_{self.rng.choice(TEMPORAL)}({self._period()},{self._space()}{self._period()})"

    def _period(self) -> str:
        ends = (f"'{self._pick(TIMES, ODD_TIMES)}'", "'..'", "first_view")
        first, last = self.rng.choice(ends), self.rng.choice(ends)
        return self.rng.choice((f"INTERVAL({first},{last})", self._instant(0)))

    def _instant(self, depth: int) -> str:
        time = self._pick(TIMES, ODD_TIMES)
        return self.rng.choice(
            ("first_view", "last_view", f"DATE('{time[:10]}')", f"timestamp('{time}')")
        )

    def _quoted(self) -> str:
        return f"'{''.join(self._pick(TEXTS, ODD_TEXTS) for _ in range(self.rng.randint(0, 3)))}'"

    def _words(self, depth: int) -> str:
        if depth > 0 and self.rng.random() < 0.3:
            return f"casei({self._words(depth - 1)})"
        return self._pick(("typology",), ODD_NAMES) if self.rng.random() < 0.5 else self._quoted()

    def _number(self, depth: int) -> str:
        kind = self.rng.randrange(6 if depth > 0 else 4)
        if kind < 2:
            return self._pick(NUMERIC, ODD_NAMES)
        if kind < 4:
            return self._pick(NUMBERS, ODD_NUMBERS)
        if kind == 4:
            return f"-{self._number(depth - 1)}"
        sign = self._pick(("+", "-", "*", "/", "%", "^", " div "), ("**", "//", "div", "||"))
        both = f"{self._number(depth - 1)}{sign}{self._number(depth - 1)}"
        return self.rng.choice((both, f"({both})"))

    def _geometry(self) -> str:
        a, b = self.rng.randint(-170, 170) / 2, self.rng.randint(1, 80)
        return self._pick(
            (
                "geometry",
                "geometry",
                f"POINT({a} {b})",
                f"POINT Z ({a} {b} 3)",
                f"linestring(0 0, {b} {b})",
                f"POLYGON((0 0, {b} 0, {b} {b}, 0 0))",
                f"MULTIPOINT(({a} {b}), (0 0))",
                "MULTIPOLYGON(((0 0,1 0,1 1,0 0)),((5 5,6 5,6 6,5 5)))",
                f"GEOMETRYCOLLECTION(POINT({a} {b}), LINESTRING(1 2, 3 4))",
                f"BBOX({a}, 0, {a + 1}, {b})",
            ),
            (
                "POLYGON EMPTY",
                f"POINT({a} {a} {a} {a} {a})",
                f"POINT({self.rng.choice(ODD_NUMBERS)} 1)",
                f"LINESTRING({a} {b})",
                f"POLYGON((0 0, {b} 0, 0 {b}, {b} {b}, 0 0))",
                "GEOMETRYCOLLECTION(GEOMETRYCOLLECTION(POINT(1 2)))",
                "POINT(not 1)",
                "BBOX(1,2,3)",
            ),
        )

    def _mutated(self, text: str) -> str:
        rng = self.rng
        for _ in range(rng.randint(1, 6)):
            at = rng.randint(0, len(text))
            end = min(len(text), at + rng.choice((0, 0, 1, 5)))
            text = text[:at] + rng.choice(("", *PIECES, text[at:][:20])) + text[end:]
        return text

    def _deep(self, text: str) -> str:
        rng = self.rng
        depth = rng.choice((3, 9, 10, 11, 16, 17, 60, 1500))
        before, after = rng.choice(
            (("(", ")"), ("(", ",2)"), ("f(", ")"), ("casei(", ")"), ("not (", ")"))
        )
        return before * depth + text + after * max(0, depth - rng.choice((0, 0, 0, 1)))

    def _long(self, text: str) -> str:
        rng = self.rng
        unit = rng.choice(
            ("1+", "-", "not ", "1=", f"{text} and ", f"{text} or ", "1 or ", "f(1),", "''", "a like ")
        )
        return unit * min(rng.choice((20, 32, 200, 4000)), 4100 // len(unit)) + text

    def _repeated(self, text: str) -> str:
        return self.rng.choice((",", " and ", " or ", "+", " ")).join(
            [text] * self.rng.choice((2, 20, 200))
        )

    def _attack(self, text: str) -> str:
        attack = self.rng.choice(tuple(NAMED.values()))
        return self._mutated(attack) if self.rng.random() < 0.5 else f"{text} or {attack}"

    def _node(self, depth: int) -> Any:
        rng = self.rng
        leaf = rng.choice(
            (
                True,
                None,
                1,
                -1.5,
                2**70,
                "a",
                "\ud800",
                "\x00",
                {"property": rng.choice(("saliency", "typology", "geometry", "colour"))},
                [],
                {},
                [1, 2],
            )
        )
        if depth <= 0:
            return leaf
        kind = rng.randrange(8)
        if kind == 0:
            return {rng.choice(("date", "timestamp", "interval", "bbox")): self._node(depth - 1)}
        if kind == 1:
            return {"type": rng.choice(("Point", "Polygon")), "coordinates": self._node(depth - 1)}
        if kind == 2:
            return {
                "type": "Point",
                "coordinates": [rng.uniform(-400, 400), rng.choice((1, math.pi, "x"))],
            }
        names = (
            "and",
            "or",
            "not",
            "=",
            "<",
            "in",
            "like",
            "between",
            "isNull",
            "s_intersects",
            "t_after",
            "+",
            "^",
        )
        arguments = [self._node(depth - 1) for _ in range(rng.choice((0, 1, 2, 2, 2, 3)))]
        return {"op": rng.choice((*names, "CASEI", "casei", "exec")), "args": arguments}
