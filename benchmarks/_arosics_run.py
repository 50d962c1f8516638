"""Tie points of an ortho pair by AROSICS, told as JSON; run by an interpreter that has AROSICS.

Filtered by reliability and likeness, not by RANSAC, which fails with some versions of its libraries:
that spares AROSICS time and leaves it more tie points.

Run: PYTHON _arosics_run.py REFERENCE TARGET GRID_PX LARGEST_SHIFT_PX
"""

import json
import sys
import time

from arosics import COREG_LOCAL


def main() -> None:
    """Find tie points on one core, and tell CPU time, how many were tried and how many accepted."""
    reference, target, grid_px, largest_px = sys.argv[1:]
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
    shift = accepted[["X_SHIFT_M", "Y_SHIFT_M"]].median()
    told = {"tried": len(table), "accepted": len(accepted), "cpu_s": cpu_s}
    told |= {"east_m": float(shift["X_SHIFT_M"]), "north_m": float(shift["Y_SHIFT_M"])}
    print(json.dumps(told))


if __name__ == "__main__":
    main()
