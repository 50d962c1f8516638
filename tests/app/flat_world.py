"""A textured plane, a block of points on it, and a scene of it whose model has a known error."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio

from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.imagery.source import ArrayImage, ImageSource, render_chip
from amers.services.sensors.rpc import RpcModel
from amers.services.types import UNKNOWN_FRAME, Array, ChipArray, ControlPoints, FloatImage, Frame, Views
from tests.factories import images, metadata

CENTRE = np.array([5.25, 43.25])
GROUND_H = 200.0
GSD_M = 0.5
GSDS_M = (0.5, 2.0)
SHIFT_PX = np.array([14.0, -9.0])
"""The shift that corrects the delivered model, line and sample."""
SIGMA_M = 6.0
VIEWS = 2


@dataclass(frozen=True)
class FlatWorld:
    """Files of a block and of a scene, and the truth about the scene.

    Attributes:
        block: folder of the block.
        image: GeoTIFF of the scene, without tags.
        rpc_text: its delivered model as a file beside it.
        tagged: the same scene with the model in its tags.
        true_model: of the scene.
        ground: what its images show, but for their gain and noise.
    """

    block: Path
    image: Path
    rpc_text: Path
    tagged: Path
    true_model: RpcModel
    ground: FloatImage


def make_flat_world(
    folder: Path, size: int = 1200, points: int = 40, seed: int = 5, frame: Frame = UNKNOWN_FRAME
) -> FlatWorld:
    """Write a block and a scene of `size` x `size` pixels that share a piece of ground.

    The block states its frame on the Earth, or none.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    truth, ground = flat_model(size), flat_texture(size, rng)
    seen = [_seen(ground, rng) for _ in range(VIEWS + 1)]
    write_flat_block(
        folder / "block", truth, [ArrayImage(image) for image in seen[:VIEWS]], points, rng, frame
    )
    delivered = replace(truth, image_offset=truth.image_offset - SHIFT_PX)
    image, tagged = folder / "scene.tif", folder / "tagged.tif"
    for path, model in ((image, None), (tagged, delivered)):
        profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "uint16"}
        with rasterio.open(path, "w", **profile) as file:
            file.write(np.rint(seen[VIEWS]).astype(np.uint16), 1)
            if model is not None:
                file.rpcs = gdal_rpc(model)
    rpc_text = folder / "scene_RPC.TXT"
    rpc_text.write_text(format_rpc_text(delivered))
    return FlatWorld(folder / "block", image, rpc_text, tagged, truth, ground)


def flat_model(size: int) -> RpcModel:
    """A vertical, north-up view whose positions depend slightly on the height."""
    one = np.eye(20)[0]
    line_num, sample_num = np.zeros(20), np.zeros(20)
    line_num[[2, 3]] = -1.0, 0.02
    sample_num[[1, 3]] = 1.0, 0.03
    half_m = size * GSD_M / 2.0
    metre_deg = 1.0 / 111_320.0
    return RpcModel(
        line_num=line_num,
        line_den=one,
        sample_num=sample_num,
        sample_den=one,
        image_offset=np.full(2, (size - 1.0) / 2.0),
        image_scale=np.full(2, size / 2.0),
        ground_offset=np.array([*CENTRE, GROUND_H]),
        ground_scale=np.array(
            [half_m * metre_deg / np.cos(np.radians(CENTRE[1])), half_m * metre_deg, 500.0]
        ),
    )


def flat_texture(size: int, rng: np.random.Generator) -> FloatImage:
    """Noise at all scales, like natural ground."""
    out = np.full((size, size), 1500.0, dtype=np.float32)
    for sigma in (1.0, 3.0, 9.0, 27.0):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        out += 200.0 * layer / layer.std()
    return out


def _seen(ground: FloatImage, rng: np.random.Generator) -> FloatImage:
    """The ground with another illumination and the noise of another sensor."""
    gain, noise = rng.uniform(0.8, 1.2), rng.normal(0.0, 20.0, ground.shape)
    return np.clip(gain * ground + noise, 1.0, 4095.0).astype(np.float32)


def write_flat_block(
    folder: Path,
    model: RpcModel,
    seen: Sequence[ImageSource],
    count: int,
    rng: np.random.Generator,
    frame: Frame = UNKNOWN_FRAME,
) -> None:
    """Write a block of points on the plane, with chips of images that all have one model."""
    size = seen[0].shape[0]
    margin = 50 * GSDS_M[-1] / GSD_M + 20
    line_sample = rng.uniform(margin, size - margin, (count, 2))
    points = _control_points(model.locate(line_sample, np.full(count, GROUND_H)), count)

    def chips(row: int) -> ChipArray:
        cut = [
            render_chip(image, model, points.lon_lat_h[row], gsd_m) for gsd_m in GSDS_M for image in seen
        ]
        return np.rint(np.stack(cut)).astype(np.uint16)

    low, high = points.lon_lat_h[:, :2].min(axis=0) - 1e-4, points.lon_lat_h[:, :2].max(axis=0) + 1e-4
    block_metadata = metadata("flat", "1", (low[0], low[1], high[0], high[1]), GSDS_M)
    write_block(folder, replace(block_metadata, frame=frame), points, chips, {})


def _control_points(lon_lat_h: Array, count: int) -> ControlPoints:
    per_point = VIEWS * len(GSDS_M)
    return ControlPoints(
        id=np.arange(count, dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=np.broadcast_to(np.diag([0.01, 0.01, 0.04]), (count, 3, 3)).copy(),
        block=np.zeros(count, dtype=np.int64),
        frames=(UNKNOWN_FRAME,),
        saliency=np.full(count, 0.8),
        health=np.ones(count),
        views=Views(
            start=np.arange(count + 1, dtype=np.int64) * per_point,
            gsd_m=np.tile(np.repeat(GSDS_M, VIEWS), count),
            image=np.tile(np.arange(VIEWS, dtype=np.int64), count * len(GSDS_M)),
            incidence_deg=np.full(count * per_point, 3.0),
            azimuth_deg=np.full(count * per_point, 90.0),
            health=np.ones(count * per_point),
            images=images(VIEWS),
        ),
        chip_file=np.zeros(count, dtype=np.int64),
        chip_row=np.zeros(count, dtype=np.int64),
        chip_files=(),
    )


def publish_world(dsn: str, storage: Storage, world: FlatWorld) -> None:
    """Ingest and publish the block of a world."""
    with engine.connect(dsn) as connection:
        publish_block(connection, str(ingest_block(connection, storage, world.block).block.number))
