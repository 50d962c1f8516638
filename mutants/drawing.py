"""Which mutants are drawn: by a text, such as a commit, and of the lines that were changed since one."""

import re
import subprocess
from collections.abc import Iterable
from hashlib import blake2b
from pathlib import Path

from mutants.changes import Mutant

ROOT = Path(__file__).parent.parent


def drawn(mutants: Iterable[Mutant], draw: str, sample: int) -> list[Mutant]:
    """Some of the mutants, the same for the same text; a larger sample contains the smaller one."""
    return sorted(mutants, key=lambda one: _place(one, draw))[:sample]


def _place(mutant: Mutant, draw: str) -> str:
    """Where a mutant stands in a draw."""
    return blake2b(f"{draw}\0{mutant.key}".encode(), digest_size=8).hexdigest()


def commit(name: str = "HEAD") -> str:
    """The short name of a commit; empty for one that is not here."""
    return _git("rev-parse", "--short=8", "--verify", "--quiet", name, check=False).strip()


def shared_commit(branch: str) -> str:
    """The short name of the last commit that HEAD shares with a branch; empty without the branch."""
    return commit(_git("merge-base", branch, "HEAD", check=False).strip() or "-")


def last_change_of(paths: Iterable[str]) -> str:
    """The last commit that changed one of some files or folders; empty where none did."""
    return _git("log", "-1", "--format=%H", "--", *paths, check=False).strip()


def changed_lines(since: str) -> dict[str, set[int]]:
    """Lines of the working tree that a commit did not have, by file."""
    lines, path = dict[str, set[int]](), ""
    for text in _git("diff", "--unified=0", since).splitlines():
        if text.startswith("+++ "):
            path = text.removeprefix("+++ b/")
        elif place := re.match(r"@@ .* \+(\d+)(?:,(\d+))? @@", text):
            first, count = int(place[1]), int(place[2] or 1)
            lines.setdefault(path, set()).update(range(first, first + count))
    return lines


def is_among(mutant: Mutant, lines: dict[str, set[int]]) -> bool:
    """Whether a mutant changes one of some lines."""
    return not lines.get(mutant.path, set()).isdisjoint(range(mutant.lines[0], mutant.lines[1] + 1))


def _git(*words: str, check: bool = True) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=check).stdout
