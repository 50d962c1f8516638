"""Images as satellites with rigorous models deliver them: image and metadata by their names."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from amers.services.sensors.light_path import GEOMETRIC, LightPath
from amers.services.sensors.pushbroom import PushbroomModel
from tests.services.formats.sensor_models import simulated_metadata as simulated

OF_WORLDVIEW = LightPath(velocity_aberration=True, light_time=True, refraction=True)
GROUND_H = 1500.0


@dataclass(frozen=True)
class Product:
    """Metadata with a rigorous model, and the names under which it is delivered.

    Attributes:
        write: the metadata of a model.
        image, metadata: names of the files, with the number of the image in braces.
        light_path: that the metadata leave to the reader.
    """

    write: Callable[[PushbroomModel], str]
    image: str
    metadata: str
    light_path: LightPath = GEOMETRIC


PRODUCTS = {
    "SPOT 1 to 4": Product(simulated.spot4_dimap, "IMAGERY.TIF", "METADATA.DIM"),
    "SPOT 5": Product(simulated.spot5_dimap, "IMAGERY.TIF", "METADATA.DIM"),
    "SPOT 6/7, Pléiades": Product(
        simulated.dimap_v2, "IMG_SPOT6_P_20210603102{}.TIF", "DIM_SPOT6_P_20210603102{}.XML"
    ),
    "Pléiades, CNES": Product(
        simulated.phr_dimap, "IMG_P1BP--202106031234{}CP.TIF", "PHRDIMAP_P1BP--202106031234{}CP.XML"
    ),
    "WorldView": Product(
        simulated.worldview_isd, "21JUN03-P1BS_R1C1-P00{}.TIF", "21JUN03-P1BS-P00{}.XML", OF_WORLDVIEW
    ),
}
"""By the names of the table in `docs/methods/rigorous_models.md`."""


def write_product(folder: Path, name: str, number: int = 1) -> Path:
    """Write a product into a folder of its own; returns its image, without any texture."""
    product = PRODUCTS[name]
    folder.mkdir(parents=True)
    model = simulated.truth(product.light_path, 18.0 / number)
    (folder / product.metadata.format(number)).write_text(product.write(model), encoding="utf-8")
    path = folder / product.image.format(number)
    write_empty(path, model.image_shape)
    return path


def write_empty(path: Path, shape: tuple[int, int]) -> None:
    """Write an image without any texture."""
    lines, samples = shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=lines,
        width=samples,
        count=1,
        dtype="uint8",
        tiled=True,
        sparse_ok=True,
        compress="deflate",
    ):
        pass
    # An image of so few bytes for its pixels counts as a bomb.
    os.truncate(path, max(path.stat().st_size, lines * samples // 1000))


def write_terrain(path: Path) -> Path:
    """Flat ground below all products, heights above the ellipsoid."""
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=60,
        width=60,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=from_origin(6.9, 46.0, 0.004, 0.004),
    ) as file:
        file.write(np.full((1, 60, 60), GROUND_H, dtype=np.float32))
    return path


def write_mark(path: Path, name: str) -> Path:
    """One mark in the middle of the image of a product, 20 px off its model."""
    model = simulated.truth(PRODUCTS[name].light_path)
    line, sample = (np.array(model.image_shape) - 1.0) / 2.0
    lon, lat, h = model.locate(np.array([[line, sample]]), np.array([GROUND_H]))[0].tolist()
    path.write_text(
        "# pixel-origin=centre heights=ellipsoid\nid,lon,lat,height_m,line,sample\n"
        f"GCP,{lon!r},{lat!r},{h!r},{line + 12.0},{sample - 16.0}\n"
    )
    return path
