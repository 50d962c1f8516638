"""The tables `registration` and `measure`: what became of each point in each registered scene."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

import numpy as np
from psycopg.rows import class_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection
from services.types import Measures

COLUMNS = "id, job_id, scene_id, block_versions, options, report, verdict, files, created_at"


@dataclass(frozen=True)
class RegistrationRow:
    """A registered scene.

    Attributes:
        job_id: the job that did it; a job registers once.
        block_versions: id and version of every block whose points were used.
        options: of the registration.
        report: as `report.json` has it.
        files: name to key in the storage.
    """

    id: UUID
    job_id: UUID | None
    scene_id: UUID | None
    block_versions: list[dict[str, Any]]
    options: dict[str, Any]
    report: dict[str, Any]
    verdict: str
    files: dict[str, str]
    created_at: datetime


def insert_registration(
    connection: Connection,
    *,
    job_id: UUID | None,
    scene_id: UUID | None,
    block_versions: list[dict[str, Any]],
    options: dict[str, Any],
    report: dict[str, Any],
    verdict: str,
    files: dict[str, str],
) -> UUID:
    """Store what a registration found."""
    registration_id = uuid4()
    connection.execute(
        "insert into registration"
        " (id, job_id, scene_id, block_versions, options, report, verdict, files)"
        " values (%s, %s, %s, %s, %s, %s, %s, %s)",
        [
            registration_id,
            job_id,
            scene_id,
            Jsonb(block_versions),
            Jsonb(options),
            Jsonb(report),
            verdict,
            Jsonb(files),
        ],
    )
    return registration_id


def insert_measures(connection: Connection, registration_id: UUID, measures: Measures) -> None:
    """Store what happened to each point."""
    columns = (
        "registration_id, point_id, matched, active, reason, score, line, sample, sigma_px,"
        " residual_line_px, residual_sample_px"
    )
    numbers = np.column_stack(
        [measures.score, measures.line_sample, measures.sigma_px, measures.residual_px]
    ).astype(object)
    numbers[np.isnan(numbers.astype(np.float64))] = None
    with connection.cursor().copy(f"copy measure ({columns}) from stdin") as copy:
        for i, point_id in enumerate(measures.point_id):
            copy.write_row(
                (
                    registration_id,
                    int(point_id),
                    bool(measures.matched[i]),
                    bool(measures.active[i]),
                    str(measures.reason[i]),
                    *numbers[i],
                )
            )


def find_by_job(connection: Connection, job_id: UUID) -> RegistrationRow | None:
    """The registration a job made."""
    with connection.cursor(row_factory=class_row(RegistrationRow)) as cursor:
        return cursor.execute(
            f"select {COLUMNS} from registration where job_id = %s", [job_id]
        ).fetchone()
