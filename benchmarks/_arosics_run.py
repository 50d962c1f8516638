"""Tie points of an ortho pair by AROSICS, told as JSON; run by an interpreter that has AROSICS.

Filtered by reliability and likeness, not by RANSAC, which fails with some versions of its libraries:
that spares AROSICS time and leaves it more tie points.

Run: PYTHON _arosics_run.py REFERENCE TARGET GRID_PX LARGEST_SHIFT_PX
"""

import json
import sys
import time
from pathlib import Path

from arosics import COREG_LOCAL


def main() -> None:
    """Find tie points on one core, and tell CPU time, memory, how many were tried and what was found."""
    reference, target, grid_px, largest_px = sys.argv[1:]
    start_mib = memory_mib("VmRSS")
    start = time.process_time()
    found = COREG_LOCAL(
        reference,
        target,
        grid_res=int(grid_px),
        max_shift=int(largest_px),
        window_size=(256, 256),
        tieP_filter_level=2,
        CPUs=1,
        progress=False,
        q=True,
    )
    table = found.CoRegPoints_table
    cpu_s = time.process_time() - start
    matched = table[table["X_SHIFT_M"] != -9999]
    accepted = matched[~matched["OUTLIER"].astype(bool)]
    told = {"tried": len(table), "cpu_s": cpu_s, "start_mib": start_mib, "peak_mib": memory_mib("VmHWM")}
    told |= {"east_m": accepted["X_SHIFT_M"].tolist(), "north_m": accepted["Y_SHIFT_M"].tolist()}
    print(json.dumps(told))


def memory_mib(name: str) -> float:
    """Resident memory of this process, now (VmRSS) or at its highest (VmHWM)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith(f"{name}:"))


if __name__ == "__main__":
    main()
