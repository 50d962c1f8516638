"""A draw of an archipelago (`benchmarks._cape_verde`) as files that commands read."""

import csv
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from amers.services.formats.images.ortho import gdal_transform
from amers.services.formats.images.raster import gdal_rpc
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.rpc import RpcModel
from benchmarks._cape_verde import (
    ISLAND_SIGMA_M,
    POINT_SIGMA_M,
    SITE_FRAME_M,
    SITE_OWN_M,
    SITES,
    Draw,
    ground,
)

_TILE_PX = 128


def write_files(folder: Path, one: Draw) -> list[str]:
    """Images without pixels, a file of marks for each site, one for the ties, and a terrain.

    Returns:
        What follows `amers points reach`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    images = {image.name: folder / f"{image.name.replace(' ', '_')}.tif" for image in one.images}
    words = []
    for image, kind in zip(one.images, one.kinds, strict=True):
        _write_image(images[image.name], image.model, kind.shape)
        words += ["--images", str(images[image.name])]
        words += ["--sigma-m", f"{images[image.name].name}={kind.shift_m:g}"]
        words += ["--edge-sigma-m", f"{images[image.name].name}={kind.slope_m:g}"]
    names = ["ties", *SITES]
    marks = [folder / f"{name}.csv" for name in names]
    for number, path in enumerate(marks):
        _write_marks(path, one, number - 1, [images[image.name].name for image in one.images])
    dem = folder / "dem.tif"
    _write_terrain(dem)
    sigma_m = float(np.hypot(ISLAND_SIGMA_M, POINT_SIGMA_M))
    words += ["--dem", str(dem), "--dem-vertical", "ellipsoid", "--dem-sigma-m", f"{sigma_m:.2f}"]
    words += ["--site-frame-sigma-m", f"{SITE_FRAME_M},{SITE_FRAME_M}"]
    words += ["--point-sigma-m", f"{SITE_OWN_M},{SITE_OWN_M}", "--vertical", "ellipsoid"]
    return [*map(str, marks), *words]


def _write_image(path: Path, model: object, shape: tuple[int, int]) -> None:
    """A GeoTIFF of empty tiles with the model of an image."""
    place = {}
    if isinstance(model, OrthoModel):
        place = {"crs": model.grid.crs, "transform": gdal_transform(model.grid)}
    with rasterio.open(
        path, "w", "GTiff", shape[1], shape[0], 1, dtype="uint8", tiled=True, sparse_ok=True,
        blockxsize=_TILE_PX, blockysize=_TILE_PX, bigtiff="yes", **place,
    ) as file:  # fmt: skip
        if isinstance(model, RpcModel):
            file.rpcs = gdal_rpc(model)


def _write_marks(path: Path, one: Draw, site: int, images: list[str]) -> None:
    """The marks of the points of a site, with their known ground, or of the ties (-1) without."""
    known = {}
    if site >= 0:
        own = one.sites[site].ground
        known = dict(zip(own.point.tolist(), own.lon_lat_h.tolist(), strict=True))
    with path.open("w", newline="") as file:
        file.write("# pixel-origin=centre\n")
        rows = csv.writer(file)
        ground_columns = ["lon", "lat", "height_m"] if site >= 0 else []
        rows.writerow(["id", "image", "line", "sample", "sigma_px", *ground_columns])
        seen = one.observations
        for row in np.flatnonzero(one.site[seen.point] == site).tolist():
            point = int(seen.point[row])
            place = [repr(value) for value in known.get(point, [])]
            line, sample = seen.line_sample[row].tolist()
            sigma_px = float(np.ravel(seen.sigma_px[row])[0])
            image = images[int(seen.image[row])]
            rows.writerow([f"P{point}", image, repr(line), repr(sample), sigma_px, *place])


def _write_terrain(path: Path) -> None:
    land = ground()
    lines, samples = land.grid.shape
    step = float(land.grid.step_xy[0, 1])
    west, north = (float(value) for value in land.grid.origin_xy)
    place = from_origin(west - step / 2.0, north + step / 2.0, step, step)
    with rasterio.open(
        path, "w", "GTiff", samples, lines, 1, crs="EPSG:4326", transform=place, dtype="float32"
    ) as file:
        file.write(land.height_m.reshape(lines, samples).astype(np.float32), 1)
