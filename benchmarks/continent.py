"""A simulated continent in small: an archive of images over years, control, and the truth apart.

`make` writes what a user has (see `benchmarks._continent`): 40 images of 11 km from 6 passes over 22 x
22 km, with clouds, seasons, changes on the ground, location errors of 5 m that a pass shares, drifts and
jitter; an older block, an elevation model and ortho-images as control; 20 later images that no
production sees. Existing files are kept: an interrupted run goes on where it was.

`judge` compares a block with the truth: errors of its points against what it declares, density, and
the later images registered on it.

Run: python -m benchmarks.continent make FOLDER [--size small] [--seed 1] [--jobs 2]
     python -m benchmarks.continent judge FOLDER --block BLOCK [--points 300]
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console

from amers.services.formats.block.reader import FolderChips, read_block
from benchmarks._campaign import run_campaign
from benchmarks._continent import SIZES, Continent, make_truth, open_continent
from benchmarks._continent_archive import write_archive_catalogue, write_image
from benchmarks._continent_control import write_control
from benchmarks._continent_judged import judge_density, never_found, register_later
from benchmarks._continent_points import judge_points, true_places
from benchmarks._measuring import keep, memory_mib


def main() -> None:
    """Make a continent or judge a block, and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=["make", "judge"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", choices=[*SIZES], default="continent")
    parser.add_argument("--seed", type=int, default=1, help="of the random numbers (%(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    parser.add_argument("--block", type=Path, help="folder of the block to judge")
    parser.add_argument("--points", type=int, default=300, help="truly placed (%(default)s)")
    arguments = parser.parse_args()
    say = Console().print
    if arguments.command == "make":
        make(arguments.folder, arguments.size, arguments.seed, arguments.jobs, say)
    elif arguments.block is None:
        parser.error("judge: no block given; add --block with its folder")
    else:
        continent = open_continent(arguments.folder)
        judgement = judge(continent, arguments.block, arguments.points, say)
        say(judgement)
        keep(f"continent_{continent.size_name}", judgement)


def judge(
    continent: Continent,
    block: Path,
    most_points: int,
    say: Callable[[str], object] = lambda words: None,
) -> dict[str, Any]:
    """What the truth says of a block: its points, its density, and later images registered on it.

    Args:
        continent: that its images show.
        block: its folder.
        most_points: number of points, spread at random, whose true place is found.
        say: receives what is done.
    """
    points, chips = read_block(block).points, FolderChips(block)
    rng = np.random.default_rng(continent.seed)
    rows = np.sort(rng.permutation(len(points))[:most_points])
    places = true_places(continent, points, chips, rows, say)
    of_points = judge_points(points, places)
    later = register_later(
        continent, points, chips, places.lon_lat_h, np.array(of_points.frame_error_m), say=say
    )
    chips.close()
    return {
        "points": asdict(of_points),
        "density": asdict(judge_density(continent, points)),
        "never_found": never_found(later),
        "later": {scene.name: asdict(scene.outcome) for scene in later},
    }


def make(
    folder: Path,
    size: str = "continent",
    seed: int = 1,
    jobs: int = 1,
    say: Callable[[str], object] = lambda words: None,
) -> Continent:
    """The continent in a folder, after making the files that are missing.

    Args:
        folder: of all files.
        size: "continent" or "small".
        seed: of everything.
        jobs: processes that render.
        say: receives what is done and what it took.

    Raises:
        InputError: the folder has a continent of another size or seed.
    """
    started = time.monotonic()
    continent = make_truth(folder, size, seed)
    write_archive_catalogue(continent)
    say(f"world and catalogue: {time.monotonic() - started:.0f} s, {memory_mib('VmHWM'):.0f} MiB")
    names = [f"archive/images/{name}.tif" for name in continent.views]
    names += [f"later/{name}.tif" for name in continent.later]
    missing = [name for name in names if not (folder / name).exists()]
    peaks = run_campaign({name: name for name in missing}, partial(_write, folder), jobs=jobs).values()
    say(f"{len(missing)} images: {time.monotonic() - started:.0f} s")
    write_control(continent)
    seconds, peak_mib = time.monotonic() - started, max([*peaks, memory_mib("VmHWM")])
    say(f"control: {seconds:.0f} s from the start, at most {peak_mib:.0f} MiB a process")
    _keep_costs(continent, seconds, peak_mib, len(missing))
    return continent


def _write(folder: Path, name: str) -> float:
    """Write one image; returns the largest memory of the process so far, MiB."""
    cv2.setNumThreads(1)
    continent = open_continent(folder)
    path = folder / name
    views = continent.later if path.parent.name == "later" else continent.views
    write_image(continent, views[path.stem], path)
    return memory_mib("VmHWM")


def _keep_costs(continent: Continent, seconds: float, peak_mib: float, images: int) -> None:
    costs = {"seconds": round(seconds), "peak_mib_a_process": round(peak_mib), "images": images}
    if images:
        (continent.truth / "costs.json").write_text(json.dumps(costs, indent=1))


if __name__ == "__main__":
    main()
