"""Work in processes ends, also where a task cannot reach them."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.long

PATIENCE_S = 120.0
PROGRAM = """
import time
from functools import partial
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.services.tasks import Work

class Unsendable:
    def __reduce__(self):
        time.sleep(0.3)
        raise TypeError("it stays here")

if __name__ == "__main__":
    with open_executor(ComputeOptions(jobs=2)) as (executor, ahead):
        Work(executor, ahead=ahead).each("count", len, [partial(tuple, [Unsendable()])] * 6)
"""


def test_work_ends_whose_tasks_cannot_be_sent() -> None:
    """Others are on their way to the processes when the first is refused."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert "TypeError: it stays here" in done.stderr
