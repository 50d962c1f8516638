"""The images of a simulated continent as files, and their catalogue."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import rasterio
import rasterio.features
import shapely
from rasterio.windows import Window as RasterWindow

from amers.services.formats.images.raster import gdal_rpc
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.imagery.source import Window
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.archive import ArchiveView
from amers.services.simulation.conditions import clouds_over
from amers.services.simulation.tiles import TILE_PX
from amers.services.types import Array
from benchmarks._catalogue import write_catalogue
from benchmarks._continent import Continent

BITS = 12
_STRIP_LINES = 8 * TILE_PX
_BLOCK_PX = 256
_MASK_PX = 8
"""Pixels of an image for one of its cloud mask."""
_SEEN_OPACITY = 0.5
"""Opacity from which a producer's mask shows a cloud; thin edges are missed."""
_MASK_REACH = 1
"""Cells by which a producer widens its clouds."""


def write_image(continent: Continent, view: ArchiveView, path: Path) -> None:
    """Write an image as it is delivered: 12 bits, borders without data, tags with RPC and time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image, shape = continent.image(view), view.plan.shape
    part = path.with_suffix(".part.tif")
    moment = view.plan.acquired_at
    with rasterio.open(
        part,
        "w",
        driver="GTiff",
        height=shape[0],
        width=shape[1],
        count=1,
        dtype="uint16",
        nbits=BITS,
        nodata=0,
        tiled=True,
        blockxsize=_BLOCK_PX,
        blockysize=_BLOCK_PX,
    ) as file:
        file.rpcs = gdal_rpc(delivered_model(continent, view))
        file.update_tags(
            MISSION=view.platform,
            IMAGING_DATE=f"{moment:%Y-%m-%d}",
            IMAGING_TIME=f"{moment:%H:%M:%S.%f}Z",
        )
        for line in range(0, shape[0], _STRIP_LINES):
            lines = min(_STRIP_LINES, shape[0] - line)
            pixels = image.read(Window(line, 0, lines, shape[1])).astype(np.uint16)
            pixels[_border(view, line, lines)] = 0
            file.write(pixels, 1, window=RasterWindow(0, line, shape[1], lines))
    part.rename(path)


def delivered_model(continent: Continent, view: ArchiveView) -> RpcModel:
    """The RPC of an image with its errors, and their stated standard deviations."""
    bias_m, random_m = view.stated_m
    delivered = continent.geometry(view).delivered
    return replace(delivered, error_bias_m=bias_m, error_random_m=random_m)


def write_archive_catalogue(continent: Continent) -> Path:
    """Write items and masks of the images, and the area; returns the file of the items."""
    folder = continent.folder / "archive"
    feature = {
        "type": "Feature",
        "properties": {},
        "geometry": json.loads(shapely.to_geojson(continent.area)),
    }
    (continent.folder / "area.geojson").write_text(json.dumps(feature))
    return write_catalogue(archive_catalogue(continent), folder)


def archive_catalogue(continent: Continent) -> ImageCatalogue:
    """What the producers state of the images of the archive."""
    views = list(continent.views.values())
    models = [delivered_model(continent, view) for view in views]
    taken = [continent.geometry(view).acquisition for view in views]
    shown = [_footprint(view, model) for view, model in zip(views, models, strict=True)]
    masks = [_cloud_mask(view, model) for view, model in zip(views, models, strict=True)]
    covers = [100.0 * mask.area / ground.area for mask, ground in zip(masks, shown, strict=True)]
    numbers = {
        name: np.array([getattr(one, name) for one in taken])
        for name in ("incidence_deg", "azimuth_deg", "sun_elevation_deg", "sun_azimuth_deg")
    }
    return ImageCatalogue(
        id=_objects([view.name for view in views]),
        footprint=_objects(shown),
        mask=_objects(masks),
        acquired=np.array(
            [view.plan.acquired_at.replace(tzinfo=None) for view in views], dtype="datetime64[ms]"
        ),
        cloud_percent=np.round(np.array(covers), 1),
        snow_percent=np.zeros(len(views)),
        platform=_objects([view.platform for view in views]),
        orbit=np.array([view.orbit for view in views], dtype=np.int64),
        **numbers,
    )


def _border(view: ArchiveView, line: int, lines: int) -> Array:
    """Which pixels (lines, samples) have no data: a slanted border on the left and on the right."""
    first, last = view.border_px
    width = first + (last - first) * (np.arange(line, line + lines) / view.plan.shape[0])
    sample = np.arange(view.plan.shape[1])
    from_edge = np.minimum(sample, view.plan.shape[1] - 1 - sample)
    return np.asarray(from_edge[None, :] < width[:, None])


def _footprint(view: ArchiveView, model: RpcModel) -> shapely.Polygon:
    lines, samples = view.plan.shape
    first, last = view.border_px
    corners = [
        [0.0, first],
        [0.0, samples - 1.0 - first],
        [lines - 1.0, samples - 1.0 - last],
        [lines - 1.0, last],
    ]
    return shapely.Polygon(_ground(model, np.array(corners)))


def _cloud_mask(view: ArchiveView, model: RpcModel) -> shapely.MultiPolygon:
    """The clouds of an image as its producer outlines them, on the ground."""
    rng = np.random.default_rng([view.seed, 0])
    clouds = clouds_over(view.plan.shape, view.conditions.cloud_cover, rng)
    if clouds is None:
        return shapely.MultiPolygon()
    line, sample = (np.arange(0.0, size, _MASK_PX) for size in view.plan.shape)
    seen = (clouds.opacity(line, sample) > _SEEN_OPACITY).astype(np.uint8)
    seen = cv2.dilate(seen, np.ones((2 * _MASK_REACH + 1,) * 2, np.uint8))
    outlines = []
    for geometry, value in rasterio.features.shapes(seen, mask=seen > 0):
        if value > 0:
            cloud = shapely.simplify(shapely.geometry.shape(geometry), 1.0)
            outlines.append(
                shapely.transform(cloud, lambda xy: _ground(model, (xy[:, ::-1] - 0.5) * _MASK_PX))
            )
    whole = shapely.make_valid(shapely.union_all(shapely.make_valid(np.array(outlines))))
    inside = shapely.intersection(whole, _footprint(view, model))
    parts = shapely.get_parts(inside)
    return shapely.MultiPolygon([part for part in parts if part.geom_type == "Polygon"])


def _ground(model: RpcModel, line_sample: Array) -> Array:
    """Longitudes and latitudes (n, 2) of image positions at the middle height of their model."""
    height_m = np.full(len(line_sample), sum(model.height_range_m) / 2.0)
    return np.asarray(model.locate(np.asarray(line_sample, dtype=np.float64), height_m)[:, :2])


def _objects(values: list[object]) -> np.ndarray:
    out = np.empty(len(values), dtype=object)
    out[:] = values
    return out
