"""Surfaces of real pairs and blocks beside lidar and beside the surface of another program.

Needs AMERS_REAL_DATA, a folder with `wv3_jacksonville` (nine dates and a lidar surface) and
`phr_calanques_triplet` (three views of one pass and the surface that S2P made of them), and a block of
either with adjusted models, as `amers production run` makes them. *Within 1 m* is the share of all cells
of the lidar surface, also of those without a height; its vertical datum is not stated, so that the
median is removed, and the horizontal offset is estimated to a cell. *Holds* are the shares of the 90 %
intervals that contain the truth, of all cells and of those whose surroundings are flat.
Run: python -m benchmarks.surface --town BLOCK --hills BLOCK [--cars COMMAND]
"""

import os

# Read by Numba when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio

from amers.services.formats.images.scenes import read_scene
from amers.services.map_grid import MapGrid
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.surface import make_surface, surface_tiles
from amers.services.types import Array, FloatImage
from benchmarks._cars import cars_surface
from benchmarks._measuring import keep, memory_mib, print_table

TOWN, HILLS = "wv3_jacksonville", "phr_calanques_triplet"
SETS = {
    "a week apart, B/H 0.61": (TOWN, ("001", "003")),
    "a month apart, B/H 0.31": (TOWN, ("018", "019")),
    "six weeks apart, B/H 0.48": (TOWN, ("016", "019")),
    "one pass, B/H 0.19": (TOWN, ("009", "010")),
    "three dates": (TOWN, ("016", "018", "019")),
    "five dates": (TOWN, ("001", "003", "016", "018", "019")),
    "nine dates": (TOWN, ("001", "003", "005", "009", "010", "012", "016", "018", "019")),
    "pair of one pass": (HILLS, ("01", "03")),
    "triplet of one pass": (HILLS, ("01", "02", "03")),
}
LARGEST_OF_PEER = 3
"""Scenes of the largest set that CARS makes too: its pairs take a minute and more."""
FLAT_M = 0.3
"""Largest range of the truth within 5 x 5 cells of flat ground."""
OFFSETS = range(-4, 5)
FAR = 5.0
"""Errors of more sigmas are counted."""


@dataclass(frozen=True)
class Outcome:
    """One surface beside the truth; see the module."""

    scenes: str
    made: str
    pairs: int
    covered: float
    within_1_m: float
    bias_m: float | None
    nmad_m: float
    flat_nmad_m: float
    le90_m: float
    holds: float | None
    holds_flat: float | None
    beyond_5_sigma: float | None
    cpu_s: float
    memory_mib: float


def outcome(folder: Path, block: Path, name: str, fill_cells: int) -> Outcome:
    """A surface of one set of scenes over the grid of the truth."""
    images = images_of(folder, block, name)
    truth, grid = truth_of(folder, name)
    scenes = [read_scene(image, model, sigma_m=1.0) for image, model in images.items()]
    begun = time.process_time()
    surface = make_surface(scenes, SurfaceOptions(fill_cells=fill_cells), grid=grid)
    heights, sigmas = (np.full(grid.shape, np.nan, dtype=np.float32) for _ in range(2))
    for tile in surface_tiles(surface):
        w = tile.window
        place = np.s_[w.line : w.line + w.lines, w.sample : w.sample + w.samples]
        heights[place], sigmas[place] = tile.height_m, tile.sigma_m
    took = (time.process_time() - begun, memory_mib("VmHWM"))
    made = f"{fill_cells} cells filled"
    return judged(name, made, len(surface.pairs), (heights, sigmas, truth), took)


def peer(folder: Path, block: Path, name: str, command: str) -> Outcome | None:
    """The surface that CARS makes of one set of scenes, which states no sigmas; None where it fails."""
    images = images_of(folder, block, name)
    truth, grid = truth_of(folder, name)
    made = cars_surface(command, images, grid)
    if made is None:
        return None
    count = len(images) * (len(images) - 1) // 2
    heights = (made.heights, np.full(grid.shape, np.nan, dtype=np.float32), truth)
    return judged(name, "CARS", count, heights, (made.cpu_s, made.memory_mib))


def judged(
    name: str,
    made: str,
    pairs: int,
    heights: tuple[FloatImage, FloatImage, FloatImage],
    took: tuple[float, float],
) -> Outcome:
    """Heights and sigmas beside the truth."""
    found, sigmas, truth = heights
    town = SETS[name][0] == TOWN
    error_m, sigma_m = (beside if town else straight)(found, sigmas, truth)
    known, flat = np.isfinite(error_m), np.isfinite(error_m) & flat_cells(truth)
    hits = np.abs(error_m) < 1.6449 * sigma_m
    stated = bool(np.isfinite(sigmas).any())
    return Outcome(
        name,
        made,
        pairs,
        float(np.isfinite(found).mean()),
        float((np.abs(error_m[known]) < 1.0).sum() / np.isfinite(truth).sum()),
        None if town else float(np.median(error_m[known])),
        nmad(error_m[known]),
        nmad(error_m[flat]),
        float(np.quantile(np.abs(error_m[known]), 0.9)),
        float(hits[known].mean()) if stated else None,
        float(hits[flat].mean()) if stated else None,
        float((np.abs(error_m) > FAR * sigma_m)[known].mean()) if stated else None,
        *took,
    )


def images_of(folder: Path, block: Path, name: str) -> dict[Path, Path]:
    """The images of a set, and the files of their adjusted models."""
    data, numbers = SETS[name]
    stems = [f"{'jax' if data == TOWN else 'img'}_{number}" for number in numbers]
    return {folder / data / f"{s}.tif": block / "models" / f"{s}_RPC.TXT" for s in stems}


def truth_of(folder: Path, name: str) -> tuple[FloatImage, MapGrid]:
    """The heights that a set is compared with, and their grid."""
    data = SETS[name][0]
    return read_truth(folder / data / ("lidar_west.tif" if data == TOWN else "expected_output/dsm.tif"))


def read_truth(path: Path) -> tuple[FloatImage, MapGrid]:
    """The heights in a file, and their grid."""
    with rasterio.open(path) as file:
        truth = file.read(1, masked=True).astype(np.float32).filled(np.nan)
        at, crs = file.transform, file.crs.to_wkt()
    origin = np.array([at.c + at.a / 2.0, at.f + at.e / 2.0])
    return truth, MapGrid(crs, origin, np.array([[0.0, at.a], [at.e, 0.0]]), truth.shape)


def straight(heights: FloatImage, sigmas: FloatImage, truth: FloatImage) -> tuple[Array, Array]:
    """Errors and sigmas where the datum and the place of the truth are known."""
    return heights - truth, sigmas


def beside(heights: FloatImage, sigmas: FloatImage, truth: FloatImage) -> tuple[Array, Array]:
    """Errors and sigmas at the offset in whole cells that leaves the smallest errors, median removed."""

    def at(down: int, right: int) -> tuple[float, Array, Array]:
        matrix = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
        moved = [
            cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_NEAREST, borderValue=np.nan)
            for image in (heights, sigmas)
        ]
        error_m = moved[0] - truth
        error_m -= np.nanmedian(error_m)
        return float(np.nanmean(np.minimum(np.abs(error_m), 2.0))), error_m, np.asarray(moved[1])

    tried = (at(down, right) for down in OFFSETS for right in OFFSETS)
    return min(tried, key=lambda one: one[0])[1:]


def flat_cells(truth: FloatImage) -> Array:
    """Where the truth varies by less than `FLAT_M` around."""
    extent = cv2.morphologyEx(np.nan_to_num(truth, nan=1e6), cv2.MORPH_GRADIENT, np.ones((5, 5)))
    return np.asarray(extent < FLAT_M)


def nmad(errors: Array) -> float:
    """Robust standard deviation around the median."""
    return float(1.4826 * np.median(np.abs(errors - np.median(errors))))


def share(value: float | None, digits: int) -> str | None:
    """A share as text; None where there is none."""
    return None if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Make all surfaces, with gaps and filled, and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--town", type=Path, required=True, help=f"block of {TOWN}")
    parser.add_argument("--hills", type=Path, required=True, help=f"block of {HILLS}")
    parser.add_argument("--cars", help="command of CARS, which makes the same surfaces")
    parser.add_argument("--only", help="part of the names of the sets")
    arguments = parser.parse_args()
    folder = Path(os.environ["AMERS_REAL_DATA"])
    blocks = {TOWN: arguments.town, HILLS: arguments.hills}
    names = [name for name in SETS if (arguments.only or "") in name]
    outcome(folder, blocks[SETS[names[0]][0]], names[0], 0)  # compiles
    outcomes = []
    for name in names:
        block = blocks[SETS[name][0]]
        for cells in (0, SurfaceOptions().fill_cells):
            outcomes.append(outcome(folder, block, name, cells))
        if arguments.cars and len(SETS[name][1]) <= LARGEST_OF_PEER:
            other = peer(folder, block, name, arguments.cars)
            outcomes += [other] if other else []
    keep("surface", [asdict(one) for one in outcomes])
    print_table(
        "Surfaces",
        outcomes,
        {
            "scenes": lambda one: one.scenes,
            "made": lambda one: one.made,
            "pairs": lambda one: one.pairs,
            "covered": lambda one: f"{one.covered:.3f}",
            "within 1 m": lambda one: f"{one.within_1_m:.3f}",
            "bias, m": lambda one: None if one.bias_m is None else f"{one.bias_m:+.3f}",
            "NMAD, m": lambda one: f"{one.nmad_m:.3f}",
            "flat, m": lambda one: f"{one.flat_nmad_m:.3f}",
            "LE90, m": lambda one: f"{one.le90_m:.2f}",
            "holds": lambda one: share(one.holds, 2),
            "holds, flat": lambda one: share(one.holds_flat, 2),
            "5 sigma": lambda one: share(one.beyond_5_sigma, 4),
            "CPU s": lambda one: f"{one.cpu_s:.1f}",
            "MiB": lambda one: f"{one.memory_mib:.0f}",
        },
        width=140,
    )


if __name__ == "__main__":
    main()
