"""The surface of a job on the map: its tiles, and its heights at a place or along a line."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.db.jobs.jobs import Job
from amers.app.errors import DamagedFile, InputError, NotFound
from amers.app.storage import Storage
from amers.app.usecases.damage import named_by_row
from amers.app.usecases.results import result_key
from amers.services.errors import FormatError
from amers.services.formats.addresses import Address
from amers.services.formats.images.surface_tiles import draw_surface_tile, outline_of, surface_limits
from amers.services.formats.images.surfaces import SurfaceImage, open_surface, read_reduced
from amers.services.geodesy import continuous
from amers.services.orthorectification.tile_limits import TileLimits, TilePlace
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.surface.relief import HEIGHT_COLOURS, shown_range
from amers.services.types import Array

SURFACE_NAME = "surface.tif"
MOST_PLACES = 400
"""Places along a line at most: about as many as the chart of a page has pixels."""
_LIMITS, _BOUNDS, _RANGE, _COLOURS = "tile_limits", "bounds", "height_range_m", "height_colours"
_LOOKED_AT = 800
"""Cells a side that tell the range of the heights."""

MAP_VALUES: dict[str, dict[str, Any]] = {
    _LIMITS: {
        "type": "array",
        "items": {"type": "object"},
        "title": "First and last rows and columns of tiles, from the finest zoom to the coarsest",
    },
    _BOUNDS: {
        "type": "array",
        "items": {"type": "number"},
        "title": "West, south, east and north of the surface, degrees",
    },
    _RANGE: {
        "type": "array",
        "items": {"type": "number"},
        "title": "Heights of the first and the last colour of the tiles, metres",
    },
    _COLOURS: {
        "type": "array",
        "items": {"type": "string"},
        "title": "Colours of the tiles, from the lowest height to the highest",
    },
}
"""Values of the results that the map needs, as the process describes them."""


@dataclass(frozen=True)
class HeightAt:
    """What a surface has at a place.

    Attributes:
        distance_m: from the first place.
        lon, lat: degrees.
        height_m: above the ellipsoid; None where the cell has no height.
        sigma_m: one standard deviation; None where the cell has no height.
        views: number of images; 0 where it was filled or has no height.
        reason: why the cell has no height, or that it has one.
    """

    distance_m: float
    lon: float
    lat: float
    height_m: float | None
    sigma_m: float | None
    views: int
    reason: str


def map_values(surface: Path) -> dict[str, Any]:
    """The values of `MAP_VALUES` for the file of a surface; no tiles where it is too near to a pole."""
    with open_surface(surface) as opened:
        outline = continuous(outline_of(opened))
        limits = []
        with suppress(InputError):
            limits = surface_limits(opened)
    bands, _ = read_reduced(surface, _LOOKED_AT)
    return {
        _LIMITS: [asdict(one) for one in limits],
        _BOUNDS: [*outline.min(axis=0).tolist(), *outline.max(axis=0).tolist()],
        _RANGE: list(shown_range(bands[0])),
        _COLOURS: list(HEIGHT_COLOURS),
    }


def surface_tile(storage: Storage, job: Job, place: TilePlace) -> bytes:
    """A tile of the surface that a job made.

    Raises:
        NotFound: the job made no surface, or it does not lie on this tile.
        DamagedFile: the stored surface cannot be read.
    """
    key, results = result_key(job, SURFACE_NAME), job.results or {}
    limits = [TileLimits(**one) for one in results.get(_LIMITS, [])]
    if all(one.index(place) is None for one in limits):
        zooms = f"{limits[-1].zoom} to {limits[0].zoom}" if limits else "none"
        raise NotFound(
            f"no tile {place.zoom}/{place.row}/{place.column} of the surface: its zooms are {zooms}, "
            f"rows and columns are in {_LIMITS} of the results"
        )
    low, high = results[_RANGE]
    with _opened(storage, key) as surface:
        return draw_surface_tile(surface, place, (low, high))


def surface_heights(storage: Storage, job: Job, lon_lat: Array) -> list[HeightAt]:
    """The heights of the surface that a job made, at a place or along the line between two.

    Args:
        storage: of the installation.
        job: that made the surface.
        lon_lat: (1 or 2, 2) degrees.

    Raises:
        NotFound: the job made no surface.
        DamagedFile: the stored surface cannot be read.
    """
    with _opened(storage, result_key(job, SURFACE_NAME)) as surface:
        ends = surface.grid.line_sample(lon_lat)
        cells = float(np.hypot(*(ends[-1] - ends[0]))) if np.isfinite(ends).all() else 0.0
        count = 1 if len(ends) == 1 else min(MOST_PLACES, 2 + math.floor(cells))
        share = np.linspace(0.0, 1.0, count)
        places = ends[0] + share[:, None] * (ends[-1] - ends[0])
        bands = surface.at(places, cells / max(count - 1, 1))
        at = surface.grid.lon_lat(places)
        distances_m = share * cells * surface.grid.gsd_m
    rows = zip(distances_m.tolist(), at.tolist(), bands.T.tolist(), strict=True)
    return [_height_at(distance_m, place, values) for distance_m, place, values in rows]


def _height_at(distance_m: float, lon_lat: list[float], values: list[float]) -> HeightAt:
    height_m, sigma_m, views, reason = values
    known, is_inside = math.isfinite(height_m), math.isfinite(reason)
    return HeightAt(
        round(distance_m, 2),
        lon_lat[0],
        lon_lat[1],
        round(height_m, 2) if known else None,
        round(sigma_m, 2) if known else None,
        int(views) if known else 0,
        REASON_LABELS[Reason(int(reason)) if is_inside else Reason.OUTSIDE],
    )


@contextmanager
def _opened(storage: Storage, key: str) -> Iterator[SurfaceImage]:
    """A stored surface, read by windows: from the folder of the storage, or from its bucket."""
    with named_by_row(key):
        path = storage.local(key)
        storage.size(key)
    try:
        with open_surface(path or Address(f"{storage.place.rstrip('/')}/{key}")) as surface:
            yield surface
    except FormatError as error:
        raise DamagedFile(key, str(error)) from error
