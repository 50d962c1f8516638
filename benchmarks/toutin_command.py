"""Toutin and Carbonneau (1992) by `amers points experiment` on marks in files, beside their figures.

The draws are those of `benchmarks.toutin`, written as images with orbits and attitudes in DIMAP and as
files of marks: points that all three images show, 1.5 m on the ground, and six tie points, marked within
2.1 m a coordinate. Root mean squares at the check points of the command, over all draws.
Run: python -m benchmarks.toutin_command [--trials 6]
"""

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from amers.services.formats.images.raster import write_raster
from amers.services.sensors.pushbroom import PushbroomModel
from benchmarks._measuring import keep, open_folder, print_table
from benchmarks.toutin import (
    ALL,
    BASE_TO_HEIGHT,
    GSD_M,
    LOOK_DEG,
    PAIRS,
    POINT_M,
    POINTING_M,
    PUBLISHED_4,
    PUBLISHED_5,
    PUBLISHED_UP,
    SHAPE,
    SIGMA_M,
    SINGLES,
    TIES,
    Draw,
    draw,
    marked,
)
from tests.services.formats.sensor_models.simulated_metadata import dimap_v2

COUNTS = (3, 4, 6, 10)
NAMES = tuple(f"IMG_{number}" for number in range(len(LOOK_DEG)))
CONFIGURATIONS: tuple[tuple[int, ...], ...] = (*SINGLES, *PAIRS, ALL)
MARK_M = POINTING_M[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=6)
    trials = parser.parse_args().trials
    squares: dict[tuple[tuple[int, ...], int], list[np.ndarray]] = {}
    for trial in range(trials):
        with open_folder() as folder:
            for row in by_command(write_files(folder, draw(trial)))["rows"]:
                members = tuple(NAMES.index(name) for name in row["images"])
                rms_m = np.array([np.nan if value is None else value for value in row["rms_m"]])
                squares.setdefault((members, row["control_points"]), []).append(rms_m**2)
    rms_m = {key: np.sqrt(np.mean(values, axis=0)) for key, values in squares.items()}
    show(rms_m, trials)
    outcome = [
        {"images": members, "control_points": count, "rms_m": values.tolist()}
        for (members, count), values in rms_m.items()
    ]
    keep("toutin_command", {"date": datetime.now(UTC).isoformat(), "trials": trials, "rows": outcome})


def write_files(folder: Path, drawn: Draw) -> list[str]:
    """Write the images and the marks of a draw; returns what follows `amers points experiment`."""
    words = [str(folder / "marks.csv"), "--rigorous", "toutin", "--sigma-m", f"{SIGMA_M:g}"]
    for name, image in zip(NAMES, drawn.truth.images, strict=True):
        path = folder / f"{name}.tif"
        write_raster(path, np.zeros(SHAPE, np.uint8))
        model = image.model
        assert isinstance(model, PushbroomModel)
        (folder / f"DIM_{name.removeprefix('IMG_')}.XML").write_text(dimap_v2(model))
        words += ["--images", str(path)]
    count = len(drawn.known) - TIES
    points = np.flatnonzero(drawn.shown.all(axis=1))
    marks = marked(drawn, ALL, points, MARK_M)
    half = np.array(SHAPE) / 2.0
    outside = (np.abs(marks.line_sample + 0.5 - half) > half).any(axis=1)
    marks = marks.take(~np.isin(marks.point, marks.point[outside]))
    with (folder / "marks.csv").open("w", newline="") as file:
        file.write("# pixel-origin=centre heights=ellipsoid\n")
        rows = csv.writer(file)
        rows.writerow(["id", "image", "line", "sample", "lon", "lat", "height_m"])
        for point, image, at in zip(marks.point, marks.image, marks.line_sample, strict=True):
            known = [repr(value) for value in drawn.known[point].tolist()]
            ground = known if point < count else ["", "", ""]
            rows.writerow([f"P{point}", NAMES[image], *map(repr, at.tolist()), *ground])
    words += ["--mark-sigma-px", f"{MARK_M / GSD_M:.3f}", "--point-sigma-m", f"{POINT_M},{POINT_M}"]
    return [*words, "--control-points", ",".join(map(str, COUNTS)), "--draws", "2"]


def by_command(words: Sequence[str]) -> dict[str, Any]:
    """What `amers points experiment` prints."""
    command = [sys.executable, "-m", "amers", "points", "experiment", *words, "--json"]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    return dict(json.loads(done.stdout))


def show(rms_m: Mapping[tuple[tuple[int, ...], int], np.ndarray], trials: int) -> None:
    """Print what the command measured, beside the published tables 4 and 5 and the graphs."""

    def published(members: tuple[int, ...]) -> str:
        if members in PUBLISHED_4:
            return f"{_metres(PUBLISHED_4[members])}; {_metres(PUBLISHED_5[members])}"
        return f"Z {PUBLISHED_UP[members]:.0f}" if members in PUBLISHED_UP else ""

    columns: dict[str, Any] = {
        "images": lambda members: ", ".join(f"{LOOK_DEG[image]:.1f}" for image in members),
        "B/H": lambda members: BASE_TO_HEIGHT.get(members, ""),
        "published, 6": published,
    }
    for count in COUNTS:
        columns[str(count)] = lambda members, count=count: _metres(rms_m[_key(rms_m, members, count)])
    print_table(f"check points, X, Y, Z, m, {trials} files", CONFIGURATIONS, columns, width=150)


def _key(rms_m: Mapping[Any, Any], members: tuple[int, ...], count: int) -> Any:
    return next(key for key in rms_m if set(key[0]) == set(members) and key[1] == count)


def _metres(values: Sequence[float] | np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in values if value > 0.0)


if __name__ == "__main__":
    main()
