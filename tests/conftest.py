"""What every test may ask for, and which tests a fast run leaves out."""

import fcntl
import gc
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from amers.app.child_processes import SAFE_PATH
from tests.run_folders import DISK, MEMORY, end_dead_runs, place_of_databases, run_folder

# Until all tests are collected: it would look again and again through modules that live to the end.
gc.disable()

settings.register_profile("amers", deadline=None)
settings.load_profile("amers")

# Read by the linear algebra when NumPy is first imported, which is after this file, and by OpenCV: the
# processes of the tests are more than the cores.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_threads, "1")


LEFT_OUT = pytest.StashKey[Counter[str]]()
"""How many tests a fast run leaves out, by reason."""


@pytest.fixture(autouse=True)
def own_places_of_modules() -> Iterator[None]:
    """Undo what commands in the process of a test set for the processes that libraries start."""
    before = {name: os.environ.get(name) for name in SAFE_PATH}
    yield
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--fast` and `--attacks`."""
    parser.addoption(
        "--fast",
        action="store_true",
        help="leave out journeys, Monte Carlo, long and thorough tests, tests that need a database",
    )
    parser.addoption(
        "--attacks",
        choices=("bounded", "full"),
        default="bounded",
        help="how many hostile values and filters to try: some, or all as `make test-security` does",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put long modules first, and leave out what a fast run does not wait for."""
    if config.getoption("--fast"):
        _keep_fast(config, items)
    _begin_long_ones_first(items)


def pytest_collection_finish() -> None:
    """Spare the garbage collector what lives to the end: all modules and tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take over what a worker of pytest-xdist has left out; all workers leave out the same."""
    node.config.stash[LEFT_OUT] = Counter(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Hand what was left out to the process that reports, when this is a worker of pytest-xdist."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left_out"] = dict(session.config.stash.get(LEFT_OUT, Counter()))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Report what a fast run has left out."""
    if counts := config.stash.get(LEFT_OUT, None):
        parts = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        terminalreporter.write_line(f"left out by --fast: {parts}; `make test` runs more")


def _keep_fast(config: pytest.Config, items: list[pytest.Item]) -> None:
    reasons = [_slow_because(item) for item in items]
    config.hook.pytest_deselected(items=[item for item, why in zip(items, reasons, strict=True) if why])
    config.stash[LEFT_OUT] = Counter(why for why in reasons if why)
    items[:] = [item for item, why in zip(items, reasons, strict=True) if not why]


def _slow_because(item: pytest.Item) -> str | None:
    """Why a fast run leaves a test out; None when it does not."""
    if item.nodeid.startswith("tests/journeys/"):
        return "journeys"
    if "open_folder" in getattr(item, "fixturenames", ()) or item.get_closest_marker("database"):
        return "tests that need a database"
    if item.get_closest_marker("endurance"):
        return "tests of endurance"
    if item.get_closest_marker("thorough"):
        return "thorough tests"
    if item.get_closest_marker("monte_carlo"):
        return "Monte Carlo tests"
    return "long tests" if item.get_closest_marker("long") else None


def _begin_long_ones_first(items: list[pytest.Item]) -> None:
    """Modules with long tests first: one that is begun last leaves the other cores without work.

    Of these, those of the science come before those of services whose workers are killed while they
    work: these find the kernels compiled.
    """
    long = {item.path for item in items if item.get_closest_marker("long")}
    items.sort(key=lambda item: (item.path not in long, not item.nodeid.startswith("tests/services/")))


@pytest.fixture(scope="session")
def open_folder() -> Iterator[Path]:
    """A short temporary folder that the server's user can pass, unlike pytest's own."""
    end_dead_runs(DISK, MEMORY)
    with run_folder() as folder:
        yield folder


@pytest.fixture(scope="session")
def cluster_folder(open_folder: Path) -> Iterator[Path]:
    """A temporary folder for the cluster of this process, in memory if there is enough."""
    with run_folder(place_of_databases()) as folder:
        yield folder / "postgres"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images named by AMERS_REAL_DATA; tests that ask for it are skipped without."""
    named = os.environ.get("AMERS_REAL_DATA")
    if not named:
        pytest.skip("AMERS_REAL_DATA is not set: no real images to test on")
    folder = Path(named)
    if not folder.is_dir():
        pytest.fail(f"AMERS_REAL_DATA names {named}, which is not a folder")
    return folder


@pytest.fixture(scope="session")
def small_continent(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A small `benchmarks._continent.Continent`: a simulated archive as files, and its truth.

    The first process of tests that asks makes it, others wait and open it: nobody changes its files.
    """
    # Not with the others: NumPy is first imported after this file.
    from benchmarks.continent import make, open_continent

    temporary = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        temporary = temporary.parent
    folder, complete = temporary / "continent", temporary / "continent_complete"
    with (temporary / "continent_lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not complete.exists():
            make(folder, "small", seed=1)
            complete.touch()
    return open_continent(folder)
