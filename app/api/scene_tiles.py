"""Tiles of registered scenes, of surfaces and of references, in the form of OGC API - Tiles."""

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Response

from amers.app.api.deps import DatabaseDep, Reader, Registrar, SettingsDep, StorageDep
from amers.app.api.jobs import JobId
from amers.app.api.paths import PathNumber
from amers.app.api.routes import CallerRoute
from amers.app.api.tiles import refuse_other_matrix_set
from amers.app.usecases import jobs
from amers.app.usecases.reference_map import reference_tile
from amers.app.usecases.scene_map import Layer, scene_tile
from amers.app.usecases.surface_map import surface_tile
from amers.services.formats.images.map_tiles import tile_media_type
from amers.services.orthorectification.tile_limits import TilePlace


async def _place(matrix_set: str, z: PathNumber, y: PathNumber, x: PathNumber) -> TilePlace:
    refuse_other_matrix_set(matrix_set)
    return TilePlace(z, y, x)


TilePlaceDep = Annotated[TilePlace, Depends(_place)]

router = APIRouter(tags=["tiles"], route_class=CallerRoute)


@router.get(
    "/jobs/{job_id}/map/{layer}/tiles/{matrix_set}/{z}/{y}/{x}",
    response_class=Response,
    responses={
        200: {"description": "An image.", "content": {"image/jpeg": {}, "image/png": {}}},
    },
)
def map_tile(
    *,
    job_id: JobId,
    layer: Layer | Literal["surface"],
    place: TilePlaceDep,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Reader,
) -> Response:
    """Return a tile of a scene (`raw`, `registered`) of a job `map-scene`, or of one's `surface`.

    That of a job `make-surface` has the colours of the heights under a light from the north-west. z, y
    and x are tile matrix, row and column. At the border a tile is transparent.
    """
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    if layer == "surface":
        tile = surface_tile(storage, job, place)
    else:
        tile = scene_tile(storage, job, layer, place)
    # Results never change; browsers ask again each time, so that the token is checked for every tile.
    tag = f'"{job.id}-{job.attempt}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
    return Response(tile, media_type=tile_media_type(tile), headers=headers)


@router.get(
    "/references/{name}/tiles/{matrix_set}/{z}/{y}/{x}",
    response_class=Response,
    responses={
        200: {"description": "An image.", "content": {"image/jpeg": {}, "image/png": {}}},
    },
)
def reference_map_tile(
    *, name: str, place: TilePlaceDep, database: DatabaseDep, settings: SettingsDep, caller: Registrar
) -> Response:
    """Return a tile of a reference image, in grey, at zooms near to that of its pixels.

    z, y and x are tile matrix, row and column. At the border a tile is transparent.
    """
    tile = reference_tile(database, settings, name, place)
    headers = {"Cache-Control": "private, max-age=600", "X-Content-Type-Options": "nosniff"}
    return Response(tile, media_type=tile_media_type(tile), headers=headers)
