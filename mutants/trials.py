"""One mutant after another is put into a copy of the project, and its tests are run."""

import ast
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from mutants.changes import Mutant
from mutants.covering import PYTEST, Coverage
from mutants.report import Trial

State = Literal["killed", "survived", "timeout", "no tests"]
START_S = 120.0
"""Longest time to import everything, start a database and compile kernels, on a busy machine."""
TIMES_LONGER = 5.0
"""A mutant whose tests take so many times as long as before has been noticed."""
_LEFT_OUT = (".git", ".venv", ".mutants", ".*_cache", "node_modules", "demo-output", "results")


@contextmanager
def copied_project(root: Path) -> Iterator[Path]:
    """A copy of the working tree, with its compiled kernels, which mutants may change."""
    with TemporaryDirectory(prefix="amers-mutants-") as folder:
        copy = Path(folder) / "project"
        shutil.copytree(root, copy, ignore=shutil.ignore_patterns(*_LEFT_OUT), symlinks=True)
        yield copy


def tried(
    coverage: Coverage,
    module: str,
    mutant: Mutant,
    limit_s: float,
    *,
    digests: tuple[str, str] = ("", ""),
    start_s: float = START_S,
) -> Trial:
    """Try a mutant with the tests that run it, the fastest first.

    Args:
        coverage: of the copy in which it is tried.
        module: for which it is.
        mutant: that is tried.
        limit_s: time of the tests; the first is run however long it takes.
        digests: of the mutant's file and of the module's tests.
        start_s: longest time until the first test begins.
    """
    covering = coverage.tests_of(mutant)
    chosen, expected_s = list[str](), 0.0
    for test in covering:
        expected_s += coverage.seconds[test]
        if chosen and expected_s > limit_s:
            break
        chosen.append(test)
    begun = time.monotonic()
    longest_s = TIMES_LONGER * min(expected_s, limit_s) + start_s
    state = Workplace(coverage.root).outcome(mutant, chosen, longest_s)
    return Trial(
        module=module,
        key=mutant.key,
        path=mutant.path,
        line=mutant.lines[0],
        definition=mutant.definition,
        before=mutant.before,
        after=mutant.after,
        state=state,
        tests=len(chosen),
        covering=len(covering),
        seconds=time.monotonic() - begun,
        code=digests[0],
        test_code=digests[1],
    )


@dataclass(frozen=True)
class Workplace:
    """A copy of the project in which mutants are tried.

    Attributes:
        root: of the copy.
    """

    root: Path

    def outcome(self, mutant: Mutant, tests: Sequence[str], longest_s: float) -> State:
        """Whether one of some tests notices a mutant.

        Args:
            mutant: of a file of this copy.
            tests: those that are run.
            longest_s: after which a run that has not ended is a timeout.
        """
        if not tests:
            return "no tests"
        with self._changed(mutant):
            return self._run(tests, longest_s)

    def _run(self, tests: Sequence[str], limit_s: float) -> State:
        process = subprocess.Popen(
            [*PYTEST, "-x", *tests],
            cwd=self.root,
            env=os.environ | {"PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return "survived" if process.wait(limit_s) == 0 else "killed"
        except subprocess.TimeoutExpired:
            return "timeout"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    @contextmanager
    def _changed(self, mutant: Mutant) -> Iterator[None]:
        """The mutant in its place.

        Numba keeps kernels as long as their own file is unchanged, whatever they call in others: those
        that may contain what has changed are compiled again, and afterwards the former ones come back.
        """
        path = self.root / mutant.path
        text, times = path.read_bytes(), path.stat()
        concerned = {mutant.path} | (self._users_of(mutant.path) if self._is_compiled(mutant) else set())
        former = {file: file.read_bytes() for file in self._compiled(concerned)}
        try:
            path.write_text(mutant.source)
            if len(concerned) > 1:
                for file in former:
                    file.unlink()
            yield
        finally:
            path.write_bytes(text)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            for file in self._compiled(concerned):
                file.unlink()
            for file, content in former.items():
                file.write_bytes(content)

    def _compiled(self, paths: set[str]) -> list[Path]:
        """Files in which Numba keeps the kernels of modules."""
        found: list[Path] = []
        for path in paths:
            file = self.root / path
            found += (file.parent / "__pycache__").glob(f"{file.stem}.*.nb?")
        return found

    def _is_compiled(self, mutant: Mutant) -> bool:
        """Whether kernels of other files may contain what a mutant changes: a kernel or a constant."""
        for statement in ast.parse((self.root / mutant.path).read_text()).body:
            if isinstance(statement, ast.FunctionDef) and statement.name == mutant.definition:
                return any("njit" in ast.unparse(one) for one in statement.decorator_list)
        return mutant.definition.isupper()

    def _users_of(self, path: str) -> set[str]:
        """Files that import a module, or one that does."""
        found, left = set[str](), [path]
        while left:
            name = "amers." + left.pop().removesuffix(".py").replace("/", ".")
            new = {user for user, imported in self._imports.items() if name in imported} - found
            found |= new
            left += new
        return found

    @cached_property
    def _imports(self) -> dict[str, set[str]]:
        """The modules that each file of the science imports."""
        return {
            str(file.relative_to(self.root)): {
                node.module
                for node in ast.walk(ast.parse(file.read_text()))
                if isinstance(node, ast.ImportFrom) and node.module
            }
            for file in self.root.glob("services/**/*.py")
        }
