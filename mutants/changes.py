"""The mutants of a file: its text with one small change.

The changes are those of mutmut, without what a type error shows at once (a value that becomes None, a
missing argument), what changes nothing, and messages for people; and two more: a term, a factor or a
condition is dropped, and the values of two arguments are exchanged.
"""

import itertools
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import libcst as cst
import libcst.matchers as m
from libcst.metadata import CodeRange, MetadataWrapper, PositionProvider
from mutmut.mutation.mutators import mutation_operators, operator_arg_removal, operator_string

_LEFT_ALONE = m.OneOf(
    m.Annotation(),
    m.Decorator(),
    m.Import(),
    m.ImportFrom(),
    m.Raise(),
    m.Assert(),
    m.Expr(m.SimpleString()),
    m.Expr(m.Call(m.Attribute(m.Name("log")))),
)
_ANNOTATED = m.Subscript(m.Name("Annotated"))
_OF_ANY_NUMBER = ("max", "min", "where", "and_", "or_", "greatest", "least")
"""Functions that do something else, and do not fail, with an argument less."""
_SYMMETRIC = frozenset(_OF_ANY_NUMBER) | {"hypot", "maximum", "minimum", "intersects"}
"""Functions to which the order of their arguments is nothing; `where` of a statement, not of NumPy."""
_FOR_READERS = ("strict", "type_")
"""Named arguments that state what is true without them: equal lengths, the type of a term in SQL."""
_COMMUTATIVE = (cst.Add, cst.Multiply, cst.BitAnd, cst.BitOr)


@dataclass(frozen=True)
class Mutant:
    """A file with one change.

    Attributes:
        path: of the file, relative to the root.
        definition: function, class or constant of the file in which it stands.
        lines: first and last line of what was changed.
        before, after: the code that was changed.
        number: among equal changes in the same definition.
    """

    path: str
    definition: str
    lines: tuple[int, int]
    before: str
    after: str
    number: int
    _module: cst.Module = field(repr=False, compare=False)
    _node: cst.CSTNode = field(repr=False, compare=False)
    _changed: cst.CSTNode = field(repr=False, compare=False)

    @property
    def key(self) -> str:
        """Names the mutant whatever else changes in its file; sorted by it, mutants are shuffled."""
        parts = (self.path, self.definition, self.before, self.after, str(self.number))
        return blake2b("\0".join(parts).encode(), digest_size=8).hexdigest()

    @property
    def source(self) -> str:
        """The text of the changed file."""
        replaced = self._module.deep_replace(self._node, self._changed)
        assert isinstance(replaced, cst.Module)
        return replaced.code


def mutants_of(root: Path, path: str) -> Iterator[Mutant]:
    """All mutants of a file."""
    wrapper = MetadataWrapper(cst.parse_module((root / path).read_text()), unsafe_skip_copy=True)
    positions, module = wrapper.resolve(PositionProvider), wrapper.module
    seen = Counter[tuple[str, str, str]]()
    for statement in module.body:
        definition = _name_of(statement)
        for node in _changeable(statement):
            at = positions[node]
            assert isinstance(at, CodeRange)
            before = module.code_for_node(node)
            for changed in _changes(node):
                after = module.code_for_node(changed)
                if after == before or _is_none(before, after):
                    continue
                seen[definition, before, after] += 1
                number, lines = seen[definition, before, after], (at.start.line, at.end.line)
                yield Mutant(path, definition, lines, before, after, number, module, node, changed)


def _is_none(before: str, after: str) -> bool:
    """Whether a change makes a value None."""
    return after.count("None") > before.count("None") or re.search(r"=\s*None$", after) is not None


def _name_of(statement: cst.CSTNode) -> str:
    """The name that a statement of a module defines; empty for none."""
    if isinstance(statement, cst.FunctionDef | cst.ClassDef):
        return statement.name.value
    targets = m.findall(statement, m.AssignTarget(m.Name()) | m.AnnAssign(m.Name()))
    return str(targets[0].target.value) if targets else ""  # type: ignore[attr-defined]


def _changeable(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """The nodes of a tree without those that do nothing or only tell people something."""
    if not m.matches(node, _LEFT_ALONE):
        yield node
        for child in node.children:
            # The first part of what is annotated is a type, as an annotation is.
            if not (m.matches(node, _ANNOTATED) and child is node.slice[0]):  # type: ignore[attr-defined]
                yield from _changeable(child)


def _changes(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    yield from _operand_alone(node)
    if isinstance(node, cst.Call):
        yield from _exchanged(node)
    for kind, operator in mutation_operators:
        if operator is operator_arg_removal:
            if isinstance(node, cst.Call):
                yield from _without_an_argument(node)
        elif operator is operator_string:
            # Of a name one change is enough, of its letters or their case. Texts are for people.
            if isinstance(node, cst.SimpleString) and " " not in node.value:
                yield from list(operator(node))[:1]
        elif isinstance(node, kind):
            yield from operator(node)


def _without_an_argument(call: cst.Call) -> Iterator[cst.CSTNode]:
    """A call without a named argument, or without one of any number."""
    of_any_number = _called(call) in _OF_ANY_NUMBER
    for number, argument in enumerate(call.args):
        if argument.keyword is not None and argument.keyword.value in _FOR_READERS:
            continue
        if argument.keyword is not None or (of_any_number and len(call.args) > 1):
            yield call.with_changes(args=[*call.args[:number], *call.args[number + 1 :]])


def _called(call: cst.Call) -> str:
    """The name of the function or method that is called; empty for none."""
    name = call.func.attr if isinstance(call.func, cst.Attribute) else call.func
    return name.value if isinstance(name, cst.Name) else ""


def _exchanged(call: cst.Call) -> Iterator[cst.CSTNode]:
    """A call with the values of two neighbouring arguments exchanged."""
    if _called(call) in _SYMMETRIC and not m.matches(
        call.func, m.Attribute(m.Name("np"), m.Name("where"))
    ):
        return
    for number, (one, other) in enumerate(itertools.pairwise(call.args)):
        if one.star == other.star == "":
            pair = [one.with_changes(value=other.value), other.with_changes(value=one.value)]
            yield call.with_changes(args=[*call.args[:number], *pair, *call.args[number + 2 :]])


def _operand_alone(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """One operand of an operation, in the parentheses of both."""
    if isinstance(node, cst.BooleanOperation | cst.BinaryOperation):
        both = isinstance(node, cst.BooleanOperation) or isinstance(node.operator, _COMMUTATIVE)
        for kept in (node.left, node.right) if both else (node.left,):
            yield kept.with_changes(lpar=[*node.lpar, *kept.lpar], rpar=[*kept.rpar, *node.rpar])
