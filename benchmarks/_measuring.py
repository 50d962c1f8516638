"""CPU times taken in turn, memory, the folder of a run, its table, and where figures are kept."""

import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).parent / "results"


def cpu_medians_s(ways: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median CPU time of each way of doing a thing, all threads of the process counted.

    The ways are run in turn, so that what else the machine does weighs on all of them; the first turn,
    which compiles and warms up, is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(repeats + 1):
        for name, way in ways.items():
            start = time.process_time()
            way()
            if turn > 0:
                times[name].append(time.process_time() - start)
    return {name: median(taken) for name, taken in times.items()}


def keep(name: str, outcome: Any) -> None:
    """Write the figures of a benchmark where the last ones were."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(outcome, indent=1) + "\n")


def memory_mib(name: str) -> float:
    """Resident memory of this process, now (VmRSS) or at its highest (VmHWM).

    `getrusage` would tell the peak of the parent where that was higher: it survives `exec`.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith(f"{name}:"))


@contextmanager
def open_folder(prefix: str = "amers-bench-") -> Iterator[Path]:
    """A temporary folder that the user of a database server can enter."""
    with tempfile.TemporaryDirectory(prefix=prefix, dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def print_table(
    title: str,
    rows: Iterable[Any],
    columns: Mapping[str, Callable[[Any], object]],
    *,
    width: int | None = None,
    caption: str | None = None,
) -> None:
    """Print a line for each row; a column is a function of the row, empty where that gives None."""
    table = Table(*columns, title=title, caption=caption)
    for row in rows:
        cells = [cell(row) for cell in columns.values()]
        table.add_row(*("" if cell is None else str(cell) for cell in cells))
    Console(width=width).print(table)
