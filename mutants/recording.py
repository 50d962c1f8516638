"""A plugin of pytest that records which test runs which line, and how long each test takes.

Lines that a fixture runs for several tests count for all tests of the module that asks for it first.
MUTANTS_RECORD names the file that is written; MUTANTS_SECONDS has the time in which the tests of one
module begin, and that of all: those after it are skipped, and one that goes on is ended.
"""

import json
import os
import signal
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

PASSED = "the time has passed"
GRACE_S, LONGEST_S = 2.0, 60.0
"""How long a test may go on when the time has passed, and how long it may take at most."""
IMPORT = ""
"""Stands for the tests of lines that run when modules are imported."""

_traced = coverage.Coverage(data_file=None, config_file=False, source=["amers.app", "amers.services"])
_seconds: dict[str, float] = defaultdict(float)
_seconds_of_files: dict[str, float] = defaultdict(float)
_failed: set[str] = set()
_skipped: set[str] = set()
_OF_A_FILE_S, _OF_ALL_S = map(float, os.environ["MUTANTS_SECONDS"].split())


def pytest_configure() -> None:
    """Begin before the code is imported."""
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail(PASSED))
    _traced.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Count lines for a test."""
    _traced.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        _traced.switch_context(IMPORT)


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Skip a test, before its fixtures, when the time has passed."""
    if _left_s(item) <= 0.0:
        pytest.skip(PASSED)
    return (yield from _ended_in_time(item))


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """End a test when the time has passed."""
    return (yield from _ended_in_time(item))


def _ended_in_time(item: pytest.Item) -> Iterator[None]:
    """The alarm goes off in fixtures and tests only: between them it would end pytest itself."""
    signal.setitimer(signal.ITIMER_REAL, min(max(_left_s(item), 0.0) + GRACE_S, LONGEST_S))
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _left_s(item: pytest.Item) -> float:
    """What is left of the time of a test's module, and of all."""
    of_file_s = _seconds_of_files[item.nodeid.split("::")[0]]
    return min(_OF_A_FILE_S - of_file_s, _OF_ALL_S - sum(_seconds_of_files.values()))


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
    _seconds_of_files[report.nodeid.split("::")[0]] += report.duration
    if report.failed:
        _failed.add(report.nodeid)
    elif report.skipped:
        _skipped.add(report.nodeid)


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
    seconds = {test: time for test, time in _seconds.items() if test not in _failed | _skipped}
    document = {"seconds": seconds, "failed": sorted(_failed), "lines": lines}
    Path(os.environ["MUTANTS_RECORD"]).write_text(json.dumps(document))
