"""Filters in CQL2 text, parsed into CQL2 JSON in time linear in the length of the text.

Precedence climbing over tokens that are read once each. A chain of operators is a loop; only parentheses
are read by a deeper call, and their levels are bounded. The grammar is the BNF of the standard, wider in
four points that give no text a second meaning: `!=` is `<>`; `not`, and minus signs, may follow each
other; a minus sign may stand before parentheses; a quoted name may have any character but the quotation
mark. The words of operators are names of properties only in quotation marks. Which values an operator
takes is checked by `cql2`, which translates both languages.

Sources: OGC 21-065r2, Common Query Language (CQL2): its BNF, and requirement `escaping` of CQL2 text.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeVar

from amers.app.db.features.cql2_bounds import GEOMETRY_TYPES, check_size, check_unicode
from amers.app.errors import InvalidParameter

LONGEST_TEXT = 4_000
"""Characters of a filter in text."""
DEEPEST_TEXT = 16
"""Levels of parentheses, those of functions and geometries among them."""
DEEPEST_DOCUMENT = 100
"""Levels of a filter as CQL2 JSON, two for each operator."""
MOST_OPERATORS = 32
"""Operators in one chain without `and`, `or` and parentheses: each nests what is before it."""

SPACE = r"\t-\r \x85\xa0\u1680\u2000-\u200a\u2028\u2029\u202f\u205f\u3000"
NAME_START = (
    r":_A-Za-z\xc0-\xd6\xd8-\xf6\xf8-\u02ff\u0370-\u037d\u037f-\u167f\u1681-\u1ffe\u200c\u200d\u2070-\u218f"
    r"\u2c00-\u2fef\u3001-\ud7ff\uf900-\ufdcf\ufdf0-\ufffd\U00010000-\U000effff"
)
NAME_PART = NAME_START + r".0-9\u0300-\u036f\u203f\u2040"
# Possessive: no token is read twice. A number ends where no name goes on, so that `1or` is none.
SPACES = re.compile(f"[{SPACE}]*+")
TOKEN = re.compile(
    rf"[{SPACE}]*+(?:"
    rf"(?P<number>(?:[0-9]++\.?[0-9]*+|\.[0-9]++)(?:[eE][-+]?[0-9]++)?+(?![{NAME_PART}]))"
    r"|(?P<text>'(?:[^'\\]++|''|\\'?)*+')"
    r'|(?P<quoted>"[^"]++")'
    rf"|(?P<name>[{NAME_START}][{NAME_PART}]*+)"
    r"|(?P<sign><>|<=|>=|!=|[-+*/%^<>=(),])"
    r"|(?P<end>\Z))"
)
ESCAPED_QUOTE = re.compile(r"''|\\'")

OR, AND, NOT, IS, COMPARISON, SUM, PRODUCT, POWER = range(1, 9)
"""How closely an operator binds: the rules of the BNF, from the outermost to the innermost."""
BINDING: Mapping[str, int] = {
    "or": OR,
    "and": AND,
    "is": IS,
    **dict.fromkeys(("=", "<>", "!=", "<", "<=", ">", ">=", "not", "like", "in", "between"), COMPARISON),
    **dict.fromkeys("+-", SUM),
    **dict.fromkeys(("*", "/", "%", "div"), PRODUCT),
    "^": POWER,
}
ONCE = frozenset((COMPARISON, POWER))
"""Levels of which the BNF has one operator only: `1 = 1 = 1` and `2 ^ 3 ^ 2` are no CQL2."""
NO_VALUE = frozenset((*BINDING, "null"))
GEOMETRIES = {name.lower(): name for name in GEOMETRY_TYPES}
LISTS = {"LineString": 1, "Polygon": 2, "MultiLineString": 2, "MultiPolygon": 3}
"""Levels of lists in which positions stand, for the types that write them so."""

Item = TypeVar("Item")


def parse_text(text: str) -> Any:
    """The CQL2 JSON of a filter in CQL2 text.

    Names of functions are in lower case, numbers are of double precision.

    Raises:
        InvalidParameter: the text is not CQL2, too long or too deep; the message names the character
            and what was expected there.
    """
    if len(text) > LONGEST_TEXT:
        raise InvalidParameter(
            f"filter: {len(text)} characters, {LONGEST_TEXT} at most; send it by POST as cql2-json"
        )
    check_unicode(text)
    document = _Parser(text).filter()
    check_size(document, "filter", DEEPEST_DOCUMENT)
    return document


class _Parser:
    """One reading of a text.

    Attributes:
        kind: of the next token: the name of its group in `TOKEN`.
        token: the next token as written.
        word: the next token in lower case if it is a name or a sign, else empty.
        start: index of its first character.
        level: number of open parentheses.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self.end = 0
        self.level = 0
        self.word = ""
        self._advance()

    def filter(self) -> Any:
        """The whole text."""
        document = self._expression(OR)
        if self.kind != "end":
            self._refuse("an operator, `and`, `or` or the end")
        return document

    def _advance(self) -> str:
        """Pass the next token; returns its word."""
        passed = self.word
        match = TOKEN.match(self.text, self.end)
        if match is None:
            self._refuse_character()
        assert match.lastgroup is not None
        self.kind, self.token = match.lastgroup, match[match.lastgroup]
        self.start, self.end = match.span(match.lastgroup)
        self.word = self.token.lower() if self.kind in ("name", "sign") else ""
        return passed

    def _refuse(self, expected: str) -> NoReturn:
        found = repr(self.text[self.start : self.start + 12]) if self.kind != "end" else "the end"
        raise InvalidParameter(f"filter: {found} at character {self.start + 1}, {expected} expected")

    def _refuse_character(self) -> NoReturn:
        """Raise the error for what begins no token."""
        spaces = SPACES.match(self.text, self.end)
        assert spaces is not None
        self.kind, self.start = "", spaces.end()
        character = self.text[self.start]
        if character in "'\"":
            self._refuse(f"a text or a name up to a second {character}")
        self._refuse("a number and a space" if character in ".0123456789" else "a character of CQL2")

    def _take(self, word: str) -> bool:
        """Whether the next token is a word or sign, which is then passed."""
        if self.word != word:
            return False
        self._advance()
        return True

    def _expect(self, word: str) -> None:
        if not self._take(word):
            self._refuse(f"`{word}`")

    def _open(self) -> None:
        if self.word == "(" and self.level == DEEPEST_TEXT:
            self._refuse(f"at most {DEEPEST_TEXT} levels of parentheses")
        self._expect("(")
        self.level += 1

    def _close(self) -> None:
        self._expect(")")
        self.level -= 1

    def _list(self, item: Callable[[], Item]) -> list[Item]:
        """What stands between parentheses, separated by commas."""
        self._open()
        items = [item()]
        while self._take(","):
            items.append(item())
        self._close()
        return items

    def _check_chain(self, operators: int) -> None:
        if operators > MOST_OPERATORS:
            self._refuse(f"`and`, `or` or parentheses after {MOST_OPERATORS} operators")

    def _expression(self, least: int) -> Any:
        """An expression of operators that bind at least as closely as `least`."""
        is_negation = least <= NOT and self.word == "not"
        left, most = (self._negation(), AND) if is_negation else (self._signed(), POWER)
        operators = 0
        while least <= (binding := BINDING.get(self.word, 0)) <= most:
            operators = operators + 1 if binding > AND else 0
            self._check_chain(operators)
            left = self._operation(left, binding)
            most = binding - (binding in ONCE)
        if binding > most:
            self._refuse("`and`, `or` or parentheses around what is before it")
        return left

    def _operation(self, left: Any, binding: int) -> Any:
        """An operator with what stands before and behind it."""
        op = self._advance()
        if op == "not":
            if self.word not in ("like", "in", "between"):
                self._refuse("`like`, `in` or `between`")
            return _call(op, self._operation(left, binding))
        if op == "is":
            is_negated = self._take("not")
            self._expect("null")
            is_null = _call("isNull", left)
            return _call("not", is_null) if is_negated else is_null
        if op == "in":
            return _call(op, left, self._list(lambda: self._expression(SUM)))
        right = self._expression(binding + 1)
        if op == "between":
            self._expect("and")
            return _call(op, left, right, self._expression(SUM))
        if binding <= AND and isinstance(left, dict) and left.get("op") == op:
            left["args"].append(right)
            return left
        return _call(op, left, right)

    def _prefixes(self, word: str) -> int:
        """The number of equal prefixes, which are passed."""
        count = 0
        while self.word == word:
            count += 1
            self._check_chain(count)
            self._advance()
        return count

    def _negation(self) -> Any:
        count = self._prefixes("not")
        condition = self._expression(IS)
        for _ in range(count):
            condition = _call("not", condition)
        return condition

    def _signed(self) -> Any:
        """An operand with its signs; a plus sign belongs to a number."""
        count = self._prefixes("-")
        operand = self._number() if self._take("+") else self._operand()
        for _ in range(count):
            operand = -operand if isinstance(operand, float) else _call("*", -1.0, operand)
        return operand

    def _operand(self) -> Any:
        """A literal, a property, a function, or parentheses around an expression or an array."""
        kind, token, word = self.kind, self.token, self.word
        if word == "(":
            values = self._list(self._argument)
            return values[0] if len(values) == 1 else values
        if kind == "number":
            return self._number()
        if kind in ("sign", "end") or word in NO_VALUE:
            self._refuse("a value")
        self._advance()
        if kind == "text":
            return ESCAPED_QUOTE.sub("'", token[1:-1])
        return {"property": token[1:-1]} if kind == "quoted" else self._named(token)

    def _named(self, token: str) -> Any:
        """What a name begins that has been passed."""
        word = token.lower()
        if word in ("true", "false"):
            return word == "true"
        if word.removesuffix("z") in GEOMETRIES and self.word in ("(", "z", "empty"):
            return self._geometry(word)
        return self._function(word) if self.word == "(" else {"property": token}

    def _argument(self) -> Any:
        return self._expression(OR)

    def _function(self, word: str) -> Any:
        args = self._list(self._signed_number if word == "bbox" else self._argument)
        if word in ("bbox", "interval"):
            return {word: args}
        is_instant = word in ("date", "timestamp") and len(args) == 1
        return {word: args[0]} if is_instant else _call(word, *args)

    def _number(self) -> float:
        number = float(self.token) if self.kind == "number" else math.nan
        if not math.isfinite(number):
            self._refuse("a number below 1.8e308" if self.kind == "number" else "a number")
        self._advance()
        return number

    def _signed_number(self) -> float:
        if self._take("-"):
            return -self._number()
        self._take("+")
        return self._number()

    def _geometry(self, word: str) -> dict[str, Any]:
        """A geometry of WKT as GeoJSON, its type already passed."""
        if not word.endswith("z"):
            self._take("z")
        name = GEOMETRIES[word.removesuffix("z")]
        if self._take("empty"):
            parts: list[Any] = []
        elif name == "GeometryCollection":
            parts = self._list(self._member)
        elif name == "MultiPoint":
            parts = self._list(lambda: self._point() if self.word == "(" else self._position())
        else:
            parts = self._coordinates(LISTS[name]) if name in LISTS else self._point()
        return {"type": name, "geometries" if name == "GeometryCollection" else "coordinates": parts}

    def _member(self) -> dict[str, Any]:
        """A geometry of a collection."""
        word = self.word.removesuffix("z")
        if word not in GEOMETRIES or word == "geometrycollection":
            self._refuse("a geometry that is no collection")
        return self._geometry(self._advance())

    def _coordinates(self, depth: int) -> list[Any]:
        """Lists of positions, `depth` levels of lists in each other."""
        return self._list(self._position if depth == 1 else lambda: self._coordinates(depth - 1))

    def _point(self) -> list[float]:
        self._open()
        position = self._position()
        self._close()
        return position

    def _position(self) -> list[float]:
        position = [self._signed_number(), self._signed_number()]
        if self.word not in (",", ")"):
            position.append(self._signed_number())
        return position


def _call(op: str, *args: Any) -> dict[str, Any]:
    return {"op": op, "args": list(args)}
