"""Scenes of the flat world in later years: another season, changes of the ground, clouds."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import rasterio

from amers.services.formats.block.check import check_block
from amers.services.formats.images.raster import gdal_rpc
from amers.services.types import Array, FloatImage, IntArray
from tests.app.flat_world import FlatWorld, flat_texture, make_flat_world

POINTS = 100
HALF_PX = 40
"""Half of the side of what changes around a point, and of a cloud: more than half of a fine chip."""


@dataclass(frozen=True)
class Years:
    """A flat world and what its later scenes show.

    Attributes:
        world: the block and its ground in summer.
        winter: the same ground in winter: what the summer shows is the lesser part of it.
        places: (n, 2) line, sample of the points of the block, by their ids in it.
    """

    world: FlatWorld
    winter: FloatImage
    places: IntArray


def make_years(folder: Path) -> Years:
    """A block cut from summer images, and its ground in winter."""
    world = make_flat_world(folder, points=POINTS)
    points = check_block(world.block).points
    other = flat_texture(world.ground.shape[0], np.random.default_rng(77)) - 1500.0
    winter = 1800.0 + 0.65 * (world.ground - 1500.0) + 0.6 * other
    return Years(
        world,
        winter.astype(np.float32),
        world.true_model.project(points.lon_lat_h).round().astype(np.int64),
    )


def write_scene(
    years: Years,
    path: Path,
    ground: FloatImage,
    *,
    day: str,
    changed: IntArray | tuple[int, ...] = (),
    clouded: IntArray | tuple[int, ...] = (),
    shift_px: Array | tuple[float, float] = (7.0, -5.0),
) -> Path:
    """Write a scene with tags of its date and of a model that is wrong by a shift.

    Args:
        years: the world.
        path: of the GeoTIFF.
        ground: what it shows.
        day: when it was taken.
        changed: ids of the points whose ground is a new one, the same from now on.
        clouded: ids of the points that lie under a cloud which no mask tells.
        shift_px: of the delivered model.
    """
    rng = np.random.default_rng(list(day.encode()))
    pixels = ground.copy()
    for point in changed:
        here = _around(years.places[point], pixels.shape)
        new = flat_texture(2 * HALF_PX + 1, np.random.default_rng(1000 + int(point)))
        pixels[here] = new[: pixels[here].shape[0], : pixels[here].shape[1]]
    for point in clouded:
        here = _around(years.places[point], pixels.shape)
        pixels[here] = 3000.0 + cv2.GaussianBlur(pixels[here], (0, 0), 15.0) * 0.1
    pixels = rng.uniform(0.8, 1.2) * pixels + rng.normal(0.0, 20.0, pixels.shape)
    model = replace(
        years.world.true_model,
        image_offset=years.world.true_model.image_offset - np.asarray(shift_px),
    )
    size = pixels.shape[0]
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "uint16"}
    with rasterio.open(path, "w", **profile) as file:
        file.write(np.rint(np.clip(pixels, 1.0, 4095.0)).astype(np.uint16), 1)
        file.rpcs = gdal_rpc(model)
        file.update_tags(MISSION="PHR", MISSION_INDEX="1A", IMAGING_DATE=day, IMAGING_TIME="10:30:00.0Z")
    return path


def _around(place: IntArray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    low = np.maximum(place - HALF_PX, 0)
    high = np.minimum(place + HALF_PX + 1, shape)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
