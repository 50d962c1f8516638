"""What a base is asked for: where, from which archive, which catalogues."""

import math
from dataclasses import dataclass
from pathlib import Path

import shapely

from amers.app.errors import InputError
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.formats.archive_file import read_archive
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.stac.catalogue import parse_area
from amers.services.formats.text_files import load_json, read_text
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.archives import ARCHIVES, Archive
from amers.services.imagery.scene import scene_footprint

MOST_KM2 = 200_000.0
"""Largest area of one base: a country such as the United Kingdom is made of several."""


@dataclass(frozen=True)
class BaseRequest:
    """Where a base is made, and of what.

    Attributes:
        source: archive: sentinel-2, landsat, or a TOML file that describes another (--from).
        catalogues: STAC: address of a search API, or a folder or file, given repeatedly. Nothing else
            is contacted than these, the files that their items name, and what signs their addresses.
        area: GeoJSON with the polygons of the region.
        bbox: west, south, east, north, degrees.
        scene: image whose ground, and the accuracy around it, is the region.
        terrain: heights of the ground; by default the Copernicus DEM of the same catalogues.
        geoid: grid of EGM2008, for the Copernicus DEM.
        since: leave out images before this day, UTC: YYYY-MM-DD.
    """

    source: str
    catalogues: tuple[str, ...]
    area: Path | None = None
    bbox: tuple[float, float, float, float] | None = None
    scene: Path | None = None
    terrain: TerrainFile | None = None
    geoid: Path | None = None
    since: str | None = None


@dataclass(frozen=True)
class BaseOptions:
    """How a base is made.

    Attributes:
        dates: number of clear dates that every place needs, distributed over seasons and orbits.
        spacing_m: side of the squares that get one point each, metres; by default a hundred pixels, less
            in a small region.
        min_share: smallest share of the dates showing a point in which the point is found, 0 to 1.
        max_cloud: largest cloud cover of an image according to its catalogue, percent.
        min_clear: smallest clear share of an image in the region according to its mask, percent.
        height_sigma_m: sigma of the heights, metres; by default the sigma of the terrain.
        frame_sigma_up_m: common error of all heights, one sigma, metres; by default the common error of
            the Copernicus DEM, otherwise unknown.
    """

    dates: int = 8
    spacing_m: float | None = None
    min_share: float = 0.6
    max_cloud: float = 60.0
    min_clear: float = 60.0
    height_sigma_m: float | None = None
    frame_sigma_up_m: float | None = None


def archive_of(source: str) -> Archive:
    """The archive of a name, or the one that a file describes.

    Raises:
        InputError: there is no such name, and no such file.
    """
    if source in ARCHIVES:
        return ARCHIVES[source]
    if not source.endswith(".toml"):
        raise InputError(f"--from: {source!r:.80} found, {', '.join(ARCHIVES)} or FILE.toml expected")
    return read_archive(Path(source))


def area_of(request: BaseRequest) -> shapely.Geometry:
    """The polygons of a request, longitude and latitude.

    Raises:
        InputError: none or several regions are given, or it is none on the Earth, or too large.
    """
    given = [request.area, request.bbox, request.scene]
    if sum(one is not None for one in given) != 1:
        raise InputError("a region is missing, or there are several: --area, --bbox or --scene expected")
    if request.area is not None:
        area = parse_area(load_json(read_text(request.area), str(request.area)), str(request.area))
    elif request.bbox is not None:
        west, south, east, north = request.bbox
        if not (-180.0 <= west < east <= 180.0 and -85.0 <= south < north <= 85.0):
            raise InputError(
                f"--bbox: {west:g} {south:g} {east:g} {north:g} found, W S E N in degrees with W < E "
                "within 180 and S < N within 85 expected; make two bases of a region that crosses 180"
            )
        area = shapely.box(*request.bbox)
    else:
        area = _around_scene(request)
    size_km2 = area_km2(area)
    if not 0.0 < size_km2 <= MOST_KM2:
        raise InputError(
            f"the region has {size_km2:,.0f} km², up to {MOST_KM2:,.0f} expected; make a base of each "
            "part"
        )
    return area


def area_km2(area: shapely.Geometry) -> float:
    """The size of a region on the ground, to a percent."""
    total = 0.0
    for part in shapely.get_parts(area):
        lat = part.centroid.y
        east_m, north_m = metres_per_degree(lat, 0.0)
        total += part.area * east_m * north_m
    return total / 1e6


def _around_scene(request: BaseRequest) -> shapely.Geometry:
    assert request.scene is not None
    scene = read_scene(request.scene)
    try:
        polygon = shapely.Polygon(scene_footprint(scene))
        east_m, _ = metres_per_degree(polygon.centroid.y, 0.0)
        return polygon.buffer(MAX_ERROR_SIGMAS * scene.sigma_m / max(east_m, 1.0) * math.sqrt(2.0))
    finally:
        scene.image.close()  # type: ignore[attr-defined]
