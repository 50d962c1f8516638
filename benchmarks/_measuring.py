"""CPU times taken in turn, memory, and where figures are kept."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

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
