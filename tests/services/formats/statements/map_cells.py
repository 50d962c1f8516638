"""Maps of ortho-images: datums with and without a usable transformation, units, epochs, nodes."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from amers.services.formats.elevation.rows import MAP_READER
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.statements import Subject
from tests.services.formats.statements.cell import Read, add
from tests.services.formats.statements.terrain_cells import SYSTEMS, with_epoch

SIGMA_M = 1.0


def ortho(folder: Path, crs: str, tags: dict[str, str] | None = None, **options: Any) -> Path:
    x, y, step = SYSTEMS.get(crs.partition("+")[0], SYSTEMS["EPSG:32631"])
    options = {"transform": Affine(step, 0, x, 0, -step, y)} | options
    path = folder / "ortho.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=9, width=9, count=1, dtype="uint8", crs=crs, **options
    ) as file:
        file.write(np.full((1, 9, 9), 7, np.uint8))
        file.update_tags(**(tags or {}))
    return path


def scene_of(crs: str, datum_sigma_m: float = 0.0, **form: Any) -> Read:
    """Writes an ortho-image and reads it; the accuracy of the datum is in its sigma."""

    def read(folder: Path) -> Scene:
        scene = read_scene(ortho(folder, crs, **form), sigma_m=SIGMA_M)
        assert scene.sigma_m == pytest.approx(math.hypot(SIGMA_M, datum_sigma_m))
        return scene

    return read


for crs, sigma_m, shows in (
    ("EPSG:32631", 0.0, "WGS 84 / UTM zone 31N: used"),
    ("EPSG:3857", 0.0, "used"),
    ("EPSG:25832", 0.0, "leaves positions as they are"),
    ("EPSG:26713", 7.0, "accuracy 7 m, which enters the sigmas; 2.15 m with its grid"),
    ("EPSG:31468", 2.0, "DHDN to WGS 84 (3)"),
    ("EPSG:21781", 1.5, "CH1903 to WGS 84 (2)"),
    ("EPSG:27700", 2.0, "OSGB36 to WGS 84 (6)"),
    ("EPSG:28992", 1.0, "Amersfoort to WGS 84 (4)"),
    ("EPSG:4230", 2.0, "ED50 to WGS 84 (17)"),
    ("+proj=utm +zone=31 +ellps=intl +towgs84=-87,-98,-121 +units=m", 0.0, "unknown accuracy"),
):
    name = f"datum_of_{crs}"
    add(MAP_READER, Subject.HORIZONTAL_DATUM, "used", shows, name, scene_of(crs, sigma_m))
for ellipsoid in ("GRS80", "WGS84"):
    crs = f"+proj=utm +zone=31 +ellps={ellipsoid} +units=m"
    add(MAP_READER, Subject.HORIZONTAL_DATUM, "assumed", "taken as WGS 84", ellipsoid, scene_of(crs))
for ellipsoid in ("bessel", "intl", "clrk66", "krass", "airy"):
    crs = f"+proj=utm +zone=31 +ellps={ellipsoid} +units=m"
    add(MAP_READER, Subject.HORIZONTAL_DATUM, "refused", "+towgs84=", ellipsoid, scene_of(crs))
for crs, shows in (("EPSG:4326+5773", "EGM96 height"), ("EPSG:4979", "the ellipsoid")):
    read = scene_of(crs, transform=Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0))
    add(MAP_READER, Subject.VERTICAL_DATUM, "named", shows, crs, read)
for crs in ("EPSG:2263", "EPSG:6539"):
    add(MAP_READER, Subject.UNIT, "used", "US survey foot", crs, scene_of(crs))
for point in ("Area", "Point"):
    read = scene_of("EPSG:32631", tags={"AREA_OR_POINT": point})
    add(MAP_READER, Subject.PIXEL_ORIGIN, "used", point, f"nodes_as_{point}", read)


def of_an_epoch(folder: Path) -> Scene:
    path = ortho(folder, "EPSG:9000", transform=Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0))
    with_epoch(path, 2010.0)
    return read_scene(path, sigma_m=SIGMA_M)


def by_a_world_file(folder: Path) -> Scene:
    path = ortho(folder, "EPSG:32631", transform=Affine.identity())
    (folder / "ortho.tfw").write_text("10\n0\n0\n-10\n675005\n4897995\n")
    return read_scene(path, sigma_m=SIGMA_M)


add(MAP_READER, Subject.EPOCH, "named", "2010.00", "epoch", of_an_epoch)
add(MAP_READER, Subject.PLACE, "used", "ortho.tfw", "world_file", by_a_world_file)
