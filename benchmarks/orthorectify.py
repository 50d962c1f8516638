"""A scene laid on a map: Amers beside GDAL's warper (through rasterio), on the same files.

One thread each, CPU times, medians of runs taken in turn. Both read the same tiled GeoTIFF with RPC tags
and the same terrain above the ellipsoid, and fill the same map in memory; writing is left out. The
images are ramps, whose pixels tell where they are: what comes out bilinearly is the mapping itself, so
that *from the model* and *from GDAL* are distances in pixels of the scene, away from its border. GDAL is
told not to widen its kernels (XSCALE, YSCALE), which would move ramps.
Run: python -m benchmarks.orthorectify
"""

import os

# Read by Numba when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.warp import Resampling, reproject
from rich.console import Console
from rich.table import Table

from benchmarks._measuring import cpu_medians_s, keep
from services.formats.dem import read_dem
from services.formats.ortho_files import gdal_transform
from services.formats.raster import gdal_rpc, open_raster
from services.map_grid import MapGrid
from services.orthorectify import OrthoOptions, choose_grid, orthorectify
from services.scene import Scene
from services.sensors.rpc_fit import fit_rpc
from services.simulation.orbit import pushbroom_over
from services.types import Acquisition, FloatImage

TOLERANCE_PX = 0.125
GSD_M = 0.5
POSTING_DEG = 1.0 / 3600.0
"""Of a terrain of one second: some 30 m."""
HEIGHTS_M = (300.0, 1500.0)
PLACE = (5.25, 44.2)


@dataclass(frozen=True)
class Outcome:
    """One implementation with one kernel."""

    kernel: str
    implementation: str
    map_pixels: int
    cpu_s: float
    megapixels_per_s: float
    amers_is_faster: float
    from_model_px: float | None
    from_gdal_px: float | None


def main() -> None:
    """Measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=4000, help="lines and samples of the scene")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="amers-") as folder:
        outcomes = measured(Path(folder), arguments.size, arguments.repeats)
    show(outcomes)
    keep("orthorectify", [asdict(outcome) for outcome in outcomes])


def measured(folder: Path, size: int, repeats: int) -> list[Outcome]:
    """Both implementations, both kernels, and GDAL without approximation."""
    scene, grid = make_inputs(folder, size)
    terrain = read_dem(folder / "dem.tif")
    wanted = model_positions(scene, terrain, grid)

    def ours(kernel: str) -> FloatImage:
        out = np.empty((2, *grid.shape), dtype=np.float32)
        options = OrthoOptions("cubic" if kernel == "cubic" else "bilinear", TOLERANCE_PX)
        images = [open_raster(folder / "scene.tif", band) for band in (1, 2)]
        for done in orthorectify(images, scene.model, terrain, grid, options):
            at = done.window
            out[:, at.line : at.line + at.lines, at.sample : at.sample + at.samples] = done.pixels
        return out

    def gdal(kernel: str, tolerance_px: float) -> FloatImage:
        out = np.full((2, *grid.shape), np.nan, dtype=np.float32)
        with rasterio.Env(GDAL_NUM_THREADS=1), rasterio.open(folder / "scene.tif") as file:
            reproject(
                rasterio.band(file, [1, 2]),
                out,
                rpcs=file.rpcs,
                src_crs="EPSG:4326",
                dst_crs=grid.crs,
                dst_transform=gdal_transform(grid),
                dst_nodata=np.nan,
                resampling=Resampling[kernel],
                num_threads=1,
                tolerance=tolerance_px,
                RPC_DEM=str(folder / "dem.tif"),
                RPC_DEM_SRS="EPSG:4979",
                RPC_PIXEL_ERROR_THRESHOLD="0.01",
                XSCALE="1",
                YSCALE="1",
            )
        return out

    outcomes = []
    for kernel in ("bilinear", "cubic"):
        ways = {
            "Amers": lambda kernel=kernel: ours(kernel),
            f"GDAL to {TOLERANCE_PX:g} px": lambda kernel=kernel: gdal(kernel, TOLERANCE_PX),
            "GDAL without approximation": lambda kernel=kernel: gdal(kernel, 0.0),
        }
        taken_s = cpu_medians_s(ways, repeats)
        images = {name: way() for name, way in ways.items()}
        exact = images["GDAL without approximation"]
        for name, image in images.items():
            told = (distance_px(image, wanted), distance_px(image, exact))
            seconds = taken_s[name]
            pixels = grid.shape[0] * grid.shape[1]
            outcomes.append(
                Outcome(
                    kernel,
                    name,
                    pixels,
                    seconds,
                    2e-6 * pixels / seconds,
                    seconds / taken_s["Amers"],
                    *told,
                )
            )
    return outcomes


def make_inputs(folder: Path, size: int) -> tuple[Scene, MapGrid]:
    """A scene whose two bands are ramps, terrain with 1,200 m of relief, and the map of both."""
    heights = (size, size)
    place = np.array([*PLACE, np.mean(HEIGHTS_M)])
    true = pushbroom_over(place, heights, GSD_M, 25.0, 100.0, HEIGHTS_M)
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


def distance_px(image: FloatImage, other: FloatImage) -> float:
    """Largest distance of two mappings where both show something away from the border."""
    low, high = 2.0, float(np.nanmax(other)) - 2.0
    both = np.isfinite(image).all(axis=0) & np.isfinite(other).all(axis=0)
    both &= ((other > low) & (other < high)).all(axis=0)
    return float(np.hypot(*(image - other)[:, both]).max())


def show(outcomes: list[Outcome]) -> None:
    """Print the table."""
    table = Table(
        "kernel",
        "implementation",
        "band pixels",
        "M band pixels/s",
        "Amers is faster",
        "from the model",
        "from GDAL exact",
        title="Orthorectification, one thread; largest differences of the mapping",
    )
    for o in outcomes:
        table.add_row(
            o.kernel,
            o.implementation,
            f"{2 * o.map_pixels:,}",
            f"{o.megapixels_per_s:.1f}",
            f"{o.amers_is_faster:.1f} x",
            f"{o.from_model_px:.3f} px",
            f"{o.from_gdal_px:.3f} px",
        )
    Console(width=115).print(table)


if __name__ == "__main__":
    main()
