"""Scenes of the flat world that look at it from different sides, with models that are off."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio

from amers.services.formats.images.raster import gdal_rpc
from amers.services.sensors.rpc import RpcModel
from amers.services.types import FloatImage
from tests.app.flat_world import FlatWorld, flat_texture

A_FIFTH_OF_A_PIXEL = 0.2
SCENES = {"east": (0.05, 0.3, (12.0, -7.0)), "south": (0.3, 0.02, (-9.0, 10.0))}
"""How scenes look, in sizes of the image by the height, and by how much their models are off."""


def write_scenes(world: FlatWorld, folder: Path) -> Path:
    """Write two scenes of the ground of the block, and one of other ground, into a folder."""
    rng = np.random.default_rng(8)
    for name, (_, _, shift_px) in SCENES.items():
        write_scene(folder / f"{name}.tif", true_model(world, name), shift_px, world.ground, rng)
    other = flat_texture(len(world.ground), rng)
    write_scene(folder / "wrong.tif", true_model(world, "east"), (3.0, 3.0), other, rng)
    return folder


def true_model(world: FlatWorld, name: str) -> RpcModel:
    """Flat ground looks the same from all sides."""
    line_num, sample_num = world.true_model.line_num.copy(), world.true_model.sample_num.copy()
    line_num[3], sample_num[3] = SCENES[name][:2]
    return replace(world.true_model, line_num=line_num, sample_num=sample_num)


def write_scene(
    path: Path,
    truth: RpcModel,
    shift_px: tuple[float, float],
    ground: FloatImage,
    rng: np.random.Generator,
) -> None:
    pixels = np.clip(ground + rng.normal(0.0, 20.0, ground.shape), 1.0, 4095.0)
    profile = {"driver": "GTiff", "width": len(ground), "height": len(ground), "count": 1}
    with rasterio.open(path, "w", **profile, dtype="uint16") as file:
        file.write(np.rint(pixels).astype(np.uint16), 1)
        file.rpcs = gdal_rpc(replace(truth, image_offset=truth.image_offset - shift_px))
