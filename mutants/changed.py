"""`python -m mutants.changed`: try a handful of mutants of the lines that were changed, within a time.

A report, which never fails: what survives here asks for a look, not for a test. Few files of tests are
recorded, of each some seconds, without thorough and long tests: of each changed file those that were
changed too, have its name, import it, or are listed for it in `mutants/modules.py`. Nothing runs when no
line of the code was changed, and nothing is kept.
"""

import argparse
import itertools
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from mutants.changes import Mutant, mutants_of
from mutants.covering import coverage_within
from mutants.drawing import (
    ROOT,
    changed_lines,
    commit,
    drawn,
    is_among,
    last_change_of,
    shared_commit,
)
from mutants.modules import MODULES, all_tests, importing
from mutants.report import Trial, survivors
from mutants.trials import copied_project, tried

CODE = ("app/", "services/")
TEST_FILES = 4
"""Files of tests that are recorded at most."""
PER_TEST_FILE, PER_RECORD = 0.1, 0.3
"""Parts of the time in which tests of one file, and of all, begin while they are recorded."""
PER_MUTANT = 0.05
"""Part of the time that the tests of one mutant may take without it."""
START_S = 20.0
"""A mutant whose first test has not begun by then counts as a timeout."""
LAST = 0.75
"""Part of the time after which no further mutant is begun."""


def main() -> None:
    """Report on mutants of changed lines."""
    parser = argparse.ArgumentParser(prog="python -m mutants.changed", description=__doc__)
    parser.add_argument(
        "--since",
        default=base(),
        help="a commit (default: where the branch left origin/main, or before the code changed last)",
    )
    parser.add_argument("--sample", type=int, default=6, help="mutants of all that changed (default: 6)")
    parser.add_argument("--within", type=float, default=80.0, help="seconds for all (default: 80)")
    options = parser.parse_args()
    # Whoever bounds the time: the tests of a mutant end with this process.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    begun = time.monotonic()
    lines = changed_lines(options.since) if options.since else {}
    chosen = drawn(_mutants_of(lines), commit(), options.sample)
    print(f"{len(chosen)} mutants of lines changed since {options.since or 'nothing'}", flush=True)
    if chosen:
        print(report(chosen, set(lines), begun, options.within), flush=True)


def base() -> str:
    """The commit at which HEAD left origin/main, or the one before the last change of the code.

    Empty where neither is here.
    """
    shared = shared_commit("origin/main")
    return shared if shared not in ("", commit()) else commit(f"{last_change_of(CODE)}^")


def _mutants_of(lines: dict[str, set[int]]) -> Iterator[Mutant]:
    """The mutants of some lines of the code."""
    for path in sorted(lines):
        if path.startswith(CODE) and path.endswith(".py") and (ROOT / path).exists():
            yield from (one for one in mutants_of(ROOT, path) if is_among(one, lines))


def report(mutants: list[Mutant], changed: set[str], begun: float, within_s: float) -> str:
    """What became of some mutants, of which no further one is begun near the end of the time."""
    trials: list[Trial] = []
    with copied_project(ROOT) as copy:
        tests = tests_of([one.path for one in mutants], changed)
        if not tests:
            return "no test is known for them"
        coverage = coverage_within(copy, tests, PER_TEST_FILE * within_s, PER_RECORD * within_s)
        for mutant in mutants:
            if time.monotonic() - begun > LAST * within_s:
                break
            if coverage.tests_of(mutant):
                trial = tried(coverage, "changed", mutant, PER_MUTANT * within_s, start_s=START_S)
                print(f"{trial.state:9} {mutant.path}:{mutant.lines[0]}", flush=True)
                trials.append(trial)
    noticed = sum(trial.is_noticed for trial in trials)
    summary = (
        f"{noticed} of {len(trials)} noticed; of {len(mutants) - len(trials)} others no test was run "
        f"in the time, by {' '.join(tests)}"
    )
    return "\n\n".join(one for one in (summary, survivors(trials)) if one)


def tests_of(paths: Sequence[str], changed: set[str]) -> list[str]:
    """Files of tests of some files of the code: of each in turn the one that is most about it."""
    of_each = [_tests_of_one(path, changed) for path in dict.fromkeys(paths)]
    in_turn = [test for turn in itertools.zip_longest(*of_each) for test in turn if test is not None]
    return list(dict.fromkeys(in_turn))[:TEST_FILES]


def _tests_of_one(path: str, changed: set[str]) -> list[str]:
    """The tests that are about a file, those first that were changed too, or import it."""
    imports, stem = set(importing(ROOT, [path])), Path(path).stem
    modules = [module for module in MODULES if path in module.source_files(ROOT)]
    listed = {test for module in modules for test in module.test_files(ROOT)}
    named = {test for test in all_tests(ROOT) if stem in Path(test).stem}
    return sorted(
        imports | listed | named,
        key=lambda test: (test not in changed, -(test in named) - (test in imports), test),
    )


if __name__ == "__main__":
    main()
