"""Which tests run a line: recorded once for each module of tests, again when it or the code changes.

No line of a compiled kernel is seen to run, nor that of a constant, or of a function that remembers
what it returns, by all tests that need its value: these have the tests of the lines that use them.
"""

import ast
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path

from mutants.changes import Mutant
from mutants.modules import Module

Lines = dict[str, dict[int, set[str]]]


@dataclass(frozen=True)
class Coverage:
    """Tests by line.

    Attributes:
        root: of the code.
        seconds: time of each test that passes.
        lines: tests by file and line; a module of tests stands for all of its tests.
    """

    root: Path
    seconds: dict[str, float]
    lines: Lines

    def tests_of(self, mutant: Mutant) -> list[str]:
        """The tests that run what a mutant changes, the fastest first."""
        places = {(mutant.path, line) for line in range(mutant.lines[0], mutant.lines[1] + 1)}
        named = self._tests_at(places)
        if not named or (mutant.path, mutant.definition) in self._remembered:
            named = named | self._tests_of_users(mutant.path, mutant.definition, set())
        tests = {test for name in named for test in self._by_name[name]}
        return sorted(tests, key=lambda test: self.seconds[test])

    def _tests_at(self, places: Iterable[tuple[str, int]]) -> set[str]:
        return {test for path, line in places for test in self.lines.get(path, {}).get(line, ())}

    def _tests_of_users(self, path: str, name: str, seen: set[tuple[str, str]]) -> set[str]:
        """Tests of the lines that name a definition; of those that use these, where no line is seen."""
        if not name or (path, name) in seen:
            return set()
        seen.add((path, name))
        tests = set()
        for other, line, user in self._mentions[name]:
            if name.startswith("_") and other != path:
                continue
            tests |= self._tests_at([(other, line)]) or self._tests_of_users(other, user, seen)
        return tests

    @cached_property
    def _by_name(self) -> dict[str, list[str]]:
        """Tests by their own names and by those of their modules."""
        named = defaultdict(list)
        for test in self.seconds:
            named[test].append(test)
            named[test.split("::")[0]].append(test)
        return named

    @cached_property
    def _remembered(self) -> set[tuple[str, str]]:
        """File and name of the functions that remember what they return."""
        return {
            (path, statement.name)
            for path, statement in self._statements
            if isinstance(statement, ast.FunctionDef)
            and any("cache" in ast.unparse(decorator) for decorator in statement.decorator_list)
        }

    @cached_property
    def _statements(self) -> list[tuple[str, ast.stmt]]:
        """The statements of all modules, each with its file."""
        files = [*self.root.glob("services/**/*.py"), *self.root.glob("app/**/*.py")]
        return [
            (str(file.relative_to(self.root)), statement)
            for file in files
            for statement in ast.parse(file.read_text()).body
        ]

    @cached_property
    def _mentions(self) -> dict[str, list[tuple[str, int, str]]]:
        """File, line and enclosing definition of every use of a name."""
        found = defaultdict(list)
        for path, statement in self._statements:
            for name, line in _names(statement):
                found[name].append((path, line, _defined(statement)))
        return found


def _names(statement: ast.stmt) -> Iterator[tuple[str, int]]:
    for node in ast.walk(statement):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute):
            yield node.attr, node.lineno


def _defined(statement: ast.stmt) -> str:
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return statement.name
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    if isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    return next((target.id for target in targets if isinstance(target, ast.Name)), "")


def recorded_coverage(root: Path, kept: Path, module: Module) -> Coverage:
    """The coverage of a module by its tests; what has changed is recorded again.

    Args:
        root: a copy of the project.
        kept: folder of the records.
        module: of which the tests run.
    """
    code = digest(root, module.source_files(root))
    records = {
        test: kept / f"{test.replace('/', '.')}-{code}-{digest(root, [test])}.json"
        for test in module.test_files(root)
    }
    missing = [test for test, record in records.items() if not record.exists()]
    if missing:
        _record(root, missing, records)
    seconds: dict[str, float] = {}
    lines: Lines = defaultdict(lambda: defaultdict(set))
    for record in records.values():
        document = json.loads(record.read_text())
        seconds |= document["seconds"]
        for path, of_file in document["lines"].items():
            for line, tests in of_file.items():
                lines[path][int(line)] |= set(tests)
    return Coverage(root, seconds, lines)


def _record(root: Path, tests: Sequence[str], records: dict[str, Path]) -> None:
    """Run modules of tests and divide what was recorded among them."""
    written = root / "recorded.json"
    subprocess.run(
        [*PYTEST, "-p", "mutants.recording", "-m", "not endurance", *tests],
        cwd=root,
        env=os.environ | {"MUTANTS_RECORD": str(written), "COVERAGE_CORE": "ctrace"},
        stdout=sys.stderr,
        check=False,
    )
    document = json.loads(written.read_text())
    if document["failed"]:
        print("not used, as they do not pass:", *document["failed"], sep="\n  ", file=sys.stderr)
    for test in tests:

        def own(name: str, test: str = test) -> bool:
            return name.split("::")[0] == test

        lines = {
            path: {
                line: kept for line, names in of_file.items() if (kept := [n for n in names if own(n)])
            }
            for path, of_file in document["lines"].items()
        }
        seconds = {name: time for name, time in document["seconds"].items() if own(name)}
        records[test].parent.mkdir(parents=True, exist_ok=True)
        records[test].write_text(json.dumps({"seconds": seconds, "lines": lines}))


PYTEST = (sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", "--no-header")


def digest(root: Path, paths: Sequence[str]) -> str:
    """A checksum of files."""
    together = blake2b(digest_size=8)
    for path in paths:
        together.update((root / path).read_bytes())
    return together.hexdigest()
