"""What ties and points of large images cost, CPU and memory, by the side of the images.

Every block has three images of the same ground from three directions, compressed with DEFLATE and its
predictor in tiles of 512 px of 12 bits. The ground repeats every 2,048 px, and the tiles of a file with
it: a file of any size takes 5 MB, and is unpacked tile by tile like any other.
Relief is 100 m; the delivered models are off by 5 m and state it. One point is wanted for 2 km2. Every
block is made in a process of its own, so that its peak of memory is its own. `--surfaces` finds the
height of the surface at the points as well, as productions do by default.

Run: python -m benchmarks.production_cost --sides 5000 10000 20000 40000
"""

import os

# Read by Numba and the linear algebra when they are first imported.
os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

import argparse
import multiprocessing
import struct
import time
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.raster import open_raster
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.image_production import ProductionOptions, produce_points
from amers.services.sensors.base import SensorModel
from amers.services.sensors.rpc import RpcModel
from amers.services.tasks import Work
from amers.services.types import Acquisition, Array, Observations
from benchmarks._measuring import keep, memory_mib, open_folder, print_table

GSD_M = 1.5
"""As SPOT 6 and 7 panchromatic."""
CENTRE_LON_LAT = (5.0, 45.0)
PERIOD_PX, TILE_PX = 2048, 512
RELIEF_M, HEIGHT_RANGE_M = 100.0, (-300.0, 300.0)
TANGENTS = ((0.0, 0.05), (0.12, -0.25), (-0.1, 0.3))
"""Of the incidence, along lines and samples, of each image."""
SIGMA_M = 5.0
KM2_A_POINT = 2.0
HOUSES = 20_000


@dataclass(frozen=True)
class Outcome:
    """One block of three images.

    Attributes:
        side_px: lines and samples of each image.
        points: of the block.
        wanted: squares of the ground that could have one.
        cpu_s: of each stage, an image.
        total_cpu_s: of all stages, an image.
        memory_mib: highest resident memory of the process.
        file_mib: size of one image.
        error_px: largest error of the adjusted models relative to each other, at 25 places.
    """

    side_px: int
    points: int
    wanted: int
    cpu_s: dict[str, float]
    total_cpu_s: float
    memory_mib: float
    file_mib: float
    error_px: float


def main() -> None:
    """Measure, print the table and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sides", type=int, nargs="+", default=[5_000, 10_000, 20_000, 40_000])
    parser.add_argument("--surfaces", action="store_true", help="find the surface at the points too")
    arguments = parser.parse_args()
    rows = []
    for side in arguments.sides:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append(pool.apply(measure, (side, arguments.surfaces)))
        print(rows[-1], flush=True)
    print_table(
        "Three images, one point for 2 km2; seconds of a core an image",
        rows,
        {
            "side, px": lambda row: row.side_px,
            "points": lambda row: f"{row.points} of {row.wanted}",
            **{
                stage: lambda row, stage=stage: f"{row.cpu_s.get(stage, 0.0):.1f}"
                for stage in ("features", "matches", "measures", "surfaces", "points", "adjustment")
            },
            "all": lambda row: f"{row.total_cpu_s:.1f}",
            "memory, MiB": lambda row: f"{row.memory_mib:.0f}",
            "error, px": lambda row: f"{row.error_px:.2f}",
        },
    )
    keep("production_cost", [asdict(row) for row in rows])


def measure(side_px: int, surfaces: bool) -> Outcome:
    """Make the images of a side and the points of their block."""
    cv2.setNumThreads(1)
    with open_folder() as folder:
        paths = write_images(folder, side_px)
        scenes = [
            replace(image_scene(number, side_px), image=open_raster(path))
            for number, path in enumerate(paths)
        ]
        # In a thread of its own, so that its time is not that of the adjustment.
        work = Work(ThreadPoolExecutor(1))
        begun = time.process_time()
        pairs = ProductionOptions.surface_pairs if surfaces else 0
        options = ProductionOptions(2.0, 20.0, 1000.0 * KM2_A_POINT**0.5, surface_pairs=pairs)
        made = produce_points(scenes, options, work=work)
        taken_s = time.process_time() - begun
        file_mib = paths[0].stat().st_size / 2**20
    count = len(scenes)
    return Outcome(
        side_px,
        len(made.points),
        int((side_px * GSD_M / 1000.0) ** 2 / KM2_A_POINT),
        {stage: effort.cpu_s / count for stage, effort in made.effort.items()},
        taken_s / count,
        memory_mib("VmHWM"),
        file_mib,
        largest_disagreement_px(made.adjustment.models, side_px),
    )


def write_images(folder: Path, side_px: int) -> list[Path]:
    """The three images of a side."""
    rng = np.random.default_rng(1)
    height_m, albedo = _ground(rng)
    paths = []
    for number, tangent in enumerate(TANGENTS):
        seen = _seen(height_m, albedo, np.array(tangent))
        grey = np.rint(seen + rng.normal(0.0, 4.0, seen.shape)).clip(1, 4000).astype("<u2")
        paths.append(folder / f"image_{number}.tif")
        _write_repeated(paths[-1], grey, side_px)
    return paths


def _ground(rng: np.random.Generator) -> tuple[Array, Array]:
    """Heights and brightness of one period."""
    shape = (PERIOD_PX, PERIOD_PX)

    def noise(sigma_px: float) -> Array:
        frequency = np.hypot(np.fft.fftfreq(PERIOD_PX)[:, None], np.fft.rfftfreq(PERIOD_PX)[None, :])
        low_pass = np.exp(-2.0 * (np.pi * sigma_px * frequency) ** 2)
        smooth = np.fft.irfft2(np.fft.rfft2(rng.normal(size=shape)) * low_pass, shape)
        return np.asarray(smooth / smooth.std())

    height_m = noise(150.0) * RELIEF_M / 4.0
    albedo = 900.0 + sum(60.0 * noise(sigma_px) for sigma_px in (1.5, 5.0, 20.0, 80.0))
    for row, column, lines, samples in rng.integers(
        [0, 0, 4, 4], [*shape, 30, 30], (HOUSES, 4)
    ).tolist():
        albedo[row : row + lines, column : column + samples] = rng.normal(900.0, 150.0)
    return height_m, np.asarray(albedo)


def _seen(height_m: Array, albedo: Array, tangent: Array) -> Array:
    """One period of an image: the ground displaced by its height."""
    line, sample = np.indices(albedo.shape, dtype=np.float32)
    shift_px = height_m.astype(np.float32) / GSD_M
    row, column = line, sample
    for _ in range(8):
        there = cv2.remap(shift_px, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        row, column = line - np.float32(tangent[0]) * there, sample - np.float32(tangent[1]) * there
    image = albedo.astype(np.float32)
    return np.asarray(cv2.remap(image, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP))


def _write_repeated(path: Path, period: Array, side_px: int) -> None:
    """A tiled TIFF whose tiles point at those of one period."""
    per_side, of_period = -(-side_px // TILE_PX), PERIOD_PX // TILE_PX
    parts = []
    for row, column in np.ndindex(of_period, of_period):
        lines, samples = (slice(k * TILE_PX, (k + 1) * TILE_PX) for k in (row, column))
        tile = period[lines, samples].copy()
        tile[:, 1:] -= period[lines, samples][:, :-1]
        parts.append(zlib.compress(tile.tobytes(), 6))
    first = 8 + np.concatenate([[0], np.cumsum([len(part) for part in parts])])
    number = np.arange(per_side) % of_period
    used = (number[:, None] * of_period + number[None, :]).ravel()
    offsets = first[used].astype("<u4").tobytes()
    sizes = np.array([len(part) for part in parts])[used].astype("<u4").tobytes()
    arrays_at = int(first[-1])
    entries = [
        (256, 4, 1, side_px), (257, 4, 1, side_px), (258, 3, 1, 16), (259, 3, 1, 8), (262, 3, 1, 1),
        (277, 3, 1, 1), (317, 3, 1, 2), (322, 3, 1, TILE_PX), (323, 3, 1, TILE_PX),
        (324, 4, len(used), arrays_at), (325, 4, len(used), arrays_at + len(offsets)),
    ]  # fmt: skip
    with path.open("wb") as file:
        file.write(struct.pack("<2sHI", b"II", 42, arrays_at + len(offsets) + len(sizes)))
        file.write(b"".join([*parts, offsets, sizes]))
        file.write(struct.pack("<H", len(entries)))
        file.write(b"".join(struct.pack("<HHII", *entry) for entry in entries) + b"\0" * 4)


def _model(number: int, side_px: int, error_px: Array) -> RpcModel:
    """The model of an image, off by an error."""
    half = side_px / 2.0
    degrees = GSD_M * half / np.array(metres_per_degree(CENTRE_LON_LAT[1], 0.0))
    by_height = np.array(TANGENTS[number]) * HEIGHT_RANGE_M[1] / GSD_M / half
    line, sample, one = np.zeros(20), np.zeros(20), np.zeros(20)
    line[[2, 3]], sample[[1, 3]], one[0] = (-1.0, by_height[0]), (1.0, by_height[1]), 1.0
    return RpcModel(
        line, one, sample, one,
        np.full(2, half) + error_px, np.full(2, half),
        np.array([*CENTRE_LON_LAT, 0.0]), np.array([*degrees, HEIGHT_RANGE_M[1]]),
    )  # fmt: skip


def image_scene(number: int, side_px: int) -> Scene:
    """One of the images without pixels, with the model that is delivered."""
    error_px = np.random.default_rng([2, number]).normal(0.0, SIGMA_M / GSD_M, 2)
    incidence_deg = float(np.degrees(np.arctan(np.hypot(*TANGENTS[number]))))
    acquisition = Acquisition(f"image_{number}", incidence_deg=incidence_deg)
    blank = ArrayImage(np.broadcast_to(np.float32(np.nan), (side_px, side_px)))
    return Scene(blank, _model(number, side_px, error_px), acquisition, SIGMA_M)


def largest_disagreement_px(models: Sequence[SensorModel], side_px: int) -> float:
    """The largest residual of rays of the adjusted models to 25 places that the true models show."""
    true = [_model(number, side_px, np.zeros(2)) for number in range(len(models))]
    axis = np.linspace(0.1, 0.9, 5) * side_px
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    ground = true[0].locate(places, np.zeros(len(places)))
    point = np.repeat(np.arange(len(ground)), len(models))
    image = np.tile(np.arange(len(models)), len(ground))
    shown = np.stack([model.project(ground) for model in true], axis=1).reshape(-1, 2)
    met = intersect(models, Observations(point, image, shown, np.ones(len(point))), len(ground))
    return float(np.linalg.norm(met.residual_px, axis=1).max())


if __name__ == "__main__":
    main()
