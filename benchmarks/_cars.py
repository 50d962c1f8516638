"""CARS (CNES), the program that surfaces are compared with: installed apart, run as a command.

It takes images with models as tags and writes a surface; `pip install cars` in an environment of its own
gives the command.
"""

import json
import os
import resource
import subprocess
import tempfile
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import rasterio
from rasterio.rpc import RPC
from rasterio.warp import Resampling, reproject

from amers.services.map_grid import MapGrid
from amers.services.types import FloatImage

MOST_S = 1800.0
"""Seconds after which a run is ended."""
GREEN = 2
"""Band of a colour image that is matched, as Amers takes it."""


@dataclass(frozen=True)
class Made:
    """The surface of one run.

    Attributes:
        heights: (lines, samples) over the cells that were asked for; NaN for none.
        cpu_s: of all its processes.
        memory_mib: of the largest of its processes.
    """

    heights: FloatImage
    cpu_s: float
    memory_mib: float


def cars_surface(command: str, images: dict[Path, Path], grid: MapGrid) -> Made | None:
    """The surface of all pairs of some images; None, and its last words printed, where the run failed.

    Args:
        command: that runs CARS.
        images: from each image to the text file of its model.
        grid: the cells that heights are wanted in.

    Raises:
        TimeoutExpired: the run took too long.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for image, model in images.items():
            _write_tagged(image, model, folder / f"{image.stem}.tif")
        stems = [image.stem for image in images]
        settings = {
            "input": {
                "sensors": {stem: {"image": str(folder / f"{stem}.tif")} for stem in stems},
                "pairing": list(combinations(stems, 2)),
            },
            "orchestrator": {"mode": "sequential"},
            "output": {
                "directory": str(folder / "out"),
                "resolution": float(grid.step_xy[0, 1]),
                "geoid": False,
            },
        }
        (folder / "settings.json").write_text(json.dumps(settings))
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with (folder / "log.txt").open("wb") as log:
            done = subprocess.run(
                [command, str(folder / "settings.json")],
                check=False,
                timeout=MOST_S,
                stdout=log,
                stderr=log,
                env={name: value for name, value in os.environ.items() if name != "NUMBA_NUM_THREADS"},
            )
        if done.returncode != 0:
            last = (folder / "log.txt").read_text(errors="replace").splitlines()[-30:]
            print("\n".join(["CARS failed:", *last]))
            return None
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        return Made(_heights(folder / "out" / "dsm" / "dsm.tif", grid), cpu_s, after.ru_maxrss / 1024.0)


def _heights(path: Path, grid: MapGrid) -> FloatImage:
    """The heights of a raster in the cells of a grid."""
    heights = np.full(grid.shape, np.nan, dtype=np.float32)
    step_x, step_y = grid.step_xy[0, 1], grid.step_xy[1, 0]
    corner = grid.origin_xy - np.array([step_x, step_y]) / 2.0
    with rasterio.open(path) as file:
        reproject(
            rasterio.band(file, 1),
            heights,
            dst_transform=rasterio.Affine(step_x, 0.0, corner[0], 0.0, step_y, corner[1]),
            dst_crs=grid.crs,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
    return heights


def _write_tagged(image: Path, model: Path, output: Path) -> None:
    """One band of an image with the model of a text file as tags."""
    values: dict[str, str] = {}
    for line in model.read_text().splitlines():
        key, _, value = line.partition(":")
        name, _, number = key.strip().rpartition("_")
        if name.endswith("COEFF") and number.isdigit():
            values[name] = f"{values.get(name, '')} {value.split()[0]}".strip()
        elif value.strip():
            values[key.strip()] = value.split()[0]
    with rasterio.open(image) as file:
        pixels = file.read(GREEN if file.count >= GREEN else 1)
    lines, samples = pixels.shape
    with rasterio.open(
        output,
        "w",
        driver="GTiff",
        height=lines,
        width=samples,
        count=1,
        dtype=pixels.dtype,
        rpcs=RPC.from_gdal(values),
    ) as file:
        file.write(pixels, 1)
