"""The process `renew-block`: stage a renewed version of a block from scenes registered on it."""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.db.registrations import RegistrationRow
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.renewal import next_version, read_base, renew_block, stage_renewal
from amers.app.usecases.blocks.renewing_scenes import registered_job, scene_of_job
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.results import store_results
from amers.services.types import part_of

DOCUMENT = "renewal.json"


@dataclass(frozen=True)
class RenewBlock:
    """The inputs of a renewal.

    Attributes:
        block: number, ID or ID@VERSION of the published block.
        jobs: successful jobs of register-scene on this block with the verdict "good", or of
            register-scenes, whose scenes with this verdict are used.
        scenes: scenes of the jobs register-scenes that are used; all of them must be "good". By default
            all "good" scenes.
        version: version of the renewed block; by default the next whole number.
    """

    block: str
    jobs: tuple[UUID, ...]
    scenes: tuple[UUID, ...] = ()
    version: str = ""


def _check(connection: Connection, caller: Token, inputs: RenewBlock) -> None:
    if not inputs.jobs:
        raise InputError("jobs: none given, at least one expected: the scenes that renew the block")
    if len(set(inputs.jobs)) < len(inputs.jobs):
        raise InputError("jobs: one of them is given twice; name each once")
    block = lifecycle.find_published(connection, inputs.block)
    next_version(connection, block, inputs.version)
    _registrations(connection, block, inputs)


def _registrations(connection: Connection, block: Block, inputs: RenewBlock) -> list[RegistrationRow]:
    """The registrations of the jobs."""
    rows = [
        row for job_id in inputs.jobs for row in registered_job(connection, block, job_id, inputs.scenes)
    ]
    unused = set(inputs.scenes) - {row.scene_id for row in rows}
    if unused:
        raise InputError(f"scenes: {min(map(str, unused))}: none of the jobs registered this scene")
    return rows


def _run(work: Work) -> Commit:
    """Write the version; the transaction that ends the job loads it completely or not at all."""
    inputs: RenewBlock = work.inputs
    work.progress(0.0, "reading points")
    with work.database.snapshot() as connection:
        base = read_base(connection, inputs.block, inputs.version)
        rows = _registrations(connection, base.block, inputs)
    # Lives as long as the transaction may need it; it ends with the attempt's process at the latest.
    scratch = tempfile.TemporaryDirectory(prefix="amers-renewal-")
    folder = Path(scratch.name) / "block"
    scenes = [
        scene_of_job(work.database, work.storage, work.settings, row, Path(scratch.name)) for row in rows
    ]
    document = renew_block(
        work.database, work.storage, base, scenes, folder, progress=part_of(work.progress, 0.0, 0.9)
    )
    page = Path(scratch.name) / DOCUMENT
    page.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    keys = store_results(work, {DOCUMENT: page})

    def commit(connection: Connection) -> dict[str, Any]:
        with scratch:
            ingested = stage_renewal(
                connection, work.storage, base, folder, part_of(work.progress, 0.9, 0.1)
            )
        block = ingested.block
        return {
            "number": block.number,
            "id": block.id,
            "version": block.version,
            "state": block.state,
            "points": block.n_points,
            "renews": document["renews"],
            "new_views": document["new_views"],
            "new_points": document["new_points"],
            "proposed_withdrawals": len(document["proposed_withdrawals"]),
            "files": keys,
        }

    return commit


RENEW_BLOCK = Process(
    id="renew-block",
    title="Renew a block",
    description="Stage a new version of a block: add views of scenes that were registered on "
    "it, add points where the block has too few, and remove points that later scenes no longer "
    "find.",
    scope=Scope.ADMIN,
    inputs=RenewBlock,
    outputs={DOCUMENT: "What is renewed: scenes, new views, new points, proposed withdrawals."},
    check=_check,
    run=_run,
    values={
        "number": {"type": "integer", "title": "Number of the staged version"},
        "id": {"type": "string", "title": "Name of the block"},
        "version": {"type": "string", "title": "Version"},
        "state": {"enum": ["staged"], "title": "State: an administrator publishes it"},
        "points": {"type": "integer", "title": "Points of the version"},
        "renews": {"type": "string", "title": "Version that is renewed"},
        "new_views": {"type": "integer", "title": "Views added"},
        "new_points": {"type": "integer", "title": "Points added where the block had too few"},
        "proposed_withdrawals": {"type": "integer", "title": "Points left out as vanished"},
    },
)
