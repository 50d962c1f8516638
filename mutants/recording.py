"""A plugin of pytest that records which test runs which line, and how long each test takes.

Lines that a fixture runs for several tests count for all tests of the module that asks for it first.
The variable MUTANTS_RECORD names the file that is written.
"""

import json
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

IMPORT = ""
"""Stands for the tests of lines that run when modules are imported."""

_traced = coverage.Coverage(data_file=None, config_file=False, source=["amers.app", "amers.services"])
_seconds: dict[str, float] = defaultdict(float)
_failed: set[str] = set()


def pytest_configure() -> None:
    """Begin before the code is imported."""
    _traced.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Count lines for a test."""
    _traced.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        _traced.switch_context(IMPORT)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any, request: pytest.FixtureRequest) -> Iterator[Any]:
    """Count lines of a fixture that several tests share for their module."""
    if fixturedef.scope == "function":
        return (yield)
    of_test = request.node.nodeid if isinstance(request.node, pytest.Item) else _current(request)
    _traced.switch_context(of_test.split("::")[0])
    try:
        return (yield)
    finally:
        _traced.switch_context(of_test)


def _current(request: pytest.FixtureRequest) -> str:
    return str(request._pyfuncitem.nodeid)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up the time of a test, and note the tests that do not pass."""
    _seconds[report.nodeid] += report.duration
    if not report.passed:
        _failed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write both."""
    _traced.stop()
    root, data = Path.cwd(), _traced.get_data()
    lines = {}
    for name in data.measured_files():
        of_file = {
            line: sorted(set(tests) - {IMPORT}) for line, tests in data.contexts_by_lineno(name).items()
        }
        # `amers` links to the folders in which the files lie.
        path = Path(name).resolve().relative_to(root)
        lines[str(path)] = {line: t for line, t in of_file.items() if t}
    seconds = {test: time for test, time in _seconds.items() if test not in _failed}
    document = {"seconds": seconds, "failed": sorted(_failed), "lines": lines}
    Path(os.environ["MUTANTS_RECORD"]).write_text(json.dumps(document))
