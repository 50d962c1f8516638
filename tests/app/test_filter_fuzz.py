"""Thousands of random filters in a process whose death is the failure of the test."""

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.security

COUNTS = {"bounded": 3_000, "full": 50_000}
SEED = 20_261_122
LONGEST_S = 5.0
"""Time for one filter on a busy machine."""


@pytest.mark.long
def test_random_filters_are_accepted_or_refused_and_nothing_else(request: pytest.FixtureRequest):
    count = COUNTS[request.config.getoption("--attacks")]
    run = subprocess.run(
        [sys.executable, "-m", "tests.app.filter_fuzz", str(count), str(SEED)],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, f"exit code {run.returncode}: {run.stderr[-3000:]}"
    figures = json.loads(run.stdout)
    print(figures)
    outcomes = figures["outcomes"]
    assert sum(outcomes.values()) == count
    assert all(
        outcomes[f"{kind} {language}"] > count / 1000
        for kind in ("accepted", "refused")
        for language in ("text", "json")
    )
    assert figures["slowest_s"] < LONGEST_S, figures["slowest"]
