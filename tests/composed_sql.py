"""Finds SQL put together out of strings: f-strings, `%`, `+` and `.format` that reach an execute."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

EXECUTING = {
    "execute",
    "executemany",
    "exec_driver_sql",
    "scalar",
    "scalars",
    "stream",
    "copy",
    "text",
    "SQL",
    "DDL",
    "literal_column",
    "TextClause",
}
"""Functions and methods whose first argument is SQL."""

Scope = ast.Module | ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Source:
    """A module: its syntax, and the modules that it may import names from.

    Attributes:
        beside: every module of the project by its dotted name.
    """

    tree: ast.Module
    beside: dict[str, "Source"] = field(default_factory=dict)

    def violations(self) -> list[int]:
        """Lines where composed SQL reaches an execute."""
        return sorted(
            {
                call.lineno
                for scope in self._scopes()
                for call in _calls(scope)
                if call.args and self._composed(call.args[0], scope, frozenset())
            }
        )

    def _scopes(self) -> Iterator[Scope]:
        yield self.tree
        for node in ast.walk(self.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield node

    def _composed(self, node: ast.expr, scope: Scope, seen: frozenset[int]) -> bool:
        """Whether the value of an expression is composed text, as far as names can be followed."""
        if id(node) in seen:
            return False
        seen |= {id(node)}
        match node:
            case ast.JoinedStr(values=values):
                return any(isinstance(value, ast.FormattedValue) for value in values)
            case ast.BinOp(left=left, op=ast.Add() | ast.Mod(), right=right):
                return any(self._text(side, scope, seen) for side in (left, right))
            case ast.Call(func=ast.Attribute(value=inner, attr="format" | "join")):
                return self._text(inner, scope, seen)
            case ast.Call(func=ast.Attribute(value=inner, attr="encode" | "strip" | "replace")):
                return self._composed(inner, scope, seen)
            case ast.Call(func=ast.Name(id=name)):
                function = self._function(name)
                return function is not None and any(
                    self._composed(value, function, seen) for value in _returned(function)
                )
            case ast.IfExp(body=body, orelse=otherwise):
                return self._composed(body, scope, seen) or self._composed(otherwise, scope, seen)
            case ast.Name(id=name):
                return any(
                    source._composed(value, where, seen)
                    for source, value, where in self._values(name, scope)
                )
        return False

    def _text(self, node: ast.expr, scope: Scope, seen: frozenset[int]) -> bool:
        """Whether an expression is text, composed or not."""
        match node:
            case ast.Constant(value=value):
                return isinstance(value, str | bytes)
            case ast.JoinedStr():
                return True
            case ast.Call(func=ast.Attribute(attr="SQL") | ast.Name(id="SQL")):
                return True
            case ast.Name(id=name):
                return any(
                    source._text(value, where, seen | {id(value)})
                    for source, value, where in self._values(name, scope)
                    if id(value) not in seen
                )
        return self._composed(node, scope, seen)

    def _function(self, name: str) -> ast.FunctionDef | None:
        functions = (node for node in self.tree.body if isinstance(node, ast.FunctionDef))
        return next((node for node in functions if node.name == name), None)

    def _values(self, name: str, scope: Scope) -> Iterator[tuple["Source", ast.expr, Scope]]:
        """What is assigned to a name here, in the module, or in the module it is imported from."""
        local = list(_assigned(name, scope))
        for value in local or _assigned(name, self.tree):
            yield self, value, scope if local else self.tree
        for node in self.tree.body:
            if isinstance(node, ast.ImportFrom) and node.module in self.beside:
                origin = self.beside[node.module]
                for alias in node.names:
                    if (alias.asname or alias.name) == name:
                        for value in _assigned(alias.name, origin.tree):
                            yield origin, value, origin.tree


def read_sources(root: Path, *packages: str) -> dict[Path, Source]:
    """The modules of some packages, by path."""
    sources = {
        path: Source(ast.parse(path.read_text()))
        for package in packages
        for path in sorted((root / package).rglob("*.py"))
    }
    beside = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): source
        for path, source in sources.items()
    }
    for source in sources.values():
        source.beside = beside
    return sources


def _nodes(scope: Scope) -> Iterator[ast.AST]:
    """The nodes of a scope without those of functions inside it."""
    waiting: list[ast.AST] = list(scope.body)
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            waiting += ast.iter_child_nodes(node)


def _calls(scope: Scope) -> Iterator[ast.Call]:
    for node in _nodes(scope):
        match node:
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in EXECUTING:
                yield node


def _assigned(name: str, scope: Scope) -> Iterator[ast.expr]:
    for node in _nodes(scope):
        match node:
            case ast.Assign(targets=targets, value=value):
                if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                    yield value
            case ast.AnnAssign(target=ast.Name(id=target), value=ast.expr() as value):
                if target == name:
                    yield value
            case ast.AugAssign(target=ast.Name(id=target)) if target == name:
                yield ast.BinOp(ast.Constant(""), ast.Add(), node.value)


def _returned(function: ast.FunctionDef) -> Iterator[ast.expr]:
    for node in _nodes(function):
        if isinstance(node, ast.Return) and node.value is not None:
            yield node.value
