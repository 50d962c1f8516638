"""The heights of the surface of a job, at a place or along a line, for its owner."""

import math
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query

from amers.app.api.deps import DatabaseDep, Reader, StorageDep
from amers.app.api.jobs import JobId
from amers.app.api.models.jobs import SurfaceHeight, SurfaceHeights
from amers.app.api.routes import CallerRoute
from amers.app.errors import InvalidParameter
from amers.app.usecases import jobs
from amers.app.usecases.surface_map import surface_heights
from amers.services.types import Array

router = APIRouter(tags=["jobs"], route_class=CallerRoute)


@router.get("/jobs/{job_id}/map/surface/heights")
def heights(
    *,
    job_id: JobId,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Reader,
    along: Annotated[
        str, Query(description="LON,LAT of a place, or LON,LAT,LON,LAT of both ends of a line, degrees.")
    ] = "",
) -> SurfaceHeights:
    """Return heights of a surface of a job `make-surface`, with their sigma: at a place, or on a line.

    Along a line, cells are read at equal distances, at most 400 of them.
    """
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    found = surface_heights(storage, job, _positions(along))
    return SurfaceHeights(heights=[SurfaceHeight.model_validate(one) for one in found])


def _positions(along: str) -> Array:
    """Longitudes and latitudes (1 or 2, 2) of a text."""
    try:
        numbers = [float(part) for part in along.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 4) or not all(map(math.isfinite, numbers)):
        raise InvalidParameter(
            f"along: {along[:80]!r} found, LON,LAT of a place or LON,LAT,LON,LAT of a line expected"
        )
    lon_lat = np.array(numbers).reshape(-1, 2)
    if (np.abs(lon_lat) > [180.0, 90.0]).any():
        raise InvalidParameter(
            f"along: {along[:80]} found, longitudes of -180 to 180 and latitudes of -90 to 90 expected"
        )
    return lon_lat
