"""Blocks: the quality of each, and the life of a block for administrators."""

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Header, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.body import BINARY_BODY, announced_length
from amers.app.api.deps import Admin, DatabaseDep, InstallationDep, PointsReader, SettingsDep, UploadTurn
from amers.app.api.jobs import job_url, status_info
from amers.app.api.models.blocks import (
    AccuracyRecord,
    BlockQuality,
    BlockRecord,
    ChangedBlock,
    DeletedBlock,
    PublishedBlock,
    UploadedBlock,
)
from amers.app.api.models.jobs import StatusInfo
from amers.app.api.routes import CallerRoute
from amers.app.api.sent_body import sent_chunks
from amers.app.auth import is_administrator
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.usecases import jobs
from amers.app.usecases.blocks import lifecycle, uploads
from amers.app.usecases.blocks.deletion import delete_block
from amers.app.usecases.blocks.ingestion import INGEST_BLOCK
from amers.app.usecases.blocks.lifecycle import Published
from amers.app.usecases.jobs import JobRequest
from amers.app.usecases.scenes import SentFile
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.block import quality_document

router = APIRouter(tags=["blocks"], route_class=CallerRoute)


class BlockToIngest(BaseModel):
    """A block to ingest: a folder on the server, or an uploaded archive."""

    model_config = ConfigDict(extra="forbid")

    path: str | None = Field(default=None, description="Path of the folder below AMERS_INGEST_FOLDER.")
    upload: UUID | None = Field(default=None, description="Id from the reply to the upload.")
    publish: bool = Field(default=False, description="Whether to publish the block after its ingestion.")
    priority: int = Field(
        default=0, description="Where blocks overlap, the points of the highest priority are served."
    )


class Priority(BaseModel):
    """The priority of a block among blocks that it overlaps."""

    model_config = ConfigDict(extra="forbid")

    priority: int


@router.put(
    "/blocks/uploads/{name}",
    status_code=201,
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_block(
    *, name: str, request: Request, installation: InstallationDep, caller: Admin
) -> UploadedBlock:
    """Upload a zip or tar archive of a block; send the `upload` of the reply to `POST /blocks`."""
    sent = SentFile(name, sent_chunks(request, installation.database, caller), announced_length(request))
    return UploadedBlock(upload=uploads.receive_block(installation, caller, sent))


@router.post("/blocks", status_code=201)
def ingest(
    *,
    body: BlockToIngest,
    request: Request,
    response: Response,
    database: DatabaseDep,
    settings: SettingsDep,
    caller: Admin,
    idempotency_key: Annotated[str | None, Header()] = None,
) -> StatusInfo:
    """Check and load a block, which is then staged or published; the reply is the job.

    This is an execution of the process `ingest-block`.
    """
    inputs = body.model_dump(mode="json", exclude_none=True)
    with database.transaction() as connection:
        job_request = JobRequest(INGEST_BLOCK.id, inputs)
        job = jobs.execute(connection, settings, caller, job_request, idempotency_key)
    response.headers["Location"] = job_url(request, job)
    return status_info(request, job)


@router.get("/blocks/{reference}/quality")
def quality(*, reference: str, database: DatabaseDep, caller: PointsReader) -> BlockQuality:
    """Return the quality of a block: density, views, stated deviations.

    `accuracy` has the figures that the producer of the block measured, with their references.
    """
    with database.reading() as connection:
        report = lifecycle.block_report(connection, _visible_block(connection, reference, caller))
    accuracy = [AccuracyRecord.model_validate(figure) for figure in report.accuracy]
    stated: dict[str, Any] = accuracy_document(report.stated)
    return BlockQuality(**stated, **quality_document(report.quality), accuracy=accuracy)


@router.post("/blocks/{reference}/publish")
def publish(*, reference: str, database: DatabaseDep, caller: Admin) -> PublishedBlock:
    """Publish a block; the published version of the same block is superseded."""
    with database.transaction() as connection:
        return _published(lifecycle.publish_block(connection, reference))


@router.post("/blocks/{reference}/restore")
def restore(*, reference: str, database: DatabaseDep, caller: Admin) -> PublishedBlock:
    """Publish a block again that was withdrawn or superseded; its published version is superseded."""
    with database.transaction() as connection:
        return _published(lifecycle.restore_block(connection, reference))


@router.patch("/blocks/{reference}")
def prioritise(*, reference: str, body: Priority, database: DatabaseDep, caller: Admin) -> ChangedBlock:
    """Set the priority of a block among blocks that it overlaps."""
    with database.transaction() as connection:
        block = lifecycle.prioritise_block(connection, reference, body.priority)
    return ChangedBlock(block=BlockRecord.model_validate(block))


@router.post("/blocks/{reference}/withdraw")
def withdraw(*, reference: str, database: DatabaseDep, caller: Admin) -> ChangedBlock:
    """Withdraw a block: its points are not served until it is published again."""
    with database.transaction() as connection:
        block = lifecycle.withdraw_block(connection, reference)
    return ChangedBlock(block=BlockRecord.model_validate(block))


@router.delete("/blocks/{reference}")
def delete(*, reference: str, installation: InstallationDep, caller: Admin) -> DeletedBlock:
    """Delete a block that is not published, named ID@VERSION, with its points and chips.

    Its files of chips go into the trash, but for those that other blocks have too. The block cannot be
    restored; what registrations measured at its points stays with them.
    """
    deleted = delete_block(installation, reference)
    return DeletedBlock.model_validate(deleted)


def _published(published: Published) -> PublishedBlock:
    superseded = published.superseded
    return PublishedBlock(
        block=BlockRecord.model_validate(published.block),
        superseded=None if superseded is None else BlockRecord.model_validate(superseded),
    )


def _visible_block(connection: Connection, reference: str, caller: Token | None) -> Block:
    """The block that a caller may see: any for an administrator, a published one for others."""
    if is_administrator(caller):
        return lifecycle.find_shown_block(connection, reference)
    return lifecycle.find_published(connection, reference)
