"""What every test may ask for."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.runs import end_dead_runs, run_folder

settings.register_profile("amers", deadline=None)
settings.load_profile("amers")

# Read by the linear algebra when NumPy is first imported, which is after this file.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long modules first: one that is begun last leaves the other cores without work.

    Of these, those of the science come before those of services whose workers are killed while they
    work: these find the kernels compiled.
    """
    items.sort(
        key=lambda item: (
            item.get_closest_marker("long") is None,
            not item.nodeid.startswith("tests/services/"),
        )
    )


@pytest.fixture(scope="session")
def open_folder() -> Iterator[Path]:
    """A short temporary folder that the server's user can pass, unlike pytest's own."""
    end_dead_runs()
    with run_folder() as folder:
        yield folder


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
