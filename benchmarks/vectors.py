"""A million vertices of a raw scene on the map: Amers, and GDAL's RPC transformer on the same terrain.

Polygons of 50 vertices, some 12 px apart, cover a simulated scene of 0.5 m over 1,200 m of relief, on
terrains of one second (30 m), with ripples of 10 m and of 60 m, and of 2 m. Amers also adds vertices to
bent edges and predicts the accuracy of every vertex; `vertices only` asks GDAL and Amers for the same
thing. Times are CPU times of one thread. The table compares vertices with the ground that their lines of
sight first meet, found by steps of a quarter of a metre: the share that lies elsewhere, by more than a
pixel, and the largest distance of the others. Run: python -m benchmarks.vectors
"""

import os

# Numba reads this when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa
import rasterio
import shapely
from rasterio.transform import RPCTransformer

from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.app.usecases.vector_files import VectorFile
from amers.app.usecases.vectors import correct_file
from amers.services.formats.images.raster import gdal_rpc, write_raster
from amers.services.formats.vector.layers import VectorLayer, read_layer, write_layer
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.lines_of_sight import intersect_terrain
from amers.services.sensors.rpc import RpcModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Acquisition, Array, FloatImage
from amers.services.vectors.accuracy import ErrorSources
from amers.services.vectors.correct import correct_vectors
from amers.services.vectors.shapes import Geometries, geometries_of, shapes_of
from benchmarks._measuring import keep, print_table

CENTRE = np.array([5.2, 44.2, 900.0])
GSD_M = 0.5
RELIEF_M = 1200.0
HEIGHTS_M = (200.0, 1700.0)
TERRAINS = {
    "30 m": (1.0 / 3600.0, 10.0),
    "30 m, rough": (1.0 / 3600.0, 60.0),
    "2 m": (2.0 / 111_000.0, 10.0),
}
"""Posting in degrees, and the amplitude of the ripples."""
POLYGON_VERTICES = 50
COMPARED = 1000
T = TypeVar("T")


@dataclass(frozen=True)
class Outcome:
    """What one way took and where it put the vertices.

    Attributes:
        terrain: posting of the terrain.
        way: what was run.
        vertices: that it was given.
        cpu_s: CPU time.
        vertices_per_s: by CPU time.
        wrong: share of vertices more than a pixel from the first intersection.
        largest_m: largest distance from it among the others.
    """

    terrain: str
    way: str
    vertices: int
    cpu_s: float
    vertices_per_s: float
    wrong: float | None = None
    largest_m: float | None = None


def main() -> None:
    """Measure, print the table and store the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vertices", type=int, default=1_000_000)
    parser.add_argument("--gdal-vertices", type=int, default=50_000)
    parser.add_argument("--size", type=int, default=20_000, help="lines and samples of the scene")
    arguments = parser.parse_args()
    shape = (arguments.size, arguments.size)
    true = pushbroom_over(CENTRE, shape, GSD_M, (20.0, 100.0), HEIGHTS_M)
    model = fit_rpc(true, shape, HEIGHTS_M).model
    drawn = polygons(arguments.vertices, arguments.size)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="amers-") as folder:
        for name, (posting_deg, ripple_m) in TERRAINS.items():
            side_m = arguments.size * GSD_M
            dem = write_terrain(Path(folder) / "dem.tif", posting_deg, side_m, ripple_m)
            outcomes += vertices_only(name, model, dem, drawn, arguments.gdal_vertices)
            outcomes += whole(name, model, dem, drawn, shape)
    print_table("", outcomes, COLUMNS, width=120)
    keep("vectors", [asdict(outcome) for outcome in outcomes])


def polygons(vertices: int, size: int) -> Geometries:
    """Polygons like fields: 50 vertices on a rough circle, anywhere in the image; line and sample."""
    rng = np.random.default_rng(5)
    count = vertices // POLYGON_VERTICES
    angle = np.linspace(0.0, 2.0 * np.pi, POLYGON_VERTICES, endpoint=False)
    radius = 95.0 + rng.uniform(-8.0, 8.0, (count, POLYGON_VERTICES))
    centre = rng.uniform(120.0, size - 120.0, (count, 1, 2))
    rings = centre + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(shapely.polygons(rings))


def write_terrain(path: Path, posting_deg: float, side_m: float, ripple_m: float) -> Path:
    """Write ridges and rough ground around the scene."""
    half_deg = (side_m / 2.0 + 2500.0) / 111_000.0 / np.cos(np.radians(CENTRE[1]))
    count = int(2.0 * half_deg / posting_deg)
    axis_m = np.arange(count) * posting_deg * 111_000.0
    line, sample = axis_m[:, None], axis_m[None, :]
    ridges = RELIEF_M / 2.4 * np.sin(line / 900.0) * np.cos(sample / 700.0)
    ripples = ripple_m * np.sin((line + 2.0 * sample) / 90.0)
    rough = np.random.default_rng(2).normal(0.0, 0.02 * posting_deg * 111_000.0, (count, count))
    heights: FloatImage = (CENTRE[2] + ridges + ripples + rough).astype(np.float32)
    west, north = CENTRE[0] - half_deg, CENTRE[1] + half_deg
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=count,
        width=count,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=rasterio.transform.from_origin(west, north, posting_deg, posting_deg),
    ) as file:
        file.write(heights, 1)
    return path


def vertices_only(
    name: str, model: RpcModel, dem: Path, drawn: Geometries, gdal_vertices: int
) -> list[Outcome]:
    """The outcomes of Amers and GDAL, which locate vertices on one terrain."""
    terrain = read_terrain(TerrainFile(dem, "ellipsoid"))
    vertices = np.unique(shapely.get_coordinates(drawn), axis=0)
    rows = np.random.default_rng(3).choice(len(vertices), gdal_vertices, replace=False)
    intersect_terrain(model, vertices[:10], terrain)
    seconds, ours = timed(lambda: intersect_terrain(model, vertices, terrain))
    expected = stepped(model, vertices[rows[:COMPARED]], terrain)
    amers = Outcome(name, "Amers, vertices only", len(vertices), *rate(len(vertices), seconds))
    with RPCTransformer(gdal_rpc(model), RPC_DEM=str(dem), RPC_DEMINTERPOLATION="bilinear") as gdal:
        line, sample = vertices[rows].T
        seconds, (lon, lat) = timed(lambda: gdal.xy(line, sample))
    peer = Outcome(name, "GDAL, vertices only", len(rows), *rate(len(rows), seconds))
    theirs = np.column_stack([lon, lat])[:COMPARED]
    outcomes = [compared(amers, ours[rows[:COMPARED], :2], expected), compared(peer, theirs, expected)]
    return outcomes


def whole(
    name: str, model: RpcModel, dem: Path, drawn: Geometries, shape: tuple[int, int]
) -> list[Outcome]:
    """The outcomes of the whole correction, in memory and from file to file."""
    scene = Scene(ArrayImage(np.ones((1, 1), dtype=np.float32)), model, Acquisition("a"), 5.0)
    terrain = read_terrain(TerrainFile(dem, "ellipsoid"))
    sources = ErrorSources(None, 5.0, 0.5)
    count = int(shapely.get_num_coordinates(drawn).sum())

    def corrected(geometries: Geometries) -> Geometries:
        result = correct_vectors(
            shapes_of(geometries), scene, terrain, "EPSG:32631", sources=sources, tolerance_px=0.5
        )
        result.shapes.largest(result.accuracy.on_the_earth_ce90_m)
        return geometries_of(result.shapes)

    corrected(drawn[:5])
    seconds, on_map = timed(lambda: corrected(drawn))
    added = int(shapely.get_num_coordinates(on_map).sum()) - count
    outcomes = [
        Outcome(name, f"Amers, accuracy and {added:,} more vertices", count, *rate(count, seconds))
    ]
    folder = dem.parent
    write_raster(folder / "scene.tif", np.zeros(shape, dtype=np.uint8), model)
    in_qgis = shapely.transform(drawn, lambda at: at[:, ::-1] * [1.0, -1.0] + [0.5, -0.5])
    numbers = pa.table({"number": np.arange(len(drawn))})
    write_layer(folder / "drawn.gpkg", VectorLayer("drawn", in_qgis, numbers, None))
    seconds, _ = timed(
        lambda: correct_file(
            VectorFile(folder / "drawn.gpkg"),
            SceneModel(folder / "scene.tif", sigma_m=5.0),
            TerrainFile(dem, "ellipsoid"),
            folder / "map.gpkg",
            crs="EPSG:32631",
        )
    )
    assert len(read_layer(folder / "map.gpkg").geometries) == len(drawn)
    return [*outcomes, Outcome(name, "the same, GeoPackage to GeoPackage", count, *rate(count, seconds))]


def stepped(model: RpcModel, line_sample: Array, terrain: Terrain) -> Array:
    """First intersections (n, 3) by steps of a quarter of a metre from above all ground."""
    low_m, high_m = terrain.range_m()
    found = np.full((len(line_sample), 3), np.nan)
    falling = np.arange(len(line_sample))
    for height_m in np.arange(high_m + 1.0, low_m - 1.0, -0.25):
        at = model.locate(line_sample[falling], np.full(len(falling), height_m))
        under = terrain.height_m(at[:, :2]) >= height_m
        found[falling[under]] = at[under]
        falling = falling[~under]
        if not len(falling):
            break
    return found


def timed(run: Callable[[], T]) -> tuple[float, T]:
    """The CPU time of a function, and what it returns."""
    start = time.process_time()
    result = run()
    return time.process_time() - start, result


def rate(vertices: int, seconds: float) -> tuple[float, float]:
    """CPU time and vertices per second."""
    return seconds, vertices / max(seconds, 1e-9)


def compared(one: Outcome, found: Array, expected: Array) -> Outcome:
    """The outcome with what it found (n, 3) beside first intersections (n, 3)."""
    east, north = metres_per_degree(float(CENTRE[1]), float(CENTRE[2]))
    off_m = np.hypot(*((found - expected[:, :2]) * [east, north]).T)
    right = off_m < GSD_M
    return replace(one, wrong=float(1.0 - right.mean()), largest_m=float(off_m[right].max()))


COLUMNS: dict[str, Callable[[Outcome], object]] = {
    "terrain": lambda o: o.terrain,
    "way": lambda o: o.way,
    "vertices": lambda o: f"{o.vertices:,}",
    "CPU s": lambda o: f"{o.cpu_s:.2f}",
    "vertices/s": lambda o: f"{o.vertices_per_s:,.0f}",
    "elsewhere": lambda o: None if o.wrong is None else f"{o.wrong:.2%}",
    "largest, m": lambda o: None if o.largest_m is None else f"{o.largest_m:.3f}",
}


if __name__ == "__main__":
    main()
