"""One mutant after another is put into a copy of the project, and its tests are run."""

import ast
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from mutants.changes import Mutant
from mutants.covering import PYTEST

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


@dataclass(frozen=True)
class Workplace:
    """A copy of the project in which mutants are tried.

    Attributes:
        root: of the copy.
    """

    root: Path

    def outcome(self, mutant: Mutant, tests: Sequence[str], expected_s: float) -> State:
        """Whether one of some tests notices a mutant.

        Args:
            mutant: of a file of this copy.
            tests: those that are run.
            expected_s: time that they take without it.
        """
        if not tests:
            return "no tests"
        with self._changed(mutant):
            return self._run(tests, TIMES_LONGER * expected_s + START_S)

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
