"""One known site carries an archipelago, by `amers points reach` on files.

The draws are those of `benchmarks.cape_verde`, written as images, files of marks and a terrain; the
command knows neither the terrain with which the ortho-images were made nor their incidence angles.
Beside the published figure: the root mean square of the residuals of all draws, and what is declared.
Run: python -m benchmarks.cape_verde_command [--draws 8]
"""

import argparse
import json
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from benchmarks._cape_verde import STEREO, draw
from benchmarks._cape_verde_files import write_files
from benchmarks._measuring import keep, open_folder, print_table
from benchmarks.cape_verde import FOUNDATIONS, PUBLISHED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    found: dict[str, list[dict[str, object]]] = {name: [] for name in FOUNDATIONS}
    for number in range(arguments.draws):
        one = draw(np.random.default_rng([arguments.seed, number]))
        for name, foundation in zip(FOUNDATIONS, (one.without(STEREO), one), strict=True):
            with open_folder() as folder:
                found[name].append(by_command(write_files(Path(folder), foundation)))
    outcome = {name: show(name, column, found[name]) for column, name in enumerate(FOUNDATIONS)}
    keep("cape_verde_command", {"date": datetime.now(UTC).isoformat(), **outcome})


def by_command(words: list[str]) -> dict[str, object]:
    """What `amers points reach` prints."""
    command = [sys.executable, "-m", "amers", "points", "reach", *words, "--json"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    return dict(json.loads(done.stdout))


def show(name: str, column: int, found: list[dict[str, object]]) -> dict[str, object]:
    """Print the published table with that of the command beside it."""
    rows = []
    for pair, published in PUBLISHED.items():
        checks = [
            check
            for one in found
            for check in one["checks"]  # type: ignore[attr-defined]
            if (check["known"], check["check"]) == pair
        ]
        covariance = np.array([check["covariance_m2"] for check in checks])[:, :2, :2]
        error = np.array([check["error_m"] for check in checks])[:, :2]
        solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
        rows.append(
            {
                "known": pair[0],
                "check": pair[1],
                "km": published[0],
                "published_m": published[1 + column],
                "rms_m": float(np.sqrt(np.mean((error**2).sum(axis=1)))),
                "declared_m": float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
                "normalised": float(np.mean((error * solved).sum(axis=1)) / 2.0),
            }
        )
    columns = {key: lambda row, key=key: _text(row[key]) for key in rows[0]}
    total = {
        key: float(np.sqrt(np.mean([row[key] ** 2 for row in rows])))
        for key in ("published_m", "rms_m", "declared_m")
    }
    total["normalised"] = float(np.mean([row["normalised"] for row in rows]))
    caption = ", ".join(f"{key} {value:.2f}" for key, value in total.items())
    print_table(f"{name}: {len(found)} draws", rows, columns, caption=caption)
    return {"draws": len(found), "rows": rows, "all": total}


def _text(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
