"""Blocks: what is published, the quality of each, and their life for an administrator."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from app.api.deps import Admin, PointsReader, ReadConnection, SettingsDep, StorageDep, WriteConnection
from app.auth import Scope, allows
from app.db.blocks import Block
from app.db.tokens import Token
from app.usecases import blocks
from services.quality.block import quality_document

router = APIRouter(tags=["blocks"])

GEOJSON = "application/geo+json"


class FolderToIngest(BaseModel):
    """A block on the server.

    Attributes:
        path: of its folder, below AMERS_INGEST_FOLDER.
    """

    path: str


@router.get("/collections/blocks/items")
def items(connection: ReadConnection, caller: PointsReader) -> JSONResponse:
    """The published blocks; all of them for an administrator."""
    found = (
        blocks.list_blocks(connection)
        if _is_admin(caller)
        else blocks.list_blocks(connection, ("published",))
    )
    page = {
        "type": "FeatureCollection",
        "features": [_feature(block) for block in found],
        "numberMatched": len(found),
        "numberReturned": len(found),
        "links": [],
    }
    return JSONResponse(jsonable_encoder(page), media_type=GEOJSON)


@router.get("/collections/blocks/items/{reference}")
def item(reference: str, connection: ReadConnection, caller: PointsReader) -> JSONResponse:
    """One block, by number, ID or ID@VERSION."""
    return JSONResponse(
        jsonable_encoder(_feature(_visible(connection, reference, caller))), media_type=GEOJSON
    )


@router.post("/blocks", status_code=201)
def ingest(
    body: FolderToIngest,
    request: Request,
    response: Response,
    connection: WriteConnection,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Admin,
) -> dict[str, Any]:
    """Check a block on the server and load it, staged; replies when it is done."""
    folder = blocks.folder_to_ingest(settings.ingest_folder, body.path)
    ingested = blocks.ingest_block(connection, storage, folder)
    number = ingested.block.number
    response.headers["Location"] = f"{request.base_url}collections/blocks/items/{number}"
    return {"block": _properties(ingested.block), "quality": quality_document(ingested.quality)}


@router.get("/blocks/{reference}/quality")
def quality(reference: str, connection: ReadConnection, caller: PointsReader) -> dict[str, Any]:
    """The quality figures of a block; `cells` list west, south, area in km2, number of points."""
    block = _visible(connection, reference, caller)
    return quality_document(blocks.find_quality(connection, str(block.number)))


@router.post("/blocks/{reference}/publish")
def publish(reference: str, connection: WriteConnection, caller: Admin) -> dict[str, Any]:
    """Make a block visible, and the version of it that was visible before no longer."""
    published = blocks.publish_block(connection, reference)
    superseded = published.superseded
    return {
        "block": _properties(published.block),
        "superseded": None if superseded is None else _properties(superseded),
    }


@router.post("/blocks/{reference}/withdraw")
def withdraw(reference: str, connection: WriteConnection, caller: Admin) -> dict[str, Any]:
    """Make a block invisible; it can be published again."""
    return {"block": _properties(blocks.withdraw_block(connection, reference))}


def _visible(connection: ReadConnection, reference: str, caller: Token | None) -> Block:
    """The block a caller may see: any for an administrator, the published one for others."""
    if _is_admin(caller):
        return blocks.find_block(connection, reference)
    return blocks.find_published(connection, reference)


def _is_admin(caller: Token | None) -> bool:
    return caller is not None and allows(caller, Scope.ADMIN)


def _properties(block: Block) -> dict[str, Any]:
    return {name: value for name, value in vars(block).items() if name != "outline"}


def _feature(block: Block) -> dict[str, Any]:
    ring = [*block.outline.tolist(), block.outline[0].tolist()]
    return {
        "type": "Feature",
        "id": block.number,
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": _properties(block),
    }
