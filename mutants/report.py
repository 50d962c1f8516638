"""What the tests have noticed: a table of the modules, and the mutants that survived."""

import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

EQUIVALENT = Path(__file__).parent / "equivalent.toml"
"""Mutants that change nothing that matters, each with the reason."""
_HEADER = "| module | mutants | tried | killed | timeouts | survived | equivalent | score |"
_WITHIN = 1.96
"""Standard deviations of the interval of 95 %."""


@dataclass(frozen=True)
class Trial:
    """What became of a mutant.

    Attributes:
        module: for which it was tried.
        key: of the mutant; `path`, `line`, `definition`, `before` and `after` describe it.
        state: "killed", "survived", "timeout" or "no tests".
        tests: number of tests that were run at most, of `covering` that run the code.
        seconds: that it took.
        code, test_code: checksums of the file and of the module's tests.
    """

    module: str
    key: str
    path: str
    line: int
    definition: str
    before: str
    after: str
    state: str
    tests: int
    covering: int
    seconds: float
    code: str
    test_code: str

    @property
    def is_noticed(self) -> bool:
        """Whether a test failed, or did not end."""
        return self.state in ("killed", "timeout")

    def holds(self, code: str, test_code: str) -> bool:
        """Whether the outcome would be the same: what was noticed still is when tests are added."""
        return self.code == code and (self.is_noticed or self.test_code == test_code)

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def equivalent_keys() -> set[str]:
    """Keys of the mutants that are listed as equivalent."""
    return {one["key"] for one in tomllib.loads(EQUIVALENT.read_text()).get("mutant", [])}


def score_interval(noticed: int, tried: int) -> tuple[float, float]:
    """The interval of 95 % of a share of which a sample was tried.

    Source: Wilson (1927), Probable inference, the law of succession, and statistical inference.
    """
    if not tried:
        return 0.0, 1.0
    share, z2 = noticed / tried, _WITHIN**2 / tried
    middle = share + z2 / 2.0
    half = _WITHIN * ((share * (1.0 - share) + z2 / 4.0) / tried) ** 0.5
    return (middle - half) / (1.0 + z2), (middle + half) / (1.0 + z2)


def table(trials: dict[str, Sequence[Trial]], totals: dict[str, int]) -> str:
    """The table of some modules, from the trials of each and the number of its mutants."""
    rows, equivalent = [_HEADER, "|---|" + "---:|" * 7], equivalent_keys()
    for name, of_module in trials.items():
        counted = [trial for trial in of_module if trial.is_noticed or trial.key not in equivalent]
        states = Counter(trial.state for trial in counted)
        noticed = states["killed"] + states["timeout"]
        low, high = score_interval(noticed, len(counted))
        score = f"{noticed / max(len(counted), 1):.0%} ({low:.0%} to {high:.0%})"
        survived = len(counted) - noticed
        numbers = (totals[name], len(of_module), states["killed"], states["timeout"], survived)
        cells = (name, *numbers, len(of_module) - len(counted), score)
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(rows)


def survivors(trials: Sequence[Trial]) -> str:
    """The mutants that nothing noticed, as changes of the code."""
    parts, equivalent = list[str](), equivalent_keys()
    for trial in sorted(trials, key=lambda one: (one.path, one.line)):
        if not trial.is_noticed and trial.key not in equivalent:
            why = f"{trial.tests} of {trial.covering} tests" if trial.tests else "no test runs it"
            head = f"{trial.key} {trial.path}:{trial.line} {trial.definition} ({why})"
            removed = "\n".join(f"  - {line}" for line in trial.before.splitlines())
            added = "\n".join(f"  + {line}" for line in trial.after.splitlines())
            parts.append(f"{head}\n{removed}\n{added}")
    return "\n\n".join(parts)
