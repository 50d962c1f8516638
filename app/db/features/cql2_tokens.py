"""Bounds of a filter in CQL2 text, checked token by token before the parser sees it.

The grammar is read in two ways: by OGC 21-065r2 (its BNF) and by the library `cql2` (its grammar
`cql2.pest`). Both read the tokens below alike. A filter is refused where they differ about the end of
a text, a name or a number. The check reads each character once and does not recurse.
"""

import re
from collections.abc import Iterator

from amers.app.db.features.instants import parse_moment
from amers.app.errors import InvalidParameter

LONGEST_TEXT = 4_000
"""Characters of a filter in text."""
DEEPEST_TEXT = 16
"""Levels of parentheses in text, those of functions and geometries among them."""
MOST_OPERATORS = 32
"""Operators between two of `and`, `or`, `,` and parentheses: the parser nests each in the one before."""
MOST_WORK = 12_000
"""Sum over all tokens of 2 to the power of their level: within parentheses that belong to no function,
the parser reads everything twice. 12,000 take it about 20 ms."""
MOST_ORDINATES = 4
"""Numbers of one position of a geometry: the parser reads longer ones as differences."""

TOKEN = re.compile(
    r"""
    (?P<space>[ \t\r\n\u00a0\u1680\u2000-\u200a\u2028\u2029\u202f\u205f\u3000]+)
    |(?P<text>'(?:[^']|'')*+')
    |(?P<quoted>"[^"]*+")
    |(?P<number>[0-9]+(?:\.[0-9]*)?(?:[eE][+-]?[0-9]+)?)
    |(?P<name>[A-Za-z_:][A-Za-z0-9_.:]*)
    |(?P<operator><>|<=|>=|!=|[-+*/%^<>=])
    |(?P<parenthesis>[()])
    |(?P<comma>,)
    """,
    re.VERBOSE,
)
GEOMETRY = re.compile(
    r"(?:multi)?(?:point|linestring|polygon)(?:zm|z|m)?|geometrycollection(?:zm|z|m)?", re.IGNORECASE
)
DIMENSIONS = frozenset(("z", "m", "zm"))
INFIX_WORDS = frozenset(("in", "like", "between", "is", "not", "null", "div"))
JUNCTIONS = frozenset(("and", "or"))
TEMPORAL = frozenset(("date", "timestamp", "interval"))
UNBOUNDED = "'..'"


def check_text(text: str) -> None:
    """Raise an error for a filter that is too long, too deep or too much work for the parser.

    Raises:
        InvalidParameter: the filter exceeds a limit, has a character that CQL2 does not know, or is
            read by the standard and by the parser in different ways.
    """
    if len(text) > LONGEST_TEXT:
        raise InvalidParameter(
            f"filter: {len(text)} characters, {LONGEST_TEXT} at most; send it by POST as cql2-json"
        )
    bounds = _Bounds(text)
    for token in _tokens(text):
        bounds.add(token)
    bounds.end()


def check_times(text: str) -> None:
    """Raise an error for a literal of time that is not in RFC 3339: the parser completes some.

    Raises:
        InvalidParameter: a literal is no time; the message names it.
    """
    name, functions = "", [""]
    for token in _tokens(text):
        if token["parenthesis"] == "(":
            functions.append(name)
        elif token["parenthesis"]:
            functions.pop()
        elif token["text"] and functions[-1] in TEMPORAL and token.group() != UNBOUNDED:
            parse_moment(token.group()[1:-1], "filter")
        name = token.group().lower() if token["name"] else ""


def _tokens(text: str) -> Iterator[re.Match[str]]:
    position = 0
    while position < len(text):
        token = TOKEN.match(text, position)
        if token is None:
            raise _error(text, position, _missing(text[position]))
        position = token.end()
        if token["space"] is None:
            _check_end(text, token)
            yield token


def _missing(character: str) -> str:
    if character in "'\"":
        return "a quotation that does not end"
    return "no character of CQL2 outside a text"


def _check_end(text: str, token: re.Match[str]) -> None:
    """Raise an error where the standard and the parser differ about the end of a token."""
    if token["text"] and "\\'" in token.group():
        raise _error(text, token.start(), "a \\ before a ' in a text; write '' for a ' in a text")
    following = text[token.end() : token.end() + 1]
    if token["quoted"] and (following == '"' or len(token.group()) == 2):
        raise _error(text, token.start(), 'no name: a name in quotation marks has no " in it')
    if token["number"] and (following.isalnum() or following in tuple("_.:")):
        raise _error(text, token.start(), "a number that goes on as a name; put a space between them")


class _Bounds:
    """What has been read of a filter: the open parentheses and the operators within each."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.operators = [0]
        self.is_plain: list[bool] = []
        self.after_value = False
        self.after_name = False
        self.is_geometry = False
        self.geometry_level: int | None = None
        self.ordinates = 0
        self.work = 0

    def add(self, token: re.Match[str]) -> None:
        """Check one token.

        Raises:
            InvalidParameter: with this token, the filter exceeds a limit.
        """
        self.work += 1 << sum(self.is_plain)
        if self.work > MOST_WORK:
            raise InvalidParameter(
                "filter: too much within parentheses: remove parentheses, or send it as cql2-json"
            )
        if token["parenthesis"] == "(":
            self._open(token)
        elif token["parenthesis"]:
            self._close(token)
        elif self.geometry_level is not None:
            self._ordinate(token)
        elif token["comma"]:
            self.operators[-1] = 0
            self._expect_value()
        elif token["operator"] or token["name"]:
            self._word(token)
        else:
            self._value(token)

    def end(self) -> None:
        """Check the end of the filter."""
        if self.is_plain:
            raise InvalidParameter("filter: parentheses do not match: one is not closed")

    def _open(self, token: re.Match[str]) -> None:
        if self.after_value and not self.after_name:
            raise _error(self.text, token.start(), "a ( after a value; an operator expected")
        if len(self.is_plain) == DEEPEST_TEXT:
            raise InvalidParameter(f"filter: parentheses more than {DEEPEST_TEXT} deep in each other")
        self.is_plain.append(not self.after_name)
        self.operators.append(0)
        if self.is_geometry and self.geometry_level is None:
            self.geometry_level = len(self.is_plain)
        self.ordinates = 0
        self._expect_value()

    def _close(self, token: re.Match[str]) -> None:
        if not self.is_plain:
            raise _error(self.text, token.start(), "parentheses do not match: a ) without its (")
        if self.geometry_level == len(self.is_plain):
            self.geometry_level = None
        self.is_plain.pop()
        self.operators.pop()
        self.ordinates = 0
        self._expect_value()
        self.after_value = True

    def _expect_value(self) -> None:
        self.after_value = self.after_name = self.is_geometry = False

    def _ordinate(self, token: re.Match[str]) -> None:
        """A token between the parentheses of a geometry: numbers, commas and names of geometries."""
        if token["comma"]:
            self.ordinates = 0
            self._expect_value()
        elif token["number"]:
            self.ordinates += 1
        elif token["name"]:
            word = token.group().lower()
            if not (GEOMETRY.fullmatch(word) or word in DIMENSIONS or word == "empty"):
                raise _error(self.text, token.start(), "no coordinate; numbers expected in a geometry")
            self.after_name = True
            return
        elif token["operator"] not in ("+", "-") or not self.text[token.end() :][:1].isdecimal():
            raise _error(self.text, token.start(), "no coordinate; numbers expected in a geometry")
        self.after_name = False
        if self.ordinates > MOST_ORDINATES:
            raise _error(self.text, token.start(), f"a position of more than {MOST_ORDINATES} numbers")

    def _word(self, token: re.Match[str]) -> None:
        """A name, or an operator of signs or letters."""
        word = token.group().lower()
        is_sign = bool(token["operator"])
        if self.is_geometry and (word in DIMENSIONS or word == "empty"):
            return
        if self.after_value and word in JUNCTIONS:
            self.operators[-1] = 0
            self._expect_value()
        elif (self.after_value and (is_sign or word in INFIX_WORDS)) or word in ("not", "+", "-"):
            self._operator(token)
            if word == "null":
                self.after_value = True
        elif is_sign:
            raise _error(self.text, token.start(), "an operator without a value before it")
        else:
            self._value(token)
            self.after_name = True
            self.is_geometry = GEOMETRY.fullmatch(word) is not None

    def _operator(self, token: re.Match[str]) -> None:
        self.operators[-1] += 1
        if self.operators[-1] > MOST_OPERATORS:
            raise _error(
                self.text,
                token.start(),
                f"more than {MOST_OPERATORS} operators without `and` or `or`; split the filter",
            )
        # `is null` and `not in` are words of one operator: each stands where a value has ended.
        is_begun = token.group().lower() in ("is", "not") and self.after_value
        self._expect_value()
        self.after_value = is_begun

    def _value(self, token: re.Match[str]) -> None:
        if self.after_value:
            raise _error(self.text, token.start(), "a value after a value; an operator expected")
        self._expect_value()
        self.after_value = True


def _error(text: str, position: int, problem: str) -> InvalidParameter:
    return InvalidParameter(
        f"filter: {text[position : position + 12]!r} at character {position + 1}: {problem}"
    )
