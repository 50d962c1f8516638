"""`python -m mutants [MODULE ...]`: try mutants of the modules, and print the table and the survivors.

Which mutants are drawn follows from the commit: those of another commit are fresh, and no test was
written for them. What was tried is kept in `.mutants/trials.jsonl`: a run that was broken off goes on,
and a mutant is tried again when its file has changed, or when it survived and tests have changed.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from mutants.changes import Mutant, mutants_of
from mutants.covering import Coverage, digest, recorded_coverage
from mutants.drawing import ROOT, changed_lines, commit, drawn, is_among
from mutants.modules import Module, chosen_modules
from mutants.report import Trial, equivalent_keys, survivors, table
from mutants.trials import copied_project, tried

KEPT = ROOT / ".mutants"
TRIALS = KEPT / "trials.jsonl"


def main() -> None:
    """Try a sample of the mutants of each module."""
    parser = argparse.ArgumentParser(prog="python -m mutants", description=__doc__)
    parser.add_argument(
        "module", nargs="*", help="such as services/quality, or a file of one; all if none"
    )
    parser.add_argument("--sample", type=int, default=50, help="mutants of each module (default: 50)")
    parser.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        help="of tests for each mutant, the fastest first (default: 60)",
    )
    parser.add_argument(
        "--draw", default=commit(), help="any text, which decides what is drawn (default: the commit)"
    )
    parser.add_argument(
        "--since", metavar="COMMIT", help="only mutants of lines that were changed since a commit"
    )
    options = parser.parse_args()
    changed = None if options.since is None else changed_lines(options.since)
    print(f"drawn by {options.draw}", flush=True)
    trials: dict[str, Sequence[Trial]] = {}
    totals: dict[str, int] = {}
    for module in chosen_modules(options.module):
        with copied_project(ROOT) as copy:
            mutants = [one for path in module.mutated_files(copy) for one in mutants_of(copy, path)]
            mutants = [one for one in mutants if changed is None or is_among(one, changed)]
            chosen = drawn(mutants, options.draw, options.sample)
            totals[module.name] = len(mutants)
            trials[module.name] = _all_tried(copy, module, chosen, options.seconds)
        print(table(trials, totals), survivors(trials[module.name]), sep="\n\n", flush=True)


def _all_tried(copy: Path, module: Module, mutants: Sequence[Mutant], limit_s: float) -> list[Trial]:
    """The trials of mutants, of which those that still hold are not repeated."""
    earlier, equivalent = {trial.key: trial for trial in _kept()}, equivalent_keys()
    tests = digest(copy, sorted(module.test_files(copy)))
    trials: list[Trial] = []
    coverage: Coverage | None = None
    for mutant in mutants:
        code = digest(copy, [mutant.path])
        trial = earlier.get(mutant.key)
        if trial is None or not (trial.holds(code, tests) or mutant.key in equivalent):
            coverage = coverage or recorded_coverage(copy, KEPT, module)
            trial = tried(coverage, module.name, mutant, limit_s, digests=(code, tests))
            print(f"{trial.state:9} {mutant.path}:{mutant.lines[0]} {trial.seconds:.0f} s", flush=True)
            with TRIALS.open("a") as file:
                file.write(json.dumps(trial.document()) + "\n")
        trials.append(trial)
    return trials


def _kept() -> list[Trial]:
    KEPT.mkdir(exist_ok=True)
    lines = TRIALS.read_text().splitlines() if TRIALS.exists() else []
    return [Trial(**json.loads(line)) for line in lines]


if __name__ == "__main__":
    main()
