"""The whole command `scene register` beside the registration itself, by the size of the image.

A flat world whose texture repeats itself, in images of 2,000 and of 20,000 px a side: 16 bits, in tiles,
compressed or not, with overviews or without. CPU times are those of `register_scene` in a warm process,
checks of the pixels included; of the same with all files and the report, as for each scene but the first
of a command or of a worker; and of the command as a process of its own, its start included. Memory is
the largest of the command.
Run: python -m benchmarks.whole_command
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import rasterio
from rasterio.enums import Resampling

from amers.app.one_thread import ONE_THREAD
from amers.app.usecases.registration.control_sources import points_of_block
from amers.app.usecases.registration.register import ControlSources, SceneFiles, run_registration
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.source import Window
from amers.services.registration.on_points import register_scene
from amers.services.types import FloatImage
from benchmarks._measuring import cpu_medians_s, keep, open_folder, print_table
from tests.app.flat_world import SHIFT_PX, SIGMA_M, flat_model, flat_texture, write_flat_block

PERIOD = 2_000
"""Lines and samples of the texture, which is repeated in mirror images."""
POINTS = {2_000: 40, 20_000: 450}
"""Of the block, by the size of the image: 40 a square kilometre, and what SRP takes of a scene."""
STRIP = 512
OVERVIEWS = "deflate, overviews"
PROGRAM = """
import atexit, sys, time
from benchmarks._measuring import memory_mib
atexit.register(lambda: print(time.process_time(), memory_mib("VmHWM"), file=sys.stderr))
from amers.app.cli.main import main
main()
"""
"""The command, which prints its CPU time and its largest memory at its end."""
FORMS = {"tiles": None, "deflate": "deflate", OVERVIEWS: "deflate"}
"""Compression, by what rows call it."""


@dataclass(frozen=True)
class Repeated:
    """An image source of any size whose texture repeats itself, mirrored so that it has no edges."""

    tile: FloatImage
    size: int

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.size, self.size

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, also beyond the image."""
        lines, samples = (
            _mirrored(np.arange(first, first + count), self.tile.shape[0])
            for first, count in ((window.line, window.lines), (window.sample, window.samples))
        )
        return self.tile[np.ix_(lines, samples)]


def _mirrored(index: "np.ndarray", period: int) -> "np.ndarray":
    there = index % (2 * period)
    return np.where(there < period, there, 2 * period - 1 - there)


@dataclass(frozen=True)
class Row:
    """One image.

    Attributes:
        size: lines and samples.
        form: how its pixels lie in the file.
        alone_s: CPU time of the registration in a warm process, median of the runs.
        warm_s: of the registration with its files and its report there.
        command_s: of the whole command, median.
        memory_mib: largest resident memory of the command.
    """

    size: int
    form: str
    alone_s: float
    warm_s: float
    command_s: float
    memory_mib: float


def write_scene(path: Path, source: Repeated, compress: str | None) -> None:
    """Write an image in tiles, strip by strip, with a delivered model that is off by `SHIFT_PX`."""
    rng = np.random.default_rng(3)
    truth = flat_model(source.size)
    delivered = replace(truth, image_offset=truth.image_offset - SHIFT_PX)
    profile = {"driver": "GTiff", "width": source.size, "height": source.size, "count": 1}
    profile |= {"dtype": "uint16", "tiled": True, "blockxsize": STRIP, "blockysize": STRIP}
    with rasterio.open(path, "w", **profile, **({"compress": compress} if compress else {})) as file:
        for line in range(0, source.size, STRIP):
            lines = min(STRIP, source.size - line)
            strip = source.read(Window(line, 0, lines, source.size))
            strip += rng.normal(0.0, 20.0, strip.shape)
            window = rasterio.windows.Window(0, line, source.size, lines)
            file.write(np.clip(np.rint(strip), 1.0, 4095.0).astype(np.uint16), 1, window=window)
        file.rpcs = gdal_rpc(delivered)


def in_this_process(image: Path, block: Path, repeats: int) -> tuple[float, float]:
    """CPU times of the registration, alone and with files and report, median of the warm runs."""
    points, chips = read_block(block).points, FolderChips(block)
    sources, files = ControlSources(points_of_block(block)), SceneFiles(image, sigma_m=SIGMA_M)
    ways = {
        "alone": lambda: register_scene(read_scene(image, sigma_m=SIGMA_M), points, chips),
        "warm": lambda: run_registration(files, sources, block.with_name("warm")),
    }
    taken = cpu_medians_s(ways, repeats)
    return taken["alone"], taken["warm"]


def measured(folder: Path, size: int, form: str, image: Path, repeats: int) -> Row:
    """The CPU times of one image."""
    block, environment = folder / f"block_{size}", os.environ | ONE_THREAD
    words = [sys.executable, "-m", "benchmarks.whole_command", "--alone", image, block]
    words += ["--repeats", repeats]
    told = subprocess.check_output([*map(str, words)], env=environment, text=True).split()
    words = ["scene", "register", image, "--block", block, "--sigma-m", SIGMA_M, "-o", folder / "out"]
    command, peak_mib = [], 0.0
    for _ in range(repeats):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, *map(str, words)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        cpu_s, mib = map(float, done.stderr.split()[-2:])
        command.append(cpu_s)
        peak_mib = max(peak_mib, mib)
    return Row(size, form, float(told[-2]), float(told[-1]), median(command), peak_mib)


def main() -> None:
    """Measure all images, print the table and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--sizes", type=int, nargs="+", default=[*POINTS])
    parser.add_argument("--alone", type=Path, nargs=2, help="image and block: print the registration's")
    arguments = parser.parse_args()
    if arguments.alone:
        print(*in_this_process(*arguments.alone, arguments.repeats))
        return
    rng = np.random.default_rng(5)
    tile = flat_texture(PERIOD, rng)
    rows = []
    with open_folder() as folder:
        for size in arguments.sizes:
            source = Repeated(tile, size)
            write_flat_block(
                folder / f"block_{size}", flat_model(size), [source, source], POINTS[size], rng
            )
            image = folder / f"scene_{size}.tif"
            for form in FORMS:
                if form == OVERVIEWS:
                    with rasterio.open(image, "r+") as file:
                        file.build_overviews([2, 4, 8, 16], Resampling.average)
                else:
                    write_scene(image, source, FORMS[form])
                rows.append(measured(folder, size, form, image, arguments.repeats))
                print(rows[-1], flush=True)
            image.unlink()
    keep("whole_command", [asdict(row) for row in rows])
    columns: dict[str, Callable[[Row], object]] = {
        "size": lambda row: row.size,
        "form": lambda row: row.form,
        "registration, s": lambda row: f"{row.alone_s:.2f}",
        "command, s": lambda row: f"{row.command_s:.2f}",
        "with files, ratio": lambda row: f"{row.warm_s / row.alone_s:.2f}",
        "command, ratio": lambda row: f"{row.command_s / row.alone_s:.2f}",
        "memory, MiB": lambda row: f"{row.memory_mib:.0f}",
    }
    print_table("`amers scene register` beside its registration, CPU time", rows, columns)


if __name__ == "__main__":
    main()
