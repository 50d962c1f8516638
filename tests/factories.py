"""Small valid blocks: random points with chips of noise that differ from each other."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.formats.block.document import (
    AccuracyFigure,
    BlockMetadata,
    BlockSpecification,
    Provenance,
    rectangle,
)
from amers.services.formats.block.writer import write_block
from amers.services.sensors.rpc import RpcModel
from amers.services.types import UNKNOWN_FRAME, Acquisition, Array, ChipArray, ControlPoints, Views

GSDS_M = (0.5, 2.0)
BOX = (5.2, 43.2, 5.3, 43.3)


@dataclass(frozen=True)
class MadeBlock:
    """A block in a folder and its contents.

    Attributes:
        folder: of the block.
        metadata: as written.
        points: in the order of the block, with their ids in the block.
        chips: from the row of a point to its chips, (views, 101, 101).
    """

    folder: Path
    metadata: BlockMetadata
    points: ControlPoints
    chips: Callable[[int], ChipArray]


def images(count: int) -> tuple[Acquisition, ...]:
    """Images taken a hundred days apart; sensor and date of the last one are unknown."""
    first = datetime(2023, 3, 1, 10, 30, tzinfo=UTC)
    dated = tuple(
        Acquisition(
            image_id=f"IMG_{i:02d}",
            sensor="PHR 1A",
            acquired_at=first + timedelta(days=100 * i),
            incidence_deg=5.0 * i,
            azimuth_deg=30.0 * i,
            sun_elevation_deg=50.0,
            sun_azimuth_deg=150.0,
        )
        for i in range(count - 1)
    )
    return (*dated, Acquisition(image_id=f"IMG_{count - 1:02d}"))


def control_points(
    count: int,
    rng: np.random.Generator,
    box: tuple[float, float, float, float] = BOX,
    n_images: int = 3,
    gsds_m: tuple[float, ...] = GSDS_M,
) -> ControlPoints:
    """Random points in a box, each with a view by every image at every ground sampling.

    Args:
        count: number of points.
        rng: of the positions, covariances and directions.
        box: west, south, east, north in degrees; a box with east below west crosses the antimeridian.
        n_images: number of images.
        gsds_m: ground samplings, metres.
    """
    outline = rectangle(*box)
    lon_lat_h = np.column_stack(
        [
            rng.uniform(outline[0, 0], outline[1, 0], count),
            rng.uniform(outline[0, 1], outline[2, 1], count),
            rng.uniform(40.0, 400.0, count),
        ]
    )
    lon_lat_h[:, 0] = np.where(lon_lat_h[:, 0] > 180.0, lon_lat_h[:, 0] - 360.0, lon_lat_h[:, 0])
    factor = rng.normal(0.0, 0.3, (count, 3, 3)) + np.eye(3)
    n_views = n_images * len(gsds_m)
    return ControlPoints(
        id=np.arange(count, dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=factor @ factor.transpose(0, 2, 1),
        block=np.zeros(count, dtype=np.int64),
        frames=(UNKNOWN_FRAME,),
        saliency=rng.uniform(0.0, 1.0, count).astype(np.float32).astype(np.float64),
        health=np.ones(count),
        views=Views(
            start=np.arange(count + 1, dtype=np.int64) * n_views,
            gsd_m=np.tile(np.repeat(np.sort(gsds_m), n_images), count),
            image=np.tile(np.arange(n_images, dtype=np.int64), count * len(gsds_m)),
            incidence_deg=rng.uniform(0.0, 30.0, count * n_views),
            azimuth_deg=rng.uniform(0.0, 360.0, count * n_views),
            health=np.ones(count * n_views),
            images=images(n_images),
        ),
        chip_file=np.zeros(count, dtype=np.int64),
        chip_row=np.zeros(count, dtype=np.int64),
        chip_files=(),
    )


def noise_chips(points: ControlPoints, dtype: type = np.uint16) -> Callable[[int], ChipArray]:
    """Chips of noise that depend on the position of the point only, not on its row."""

    def chips(row: int) -> ChipArray:
        views = int(points.views.start[row + 1] - points.views.start[row])
        rng = np.random.default_rng(zlib.crc32(points.lon_lat_h[row].tobytes()))
        top = 256 if dtype is np.uint8 else 4096
        return rng.integers(1, top, (views, CHIP_SIZE, CHIP_SIZE), dtype=dtype)

    return chips


def affine_model(centre_lon_lat: Array) -> RpcModel:
    """An affine RPC: pixels of 0.5 m, north up, with a displacement by the height."""
    one = np.eye(20)[0]
    line_num, sample_num = np.zeros(20), np.zeros(20)
    line_num[[2, 3]] = -1.0, 0.02
    sample_num[[1, 3]] = 1.0, 0.03
    return RpcModel(
        line_num=line_num,
        line_den=one,
        sample_num=sample_num,
        sample_den=one,
        image_offset=np.array([10_000.0, 10_000.0]),
        image_scale=np.array([10_000.0, 10_000.0]),
        ground_offset=np.array([*centre_lon_lat, 200.0]),
        ground_scale=np.array([0.06, 0.045, 500.0]),
    )


def metadata(
    name: str = "calanques",
    version: str = "1",
    box: tuple[float, float, float, float] = BOX,
    gsds_m: tuple[float, ...] = GSDS_M,
) -> BlockMetadata:
    """The metadata of a block, as a producer states them."""
    return BlockMetadata(
        id=name,
        version=version,
        title=f"Test block {name}",
        description='Points of noise, with "quotes" and accents: é.',
        license="CC-BY-4.0",
        extent=rectangle(*box),
        created=datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC),
        specification=BlockSpecification(gsds_m=gsds_m, min_views=2, points_per_km2=0.5),
        provenance=Provenance("amers", "0.1.0", ("IMG_00", "IMG_01"), {"seed": 1}),
        epoch=2024.5,
        accuracy=(AccuracyFigure("relative", "ce90_m", 0.42, 120, "tie points left out"),),
    )


def make_block(
    folder: Path,
    count: int = 40,
    *,
    seed: int = 1,
    name: str = "calanques",
    version: str = "1",
    box: tuple[float, float, float, float] = BOX,
    n_images: int = 3,
    gsds_m: tuple[float, ...] = GSDS_M,
    dtype: type = np.uint16,
) -> MadeBlock:
    """Write a small valid block: `count` points, each with `n_images` x `len(gsds_m)` chips."""
    rng = np.random.default_rng(seed)
    points = control_points(count, rng, box, n_images, gsds_m)
    block_metadata = metadata(name, version, box, gsds_m)
    outline = rectangle(*box)
    typology = [("crossroads", "building corner", 'a "rare" kind', None)[i % 4] for i in range(count)]
    order = write_block(
        folder,
        block_metadata,
        points,
        noise_chips(points, dtype),
        {"IMG_00": affine_model(outline.mean(axis=0))},
        typology=typology,
    )
    written = replace(points.take(order), id=np.arange(count, dtype=np.int64))
    return MadeBlock(folder, block_metadata, written, noise_chips(written, dtype))
