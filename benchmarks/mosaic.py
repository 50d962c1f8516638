"""Mosaics of real scenes: the steps at their seams with adjusted and with delivered models.

Needs AMERS_REAL_DATA, a folder with `wv3_jacksonville` (a town, nine dates) and `phr_calanques_triplet`
(hills, three views of one pass, and the surface that S2P made of them), a block of either with adjusted
models, as `amers production run` makes them, and a surface of the town by `amers surface make`. All
scenes of a place show all of it; of each, a strip is left that overlaps the next ones. *Seam* is the
median difference of levelled grey values along the seams over that in the whole overlaps, *straight* the
same along lines in the middle of the overlaps.
Run: python -m benchmarks.mosaic --town BLOCK --hills BLOCK --surface FILE
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

from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.source import ImageSource, Window
from amers.services.mosaic.layout import MosaicMap, MosaicScene, common_window, inside, lay_out
from amers.services.mosaic.mosaic import Mosaic, make_mosaic, mosaic_tiles
from amers.services.mosaic.options import MosaicOptions
from amers.services.mosaic.seams import CellImages
from amers.services.mosaic.steps import StepFigures
from amers.services.tasks import Work
from amers.services.types import FloatImage
from benchmarks._measuring import keep, memory_mib, print_table

TOWN, HILLS = "wv3_jacksonville", "phr_calanques_triplet"
SETS = {
    "town, a week apart": (TOWN, ("001", "003")),
    "town, three dates": (TOWN, ("001", "003", "018")),
    "town, nine dates": (TOWN, ("001", "003", "005", "009", "010", "012", "016", "018", "019")),
    "hills, one pass": (HILLS, ("01", "02", "03")),
}
GSD_M = {TOWN: 0.4, HILLS: 0.5}
OVERLAP = 0.5
"""Share of a strip that the next one shows as well."""


@dataclass(frozen=True)
class Strip:
    """Some columns of an image; the others have no data."""

    image: ImageSource
    first: int
    last: int

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the strip."""
        pixels = self.image.read(window)
        samples = np.arange(window.sample, window.sample + window.samples)
        pixels[:, (samples < self.first) | (samples >= self.last)] = np.nan
        return pixels


@dataclass(frozen=True)
class Outcome:
    """One mosaic; see the module."""

    scenes: str
    pixels: int
    places: int
    found: int
    median_m: float
    p90_m: float
    delivered_found: int
    delivered_median_m: float
    delivered_p90_m: float
    seam: float
    straight: float
    cpu_s: float
    memory_mib: float


def outcome(folder: Path, block: Path, surface: Path, name: str) -> Outcome:
    """The mosaic of one set of scenes."""
    data, numbers = SETS[name]
    stems = [f"{'jax' if data == TOWN else 'img'}_{number}" for number in numbers]
    scenes = [strip(folder / data, block, stem, k, len(stems)) for k, stem in enumerate(stems)]
    terrain = read_dem(surface, "ellipsoid" if data == HILLS else None, fill_px=50)
    begun = time.process_time()
    layout = lay_out(scenes, terrain, MosaicMap(gsd_m=GSD_M[data]))
    work = Work()
    mosaic = make_mosaic(layout, terrain, MosaicOptions(level=True), work=work)
    pixels = sum(int((tile.source > 0).sum()) for tile in mosaic_tiles(mosaic))
    cpu_s = time.process_time() - begun
    steps = mosaic.steps
    assert steps is not None
    assert steps.delivered is not None
    seam, straight = along_seams(
        mosaic, [work.kept[f"cells/{k:05d}"]["pixels"] for k in range(len(scenes))]
    )
    used, delivered = steps.used, steps.delivered
    return Outcome(
        name,
        pixels,
        steps.places,
        used.found,
        *lengths(used),
        delivered.found,
        *lengths(delivered),
        seam,
        straight,
        cpu_s,
        memory_mib("VmHWM"),
    )


def lengths(figures: StepFigures) -> tuple[float, float]:
    """Median and 90th percentile."""
    return figures.median_m, figures.p90_m


def strip(folder: Path, block: Path, stem: str, number: int, count: int) -> MosaicScene:
    """A strip of a scene, the first in the west, with its adjusted and its delivered model."""
    delivered = read_scene(folder / f"{stem}.tif", sigma_m=1.0)
    adjusted = read_scene(folder / f"{stem}.tif", block / "models" / f"{stem}_RPC.TXT", sigma_m=1.0)
    image = delivered.image
    assert isinstance(image, RasterImage)
    samples = image.shape[1]
    width = samples / (1.0 + (count - 1) * (1.0 - OVERLAP))
    first = round(number * width * (1.0 - OVERLAP))
    bands = tuple(
        Strip(image.with_mix(one_band(band)), first, round(first + width))
        for band in image.validity.image_bands
    )
    return MosaicScene(adjusted, bands, delivered.model)


def along_seams(mosaic: Mosaic, images: list[FloatImage]) -> tuple[float, float]:
    """Median differences along the seams and along straight lines, over those in the overlaps."""
    layout = mosaic.layout
    cells = CellImages(layout, images, mosaic.levels)
    cut, straight, whole = [], [], []
    for first, second in layout.overlapping():
        window = common_window(layout.cell_window(first), layout.cell_window(second))
        assert window is not None
        a, b = cells.read(first, window), cells.read(second, window)
        difference = np.abs(a - b).mean(axis=0)
        known = np.isfinite(difference)
        labels = mosaic.labels[inside(window, Window(0, 0, *mosaic.labels.shape))]
        near = [cv2.dilate((labels == k + 1).astype(np.uint8), np.ones((3, 3))) for k in (first, second)]
        on_seam = (near[0] > 0) & (near[1] > 0) & known
        if not on_seam.any():
            continue
        cut.append(difference[on_seam])
        whole.append(difference[known])
        middle = np.median(np.where(known, np.arange(known.shape[1]), np.nan)[known])
        straight.append(
            difference[:, int(middle) : int(middle) + 2][known[:, int(middle) : int(middle) + 2]]
        )
    middle_m = float(np.median(np.concatenate(whole)))
    return (
        float(np.median(np.concatenate(cut))) / middle_m,
        float(np.median(np.concatenate(straight))) / middle_m,
    )


def main() -> None:
    """Make all mosaics, and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--town", type=Path, required=True, help=f"block of {TOWN}")
    parser.add_argument("--hills", type=Path, required=True, help=f"block of {HILLS}")
    parser.add_argument("--surface", type=Path, required=True, help=f"surface of {TOWN}")
    parser.add_argument("--only", help="part of the names of the sets")
    arguments = parser.parse_args()
    folder = Path(os.environ["AMERS_REAL_DATA"])
    blocks = {TOWN: arguments.town, HILLS: arguments.hills}
    surfaces = {TOWN: arguments.surface, HILLS: folder / HILLS / "expected_output/dsm.tif"}
    names = [name for name in SETS if (arguments.only or "") in name]
    first = SETS[names[0]][0]
    outcome(folder, blocks[first], surfaces[first], names[0])  # compiles
    outcomes = [outcome(folder, blocks[SETS[name][0]], surfaces[SETS[name][0]], name) for name in names]
    keep("mosaic", [asdict(one) for one in outcomes])
    print_table(
        "Mosaics",
        outcomes,
        {
            "scenes": lambda one: one.scenes,
            "places": lambda one: one.places,
            "found": lambda one: f"{one.found}, {one.delivered_found}",
            "median, m": lambda one: f"{one.median_m:.2f}",
            "90 %, m": lambda one: f"{one.p90_m:.2f}",
            "delivered": lambda one: f"{one.delivered_median_m:.2f}",
            "90 %, m ": lambda one: f"{one.delivered_p90_m:.2f}",
            "seam": lambda one: f"{one.seam:.2f}",
            "straight": lambda one: f"{one.straight:.2f}",
            "Mpx": lambda one: f"{one.pixels / 1e6:.2f}",
            "CPU s": lambda one: f"{one.cpu_s:.1f}",
            "MiB": lambda one: f"{one.memory_mib:.0f}",
        },
        width=140,
    )


if __name__ == "__main__":
    main()
