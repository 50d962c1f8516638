"""A registered scene on the map: what drawing its tiles costs, and how fast one service sends them.

The worker's part is measured in this process: CPU time and highest memory, beside those of a scene with
a quarter of the lines and samples, so that memory is seen to grow less than the number of pixels. The
service is one process, as it is run; a client asks for tiles of the finest zoom in the middle, one after
the other, as a page does that opens there. *first* is the first request to a service that has just
started. The image is noise with the correlation of natural ground, whose tiles are large.
Run: python -m benchmarks.scene_map
"""

import argparse
import http.client
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow

from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.jobs import attempts, jobs
from amers.app.storage import Storage
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.scene_map import LAYERS, MappedScene, map_scene
from amers.app.usecases.tokens import create_token
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.rpc import RpcModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from benchmarks import _servers
from benchmarks._measuring import keep, memory_mib, open_folder, print_table

TARGET = (5.25, 44.2, 600.0)
GSD_M = 0.5
HEIGHTS_M = (300.0, 900.0)
SHIFT_PX = (14.0, -9.0)
TEXTURE_PX = 2048
POINTS = 200
TILES = 20
SEED = 7


@dataclass(frozen=True)
class Drawing:
    """The tiles of one scene.

    Attributes:
        size: lines and samples of the scene.
        cpu_s: of both models.
        highest_mib: resident memory of the process.
        file_mib: of both files.
    """

    size: int
    cpu_s: float
    highest_mib: float
    file_mib: float


@dataclass(frozen=True)
class Service:
    """Replies of one service process.

    Attributes:
        first_s: from the first request to its tile.
        next_s: of all the next tiles together.
        tiles: how many these are.
    """

    first_s: float
    next_s: float
    tiles: int


def main() -> None:
    """Measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=20_000, help="lines and samples of the scene")
    size = parser.parse_args().size
    with open_folder() as folder:
        draw(folder, 500)  # Compiles.
        drawings = []
        for lines in (size // 4, size):
            drawing, mapped = draw(folder, lines)
            drawings.append(drawing)
        service = serve(folder, mapped)
    columns: dict[str, Callable[[Drawing], object]] = {
        "scene, px": lambda one: one.size,
        "CPU, s": lambda one: f"{one.cpu_s:.0f}",
        "highest memory, MiB": lambda one: f"{one.highest_mib:.0f}",
        "tiles, MiB": lambda one: f"{one.file_mib:.0f}",
    }
    print_table("", drawings, columns)
    print(f"first tile {service.first_s:.3f} s; the next {service.tiles} in {service.next_s:.3f} s")
    keep("scene_map", {"drawings": [asdict(one) for one in drawings], "service": asdict(service)})


def draw(folder: Path, size: int) -> tuple[Drawing, MappedScene]:
    """Draw a scene of a size through both models; its tiles stay in the folder."""
    image, registration = folder / "scene.tif", folder / "registration"
    registration.mkdir(exist_ok=True)
    model = write_scene(image, size)
    write_registration(registration, size, model)
    outputs = {layer: folder / f"{layer}.tiles" for layer in LAYERS}
    start = time.process_time()
    mapped = map_scene(SceneModel(image, registration=registration), None, outputs)
    cpu_s = time.process_time() - start
    file_mib = sum(path.stat().st_size for path in outputs.values()) / 2**20
    return Drawing(size, cpu_s, memory_mib("VmHWM"), file_mib), mapped


def write_scene(path: Path, size: int) -> RpcModel:
    """Write an image of a texture that is repeated, with its model in the tags; returns the model."""
    sensor = pushbroom_over(np.array(TARGET), (size, size), GSD_M, (12.0, 100.0), HEIGHTS_M)
    model = fit_rpc(sensor, (size, size), HEIGHTS_M).model
    rng = np.random.default_rng(SEED)
    texture = np.full((TEXTURE_PX, TEXTURE_PX), 1500.0, dtype=np.float32)
    for sigma in (1.0, 3.0, 9.0, 27.0):
        layer = cv2.GaussianBlur(rng.normal(size=texture.shape).astype(np.float32), (0, 0), sigma)
        texture += 200.0 * layer / layer.std()
    strip = np.tile(np.clip(texture, 1.0, 4095.0).astype(np.uint16), (1, size // TEXTURE_PX + 1))
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "uint16"}
    tiled = {"tiled": True, "blockxsize": 512, "blockysize": 512}
    with rasterio.open(path, "w", **profile, **tiled) as file:
        for line in range(0, size, TEXTURE_PX):
            lines = min(TEXTURE_PX, size - line)
            file.write(strip[:lines, :size], 1, window=RasterWindow(0, line, size, lines))
        file.rpcs = gdal_rpc(model)
    return model


def write_registration(folder: Path, size: int, model: RpcModel) -> None:
    """Write what a registration leaves of a scene: its correction and its control points."""
    correction = ImageCorrection(
        np.array([[SHIFT_PX[0], 0.0, 0.0], [SHIFT_PX[1], 0.0, 0.0]]),
        np.full(2, (size - 1.0) / 2.0),
        np.full(2, size / 2.0),
    )
    covariance = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
    stated = CorrectionAccuracy(correction, covariance, np.zeros(2))
    text = format_correction(stated, "shift", applies_to="tags", carried="tags")
    (folder / "correction.json").write_text(text)
    rng = np.random.default_rng(SEED)
    places = model.locate(rng.uniform(0.0, size, (POINTS, 2)), rng.uniform(*HEIGHTS_M, POINTS))
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": {}}
        for place in places.tolist()
    ]
    (folder / "control_points.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )


def serve(folder: Path, mapped: MappedScene) -> Service:
    """Ask a service that has just started for the tiles in the middle of the scene."""
    cluster = Cluster(folder / "postgres", durable=False)
    with cluster.lease() as dsn:
        revisions.upgrade(dsn)
        storage = Storage(folder / "storage")
        with engine.connect(dsn) as connection:
            token = create_token(connection, "benchmark", ["register"])
            job = jobs.create(connection, "map-scene", {}, owner=token.token.id)
            assert job is not None
            files = {
                f"{layer}.tiles": storage.put_file(
                    f"results/{job.id}/1/{layer}.tiles", folder / f"{layer}.tiles"
                ).key
                for layer in LAYERS
            }
            claimed = attempts.claim_next(connection, "benchmark", 60.0)
            assert claimed is not None
            results = {"tile_limits": [asdict(one) for one in mapped.limits], "files": files}
            attempts.succeed(connection, job.id, claimed.attempt, results)
        finest = mapped.limits[0]
        row = (finest.first_row + finest.last_row) // 2
        column = (finest.first_column + finest.last_column) // 2
        places = [(row + k // 5, column + k % 5) for k in range(TILES + 1)]
        paths = [
            f"/jobs/{job.id}/map/registered/tiles/WebMercatorQuad/{finest.zoom}/{y}/{x}"
            for y, x in places
        ]
        with _servers.amers(folder) as server:
            connection_kept = server.connect()
            headers = {"Authorization": f"Bearer {token.secret}"}
            start = time.perf_counter()
            fetch(connection_kept, paths[0], headers)
            first_s = time.perf_counter() - start
            start = time.perf_counter()
            for path in paths[1:]:
                fetch(connection_kept, path, headers)
            next_s = time.perf_counter() - start
            return Service(first_s, next_s, TILES)


def fetch(connection: http.client.HTTPConnection, path: str, headers: dict[str, str]) -> None:
    """Get a tile."""
    connection.request("GET", path, headers=headers)
    reply = connection.getresponse()
    content = reply.read()
    assert reply.status == 200, content


if __name__ == "__main__":
    main()
