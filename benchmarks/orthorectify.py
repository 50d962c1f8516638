"""A scene laid on a map: Amers beside gdalwarp, on the same files, to the same tolerance.

One thread each, CPU times (gdalwarp's as of its process), medians of runs taken in turn. Both read the
same tiled GeoTIFF with RPC tags and the same terrain above the ellipsoid, and write the same map into a
tiled GeoTIFF. The images are ramps, whose pixels tell where they are: what comes out bilinearly is the
mapping itself, so that *from the model* and *from gdalwarp exact* are distances in pixels of the scene,
away from its border. gdalwarp is told not to widen its kernels (XSCALE, YSCALE), which would move ramps.
It approximates along the lines of the map and looks at the middle of each piece only: in relief it may
miss its own tolerance, which is why 99 % are told beside the largest.
Run: python -m benchmarks.orthorectify
"""

import os

# Read by Numba when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow

from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.ortho import gdal_transform
from amers.services.formats.images.raster import gdal_rpc, open_raster
from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoOptions, choose_grid, orthorectify
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Acquisition, FloatImage
from benchmarks._measuring import keep, print_table

TOLERANCE_PX = 0.125
GSD_M = 0.5
POSTING_DEG = 1.0 / 3600.0
"""Of a terrain of one second: some 30 m."""
HEIGHTS_M = (300.0, 1500.0)
PLACE = (5.25, 44.2)
RPC_ERROR_PX = 0.01
"""To which GDAL inverts an RPC."""


@dataclass(frozen=True)
class Outcome:
    """One implementation with one kernel."""

    kernel: str
    implementation: str
    map_pixels: int
    cpu_s: float
    megapixels_per_s: float
    amers_is_faster: float
    from_model_px: tuple[float, float]
    from_exact_px: tuple[float, float]


def main() -> None:
    """Measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=4000, help="lines and samples of the scene")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    if shutil.which("gdalwarp") is None:
        print("gdalwarp is not installed (Debian: gdal-bin): nothing to stand beside")
        return
    with tempfile.TemporaryDirectory(prefix="amers-") as folder:
        outcomes = measured(Path(folder), arguments.size, arguments.repeats)
    title = "Orthorectification, one thread; differences of the mapping: 99 %, largest"
    print_table(title, outcomes, COLUMNS, width=115)
    keep("orthorectify", [asdict(outcome) for outcome in outcomes])


def measured(folder: Path, size: int, repeats: int) -> list[Outcome]:
    """Both implementations with both kernels, and gdalwarp without approximation."""
    scene, grid = make_inputs(folder, size)
    wanted = model_positions(scene, read_dem(folder / "dem.tif"), grid)
    exact_name = "gdalwarp -et 0"
    outcomes = []
    for kernel in ("bilinear", "cubic"):
        ways: dict[str, Callable[[], float]] = {
            "Amers": lambda kernel=kernel: amers_s(folder, scene, grid, kernel),
            f"gdalwarp -et {TOLERANCE_PX:g}": lambda kernel=kernel: gdalwarp_s(
                folder, grid, kernel, TOLERANCE_PX
            ),
            exact_name: lambda kernel=kernel: gdalwarp_s(folder, grid, kernel, 0.0),
        }
        taken_s: dict[str, list[float]] = {name: [] for name in ways}
        images: dict[str, FloatImage] = {}
        for turn in range(repeats + 1):
            for name, way in ways.items():
                seconds = way()
                if turn > 0:
                    taken_s[name].append(seconds)
                else:
                    images[name] = read_map(folder)
        for name, image in images.items():
            seconds = median(taken_s[name])
            pixels = grid.shape[0] * grid.shape[1]
            outcomes.append(
                Outcome(
                    kernel,
                    name,
                    pixels,
                    seconds,
                    2e-6 * pixels / seconds,
                    seconds / median(taken_s["Amers"]),
                    distances_px(image, wanted),
                    distances_px(image, images[exact_name]),
                )
            )
    return outcomes


def amers_s(folder: Path, scene: Scene, grid: MapGrid, kernel: str) -> float:
    """CPU time of the map by Amers."""
    start = time.process_time()
    options = OrthoOptions("cubic" if kernel == "cubic" else "bilinear", TOLERANCE_PX)
    images = [open_raster(folder / "scene.tif", band) for band in (1, 2)]
    with rasterio.open(
        folder / "map.tif",
        "w",
        driver="GTiff",
        height=grid.shape[0],
        width=grid.shape[1],
        count=2,
        dtype="float32",
        crs=grid.crs,
        transform=gdal_transform(grid),
        tiled=True,
        nodata=np.nan,
    ) as file:
        terrain = read_dem(folder / "dem.tif")
        for done in orthorectify(images, scene.model, terrain, grid, options):
            at = done.window
            file.write(done.pixels, window=RasterWindow(at.sample, at.line, at.samples, at.lines))
    return time.process_time() - start


def gdalwarp_s(folder: Path, grid: MapGrid, kernel: str, tolerance_px: float) -> float:
    """CPU time of the map by gdalwarp."""
    (folder / "map.tif").unlink(missing_ok=True)
    corner = gdal_transform(grid)
    lines, samples = grid.shape
    edges = (corner.c, corner.f + lines * corner.e, corner.c + samples * corner.a, corner.f)
    settings = {
        "-to": (
            "RPC_DEM=" + str(folder / "dem.tif"),
            "RPC_DEM_SRS=EPSG:4979",
            f"RPC_PIXEL_ERROR_THRESHOLD={RPC_ERROR_PX:g}",
        ),
        "-wo": ("XSCALE=1", "YSCALE=1", "NUM_THREADS=1"),
        "-co": ("TILED=YES",),
    }
    command = ["gdalwarp", "-q", "-rpc", "-et", f"{tolerance_px:g}", "-r", kernel, "-t_srs", grid.crs]
    command += ["-te", *(repr(float(edge)) for edge in edges), "-ts", str(samples), str(lines)]
    command += ["-dstnodata", "nan", "-wm", "500"]
    command += [
        part for option, values in settings.items() for value in values for part in (option, value)
    ]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [*command, str(folder / "scene.tif"), str(folder / "map.tif")],
        check=True,
        env={"PATH": os.environ["PATH"], "GDAL_CACHEMAX": "64"},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def read_map(folder: Path) -> FloatImage:
    """Both bands of what was written last."""
    with rasterio.open(folder / "map.tif") as file:
        return file.read()


def make_inputs(folder: Path, size: int) -> tuple[Scene, MapGrid]:
    """A scene whose two bands are ramps, terrain with 1,200 m of relief, and the map of both."""
    heights = (size, size)
    place = np.array([*PLACE, np.mean(HEIGHTS_M)])
    true = pushbroom_over(place, heights, GSD_M, (25.0, 100.0), HEIGHTS_M)
    model = fit_rpc(true, heights, HEIGHTS_M).model
    profile = {"driver": "GTiff", "tiled": True, "BIGTIFF": "IF_SAFER"}
    scene_path = folder / "scene.tif"
    with rasterio.open(
        scene_path, "w", height=size, width=size, count=2, dtype="float32", **profile
    ) as file:
        file.rpcs = gdal_rpc(model)
        file.write(np.indices(heights, dtype=np.float32))
    nodes = int(size * GSD_M / 111_000.0 / POSTING_DEG * 2.0) + 60
    line, sample = np.indices((nodes, nodes))
    waves = 0.5 + 0.25 * (
        np.sin(line / 11.0) * np.cos(sample / 13.0) + np.sin((line - 2 * sample) / 37.0)
    )
    low, high = HEIGHTS_M
    with rasterio.open(
        folder / "dem.tif",
        "w",
        height=nodes,
        width=nodes,
        count=1,
        dtype="float32",
        crs="EPSG:4979",
        transform=rasterio.transform.from_origin(
            PLACE[0] - nodes / 2 * POSTING_DEG,
            PLACE[1] + nodes / 2 * POSTING_DEG,
            POSTING_DEG,
            POSTING_DEG,
        ),
        **profile,
    ) as file:
        file.write((low + 100.0 + (high - low - 200.0) * waves).astype(np.float32), 1)
    scene = Scene(open_raster(scene_path), model, Acquisition("ramps"), 1.0)
    return scene, choose_grid(scene, read_dem(folder / "dem.tif"))


def model_positions(scene: Scene, terrain: object, grid: MapGrid) -> FloatImage:
    """Line and sample of every map pixel by the model itself; NaN near the border and beyond."""
    out = np.empty((2, *grid.shape), dtype=np.float32)
    for line in range(grid.shape[0]):
        pixels = np.column_stack([np.full(grid.shape[1], float(line)), np.arange(grid.shape[1])])
        lon_lat = grid.lon_lat(pixels)
        height_m = terrain.height_m(lon_lat)  # type: ignore[attr-defined]
        out[:, line] = scene.model.project(np.column_stack([lon_lat, height_m])).T
    last = np.array(scene.image.shape)[:, None, None] - 3.0
    out[:, ~((out > 2.0) & (out < last)).all(axis=0)] = np.nan
    return out


def distances_px(image: FloatImage, other: FloatImage) -> tuple[float, float]:
    """Distance of two mappings where both show something away from the border: of 99 %, largest."""
    low, high = 2.0, float(np.nanmax(other)) - 2.0
    both = np.isfinite(image).all(axis=0) & np.isfinite(other).all(axis=0)
    both &= ((other > low) & (other < high)).all(axis=0)
    distance = np.hypot(*(image - other)[:, both])
    return float(np.quantile(distance, 0.99)), float(distance.max())


COLUMNS: dict[str, Callable[[Outcome], object]] = {
    "kernel": lambda o: o.kernel,
    "implementation": lambda o: o.implementation,
    "band pixels": lambda o: f"{2 * o.map_pixels:,}",
    "M band pixels/s": lambda o: f"{o.megapixels_per_s:.1f}",
    "Amers is faster": lambda o: f"{o.amers_is_faster:.1f} x",
    "from the model": lambda o: "{:.3f}, {:.3f} px".format(*o.from_model_px),
    "from gdalwarp exact": lambda o: "{:.3f}, {:.3f} px".format(*o.from_exact_px),
}


if __name__ == "__main__":
    main()
