"""Which tests run a line: recorded once for each module of tests, again when it or the code changes.

A record serves all modules of the code whose files are what they were when it was made.

No line of a compiled kernel is seen to run, nor that of a constant, or of a function that remembers
what it returns, by all tests that need its value: these have the tests of the lines that use them.
"""

import ast
import json
import math
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

from mutants.changes import Mutant
from mutants.modules import ALL, SHORT, Module

Lines = dict[str, dict[int, set[str]]]
Document = dict[str, Any]
"""What was recorded, as JSON: `seconds` of each test, tests of `lines` of files, checksums of `code`."""
SECONDS_OF_A_FILE = {ALL: 240.0, SHORT: 20.0}
"""Time in which tests of one file begin while they are recorded, by marks: later ones are not tried."""


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
        return [
            (str(file.relative_to(self.root)), statement)
            for file in _code(self.root)
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


def _code(root: Path) -> list[Path]:
    """All files of the code."""
    return [*root.glob("services/**/*.py"), *root.glob("app/**/*.py")]


def recorded_coverage(root: Path, kept: Path, module: Module) -> Coverage:
    """The coverage of a module by its tests; what has changed is recorded again.

    Args:
        root: a copy of the project.
        kept: folder of the records.
        module: of which the tests run.
    """
    tests = module.test_files(root)
    records = {test: kept / _record_name(root, test, marks) for test, marks in tests.items()}
    missing = [test for test, record in records.items() if not _holds(record, root, module)]
    for marks in sorted({tests[test] for test in missing}):
        of_these = [test for test in missing if tests[test] == marks]
        document = _recorded(root, of_these, marks, (SECONDS_OF_A_FILE[marks], math.inf))
        for test in of_these:
            records[test].parent.mkdir(parents=True, exist_ok=True)
            records[test].write_text(json.dumps(_of_one(test, document)))
    return _joined(root, [json.loads(record.read_text()) for record in records.values()])


def _record_name(root: Path, test: str, marks: str) -> str:
    """The name of the file in which the record of a module of tests is kept."""
    kind = blake2b(f"{marks} {SECONDS_OF_A_FILE[marks]}".encode(), digest_size=4).hexdigest()
    return f"{test.replace('/', '.')}-{kind}-{digest(root, [test])}.json"


def _holds(record: Path, root: Path, module: Module) -> bool:
    """Whether a record exists, and the code of a module is what it was then."""
    if not record.exists():
        return False
    code = json.loads(record.read_text())["code"]
    return all(code.get(path) == digest(root, [path]) for path in module.source_files(root))


def coverage_within(root: Path, tests: Sequence[str], of_a_file_s: float, of_all_s: float) -> Coverage:
    """The coverage by modules of tests, by short ones that begin within some seconds; not kept."""
    return _joined(root, [_with_sets(_recorded(root, tests, SHORT, (of_a_file_s, of_all_s)))])


def _recorded(root: Path, tests: Sequence[str], marks: str, within_s: tuple[float, float]) -> Document:
    """Run the tests of modules that have some marks and begin within the time of a module and of all."""
    written = root / "recorded.json"
    words = [*PYTEST, "-p", "mutants.recording", "--tb=no", "--disable-warnings", "-m", marks, *tests]
    own = {
        "MUTANTS_RECORD": str(written),
        "MUTANTS_SECONDS": " ".join(map(str, within_s)),
        "PYTHONPATH": str(root),
        "COVERAGE_CORE": "ctrace",
    }
    subprocess.run(words, cwd=root, env=os.environ | own, stdout=sys.stderr, check=False)
    document: Document = json.loads(written.read_text())
    document["code"] = {str(path.relative_to(root)): digest(root, [str(path)]) for path in _code(root)}
    if document["failed"]:
        print("not used, as they do not pass:", *document["failed"], sep="\n  ", file=sys.stderr)
    return document


def _of_one(test: str, document: Document) -> Document:
    """What was recorded of one module of tests."""

    def own(names: Iterable[str]) -> list[str]:
        return [name for name in names if name.split("::")[0] == test]

    lines = {
        path: {line: kept for line, names in of_file.items() if (kept := own(names))}
        for path, of_file in document["lines"].items()
    }
    own_seconds = {name: document["seconds"][name] for name in own(document["seconds"])}
    return _with_sets({"code": document["code"], "seconds": own_seconds, "lines": lines})


def _with_sets(document: Document) -> Document:
    """A record with numbers in place of tests: few sets of them run thousands of lines."""
    numbers: dict[tuple[str, ...], int] = {}
    lines = {
        path: {line: numbers.setdefault(tuple(names), len(numbers)) for line, names in of_file.items()}
        for path, of_file in document["lines"].items()
        if of_file
    }
    return document | {"lines": lines, "sets": list(numbers)}


def _joined(root: Path, documents: Iterable[Document]) -> Coverage:
    seconds: dict[str, float] = {}
    lines: Lines = defaultdict(lambda: defaultdict(set))
    for document in documents:
        seconds |= document["seconds"]
        for path, of_file in document["lines"].items():
            for line, number in of_file.items():
                lines[path][int(line)].update(document["sets"][number])
    return Coverage(root, seconds, lines)


PYTEST = (sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", "--no-header")


def digest(root: Path, paths: Sequence[str]) -> str:
    """A checksum of files."""
    together = blake2b(digest_size=8)
    for path in paths:
        together.update((root / path).read_bytes())
    return together.hexdigest()
